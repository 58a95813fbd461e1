"""A scene on a coarser mesh of the same body: one that is given, or a grid of half the cells."""

import numpy as np

from diffsim_ti.accuracy.finer import HELD, is_named
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.grid import PATTERNS, box
from diffsim_ti.scene import Scene


def halved_grid(mesh: TetrahedralMesh) -> TetrahedralMesh | None:
    """A mesh of `create_box`, moved or stretched, with every other plane of each direction that has an even number of cells;
    None for other meshes. Sets are carried along by their vertices."""
    axes = [np.unique(np.round(x, 12)) for x in mesh.vertices.T]
    counts = [len(axis) for axis in axes]
    pattern = _pattern(mesh, axes, counts)
    kept = [slice(None, None, 2 if n > 2 and n % 2 else 1) for n in counts]
    if pattern is None or all(part.step == 1 for part in kept):
        return None
    fine = np.arange(mesh.num_vertices).reshape(counts)[tuple(kept)]
    _, tetrahedra, _ = box(fine.shape, 1.0, pattern, 0.0)
    own = fine.ravel()
    place = np.full(mesh.num_vertices, -1)
    place[own] = np.arange(len(own))
    sets = {name: place[rows][place[rows] >= 0] for name, rows in mesh.vertex_sets.items()}
    out = TetrahedralMesh(mesh.vertices[own], tetrahedra, vertex_sets=sets)
    for name, rows in mesh.surface_sets.items():
        within = np.isin(own[out.surface_triangles], mesh.surface_triangles[rows]).all(1)
        out = out.with_surface_set(name, np.flatnonzero(within)) if within.any() else out
    return out


def _pattern(mesh: TetrahedralMesh, axes: list[np.ndarray], counts: list[int]) -> str | None:
    """The pattern of create_box whose tetrahedra a mesh has, its vertices being a grid of axes; else None."""
    if mesh.order != 1 or np.prod(counts) != mesh.num_vertices:
        return None
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    if not np.allclose(grid, mesh.vertices, rtol=0, atol=1e-9 * np.ptp(grid, 0).max()):
        return None
    return next((p for p in PATTERNS if np.array_equal(box(counts, 1.0, p, 0.0)[1], mesh.tetrahedra)), None)


def on_coarser(scene: Scene, mesh: TetrahedralMesh) -> Scene:
    """The scene with ten-node tetrahedra of another linear mesh of its body, which has the named sets that the scene names.
    What is held by indices is held where the other mesh's vertices lie between such vertices alone.

    Raises ValueError for what cannot be carried over: numbers for each tetrahedron, terms on vertices by their indices.
    """
    given = dict(scene.arguments)
    several = [n for n in (*scene.material.inputs, "density") if np.ndim(scene.inputs.values[n])]
    if several:
        raise ValueError(f"{several[0]} is given for each tetrahedron")
    fixed, at = given["fixed"], scene.mesh.locate(mesh.vertices, nearest=True).matrix
    if not is_named(fixed):
        held = np.zeros(scene.mesh.num_vertices)
        held[scene.mesh.vertex_indices(fixed)] = 1
        if not np.any(own := at @ held > 1 - 1e-6):
            raise ValueError(
                "none of its vertices lies between vertices that are fixed by their indices: name them as a set"
            )
        mesh, given["fixed"] = mesh.with_vertex_set(HELD, own), HELD
    nodes = mesh.quadratic()
    for name, origin in (("initial_positions", scene.mesh.vertices), ("initial_velocities", 0.0)):
        if np.ndim(given[name]) == 2:
            own = at @ (np.asarray(given[name], np.float64) - origin)
            given[name] = nodes.from_corners @ (own + (mesh.vertices if name == "initial_positions" else 0.0))
    return Scene(**given | dict(mesh=nodes, volume="tetrahedra"))
