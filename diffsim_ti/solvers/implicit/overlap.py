"""Bodies that overlap where an equilibrium is looked for, pressed apart first.

Each vertex that lies behind a triangle of another body, or nearer to it than a gap, goes to that gap along the triangle's
normal n, edges that have passed each other likewise, and the bodies follow as their stiffness K at rest lets them,

    min_du  1/2 du . K du + k/2 sum (n . (du_i - sum_a w_a du_a) + d - gap)^2,    d = n . (x_i - sum_a w_a x_a),

again and again until all are apart. The equilibrium is that of the bodies as they are at rest, wherever it is looked for
from, so that its gradients know nothing of the way there.
"""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.warn import warn
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mechanics.supports.free import projectors_of
from diffsim_ti.mechanics.surfaces.curved_pairs import CurvedPairs
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.terms.obstacles.surface_mesh import SurfaceMesh
from diffsim_ti.terms.obstacles.surface_tree import SurfaceTree, nearest_of_triangles

GAP = 0.5  # of the width, at which contact presses and holds what no support does
STIFF, SOFT = 1e4, 1e-6  # k, and what holds bodies that nothing else holds, over the diagonal of K
ROUNDS = 10
FACING = -0.3  # cosine of the angle between normals of triangles that face each other, at most
ALIKE = 3.0  # times the distance of the nearest of them that others may have
ASIDE = 0.5  # how far beside a triangle a vertex may lie, over its distance from it


def pressed_apart(workspace, u: np.ndarray, error: Overlap) -> np.ndarray:
    """Displacements near u [m] at which surfaces are apart, which the error keeps. Raises it where there are none within an
    edge of u."""
    pairs, potential, is_new = workspace.pairs, workspace.potential, error.apart is None
    place, deepest = _apart(workspace, u, error) if is_new else (error.apart, 0.0)
    pairs.begin(place, np.zeros_like(place))
    runtime.fill(potential.u, place[None])
    try:
        pairs.check_apart(potential.u)
    except Overlap:
        raise error from None
    if not np.all((workspace.volume_ratios(place) > 0) | (workspace.volume_ratios(u) <= 0)):
        raise error
    if is_new:
        error.apart = place
        warn(
            f"static solve: surfaces overlap by up to {deepest:.3g} m where it begins; they are pressed apart first, and "
            "friction between them acts from the next step on"
        )
    return place


def _apart(workspace, u: np.ndarray, error: Overlap) -> tuple[np.ndarray, float]:
    """(displacements at which vertices and edges are apart, how deep they were [m])"""
    from scipy.sparse import block_diag, diags, identity, kron
    from scipy.sparse.linalg import splu

    pairs, potential, free = workspace.pairs, workspace.potential, workspace.free
    with potential.at_rest():
        potential.blocks()
        K = assemble(potential, np.zeros((len(u), 1)), free)[0].tocsr()
    inner, C = (pairs.inner, pairs.matrix) if isinstance(pairs, CurvedPairs) else (pairs, identity(len(u)))
    spread = pairs.spread if isinstance(pairs, CurvedPairs) else lambda u: u
    rest, gap = runtime.fetch(inner.a.rest)[: inner.mesh.num_vertices].astype(np.float64), GAP * inner.width
    moves = kron(C, identity(3)).tocsr() @ block_diag(projectors_of(free)).tocsr()
    K, stiff, deepest, place = K + SOFT * diags(K.diagonal()), STIFF * K.diagonal().max(), 0.0, u
    for _ in range(ROUNDS):
        x = rest + spread(place)
        rows, missing = _near(inner, x, gap)
        deepest = max(deepest, missing.max(initial=gap) - gap)
        if missing.max(initial=0.0) < 0.5 * gap:  # vertices are apart: are edges?
            rows, missing = _crossed(inner, x, gap, max(deepest, gap))
        if missing.max(initial=0.0) < 0.5 * gap:
            return place, deepest
        rows = rows @ moves
        place = place + splu((K + stiff * (rows.T @ rows)).tocsc()).solve(stiff * (rows.T @ missing)).reshape(-1, 3)
    raise error


def _near(pairs, x: np.ndarray, gap: float):
    """(d = n . (x_i - sum_a w_a x_a) of places x as rows of a sparse matrix, gap less d), of vertices and the nearest
    triangles of other bodies that face one of theirs, d < gap."""
    from scipy.spatial import cKDTree

    triangles, reach = pairs.mesh.surface_triangles, pairs.list.typical
    corners = x[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals, middles = normals / np.linalg.norm(normals, axis=1, keepdims=True), corners.mean(1)
    around = reach + np.linalg.norm(corners - middles[:, None], axis=2).max()
    found = cKDTree(x[triangles.ravel()]).sparse_distance_matrix(cKDTree(middles), around, output_type="coo_matrix")
    corner, t = found.row, found.col
    i, own = triangles.ravel()[corner], corner // 3
    faces = (pairs.body[i] != pairs.body[triangles[t, 0]]) & ((normals[own] * normals[t]).sum(1) < FACING)
    corner, i, t = corner[faces], i[faces], t[faces]
    _, w, square = nearest_of_triangles(x[i], corners[t])
    away = x[i] - np.einsum("ij,ijk->ik", w, corners[t])
    d = (away * normals[t]).sum(1)
    order = np.lexsort((t, square, corner))
    first = order[np.flatnonzero(np.diff(corner[order], prepend=-1))]
    beside = np.sqrt(np.maximum(square - d**2, 0)) > ASIDE * np.abs(d) + 1e-6 * reach
    first = first[~beside[first] & (np.abs(d) < reach)[first]]
    least = np.full(len(x), np.inf)
    np.minimum.at(least, i[first], np.abs(d[first]))
    first = first[(d[first] < gap) & (np.abs(d[first]) <= ALIKE * least[i[first]] + gap)]
    for body in np.unique(pairs.body[triangles[t[first], 0]]):  # what lies behind a triangle alone is in no body
        nodes, local = np.unique(triangles[pairs.body[triangles[:, 0]] == body], return_inverse=True)
        none = np.zeros((0, 2), np.int64)
        tree = SurfaceTree(SurfaceMesh(x[nodes], local.reshape(-1, 3), none, none[:, 0]), np.zeros(3))
        own = (pairs.body[triangles[t[first], 0]] == body) & (d[first] < 0)
        outside = tree.distance(x[i[first[own]]]) > 0.1 * gap
        first = np.delete(first, np.flatnonzero(own)[outside])
    _, once = np.unique(i[first] * len(triangles) + t[first], return_index=True)
    i, t, w, d = (a[first[once]] for a in (i, t, w, d))
    vertices, weights = np.column_stack([i, triangles[t]]), np.column_stack([np.ones(len(i)), -w])
    return _rows(vertices, weights, normals[t], x.size), gap - d


def _crossed(pairs, x: np.ndarray, gap: float, most: float):
    """The same of edges of two bodies that face and pass each other, from -most < d < gap."""
    from scipy.spatial import cKDTree

    t = pairs.mesh.surface_triangles
    normals = np.cross(x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]])
    edges, sides = edges_of(t)
    out = np.zeros((len(edges), 3))
    np.add.at(out, sides.ravel(), np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 3, 0))
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)
    middles, along = x[edges].mean(1), x[edges[:, 1]] - x[edges[:, 0]]
    tree = cKDTree(middles)
    a, b = tree.query_pairs(np.linalg.norm(along, axis=1).max() + most, output_type="ndarray").T
    facing = (pairs.body[edges[a, 0]] != pairs.body[edges[b, 0]]) & ((out[a] * out[b]).sum(1) < FACING)
    a, b = a[facing], b[facing]
    n, r = np.cross(along[a], along[b]), x[edges[b, 0]] - x[edges[a, 0]]
    square = (n**2).sum(1)
    crosses = square > 1e-6 * (along[a] ** 2).sum(1) * (along[b] ** 2).sum(1)
    a, b, n, r, square = (part[crosses] for part in (a, b, n, r, square))
    s, t = ((np.cross(r, along[k]) * n).sum(1) / square for k in (b, a))
    n *= (np.sign((n * out[b]).sum(1)) / np.sqrt(square))[:, None]
    d = -(r * n).sum(1)
    meet = (np.minimum(s, t) > 0) & (np.maximum(s, t) < 1) & (d < gap) & (d > -most) & ((n * out[b]).sum(1) > -FACING)
    a, b, n, s, t, d = (part[meet] for part in (a, b, n, s, t, d))
    vertices, weights = np.column_stack([edges[a], edges[b]]), np.column_stack([1 - s, s, t - 1, -t])
    return _rows(vertices, weights, n, x.size), gap - d


def _rows(vertices: np.ndarray, weights: np.ndarray, n: np.ndarray, size: int):
    """n . sum w_a x_a of some four vertices as rows of a sparse matrix."""
    from scipy.sparse import csr_matrix

    columns = 3 * vertices[:, :, None] + np.arange(3)
    entries = (weights[:, :, None] * n[:, None]).ravel(), columns.ravel(), 12 * np.arange(len(n) + 1)
    return csr_matrix(entries, (len(n), size))
