"""Small bodies: single tetrahedra, cells in two patterns, jittered ones, pairs that nearly touch, one that is folded."""

import numpy as np

import diffsim_ti as ds
from diffsim_ti.mesh.reference_element import MID_EDGES

from .structures import CELL

SELF_WIDTH = 0.25 * CELL  # what pairs of one body stay apart by at rest


def direction(rng) -> np.ndarray:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def random_rotation(rng) -> tuple[np.ndarray, float]:
    return direction(rng), float(rng.uniform(0.2, 3.0))


def jittered(mesh, rng, share: float):
    noise = share * CELL * rng.uniform(-1, 1, mesh.vertices.shape)
    return ds.TetrahedralMesh(mesh.vertices + noise, mesh.tetrahedra)


def with_part(mesh, rng):
    """With a set of tetrahedra of its own."""
    count = int(rng.integers(1, mesh.num_tetrahedra + 1))
    return mesh.with_tetrahedron_set("part", np.sort(rng.permutation(mesh.num_tetrahedra)[:count]))


def with_middles(mesh, start, rng, most: float = 0.03):
    """(the same body of ten-node tetrahedra, some of whose edges are bent by `most` cells at most, and the start of all
    nodes)."""
    straight = mesh.quadratic()
    ends = straight.elements[:, MID_EDGES]
    moved, started = np.zeros((2, *straight.vertices.shape))
    started[: len(start)] = start - mesh.vertices
    started[straight.elements[:, 4:]] = started[ends].mean(2)
    if rng.random() < 0.6:
        middles = np.unique(straight.elements[:, 4:])
        moved[middles] = most * CELL * rng.uniform(-1, 1, (len(middles), 3))
    bent = ds.TetrahedralMesh(
        straight.vertices + moved,
        straight.elements,
        vertex_sets=straight.vertex_sets,
        tetrahedron_sets=straight.tetrahedron_sets,
        surface_sets={name: straight.surface_triangles[rows] for name, rows in straight.surface_sets.items()},
    )
    return bent, bent.vertices + started


def single(rng):
    corners = CELL * np.array([[0, 0, 0], [1, 0, 0.1], [0.1, 1, 0], [0, 0.2, 1.0]]) + 0.1 * CELL * rng.uniform(
        -1, 1, (4, 3)
    )
    return ds.TetrahedralMesh(corners, [[0, 1, 2, 3]], fix_orientation=True)


def body(rng):
    """1 to 12 tetrahedra."""
    kind = rng.integers(0, 4)
    if kind == 0:
        return single(rng).rotated(*random_rotation(rng))
    cells = [(2, 2, 2), (3, 2, 2), (2, 3, 2)][rng.integers(0, 3)]
    size = tuple(CELL * (np.array(cells) - 1))
    mesh = ds.TetrahedralMesh.create_box(cells, size, pattern=["kuhn", "five"][rng.integers(0, 2)])
    mesh = jittered(mesh, rng, 0.1) if rng.random() < 0.6 else mesh
    return mesh.rotated(*random_rotation(rng)) if rng.random() < 0.7 else mesh


def pair(rng):
    """(mesh of two bodies less than SELF_WIDTH apart, start positions, the way from the first to the second)."""
    gap, kind = SELF_WIDTH * rng.uniform(0.3, 0.8), rng.integers(0, 3)
    if kind == 0:  # edge across edge
        corners = CELL * np.array([[-0.5, 0, 0], [0.5, 0, 0], [0, -0.8, -0.5], [0, -0.8, 0.5]])
        lower = ds.TetrahedralMesh(corners, [[0, 1, 2, 3]], fix_orientation=True)
        upper = lower.rotated([1, 0, 1], np.pi).rotated(direction(rng), 0.1)
    else:
        lower, upper = (
            ds.TetrahedralMesh.create_box(2, CELL, pattern="five").translated([-CELL / 2] * 3) for _ in range(2)
        )
        upper = upper.rotated(*random_rotation(rng))
        lower = lower.rotated(*random_rotation(rng)) if kind == 1 else lower  # corner on corner, else corner on face
    top, low = lower.vertices[np.argmax(lower.vertices[:, 1])], upper.vertices[np.argmin(upper.vertices[:, 1])]
    under = np.array([0.0, top[1], 0.0]) if kind != 1 else top
    aside = 0.15 * CELL * rng.uniform(-1, 1, 3) * [1, 0, 1] * (kind != 1)
    upper = upper.translated(under - low * ([1, 1, 1] if kind != 0 else [0, 1, 0]) + [0, gap, 0] + aside)
    axis, angle = random_rotation(rng)
    mesh = ds.TetrahedralMesh.joined([lower, upper]).rotated(axis, angle)
    way = (
        ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [[0, 1, 2, 3]])
        .rotated(axis, angle)
        .vertices[2]
    )
    return mesh, np.array(mesh.vertices), way


def fold(rng):
    """A U of cells, and a start in which its legs are bent inwards until they nearly touch."""
    grid = ds.TetrahedralMesh.create_box((4, 3, 2), (3 * CELL, 2 * CELL, CELL), pattern="five")
    middle = grid.vertices[grid.tetrahedra].mean(1)
    kept = ~((np.abs(middle[:, 0] - 1.5 * CELL) < 0.5 * CELL) & (middle[:, 1] > CELL))
    mesh = ds.TetrahedralMesh(grid.vertices, grid.tetrahedra[kept])
    x, height = mesh.vertices, np.maximum(mesh.vertices[:, 1] - CELL, 0) / CELL
    inward = 0.5 * (CELL - SELF_WIDTH * rng.uniform(0.4, 0.8))
    start = x + np.outer(np.sign(1.5 * CELL - x[:, 0]) * inward * height, [1.0, 0, 0])
    start = start + 0.01 * CELL * rng.uniform(-1, 1, start.shape)  # edges of its legs are not parallel
    return mesh, start, np.array([1.0, 0, 0])
