"""Vertices that move by a basis in explicit passes, those that ties glue among them: a stage after the kick and drift.

With B the basis of what they can do and M their masses, where a pass has led each vertex by itself goes to the nearest place
that they can have, and so do velocities:

    u' = P u*,    v' = P v*,    P = B G^-1 B^T M,    G = B^T M B

That is the pass of the equations of motion in the numbers q of B, G q'' = B^T f: forces of constraint do no work, momentum
is kept where B has the rigid motions, and the largest frequency is at most that of vertices by themselves. Frames show
P (v + pre a). Derivatives by masses are dP x = S dM (x - P x) with S = B G^-1 B^T. Each pass takes products with B, which is
dense.
"""

import numpy as np

from diffsim_ti.common.blas_threads import one_blas_thread
from diffsim_ti.differentiation.arrays import made, value_of
from diffsim_ti.mechanics.corrections import Correction
from diffsim_ti.terms.reduced import Together


class Projection:
    """P and S of one set, for vectors of its vertices, shape (k, 3)."""

    def __init__(self, body: Together, mass: np.ndarray):
        self.B, self.mass = body.basis, mass[:, None]
        weights = mass if body.per_component else np.repeat(mass, 3)
        self.left = np.linalg.solve(self.B.T @ (weights[:, None] * self.B), self.B.T).T  # B G^-1

    def S(self, y: np.ndarray) -> np.ndarray:
        return (self.left @ (self.B.T @ y.reshape(len(self.B), -1))).reshape(y.shape)

    def P(self, x: np.ndarray) -> np.ndarray:
        return self.S(self.mass * x)

    def transposed(self, y: np.ndarray) -> np.ndarray:
        return self.mass * self.S(y)


class ProjectedSets(Correction):
    """Those of a run's scene."""

    def __init__(self, workspace):
        self.bodies = workspace.scene.reduced.by_basis
        self._first, self._known = np.cumsum([0, *(len(body.vertices) for body in self.bodies)]), (None, ())
        super().__init__(workspace, np.concatenate([body.vertices for body in self.bodies]))

    @property
    def mass(self) -> np.ndarray:
        return self.ws.arrays.values.mass[self.nodes]

    @one_blas_thread
    def each(self, name: str, x: np.ndarray) -> np.ndarray:
        """ "P", "S" or "transposed" of vectors of all sets' vertices, shape (n, 3)."""
        values = self.ws.arrays.values
        parts = [slice(*ends) for ends in zip(self._first, self._first[1:])]
        if self._known[0] is not values:
            self._known = values, [Projection(body, self.mass[own]) for body, own in zip(self.bodies, parts)]
        return np.concatenate([getattr(p, name)(x[own]) for p, own in zip(self._known[1], parts)])

    def pulled(self, forces: np.ndarray) -> np.ndarray:
        """Forces [N] on all vertices with those that hold the sets together."""
        out = np.array(forces)
        out[self.nodes] = self.each("transposed", out[self.nodes])
        return out

    def _projected(self, of, x: np.ndarray) -> np.ndarray:
        """P x"""
        at = value_of(x)
        there, each = self.each("P", at), self.each
        by_mass = (lambda dm: each("S", dm[:, None] * (at - there)), lambda w: (each("S", w) * (at - there)).sum(1))
        return made(there, (x, lambda dx: each("P", dx), lambda w: each("transposed", w)), (of.mass, *by_mass))

    def ends(self, of, at, u, y, v, found=None):
        return self._projected(of, y), self._projected(of, v), None

    def shown(self, of, at, u, v, found=None):
        if found is not None:
            return v + found / of.mass[:, None], found
        out = self._projected(of, v)
        return out, self.mass[:, None] * value_of(out - v)
