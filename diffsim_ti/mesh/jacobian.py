"""The determinant J of the map of a ten-node tetrahedron: its bounds and its mean, exactly.

x = sum_a N_a(xi) X_a is quadratic, dx/dxi linear, and J = det dx/dxi a cubic, whose Bernstein coefficients b bound it from
below and above, with J = b at the four corners. Halving an element's edges makes the bounds as sharp as wanted.
Johnen, Remacle, Geuzaine 2013, Geometrical validity of curvilinear finite elements, doi:10.1016/j.jcp.2012.08.051.
"""

from itertools import combinations_with_replacement, product

import numpy as np

from diffsim_ti.mesh.reference_element import QUADRATIC

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
