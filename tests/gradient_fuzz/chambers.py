"""A hollow body, and what its cavity is filled with."""

import numpy as np

import diffsim_ti as ds
from diffsim_ti.mesh.enclosure import Enclosure

from .bodies import random_rotation
from .structures import CELL

INNER = np.arange(4)  # vertices of the cavity


def hollow(rng) -> ds.TetrahedralMesh:
    """A tetrahedron within another: a wedge on each face, of three tetrahedra."""
    corners = 0.5 * CELL * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    corners = corners + 0.05 * CELL * rng.uniform(-1, 1, (4, 3))
    tetrahedra = []
    for a, b, c in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]):
        tetrahedra += [[a, b, c, c + 4], [a, b, b + 4, c + 4], [a, a + 4, b + 4, c + 4]]
    mesh = ds.TetrahedralMesh(np.concatenate([corners, 3 * corners]), tetrahedra, fix_orientation=True)
    return mesh.rotated(*random_rotation(rng))


def cavity(mesh) -> np.ndarray:
    """Its walls, as vertex indices."""
    return mesh.surface_faces[np.isin(mesh.surface_faces[:, :3], INNER).all(1)]


def outer_triangles(mesh) -> np.ndarray:
    """Triangles of the surface, as vertex indices, but for those of the cavity."""
    outer = ~np.isin(mesh.surface_faces[:, :3], INNER).all(1)
    return mesh.surface_triangles[np.repeat(outer, len(mesh.surface_triangles) // len(outer))]


def chamber(kind: str, rng, mesh, start: np.ndarray, steps: int, duration: float, E: float):
    """One of structures.CHAMBERS: a gas whose pressure is a share of the modulus, or a volume near that of the start."""
    name, how = kind.split(" ", 1)
    walls = cavity(mesh)
    if name == "gas":
        outside, size = 0.3 * E, 0.3 * E
    else:
        outside, size = 0.0, Enclosure(walls, [], None).volume(start)

    def around(*shape):
        return size * (1 + (0.1 if name == "gas" else 0.01) * rng.uniform(-1, 1, shape))

    if how == "constant":
        given = around()
    elif how == "per step":
        given = around(steps)
    else:
        given = duration * np.array([0.0, rng.uniform(0.2, 0.8), 1.0]), around(3)
    if name == "gas":
        return ds.GasChamber(given, walls, outside, rng.uniform(1.0, 1.5))
    return ds.FilledChamber(given, walls)
