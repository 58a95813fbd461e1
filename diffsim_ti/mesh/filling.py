"""Surfaces filled with tetrahedra: closed ones by TetGen, others by fTetWild (the extras `surfaces` and `dirty`)."""

import importlib.util
import logging
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.checks import oriented
from diffsim_ti.mesh.geometry import edge_matrices, edges_of, signed_volumes, sorted_faces
from diffsim_ti.mesh.sets import components, places_of_triangles

SURFACES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")  # files that hold surfaces alone
INSTALL = 'pip install "diffsim-ti[surfaces]"'
INSTALL_DIRTY = 'pip install "diffsim-ti[dirty]"'
ELSEWHERE = "or fill it elsewhere, with Gmsh or fTetWild"
MOST = 2_000_000  # triangles of a surface that is cut
LONGEST = 600.0  # seconds that fTetWild may take
CELLS = 20  # edges along the diagonal that fTetWild takes where no size is given
MEAN_RATIO = 1.5  # largest circumradius over shortest edge


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """(points, triangles, name of each part -> rows of its triangles) of a file, by trimesh; polygons are cut into
    triangles. A file of one part names none."""
    try:
        import trimesh
    except ImportError as error:
        raise ValueError(f"files of surfaces are read by trimesh, which is missing: {INSTALL}") from error
    parts, log = None, logging.getLogger("trimesh")
    loud, log.disabled = log.disabled, True  # it writes tracebacks of what it then raises
    try:
        for split in ("split_objects", "split_groups") if path.suffix.lower() == ".obj" else ("",):
            options = dict(maintain_order=True, skip_materials=True, group_material=False) if split else {}
            scene = trimesh.load_scene(path, process=False, **options, **({split: True} if split else {}))
            found = [(str(node), scene.graph[node]) for node in scene.graph.nodes_geometry]
            if parts is None or len(found) > len(parts):
                parts = [(name, matrix, scene.geometry[geometry]) for name, (matrix, geometry) in found]
    except Exception as error:
        raise ValueError(f"{path}: trimesh cannot read this surface ({error}); check that it is complete") from error
    finally:
        log.disabled = loud
    parts = [(name, matrix, part) for name, matrix, part in parts if len(getattr(part, "faces", ()))]
    if not parts:
        raise ValueError(f"{path} holds no triangles; export a surface of triangles")
    points = [np.asarray(part.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3] for _, matrix, part in parts]
    firsts = np.cumsum([0, *map(len, points)])
    triangles = [np.asarray(part.faces, np.int64) + first for (_, _, part), first in zip(parts, firsts)]
    ends = np.cumsum([0, *map(len, triangles)])
    named = {name: np.arange(a, b) for (name, _, _), a, b in zip(parts, ends[:-1], ends[1:])}
    return np.concatenate(points), np.concatenate(triangles), named if len(named) > 1 else {}


def filled(points: np.ndarray, triangles: np.ndarray, parts: dict | None = None, size=None, cells=None) -> tuple:
    """(vertices, tetrahedra, vertex sets, tetrahedron sets, triangles by name) of the body within a surface.

    A closed surface keeps all points and triangles (cut into parts where size asks for it), and closed parts within others
    bound cavities. One that is open or meets itself is filled by fTetWild, which moves it by up to a thousandth of its size,
    with a UserWarning.
    parts: name -> rows of triangles; these become sets, and what a part bounds alone a tetrahedron set of its name.
    size: edge length that tetrahedra reach at most, about [m]; default as large as their quality allows. cells: the same as
    a number of edges along the longest side.
    Raises ValueError for a surface that is not finite, for a closed one where TetGen is missing, and for others where
    fTetWild is, with what is wrong and where.
    Si 2015, TetGen, a Delaunay-Based Quality Tetrahedral Mesh Generator, doi:10.1145/2629697.
    Hu et al. 2020, Fast Tetrahedral Meshing in the Wild, doi:10.1145/3386569.3392385.
    """
    from scipy.spatial import cKDTree

    points, triangles, rows = welded(points, triangles)
    size = size_of(points, size, cells)
    fault = fault_of(points, triangles)
    if fault is not None:  # some may stand there twice
        _, once = np.unique(np.sort(triangles, 1), axis=0, return_index=True)
        if fault_of(points, triangles[np.sort(once)]) is None:
            triangles, rows, fault = triangles[np.sort(once)], rows[np.sort(once)], None
    if fault is None:
        if size is not None:
            points, triangles, of = split_to(points, triangles, size)
            rows = rows[of]
        try:
            vertices, tetrahedra = by_tetgen(points, triangles, size)
        except RuntimeError as error:
            said = " ".join(str(error).split())
            fault = f"TetGen cannot fill the surface ({said}): its triangles may meet each other"
    if fault:
        return *by_ftetwild(points, triangles, size, fault, parts), {}, {}, {}
    where = cKDTree(vertices).query(points)[1]  # the vertex at each of the points
    region, walls = regions(tetrahedra, where[triangles])
    inside = are_inside(vertices, tetrahedra, region, points, triangles)
    sets = {name: np.isin(rows, members) for name, members in (parts or {}).items()}
    named = {name: where[triangles[own]] for name, own in sets.items()}
    bounded = {name: inside & alone for name, alone in _bounded_by(region, walls, sets).items()}
    chosen = inside[region]
    solid = {name: np.nonzero(own[region[chosen]])[0] for name, own in bounded.items() if own.any()}
    used, corners = np.unique(tetrahedra[chosen], return_inverse=True)
    named = {name: np.searchsorted(used, own) for name, own in named.items()}
    tetrahedra = corners.reshape(-1, 4).astype(np.int64)
    return vertices[used], tetrahedra, {name: np.unique(own) for name, own in named.items()}, solid, named


def size_of(points: np.ndarray, size: float | None, cells: int | None) -> float | None:
    """The length that size, or cells along the longest side, stand for [m]; None if neither is given."""
    if size is not None and cells is not None:
        raise ValueError(f"size and cells exclude each other, got {size} and {cells}; pass one of them")
    if cells is not None:
        if isinstance(cells, bool) or not (isinstance(cells, (int, np.integer)) and cells >= 1):
            raise ValueError(f"cells must be a whole number of at least 1 along the longest side, got {cells!r}")
        return float(np.ptp(points, 0).max()) / cells
    if size is not None and not (np.isfinite(size) and size > 0):
        raise ValueError(f"size must be a length above 0 [m], got {size}; None lets tetrahedra grow inwards")
    return size


def split_to(points: np.ndarray, triangles: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points, triangles, the triangle that each is a part of) with every edge that is longer than 1.5 sizes cut in two,
    again and again; neighbours share the cuts."""
    of = np.arange(len(triangles))
    while True:
        known, sides = edges_of(triangles)
        long = np.linalg.norm(points[known[:, 1]] - points[known[:, 0]], axis=1) > 1.5 * size
        if not long.any():
            return points, triangles, of
        if len(triangles) > MOST:
            raise ValueError(f"size {size:.3g} m cuts the surface into more than {MOST} triangles; take a larger one")
        middle = np.full(len(known), -1)
        middle[long] = len(points) + np.arange(long.sum())
        points = np.concatenate([points, points[known[long]].mean(1)])
        cuts, parts, parents = middle[sides], [], []
        for pattern, pieces in CUTS.items():  # which of the edges 01, 12, 20 are cut; a, b, c: their middles
            own = np.nonzero(((cuts >= 0) == pattern).all(1))[0]
            nodes = np.concatenate([triangles[own], cuts[own]], 1)
            for piece in pieces:
                parts.append(nodes[:, piece])
                parents.append(of[own])
        triangles, of = np.concatenate(parts), np.concatenate(parents)


CUTS = {  # of corners 0, 1, 2 and middles 3 (of edge 01), 4 (12), 5 (20)
    (False, False, False): ([0, 1, 2],),
    (True, False, False): ([0, 3, 2], [3, 1, 2]),
    (False, True, False): ([0, 1, 4], [0, 4, 2]),
    (False, False, True): ([0, 1, 5], [1, 2, 5]),
    (True, True, False): ([3, 1, 4], [0, 3, 4], [0, 4, 2]),
    (False, True, True): ([4, 2, 5], [0, 1, 4], [0, 4, 5]),
    (True, False, True): ([0, 3, 5], [3, 1, 2], [3, 2, 5]),
    (True, True, True): ([0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]),
}


def by_tetgen(points: np.ndarray, triangles: np.ndarray, size: float | None) -> tuple[np.ndarray, np.ndarray]:
    """(vertices, tetrahedra) of all that a closed surface bounds; RuntimeError where triangles meet each other."""
    try:
        import tetgen
    except ImportError as error:
        raise ValueError(f"surfaces are filled by TetGen, which is missing: {INSTALL}, {ELSEWHERE}") from error
    volume = {} if size is None else dict(fixedvolume=True, maxvolume=size**3 / 72**0.5)
    mesher = tetgen.TetGen(points, triangles.astype(np.int32))
    shape = dict(quality=True, minratio=MEAN_RATIO, mindihedral=10.0)
    # without nofacewritten, TetGen leaves files of refused triangles in the working folder
    made = mesher.tetrahedralize(nobisect=True, nofacewritten=True, **shape, **volume)
    return np.asarray(made[0], np.float64), np.asarray(made[1], np.int64)


def by_ftetwild(points: np.ndarray, triangles: np.ndarray, size: float | None, fault: str, parts) -> tuple:
    """(vertices, tetrahedra) of what a surface winds around, with a word about it."""
    if importlib.util.find_spec("pytetwild") is None:
        raise ValueError(
            f"{fault}; mend it (in Blender: select non-manifold edges, fill; in MeshLab: close holes), or let fTetWild fill "
            f"it as it is: {INSTALL_DIRTY}"
        )
    length = dict(edge_length_fac=1 / CELLS) if size is None else dict(edge_length_abs=size)
    found = in_a_process(FTETWILD, dict(points=points, triangles=triangles.astype(np.int32), **length), fault)
    vertices, tetrahedra = found["vertices"].astype(np.float64), found["tetrahedra"].astype(np.int64)
    if not len(tetrahedra):
        raise ValueError(f"{fault}; and fTetWild finds no inside; close its holes (in MeshLab: close holes)")
    volumes = signed_volumes(edge_matrices(vertices, tetrahedra))
    tetrahedra, volume = oriented(tetrahedra, volumes, fix_orientation=True), float(np.abs(volumes).sum())
    lost = f"; its parts {', '.join(parts)} are no sets then" if parts else ""
    warn(
        f"{fault}: filled by fTetWild, which moves the surface by up to {1e-3 * np.linalg.norm(np.ptp(points, 0)):.2g} m; "
        f"the body has {volume:.4g} m^3{lost}; mend the surface to keep it exactly"
    )
    used, corners = np.unique(tetrahedra, return_inverse=True)
    return vertices[used], corners.reshape(-1, 4).astype(np.int64)


FTETWILD = """
import sys, numpy, pytetwild
given = dict(numpy.load(sys.argv[1]))
points, triangles = given.pop("points"), given.pop("triangles")
vertices, tetrahedra = pytetwild.tetrahedralize(points, triangles, quiet=True, **{k: float(v) for k, v in given.items()})
numpy.savez(sys.argv[2], vertices=vertices, tetrahedra=tetrahedra)
"""


def in_a_process(script: str, arrays: dict, fault: str) -> dict[str, np.ndarray]:
    """What a script in a process of its own makes of arrays: fTetWild may end a process on surfaces that are far from
    closed, or not end at all."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        np.savez(given, **arrays)
        command = [sys.executable, "-c", script, str(given), str(found)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST, cwd=folder)
        except subprocess.TimeoutExpired as error:
            raise ValueError(
                f"{fault}; and fTetWild did not fill it within {LONGEST:g} s; mend it, {ELSEWHERE}, or pass a larger size"
            ) from error
        if done.returncode or not found.exists():
            said = (done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"])[-1]
            raise ValueError(f"{fault}; and fTetWild cannot fill it ({said}); mend it, {ELSEWHERE}")
        with np.load(found) as data:
            return dict(data)


def regions(tetrahedra: np.ndarray, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(for each tetrahedron the number of the region that it lies in, (region, row of walls) for each of the walls that a
    region has), regions being parted by the triangles `walls`."""
    count = int(max(tetrahedra.max(initial=0), walls.max(initial=0))) + 1
    corners, order, same = sorted_faces(tetrahedra, count)
    wall = places_of_triangles(corners, walls)
    first, second = order[:-1][same], order[1:][same]
    through = wall[first] < 0
    region = components(first[through] // 4, second[through] // 4, len(tetrahedra))
    at = np.nonzero(wall >= 0)[0]
    return region, np.stack([region[at // 4], wall[at]], 1)


def _bounded_by(region: np.ndarray, walls: np.ndarray, sets: dict) -> dict[str, np.ndarray]:
    """name -> which regions have walls of that part alone."""
    total = np.bincount(walls[:, 0], minlength=region.max() + 1)
    counts = {name: np.bincount(walls[own[walls[:, 1]], 0], minlength=len(total)) for name, own in sets.items()}
    return {name: (count == total) & (total > 0) for name, count in counts.items()}


def are_inside(vertices, tetrahedra, region, points, triangles) -> np.ndarray:
    """Which regions lie inside the surface: from the middle of one tetrahedron of each, a ray leaves by an odd number of
    triangles."""
    volumes = np.abs(signed_volumes(edge_matrices(vertices, tetrahedra)))
    order = np.lexsort((-volumes, region))
    largest = order[np.searchsorted(region[order], np.arange(region.max() + 1))]
    turn, _ = np.linalg.qr(np.array([[0.31, 0.77, 0.13], [0.59, 0.23, 0.83], [0.47, 0.91, 0.37]]))  # rays miss edges
    a, b, c = (points @ turn)[triangles].transpose(1, 0, 2)
    normal, inside = np.cross(b - a, c - a), []
    for at in vertices[tetrahedra[largest]].mean(1) @ turn:
        ways = [(q - p, at - p) for p, q in ((a, b), (b, c), (c, a))]  # seen along the ray
        sides = [np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]) for u, v in ways]
        above = ((at - a) * normal).sum(1) * np.sign(normal[:, 2]) < 0
        inside.append(((sides[0] == sides[1]) & (sides[1] == sides[2]) & above).sum() % 2 == 1)
    return np.array(inside)


def welded(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points, triangles, rows of the triangles that stay): with one point for all that lie within 1e-9 of the size (an .stl
    has three for each triangle), and without triangles that have no area then."""
    if not len(triangles) or not np.all(np.isfinite(points[triangles])):
        raise ValueError("points of the surface must be finite, and there must be triangles; export it again")
    used, corners = np.unique(triangles, return_inverse=True)
    points, corners = points[used], corners.reshape(triangles.shape)
    grid = np.round((points - points.min(0)) / (1e-9 * max(float(np.ptp(points, 0).max()), 1e-300)))
    _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    triangles = place.ravel()[corners]
    rows = np.nonzero((triangles != np.roll(triangles, 1, axis=1)).all(1))[0]
    return points[first], triangles[rows], rows


def fault_of(points: np.ndarray, triangles: np.ndarray) -> str | None:
    """What is wrong with a surface that is not closed, and where: each edge belongs to two triangles, or to four, six ...
    where parts touch."""
    known, sides = edges_of(triangles)
    odd = known[np.bincount(sides.ravel()) % 2 == 1]
    if len(triangles) >= 4 and not len(odd):
        return None
    at = f"; the first is at {np.array2string(points[odd[0]].mean(0), precision=4)}" if len(odd) else ""
    return f"the surface is not closed: {len(odd)} of {len(known)} edges belong to an odd number of triangles{at}"
