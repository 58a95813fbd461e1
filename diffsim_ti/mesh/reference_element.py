"""Reference tetrahedra: shape functions, their derivatives, and quadrature rules, for elements of four and of ten nodes.

Coordinates xi of the reference tetrahedron (0,0,0), (1,0,0), (0,1,0), (0,0,1); barycentric L = (1 - sum xi, xi). Corners
come first, then the middles of edges in VTK's order. With ten nodes N_a = L_a (2 L_a - 1) at corners, 4 L_a L_b between.
Zienkiewicz, Taylor, Zhu, The Finite Element Method, 6th ed., 8.6; Stroud 1971, Approximate Calculation of Multiple
Integrals, 2.4 (products of Gauss-Jacobi rules).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

MID_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])  # ends of the edge of nodes 4..9


@dataclass(frozen=True)
class ReferenceElement:
    """The tetrahedron of an order: 1, linear with four nodes, or 2, quadratic with ten."""

    order: int

    @property
    def num_nodes(self) -> int:
        return 10 if self.order == 2 else 4

    @property
    def num_points(self) -> int:
        """Of the stresses."""
        return len(self.weights)

    @cached_property
    def _rule(self) -> tuple[np.ndarray, np.ndarray]:
        if self.order == 1:
            return np.full((1, 3), 0.25), np.ones(1)
        near, far = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
        return np.full((4, 3), far) + (near - far) * np.eye(4)[:, 1:], np.full(4, 0.25)

    @property
    def points(self) -> np.ndarray:
        """xi of the points of the stresses, shape (num_points, 3): the centroid, or four that are exact to degree two."""
        return self._rule[0]

    @property
    def weights(self) -> np.ndarray:
        """Shares of the volume that belong to the points, shape (num_points,)."""
        return self._rule[1]

    @property
    def nodes(self) -> np.ndarray:
        """xi of the nodes, shape (num_nodes, 3)."""
        corners = np.eye(4)[:, 1:]
        return corners if self.order == 1 else np.concatenate([corners, corners[MID_EDGES].mean(1)])

    def functions(self, xi: np.ndarray) -> np.ndarray:
        """N_a at points, shape (k, num_nodes)."""
        L = barycentric(xi)
        return L if self.order == 1 else quadratic(L, MID_EDGES)

    def derivatives(self, xi: np.ndarray) -> np.ndarray:
        """dN_a / dxi at points, shape (k, num_nodes, 3)."""
        by_L = np.concatenate([-np.ones((1, 3)), np.eye(3)])  # dL / dxi
        if self.order == 1:
            return np.broadcast_to(by_L, (len(xi), 4, 3))
        return quadratic_slopes(barycentric(xi), by_L, MID_EDGES)

    @cached_property
    def lumped(self) -> np.ndarray:
        """Shares of an element's mass that explicit steps put to its nodes: in proportion to the diagonal of the consistent
        matrix where edges are straight, 1/4, or 1/36 and 4/27.

        Hinton, Rock, Zienkiewicz 1976, doi:10.1002/eqe.4290040305.
        """
        if self.order == 1:
            return np.full(4, 0.25)
        xi, weights = quadrature(4)
        diagonal = weights @ self.functions(xi) ** 2
        return diagonal / diagonal.sum()


LINEAR, QUADRATIC = ReferenceElement(1), ReferenceElement(2)


def reference_element(num_nodes: int) -> ReferenceElement:
    """Of elements with four or ten nodes."""
    return QUADRATIC if num_nodes == 10 else LINEAR


def barycentric(xi: np.ndarray) -> np.ndarray:
    """L, shape (k, 4), or (k, 3) of coordinates in a triangle."""
    return np.concatenate([1 - xi.sum(1, keepdims=True), xi], 1)


def quadratic(L: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """L_a (2 L_a - 1) of corners, then 4 L_a L_b of the middles of edges, shape (k, corners + edges)."""
    a, b = edges.T
    return np.concatenate([L * (2 * L - 1), 4 * L[:, a] * L[:, b]], 1)


def quadratic_slopes(L: np.ndarray, by_L: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Their derivatives, by those of L."""
    a, b = edges.T
    middles = 4 * (L[:, a, None] * by_L[b] + L[:, b, None] * by_L[a])
    return np.concatenate([(4 * L - 1)[:, :, None] * by_L, middles], 1)


@lru_cache(maxsize=None)
def quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """(xi, shares of the volume) of a rule with positive weights, exact for polynomials up to a degree."""
    from scipy.special import roots_jacobi

    n = degree // 2 + 1
    (a, wa), (b, wb), (c, wc) = (roots_jacobi(n, power, 0) for power in (2, 1, 0))
    x, y, z = np.meshgrid((1 + a) / 2, (1 + b) / 2, (1 + c) / 2, indexing="ij")
    weights = np.einsum("i,j,k->ijk", wa / wa.sum(), wb / wb.sum(), wc / wc.sum()).ravel()
    return np.stack([x, y * (1 - x), z * (1 - x) * (1 - y)], -1).reshape(-1, 3), weights
