"""The rest shape of tetrahedra, of ten nodes with edges that may be curved, and their points."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffsim_ti.differentiation.arrays import made, value_of, with_slopes
from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.mesh.reference_element import QUADRATIC, quadrature

if TYPE_CHECKING:
    from diffsim_ti.inputs.inputs import Derived
    from diffsim_ti.mesh import TetrahedralMesh


class RestShape(Recording, Link):
    """Of rest positions X: X itself and, at each of the points of an element, B = D^-1, D = dX/dxi, whose rows are grad xi,
    and the share V = w det D / 6 of the volume. Of tetrahedra of four nodes, whose edges are the columns of D, these have
    shapes (m, 3, 3) and (m,); of ten nodes, whose edges may be curved, (m, 4, 3, 3) and (m, 4), and there are the elements'
    volumes too, by a rule that is exact for them.

    dB = -B dD B and dV = V tr(B dD). Raises ValueError for an element that is turned inside out at a point.
    """

    reads = ("rest_positions",)

    def __init__(self, mesh: "TetrahedralMesh"):
        self.elements, self.element = mesh.elements, mesh.reference
        rules = [(self.element.points, self.element.weights)]
        if self.element.order == 2:
            rules.append(quadrature(3))  # det D is a cubic
        self.rules = [(self.element.derivatives(xi), weights) for xi, weights in rules]
        self.writes = ("rest", "gradients", "volumes", "element volumes")[: 2 + len(rules)]
        self._last = None  # X and what derivatives need of it

    def value(self, X):
        (B, V), *whole = self._recorded(X)
        return X, *self._of_points(B, V), *(W.sum(1) for _, W in whole)

    def _recorded(self, X):
        """What `_inverse` says; of arrays that record, too."""
        found = self._inverse(value_of(X))
        return found if X is value_of(X) else [self._of(X, *rule, *known) for rule, known in zip(self.rules, found)]

    def _of(self, X, by_xi, _, B, V):
        D, Bt = self._edges(X, by_xi), np.swapaxes(B, 2, 3)
        inverse = made(B, (D, lambda dD: -B @ dD @ B, lambda by: -Bt @ by @ Bt))
        return inverse, with_slopes(V, (D, lambda: V[..., None, None] * Bt))

    def _of_points(self, *arrays):
        """Without the axis of points where each element has one."""
        return [x[:, 0] for x in arrays] if self.element.order == 1 else arrays

    def _inverse(self, X):
        """(D^-1, w det D / 6) at the points of stresses and at those of the volume."""
        if self._last is not None and self._last[0] is X:
            return self._last[1]
        out = []
        for by_xi, weights in self.rules:
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
