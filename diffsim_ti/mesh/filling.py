"""Closed surfaces filled with tetrahedra, by TetGen (the extra `surfaces`)."""

from pathlib import Path

import numpy as np

from diffsim_ti.mesh.sets import components

SURFACES = (".stl", ".obj", ".ply", ".off")  # files that hold surfaces alone
INSTALL = 'pip install "diffsim-ti[surfaces]"'
ELSEWHERE = "or fill it elsewhere, with Gmsh or fTetWild"
MEAN_RATIO = 1.5  # largest circumradius over shortest edge


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(points, triangles) of a file; other cells are left out."""
    import meshio

    try:
        mesh = meshio.read(path)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{path}: meshio cannot read this surface ({error}); check that it is complete") from error
    cells = {block.type: block.data for block in mesh.cells}
    if "quad" in cells:
        quads = cells["quad"]
        cells["cut"] = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    triangles = [cells[kind] for kind in ("triangle", "cut") if kind in cells]
    if not triangles:
        raise ValueError(
            f"{path} holds no triangles, but {', '.join(cells) or 'nothing'}; export a surface of triangles"
        )
    return np.asarray(mesh.points, np.float64), np.concatenate(triangles).astype(np.int64)


def filled(points: np.ndarray, triangles: np.ndarray, size: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(vertices, tetrahedra) within a closed surface, all of whose points and triangles stay; closed parts within others
    bound cavities.

    size: edge length that tetrahedra reach at most, about [m]; default as large as their quality allows.
    Raises ValueError for a surface that is open, meets itself or is not finite, and where TetGen is missing.
    Si 2015, TetGen, a Delaunay-Based Quality Tetrahedral Mesh Generator, doi:10.1145/2629697.
    """
    points, triangles = welded(points, triangles)
    check_closed(points, triangles)
    if size is not None and not (np.isfinite(size) and size > 0):
        raise ValueError(f"size must be a length above 0 [m], got {size}; None lets tetrahedra grow inwards")
    volume = {} if size is None else dict(fixedvolume=True, maxvolume=size**3 / 72**0.5)
    try:
        import tetgen
    except ImportError as error:
        raise ValueError(f"surfaces are filled by TetGen, which is missing: {INSTALL}, {ELSEWHERE}") from error
    mesher = tetgen.TetGen(points, triangles.astype(np.int32))
    shape = dict(quality=True, minratio=MEAN_RATIO, mindihedral=10.0)
    try:  # without nofacewritten, TetGen leaves files of refused triangles in the working folder
        made = mesher.tetrahedralize(nobisect=True, nofacewritten=True, **shape, **volume)
    except RuntimeError as error:
        raise ValueError(
            f"TetGen cannot fill the surface ({' '.join(str(error).split())}): its triangles may meet each other; mend it, "
            f"with MeshLab say, {ELSEWHERE}"
        ) from error
    return _without_cavities(np.asarray(made[0], np.float64), np.asarray(made[1], np.int64), points, triangles)


def _without_cavities(vertices, tetrahedra, points, triangles) -> tuple[np.ndarray, np.ndarray]:
    """Without tetrahedra of closed parts of the surface that lie within another: there, a ray leaves by an even number of
    triangles. A surface in one piece has none."""
    part = components(triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel(), len(points))
    if len(np.unique(part[triangles[:, 0]])) == 1:
        return vertices, tetrahedra
    turn, _ = np.linalg.qr(np.array([[0.31, 0.77, 0.13], [0.59, 0.23, 0.83], [0.47, 0.91, 0.37]]))  # rays miss edges
    a, b, c = (points @ turn)[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    centers, inside = vertices[tetrahedra].mean(1) @ turn, []
    for center in np.array_split(centers, 1 + len(centers) * len(triangles) // 1_000_000):
        at = center[:, None]
        ways = [(q - p, at - p) for p, q in ((a, b), (b, c), (c, a))]  # seen along the ray
        sides = [np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]) for u, v in ways]
        above = np.einsum("ij,kij->ki", normal, at - a) * np.sign(normal[:, 2]) < 0
        inside.append((((sides[0] == sides[1]) & (sides[1] == sides[2]) & above).sum(1) % 2) == 1)
    tetrahedra = tetrahedra[np.concatenate(inside)]
    used, corners = np.unique(tetrahedra, return_inverse=True)
    return vertices[used], corners.reshape(tetrahedra.shape).astype(np.int64)


def welded(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """With one point for all that lie within 1e-9 of the size (an .stl has three for each triangle), and without triangles
    that have no area then."""
    if not np.all(np.isfinite(points[triangles])):
        raise ValueError("points of the surface must be finite; export it again")
    used, corners = np.unique(triangles, return_inverse=True)
    points, corners = points[used], corners.reshape(triangles.shape)
    grid = np.round((points - points.min(0)) / (1e-9 * max(float(np.ptp(points, 0).max()), 1e-300)))
    _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    triangles = place.ravel()[corners]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(1)
    return points[first], triangles[whole]


def check_closed(points: np.ndarray, triangles: np.ndarray) -> None:
    """Each edge belongs to two triangles, or to four, six ... where parts touch."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    known, count = np.unique(edges, axis=0, return_counts=True)
    odd = known[count % 2 == 1]
    if len(triangles) < 4 or len(odd):
        at = f"; the first is at {np.array2string(points[odd[0]].mean(0), precision=4)}" if len(odd) else ""
        raise ValueError(
            f"the surface is not closed: {len(odd)} of {len(known)} edges belong to an odd number of triangles{at}; close "
            "it (in Blender: select non-manifold edges, fill; in MeshLab: close holes)"
        )
