"""Bodies with cavities: a hollow cube, a cube with a pit, thick-walled spheres."""

import numpy as np

import diffsim_ti as ds


def _without(mesh, lost, name="cavity") -> ds.TetrahedralMesh:
    """The mesh without the tetrahedra of a box of cells, whose walls are the surface set `name`."""
    out = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra[~lost(mesh.centroids)])
    low, high = np.ptp(out.vertices, 0) * 0 + out.vertices.min(0), out.vertices.max(0)
    x = out.vertices[out.surface_triangles]
    outer = ((np.abs(x - low) < 1e-9).all(1) | (np.abs(x - high) < 1e-9).all(1)).any(1)
    return out.with_surface_set(name, np.flatnonzero(~outer))


def shaken(mesh, amount, seed=0, keep=None) -> ds.TetrahedralMesh:
    """Vertices moved at random, but for components where `keep` is true."""
    moved = amount * np.random.default_rng(seed).uniform(-1, 1, mesh.vertices.shape)
    if keep is not None:
        moved[keep] = 0
    surface = {name: mesh.surface_triangles[rows] for name, rows in mesh.surface_sets.items()}
    sets = dict(surface_sets=surface, vertex_sets=dict(mesh.vertex_sets))
    return ds.TetrahedralMesh(mesh.vertices + moved, mesh.tetrahedra, **sets)


def hollow_cube(cells=3, size=0.3, shake=0.005) -> ds.TetrahedralMesh:
    """A cube without its cells in the middle, "cavity", with a vertex set "bottom"."""
    mesh = ds.TetrahedralMesh.create_box((cells + 1,) * 3, size)
    h = size / cells
    mesh = _without(mesh, lambda x: ((x > h) & (x < size - h)).all(1))
    return shaken(mesh.with_vertex_set("bottom", mesh.vertices[:, 2] < 1e-9), shake)


def pitted_cube(size=0.3, shake=0.005) -> ds.TetrahedralMesh:
    """Half of a hollow cube, cut at z = 0, where its vertices are the set "cut"; "corner" holds the rest."""
    mesh = ds.TetrahedralMesh.create_box((4, 4, 3), (size, size, 2 * size / 3))
    h = size / 3
    mesh = _without(mesh, lambda x: ((x[:, :2] > h) & (x[:, :2] < size - h)).all(1) & (x[:, 2] < h))
    cut = mesh.vertices[:, 2] < 1e-9
    mesh = mesh.with_vertex_set("cut", cut).with_vertex_set("corner", [0, 1])
    keep = np.zeros(mesh.vertices.shape, bool)
    keep[cut, 2] = True
    return shaken(mesh, shake, keep=keep)


def eighth_sphere(inner=1.0, outer=1.2, layers=2, around=6) -> ds.TetrahedralMesh:
    """An eighth of a thick-walled sphere about the origin; vertex sets x0, y0, z0 on its planes, surface sets "inside",
    "outside". A triangle cut into `around` strips is projected; each of the prisms becomes three tetrahedra.
    """
    n = around
    grid = [(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]
    place = {key: k for k, key in enumerate(grid)}
    flat = np.array(grid, float) / n
    angle = np.sin(0.5 * np.pi * flat) / np.linalg.norm(np.sin(0.5 * np.pi * flat), axis=1, keepdims=True)
    triangles = []
    for i in range(n):
        for j in range(n - i):
            a, b, c = (i, j), (i + 1, j), (i, j + 1)
            triangles.append([place[p[0], p[1], n - sum(p)] for p in (a, b, c)])
            if i + j < n - 1:
                triangles.append([place[p[0], p[1], n - sum(p)] for p in ((i + 1, j), (i + 1, j + 1), (i, j + 1))])
    m, radii = len(grid), np.linspace(inner, outer, layers + 1)
    vertices = np.concatenate([r * angle for r in radii])
    tetrahedra = []
    for k in range(layers):
        for t in triangles:
            low, mid, high = sorted(t)  # the same diagonals on both sides of a quadrilateral
            a, b, c, d, e, f = (v + s * m for s in (k, k + 1) for v in (low, mid, high))
            tetrahedra += [[a, b, c, f], [a, b, f, e], [a, e, f, d]]
    mesh = ds.TetrahedralMesh(vertices, tetrahedra, fix_orientation=True)
    for name, d in zip(("x0", "y0", "z0"), range(3)):
        mesh = mesh.with_vertex_set(name, np.abs(mesh.vertices[:, d]) < 1e-9)
    radius = np.linalg.norm(mesh.vertices[mesh.surface_triangles], axis=2)
    mesh = mesh.with_surface_set("inside", np.flatnonzero((np.abs(radius - inner) < 1e-9).all(1)))
    return mesh.with_surface_set("outside", np.flatnonzero((np.abs(radius - outer) < 1e-9).all(1)))
