"""Elastic foundations in explicit passes: at each vertex that lies on one, f = -K u."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import PRECISIONS

A = ti.template()  # an array or Bundle handed to a Taichi function
FOUNDED = dict(foundation_slot="ints", foundation="vectors")  # place among those on one, or -1; three rows of K each


@dataclass(frozen=True)
class Foundations:
    """Functions of one vertex i."""

    precision: str

    @property
    def fp(self):
        return PRECISIONS[self.precision]

    @property
    def vector(self):
        return ti.types.vector(4, self.fp)

    @ti.func
    def force(self, i, u, scene: A, stiffness: A):
        """-K u; stiffness: rows of K, or of its change. K is symmetric, so this is also the product with the transpose."""
        f, k = self.vector(0), scene.foundation_slot[i]
        if k >= 0:
            for d in ti.static(range(3)):
                f[d] = ti.cast(-1, self.fp) * stiffness[3 * k + d].dot(u)
        return f

    @ti.func
    def add_vjp(self, i, u, f_adj, scene: A, adjoint: A):
        k = scene.foundation_slot[i]
        if k >= 0:
            for d in ti.static(range(3)):
                row = adjoint.foundation_felt[3 * k + d]
                adjoint.foundation_felt[3 * k + d] = row - f_adj[d] * u
