"""Bodies of odd shapes, for falls that no scanned mesh shows: sheets, combs, springs, slivers, one tetrahedron alone."""

import warnings

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh


def of_cells(cells: np.ndarray) -> TetrahedralMesh:
    """A body of unit cubes, those of a grid where `cells` is true."""
    box = TetrahedralMesh.create_box(np.array(cells.shape) + 1, np.array(cells.shape, float))
    mesh = box.tetrahedra[np.repeat(cells.ravel(), 6)]
    used, tetrahedra = np.unique(mesh, return_inverse=True)
    return TetrahedralMesh(box.vertices[used], tetrahedra.reshape(-1, 4))


def tetrahedron() -> TetrahedralMesh:
    return TetrahedralMesh(np.array([[0, 0, 0], [1, 0.1, 0], [0.2, 1, 0], [0.3, 0.2, 0.9]]), np.array([[0, 1, 2, 3]]))


def sheet() -> TetrahedralMesh:
    """Fifty times as wide as it is thick, lying aslant."""
    return TetrahedralMesh.create_box((14, 2, 14), (1, 0.02, 1)).rotated([1, 0, 0.3], 0.3)


def comb() -> TetrahedralMesh:
    """A bar with five teeth, which point down."""
    cells = np.zeros((9, 6, 2), bool)
    cells[:, 4:], cells[::2] = True, True
    return of_cells(cells)


def hollow_box() -> TetrahedralMesh:
    """Walls of one cell around nothing."""
    cells = np.ones((7, 7, 7), bool)
    cells[1:-1, 1:-1, 1:-1] = False
    return of_cells(cells)


def spring() -> TetrahedralMesh:
    """A wire wound three times."""
    bar = TetrahedralMesh.create_box((3, 91, 3), (0.12, 1, 0.12), origin=(-0.06, 0, -0.06))
    x, s, z = bar.vertices.T
    turn, r = 6 * np.pi * s, 0.5 + x
    return TetrahedralMesh(
        np.stack([r * np.cos(turn), s + z, r * np.sin(turn)], 1), bar.tetrahedra, fix_orientation=True
    )


def dumb_bell() -> TetrahedralMesh:
    """Two blocks that a thin bar joins."""
    cells = np.zeros((12, 4, 4), bool)
    cells[:4], cells[-4:], cells[:, 1:2, 1:2] = True, True, True
    return of_cells(cells)


def hinge() -> TetrahedralMesh:
    """Two blocks that share one edge."""
    cells = np.zeros((6, 6, 3), bool)
    cells[:3, :3], cells[3:, 3:] = True, True
    return of_cells(cells)


def two_pieces() -> TetrahedralMesh:
    """A block beside a smaller one: two bodies in one mesh."""
    block = TetrahedralMesh.create_cube(4)
    return TetrahedralMesh.joined([block, block.scaled(0.4).rotated([0, 1, 1], 0.5).translated([1.6, 0.2, 0])])


def slivers() -> TetrahedralMesh:
    """Random points of a ball, joined as Delaunay has it, with all the slivers of that but the very worst."""
    from scipy.spatial import Delaunay

    points = np.random.default_rng(4).standard_normal((400, 3))
    points *= (np.random.default_rng(5).random((400, 1)) ** (1 / 3)) / np.linalg.norm(points, axis=1, keepdims=True)
    tetrahedra = Delaunay(points).simplices
    corners = points[tetrahedra]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    edges = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=-1).max((1, 2))
    good = tetrahedra[np.abs(volumes) > 1e-3 * edges**3]
    used, good = np.unique(good, return_inverse=True)
    return TetrahedralMesh(points[used], good.reshape(-1, 4), fix_orientation=True)


ODD_BODIES = (tetrahedron, sheet, comb, hollow_box, spring, dumb_bell, hinge, two_pieces, slivers)


def save_all(folder) -> list:
    """Write them all, as files of their names; returns the paths."""
    paths = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of slivers
        for body in ODD_BODIES:
            paths.append(folder / f"{body.__name__}.vtu")
            body().save(paths[-1])
    return paths
