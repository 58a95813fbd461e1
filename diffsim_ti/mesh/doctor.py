"""What may be wrong with a mesh as people have it, with remedies: `mesh.check()`, `diffsim-ti check body.msh`."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.mesh import geometry
from diffsim_ti.mesh.checks import SLIVER, oriented
from diffsim_ti.mesh.geometry import FACES, edge_matrices, signed_volumes, sorted_faces, squared_edges, triangle_normals
from diffsim_ti.mesh.sets import components, parts_of_vertices, without_unused

COINCIDING = 1e-9  # of the size of the body: nodes that near are one place
TOUCHING = 1e-6  # of the size: how far a vertex may lie from a face that it is said to lie on
LARGEST = 5.0  # [m] beyond which lengths look like millimetres
SOFT = 10.0  # [m/s], the speed of sound of a soft body: E = 1e5 Pa, 1000 kg/m^3


@dataclass(frozen=True)
class Finding:
    """what: a sentence with counts and places. remedy: what to do. mended: whether `mended` does so."""

    what: str
    remedy: str
    mended: bool = False

    def __str__(self) -> str:
        return f"{self.what}; {self.remedy}"


class Findings(tuple):
    """What was found; printed, one line for each."""

    def __str__(self) -> str:
        return "\n".join(f"- {finding}" for finding in self) or "nothing to mend"

    __repr__ = __str__


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """ "1 vertex", "2 vertices"."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"


def findings(parts: tuple) -> Findings:
    """Of (vertices, elements, vertex sets, tetrahedron sets, triangles by name), as a file has them: also of what the
    constructor of a mesh refuses."""
    vertices, elements, vertex_sets, tetrahedron_sets, triangles = parts
    corners, out = elements[:, :4], []

    def note(count: int, noun: str, plural: str, more: str, remedy: str, mended: bool = False) -> None:
        if count:
            out.append(Finding(counted(count, noun, plural) + more, remedy, mended))

    if bad := int((~np.isfinite(vertices)).any(1).sum()):
        note(bad, "vertex has", "vertices have", " coordinates that are not finite", "export the file again")
        return Findings(out)
    volumes, squares = signed_volumes(edge_matrices(vertices, corners)), squared_edges(vertices, corners)
    size = float(np.ptp(vertices[np.unique(corners)], 0).max())
    turned, repeated = int((volumes < 0).sum()), len(corners) - len(np.unique(np.sort(corners, 1), axis=0))
    note(turned, "tetrahedron", "tetrahedra", " inside-out", "pass fix_orientation=True", True)
    note(repeated, "repeated tetrahedron", "repeated tetrahedra", "", "keep one of each", True)
    flat = np.nonzero(np.abs(volumes) <= 1e-12 * squares.max(1) ** 1.5)[0]
    note(len(flat), "flat tetrahedron", "flat tetrahedra", f", the first is {[*flat, 0][0]}", "remesh there")
    orphans, remedy = len(vertices) - len(np.unique(elements)), "pass drop_orphans=True to from_file"
    note(orphans, "vertex", "vertices", " in no tetrahedron", remedy, True)
    out += _connections(vertices, elements, size)
    areas = np.linalg.norm(triangle_normals(vertices, corners[:, FACES].reshape(-1, 3)), axis=1).reshape(-1, 4)
    altitude = 3 * np.abs(volumes) / np.maximum(areas.max(1), 1e-300)
    quality = 12 * np.cbrt(3 * np.abs(volumes)) ** 2 / np.maximum(squares.sum(1), 1e-300)
    if len(bad := np.nonzero(quality < SLIVER)[0]):
        worst, without = int(np.argmin(altitude)), altitude[quality >= SLIVER]
        gain = float(without.min() / altitude[worst]) if len(without) and altitude[worst] > 0 else np.inf
        what = (
            f" (quality below {SLIVER}), worst tetrahedron {bad[np.argmin(quality[bad])]}; "
            f"without them explicit steps could be {gain:.3g} times longer"
        )
        note(len(bad), "sliver", "slivers", what, "remesh, or use an implicit solver")
    out += _sets(vertex_sets, tetrahedron_sets, triangles, len(elements))
    if size > LARGEST:
        what = f"the body is {size:.4g} m long, which looks like millimetres"
        out.append(Finding(what, "lengths are metres: take mesh.scaled(1e-3), or leave a body of that size as it is"))
    far, thinnest = float(np.abs(vertices.mean(0)).max()), float(altitude.min())
    if (coarse := np.finfo(np.float32).eps * far) > 1e-3 * thinnest:
        what = (
            f"it lies {far:.3g} m from the origin, where float32 resolves {coarse:.2g} m of the smallest altitude of "
        )
        remedy = "move it to the origin by mesh.translated, or compute in float64"
        out.append(Finding(f"{what}{thinnest:.2g} m", remedy))
    return Findings(out)


def step_in_words(mesh) -> str:
    """How long an explicit step of a soft body may be."""
    thin = int(np.argmin(mesh.altitudes.min(1)))
    low = float(mesh.altitudes[thin].min())
    return (
        f"smallest altitude {low:.3g} m in tetrahedron {thin}: explicit steps of about {low / SOFT:.2g} s for a speed of "
        f"sound of {SOFT:g} m/s (E = 1e5 Pa, 1000 kg/m^3); they grow with the altitude"
    )


def mended(parts: tuple) -> tuple:
    """Without what can be mended in only one way: tetrahedra turned, repeated ones once, no vertices that none uses, no
    empty sets."""
    vertices, elements, vertex_sets, tetrahedron_sets, triangles = parts
    elements = oriented(elements, signed_volumes(edge_matrices(vertices, elements[:, :4])), fix_orientation=True)
    _, first, inverse = np.unique(np.sort(elements[:, :4], 1), axis=0, return_index=True, return_inverse=True)
    keep = np.sort(first)
    new = np.searchsorted(keep, first[inverse.ravel()])
    tetrahedron_sets = {name: np.unique(new[rows]) for name, rows in tetrahedron_sets.items() if len(rows)}
    vertices, elements, *sets = without_unused(vertices, elements[keep], vertex_sets, triangles)
    vertex_sets, triangles = ({name: rows for name, rows in own.items() if len(rows)} for own in sets)
    return vertices, elements, vertex_sets, tetrahedron_sets, triangles


def coinciding(vertices: np.ndarray, tolerance: float) -> np.ndarray:
    """For each vertex the first of those that lie within the tolerance [m] of it, directly or by way of others."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(vertices).query_pairs(tolerance, output_type="ndarray")
    part = components(pairs[:, 0], pairs[:, 1], len(vertices))
    _, first = np.unique(part, return_index=True)
    return first[part]


def coinciding_of_pieces(vertices: np.ndarray, elements: np.ndarray) -> int:
    """How many vertices lie where a vertex of another piece does."""
    used = np.unique(elements)
    x, part = vertices[used], parts_of_vertices(elements, len(vertices))[used]
    if len(np.unique(part)) == 1:
        return 0
    grid = np.round((x - x.min(0)) / (COINCIDING * max(float(np.ptp(x, 0).max()), 1e-300)))
    _, place = np.unique(grid, axis=0, return_inverse=True)
    pairs = np.unique(np.stack([place.ravel(), part], 1), axis=0)
    several = np.bincount(pairs[:, 0])
    return int((several[several > 1] - 1).sum())


def _connections(vertices: np.ndarray, elements: np.ndarray, size: float) -> list[Finding]:
    """Pieces, nodes that coincide, faces that touch without common nodes, and hinges."""
    out, used, part = [], np.unique(elements), parts_of_vertices(elements, len(vertices))
    names, piece = np.unique(part[elements[:, 0]], return_inverse=True)
    if len(names) > 1:
        remedy = "bodies that are meant to be apart are fine; others need common nodes, merged or tied"
        out.append(Finding(f"{len(names)} pieces that share no vertex", remedy))
    twice = coinciding_of_pieces(vertices, elements)
    if twice:
        what = f"{counted(twice, 'vertex coincides', 'vertices coincide')} with others of another piece"
        out.append(Finding(what, "if the pieces are one body, take mesh.merged()"))
    own = coinciding(vertices[used], COINCIDING * size)
    doubled = int((own != np.arange(len(used))).sum()) - twice
    if doubled > 0:
        what = f"{counted(doubled, 'vertex coincides', 'vertices coincide')} with others of the same piece"
        out.append(Finding(what, "a crack that is meant is fine; else take mesh.merged()"))
    if len(names) > 1 and (touching := _touching(vertices, elements, piece, size)):
        what = f"{counted(touching, 'vertex lies', 'vertices lie')} on faces of another piece, without a node there"
        remedy = "mesh both parts with common nodes (in Gmsh: fragment), glue them by ds.Tie, or leave them to contact"
        out.append(Finding(what, remedy))
    return out + hinges(elements, len(vertices))


def hinges(elements: np.ndarray, num_vertices: int) -> list[Finding]:
    """Where parts share an edge or a vertex and no face: none or one."""
    _, order, same = sorted_faces(elements[:, :4], num_vertices)
    solid = components(order[:-1][same] // 4, order[1:][same] // 4, len(elements))
    if not solid.any():
        return []
    pairs = np.unique(elements[:, :4].astype(np.int64) * len(elements) + solid[:, None])
    vertex, part = np.divmod(pairs, len(elements))
    joint = vertex[1:] == vertex[:-1]
    count = solid.max() - components(part[:-1][joint], part[1:][joint], solid.max() + 1).max()
    if not count:
        return []
    at = np.unique(vertex[1:][joint])
    what = (
        f"{counted(count, 'hinge')}: parts hang together by an edge or a vertex alone, at vertices "
        f"{at[:6].tolist()}{' ...' if len(at) > 6 else ''}"
    )
    return [Finding(what, "such parts turn freely about it; give them common faces")]


def is_manifold(triangles: np.ndarray) -> bool:
    """Whether a closed surface, shape (k, 3), meets itself at no edge and no vertex: each edge has two triangles, and those
    about each vertex go round it once."""
    start, end = triangles.ravel(), np.roll(triangles, -1, 1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high = low[order], high[order]
    again = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    if len(order) % 2 or not again[::2].all() or again[1::2].any():
        return False
    here, there = order[::2], order[1::2]  # corners of two triangles, from which their common edge goes
    after = np.arange(len(start)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    fans = components(np.concatenate([here, after[here]]), np.concatenate([after[there], there]), len(start))
    return len(np.unique(fans)) == len(np.unique(start))


def _touching(vertices: np.ndarray, elements: np.ndarray, piece: np.ndarray, size: float) -> int:
    """How many vertices of a piece's surface lie on a face of another piece and on none of its vertices."""
    from scipy.spatial import cKDTree

    corners, order, same = sorted_faces(elements[:, :4], len(vertices))
    outer = np.ones(len(corners), bool)
    outer[order[:-1][same]] = outer[order[1:][same]] = False
    faces, of = corners[outer], np.repeat(piece, 4)[outer]
    middles, count = vertices[faces].mean(1), 0
    reach = np.linalg.norm(vertices[faces] - middles[:, None], axis=2).max(1)
    for k in range(of.max() + 1):
        own, others = np.unique(faces[of == k]), np.nonzero(of != k)[0]
        low, high = vertices[own].min(0) - TOUCHING * size, vertices[own].max(0) + TOUCHING * size
        middle, r = middles[others], reach[others, None]
        near = others[((middle + r >= low) & (middle - r <= high)).all(1)]
        if not len(near):
            continue
        taken = cKDTree(vertices[np.unique(faces[near])])
        lists = cKDTree(middles[near]).query_ball_point(vertices[own], reach[near].max() + TOUCHING * size)
        alone = taken.query(vertices[own])[0] > TOUCHING * size
        for vertex, some, free in zip(own, lists, alone):
            if free and some:
                x, triangles = vertices[vertex], vertices[faces[near[some]]]
                away = np.linalg.norm(geometry.nearest_on_triangles(x, triangles) - x, axis=1)
                count += bool(away.min() <= TOUCHING * size)
    return count


def _sets(vertex_sets: dict, tetrahedron_sets: dict, triangles: dict, count: int) -> list[Finding]:
    out = []
    kinds = (("vertex", vertex_sets), ("tetrahedron", tetrahedron_sets), ("surface", triangles))
    empty = [f"{kind} set {name!r}" for kind, sets in kinds for name, rows in sets.items() if not len(rows)]
    if empty:
        out.append(Finding(f"empty: {', '.join(empty)}", "select members anew, or leave the sets out", True))
    many = np.bincount(
        np.concatenate([np.unique(r) for r in tetrahedron_sets.values()] or [[]]).astype(int), minlength=count
    )
    if len(tetrahedron_sets) > 1 and (several := int((many > 1).sum())):
        what = f"{counted(several, 'tetrahedron is', 'tetrahedra are')} in several tetrahedron sets"
        out.append(Finding(what, "materials by set need one set for each: say which"))
    if tetrahedron_sets and (none := int((many == 0).sum())):
        what = f"{counted(none, 'tetrahedron is', 'tetrahedra are')} in no tetrahedron set"
        out.append(Finding(what, "materials by set need one set for each: name a set of the rest"))
    return out
