"""Meshes of ten-node tetrahedra to try things on: straight, curved, numbered at random."""

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh

# The ways to number the corners of a tetrahedron that keep its volume positive, with the mid-edge vertices.
EVEN = [[1, 2, 0, 3], [2, 0, 1, 3], [0, 2, 3, 1], [1, 0, 3, 2], [3, 2, 1, 0], [0, 1, 2, 3]]
MIDDLES = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]


def turned(corners: list[int]) -> list[int]:
    """Columns of a ten-node element for another order of its corners."""
    place = {frozenset(pair): 4 + k for k, pair in enumerate(MIDDLES)}
    return corners + [place[frozenset((corners[a], corners[b]))] for a, b in MIDDLES]


def box(pattern="five", **more) -> TetrahedralMesh:
    """With sets of vertices, tetrahedra and triangles."""
    mesh = TetrahedralMesh.create_box((3, 4, 3), (1.0, 2.0, 1.5), pattern, **more)
    mesh = mesh.with_tetrahedron_set("core", [1, 2, 3]).with_tetrahedron_set("low", [3, 4, 9])
    return mesh.with_vertex_set("tip", [3]).with_surface_set("lid", lambda x, n: n[:, 1] > 0.9)


def wavy(size=0.1, mesh=None) -> TetrahedralMesh:
    """Curved smoothly, all edges."""
    mesh = box().quadratic() if mesh is None else mesh
    x, y, z = mesh.vertices.T
    moved = mesh.vertices + size * np.stack([np.sin(2 * y + z), np.cos(3 * z) * x, np.sin(2 * x) * y], 1)
    return with_vertices(mesh, moved)


def crumpled(size=0.02, seed=0, mesh=None) -> TetrahedralMesh:
    """Curved at random, all edges."""
    mesh = box().quadratic() if mesh is None else mesh
    return with_vertices(mesh, mesh.vertices + size * np.random.default_rng(seed).normal(size=mesh.vertices.shape))


def ring(cells: int) -> TetrahedralMesh:
    """A quarter of a ring of radii 1 and 2 and height 1, curved about z; sides xmin and xmax are the inner and the outer."""
    box = TetrahedralMesh.create_box(
        (cells + 1, 2 * cells + 1, cells + 1), (1, np.pi / 2, 1), "five", (1, 0, 0)
    ).quadratic()
    r, angle, z = box.vertices.T
    return with_vertices(box, np.stack([r * np.cos(angle), r * np.sin(angle), z], 1))


def ball(cells: int, radius=0.1) -> TetrahedralMesh:
    """From a cube; the surface's vertices, mid-edge ones too, lie on the sphere."""
    cube = TetrahedralMesh.create_box(cells + 1, 2.0, "five", (-1, -1, -1))
    x = np.array(cube.vertices)
    length = np.linalg.norm(x, axis=1)
    x *= (radius * np.abs(x).max(1) / np.where(length > 0, length, 1))[:, None]
    mesh = TetrahedralMesh(x, cube.tetrahedra).quadratic()
    x, surface = np.array(mesh.vertices), mesh.surface_vertices
    x[surface] *= radius / np.linalg.norm(x[surface], axis=1)[:, None]
    return with_vertices(mesh, x)


def turned_by(mesh, old, new) -> TetrahedralMesh:
    """Turned so that one unit vector becomes another."""
    old, new = np.asarray(old, float), np.asarray(new, float)
    across = np.cross(old, new)
    if not across.any():
        return mesh
    return mesh.rotated(across, np.arctan2(np.linalg.norm(across), old @ new))


def with_vertices(mesh, vertices) -> TetrahedralMesh:
    triangles = {name: mesh.surface_triangles[rows] for name, rows in mesh.surface_sets.items()}
    return TetrahedralMesh(
        vertices,
        mesh.elements,
        vertex_sets=dict(mesh.vertex_sets),
        tetrahedron_sets=dict(mesh.tetrahedron_sets),
        surface_sets=triangles,
    )


def renumbered(mesh, seed=0) -> tuple[TetrahedralMesh, np.ndarray, np.ndarray]:
    """(mesh with vertices, tetrahedra and corners numbered at random, new index of each vertex, old tetrahedron of each)."""
    rng = np.random.default_rng(seed)
    new, order = rng.permutation(mesh.num_vertices), rng.permutation(mesh.num_tetrahedra)
    vertices = np.empty_like(mesh.vertices)
    vertices[new] = mesh.vertices
    columns = np.array([turned(corners) for corners in EVEN])[rng.integers(0, len(EVEN), mesh.num_tetrahedra)]
    elements = np.take_along_axis(mesh.elements[order], columns[:, : mesh.elements.shape[1]], 1)
    return TetrahedralMesh(vertices, new[elements]), new, order


def face_rule(degree=8) -> tuple[np.ndarray, np.ndarray]:
    """(barycentric coordinates, weights that sum to one) of a rule on triangles."""
    x, w = np.polynomial.legendre.leggauss(degree)
    x, w = (x + 1) / 2, w / 2
    s, t = (part.ravel() for part in np.meshgrid(x, x, indexing="ij"))
    weights = 2 * (w[:, None] * w).ravel() * (1 - s)
    t = t * (1 - s)
    return np.stack([1 - s - t, s, t], 1), weights


def six(L: np.ndarray) -> np.ndarray:
    """Shape functions of a six-node face at barycentric coordinates, shape (k, 6)."""
    return np.concatenate([L * (2 * L - 1), 4 * L * np.roll(L, -1, 1)], 1)


def six_by(L: np.ndarray) -> np.ndarray:
    """Their derivatives by L1 and L2, shape (k, 6, 2)."""
    by = np.array([[-1.0, -1], [1, 0], [0, 1]])
    corners = (4 * L - 1)[:, :, None] * by
    return np.concatenate([corners, 4 * (L[:, :, None] * np.roll(by, -1, 0) + np.roll(L, -1, 1)[:, :, None] * by)], 1)
