"""The map x(xi) = sum_a N_a(xi) X_a of a ten-node tetrahedron, straight edges or curved: its determinant and its inverse.

dx/dxi is linear, and J = det dx/dxi a cubic, whose Bernstein coefficients b bound it from below and above, with J = b at the
four corners. Halving an element's edges makes the bounds as sharp as wanted.
Johnen, Remacle, Geuzaine 2013, Geometrical validity of curvilinear finite elements, doi:10.1016/j.jcp.2012.08.051.
"""

from itertools import combinations_with_replacement, product

import numpy as np

from diffsim_ti.mesh import reference_face
from diffsim_ti.mesh.geometry import nearest_on_triangles
from diffsim_ti.mesh.reference_element import MID_EDGES, QUADRATIC, barycentric

HALVINGS = 5  # an element that is not known to be right then is within some per cent of being wrong
_CORNERS = np.concatenate([np.zeros((1, 3)), np.eye(3)])
_TRIPLES = list(combinations_with_replacement(range(4), 3))
_AVERAGE = np.zeros((len(_TRIPLES), 64))
for _place, _corners in enumerate(product(range(4), repeat=3)):
    _AVERAGE[_TRIPLES.index(tuple(sorted(_corners))), _place] = 1
_AVERAGE /= _AVERAGE.sum(1, keepdims=True)
_AT_CORNERS = [_TRIPLES.index((a, a, a)) for a in range(4)]


def _eighths() -> np.ndarray:
    """Barycentric coordinates of the corners of the eight tetrahedra that the middles of edges make, shape (8, 4, 4)."""
    L = np.eye(4)
    between = {(a, b): (L[a] + L[b]) / 2 for a in range(4) for b in range(4)}
    at_corners = [[between[a, b] for b in range(4)] for a in range(4)]
    around = [(0, 1), (0, 3), (2, 3), (1, 2)]  # the equator of the octahedron about the diagonal from 02 to 13
    inner = [[between[0, 2], between[1, 3], between[around[k]], between[around[(k + 1) % 4]]] for k in range(4)]
    return np.array(at_corners + inner)


_EIGHTHS = _eighths()


def corner_gradients(nodes: np.ndarray) -> np.ndarray:
    """dx/dxi at the corners of elements, shape (m, 4, 3, 3), from places of their ten nodes, shape (m, 10, 3)."""
    return np.einsum("anj,eni->eaij", QUADRATIC.derivatives(_CORNERS), nodes)


def coefficients(gradients: np.ndarray) -> np.ndarray:
    """Bernstein coefficients of J [m^3], shape (m, 20), from dx/dxi at corners; the mean of J is theirs."""
    u, v, w = np.moveaxis(gradients, 3, 0)
    mixed = np.einsum("eai,ebci->eabc", u, np.cross(v[:, :, None], w[:, None]))
    return mixed.reshape(-1, 64) @ _AVERAGE.T


def volumes(nodes: np.ndarray) -> np.ndarray:
    """Integral of J over the reference tetrahedron [m^3], shape (m,)."""
    return coefficients(corner_gradients(nodes)).mean(1) / 6


def lowest(nodes: np.ndarray) -> np.ndarray:
    """The lower bound of J by its coefficients [m^3], shape (m,)."""
    return coefficients(corner_gradients(nodes)).min(1)


def lowest_jacobian(mesh) -> np.ndarray:
    """Lower bound of J = det dx/dxi over its mean in each element, shape (num_tetrahedra,); 1 where edges are straight."""
    out, some = np.ones(mesh.num_tetrahedra), mesh.curved
    out[some] = lowest(mesh.vertices[mesh.elements[some]]) / (6 * mesh.volumes[some])
    return out


def not_above(nodes: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Elements, ascending, where J <= least somewhere, or where that cannot be ruled out by HALVINGS of all edges."""
    gradients, owner, wrong = corner_gradients(nodes), np.arange(len(nodes)), []
    for _ in range(HALVINGS + 1):
        b = coefficients(gradients)
        refuted = b[:, _AT_CORNERS].min(1) <= least[owner]
        wrong.append(owner[refuted])
        unknown = (b.min(1) <= least[owner]) & ~np.isin(owner, owner[refuted])
        gradients = np.einsum("kab,ebij->ekaij", _EIGHTHS, gradients[unknown]).reshape(-1, 4, 3, 3)
        owner = np.repeat(owner[unknown], 8)
    return np.unique(np.concatenate([*wrong, owner]))


ITERATIONS = 40
ACCURACY = 1e-12  # of the size of an element


def reach(nodes: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Radius of a ball about each centre that holds the element, shape (m,): by the control points of its edges.

    An element lies in the convex hull of these (Bernstein functions are positive and sum to one).
    """
    return np.linalg.norm(_control_points(nodes) - centres[:, None], axis=2).max(1)


def _control_points(nodes: np.ndarray) -> np.ndarray:
    return np.concatenate([nodes[:, :4], 2 * nodes[:, 4:] - nodes[:, MID_EDGES].mean(2)], 1)


def barycentric_in(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """L of a point in each element, shape (m, 4); NaN where it is far outside. nodes (m, 10, 3), points (m, 3).

    It starts from the tetrahedron of the corners, then from the centroid and the corners, and halves steps that lead away.
    """
    D = np.moveaxis(nodes[:, 1:4] - nodes[:, :1], 1, 2)
    hull = np.einsum("eij,eaj->eai", np.linalg.inv(D), _control_points(nodes) - nodes[:, :1])
    first = np.linalg.solve(D, (points - nodes[:, 0])[..., None])[..., 0]
    outside = (first < hull.min(1) - 1e-6).any(1) | (first > hull.max(1) + 1e-6).any(1)
    out, left = np.full((len(nodes), 3), np.nan), np.nonzero(~outside)[0]
    for start in (first, np.full(3, 0.25), *np.concatenate([np.zeros((1, 3)), np.eye(3)])):
        xi, found = solved(nodes[left], points[left], np.broadcast_to(start, (len(nodes), 3))[left])
        out[left[found]] = xi[found]
        left = left[~found]
        if not len(left):
            break
    return barycentric(out)


def solved(nodes: np.ndarray, points: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(xi of a point in each element, also beyond it, where it was found), by Newton's method from xi, shape (m, 3)."""
    size = np.ptp(nodes, axis=1).max(1)

    def miss(xi):
        return np.einsum("en,eni->ei", QUADRATIC.functions(xi), nodes) - points

    xi, off = xi.copy(), miss(xi)
    for _ in range(ITERATIONS):
        norms = np.linalg.norm(off, axis=1)
        found = norms <= ACCURACY * size
        if found.all():
            break
        J = np.einsum("enj,eni->eij", QUADRATIC.derivatives(xi), nodes)
        singular = np.abs(np.linalg.det(J)) < 1e-12 * size**3
        J[singular] = size[singular, None, None] * np.eye(3)
        step = -np.linalg.solve(J, off[..., None])[..., 0]
        step[found] = 0.0
        for _ in range(8):
            tried = miss(xi + step)
            away = np.linalg.norm(tried, axis=1) > norms
            if not away.any():
                break
            step[away] /= 2
        xi = xi + step
        off = miss(xi)
    return xi, np.linalg.norm(off, axis=1) <= 1e3 * ACCURACY * size


def nearest_on_face(point: np.ndarray, nodes: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Coordinates (s, t) of the nearest point of a face of six nodes, shape (6, 3), from a start near to it.

    Newton's method for |x(s, t) - point|^2 / 2 within the triangle; the step solves the quadratic model there: the nearest
    point of the triangle in the metric of the second derivatives (those of Gauss and Newton where these are not positive).
    """
    corners = np.array([[0.0, 0], [1, 0], [0, 1]])
    off = _place(s, nodes) - point
    for _ in range(ITERATIONS):
        T = nodes.T @ reference_face.derivatives(s[None])[0]
        H = T.T @ T + np.einsum("aij,a->ij", reference_face.SECOND, nodes @ off)
        if np.linalg.eigvalsh(H)[0] <= 1e-6 * np.trace(T.T @ T):
            H = T.T @ T
        C = np.linalg.cholesky(H)
        model = np.pad((corners - s) @ C, ((0, 0), (0, 1)))
        target = np.pad(-np.linalg.solve(C, T.T @ off), (0, 1))
        step = np.linalg.solve(C.T, nearest_on_triangles(target, model[None])[0, :2])
        for _ in range(20):
            tried = _place(s + step, nodes) - point
            if tried @ tried <= off @ off:
                break
            step = step / 2
        if tried @ tried > off @ off:
            return s
        s, off = np.clip(s + step, 0, 1), tried
        if np.abs(step).max() < ACCURACY:
            break
    return s


def _place(s: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    return reference_face.functions(s[None])[0] @ nodes
