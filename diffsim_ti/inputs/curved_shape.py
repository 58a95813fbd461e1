"""The rest shape of ten-node tetrahedra, whose edges may be curved, and the points of all tetrahedra."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh.reference_element import QUADRATIC, quadrature

if TYPE_CHECKING:
    from diffsim_ti.inputs.inputs import Derived
    from diffsim_ti.mesh import TetrahedralMesh


class CurvedShape(Link):
    """Of rest positions X: X itself and, at each of the four points of an element, B = D^-1, D = dX/dxi, whose rows are
    grad xi, shape (m, 4, 3, 3), and the share V = w det D / 6 of the volume, shape (m, 4); and the elements' volumes, by a
    rule that is exact for curved edges.

    dB = -B dD B and dV = V tr(B dD). Raises ValueError for an element that is turned inside out at a point.
    """

    reads, writes = ("rest_positions",), ("rest", "gradients", "volumes", "element volumes")

    def __init__(self, elements: np.ndarray):
        self.elements = elements
        xi, weights = quadrature(3)  # det D is a cubic
        self.by_xi = QUADRATIC.derivatives(QUADRATIC.points), QUADRATIC.derivatives(xi)
        self.weights = QUADRATIC.weights, weights
        self._last = None  # X and what derivatives need of it

    def value(self, X):
        (B, V), (_, whole) = self._inverse(X)
        return X, B, V, whole.sum(1)

    def _inverse(self, X):
        """(D^-1, w det D / 6) at the points of stresses and at those of the volume."""
        if self._last is not None and self._last[0] is X:
            return self._last[1]
        out = []
        for by_xi, weights in zip(self.by_xi, self.weights):
            D = self._edges(X, by_xi)
            volumes = weights * np.linalg.det(D) / 6
            if not np.all(volumes > 0):
                worst = int(np.argmin(volumes.min(1)))
                raise ValueError(
                    f"rest_positions turn tetrahedron {worst} inside out at a point within (det dX/dxi / 6 = "
                    f"{(volumes / weights).min():.3g} m^3, {(~(volumes > 0)).any(1).sum()} in all); take a smaller step in "
                    "the rest shape"
                )
            out.append((np.linalg.inv(D), volumes))
        self._last = None if X.flags.writeable else (X, out)
        return out

    def _edges(self, X, by_xi):
        return np.einsum("eai,qak->eqik", X[self.elements], by_xi, optimize=True)

    def jvp(self, x, dx):
        (B, V), (C, W) = self._inverse(*x)
        dD, dE = (self._edges(dx[0], by_xi) for by_xi in self.by_xi)
        whole = (W * np.einsum("eqij,eqji->eq", C, dE)).sum(1)
        return dx[0], -B @ dD @ B, V * np.einsum("eqij,eqji->eq", B, dD), whole

    def vjp(self, x, y_adj):
        (B, V), (C, W) = self._inverse(*x)
        rest_adj, gradients_adj, volumes_adj, whole_adj = y_adj
        Bt, Ct = np.swapaxes(B, 2, 3), np.swapaxes(C, 2, 3)
        by_D = -Bt @ gradients_adj @ Bt + (V * volumes_adj)[..., None, None] * Bt
        by_E = (W * whole_adj[:, None])[..., None, None] * Ct
        X_adj = np.array(rest_adj)
        for by, by_xi in zip((by_D, by_E), self.by_xi):
            np.add.at(X_adj, self.elements, np.einsum("eqik,qak->eai", by, by_xi, optimize=True))
        return (X_adj,)


def ratios_at_corners(elements: np.ndarray, rest: np.ndarray, u: np.ndarray) -> np.ndarray:
    """J = det(dx/dxi) / det(dX/dxi) at the corners of ten-node elements, shape (m, 4): where one folds first."""
    by_xi = QUADRATIC.derivatives(np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    after, before = (np.einsum("eai,qak->eqik", x[elements], by_xi, optimize=True) for x in (rest + u, rest))
    return np.linalg.det(after) / np.linalg.det(before)


class StressPoints(NamedTuple):
    """The points of all tetrahedra, one after the other, for sums on the host."""

    nodes: np.ndarray  # (p, 4 or 10), vertices
    gradients: np.ndarray  # (p, 4 or 10, 3), grad N_a [1/m]
    volumes: np.ndarray  # (p,) [m^3]

    @classmethod
    def of(cls, mesh: "TetrahedralMesh", derived: "Derived") -> "StressPoints":
        """For the rest shape of `derived`."""
        element, B = mesh.reference, derived.gradients
        if element.order == 1:
            return cls(mesh.elements, np.concatenate([-B.sum(1, keepdims=True), B], 1), derived.volumes)
        gradients = np.einsum("qak,eqkj->eqaj", element.derivatives(element.points), B, optimize=True)
        nodes = np.repeat(mesh.elements, element.num_points, 0)
        return cls(nodes, gradients.reshape(-1, *gradients.shape[2:]), derived.volumes.ravel())

    def displacement_gradients(self, u: np.ndarray) -> np.ndarray:
        """H = sum_a u_a (x) grad N_a, shape (p, 3, 3)."""
        return np.matmul(np.swapaxes(u[self.nodes], 1, 2), self.gradients)
