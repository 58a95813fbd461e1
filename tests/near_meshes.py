"""Meshes with parts of their surface near each other at rest: a slit, a C, a box shaken until it has slivers."""

import numpy as np

import diffsim_ti as ds


def slit(gap=1e-4, cells=2, size=0.1, base=0.01):
    """A block with a slit from its top down to its middle, `base` wide at its end and `gap` wide above."""
    n = 2 * cells + 1
    grid = ds.TetrahedralMesh.create_box([n + 1, 2 * cells + 1, cells + 1], [n, 2 * cells, cells])
    (x, y, z), centre = grid.vertices.T, grid.centroids
    open_ = (centre[:, 0] > cells) & (centre[:, 0] < cells + 1) & (centre[:, 1] > cells)
    half = np.where(y > cells, gap, base) / 2
    side = np.where(x > cells + 0.5, 1, -1)
    outer = np.interp(side * (x - cells - 0.5), [0.5, cells + 0.5], [0, 1])
    place = side * (half + outer * (size / 2 - half))
    return without(np.column_stack([place, y * size / (2 * cells), z * size / (2 * cells)]), grid.tetrahedra[~open_])


def c_shape(gap=1e-3, cells=8, size=0.1):
    """A bar bent to a ring whose ends face each other `gap` apart."""
    bar = ds.TetrahedralMesh.create_box([cells + 1, 2, 2], [1.0, 0.4, 0.4])
    radius = size * (0.3 + bar.vertices[:, 1])
    angle = (2 * np.pi - gap / (0.3 * size)) * bar.vertices[:, 0]
    x = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), size * bar.vertices[:, 2]])
    return ds.TetrahedralMesh(x, bar.tetrahedra, fix_orientation=True)


def shaken(seed, resolution=4, size=0.1):
    """A box whose vertices are moved at random, as far as its tetrahedra bear it, then flattened in a random direction."""
    rng = np.random.default_rng(seed)
    box = ds.TetrahedralMesh.create_box(resolution, size)
    x, cell = np.array(box.vertices), size / (resolution - 1)
    for i in rng.permutation(len(x)):
        trial = x.copy()
        trial[i] += rng.normal(size=3) * 0.2 * cell
        corners = trial[box.tetrahedra]
        if np.linalg.det(corners[:, 1:] - corners[:, :1]).min() > 1e-2 * cell**3:
            x = trial
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    return ds.TetrahedralMesh(x - 0.7 * np.outer(x @ n, n), box.tetrahedra)


def without(vertices, tetrahedra):
    """The mesh of these tetrahedra, and only of vertices that they use."""
    used, tetrahedra = np.unique(tetrahedra, return_inverse=True)
    return ds.TetrahedralMesh(vertices[used], tetrahedra.reshape(-1, 4))
