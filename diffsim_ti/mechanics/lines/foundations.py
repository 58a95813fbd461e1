"""Elastic foundations: at each vertex that lies on one, f = -K u."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.differentiation.arrays import summed_at
from diffsim_ti.mechanics.host_force import VertexwiseHostForce
from diffsim_ti.mechanics.interaction import VertexwiseForce
from diffsim_ti.runtime import A, traced


@dataclass(frozen=True)
class FoundationForce(VertexwiseForce):
    """Functions of one vertex i."""

    name = "foundation"
    arrays = dict(foundation_slot="ints")  # place among those on one, or -1
    derived = dict(foundation="vectors")  # three rows of K each [N/m]
    adjoints = dict(foundation_adjoint="vectors")

    @traced
    def sizes(self, plan) -> dict:
        return super().sizes(plan) | dict(foundation_adjoint=plan.len_foundation)

    @ti.func
    def product(self, i, u, scene: A, stiffness: A):
        """-K u; stiffness: rows of K, or of its change. K is symmetric, so this is also the product with the transpose."""
        f, k = self.vector(0), scene.foundation_slot[i]
        if k >= 0:
            for d in ti.static(range(3)):
                f[d] = ti.cast(-1, self.fp) * stiffness[3 * k + d].dot(u)
        return f

    @ti.func
    def force(self, i, u, v, now: A, scene: A):
        return self.product(i, u, scene, scene.foundation)

    @ti.func
    def force_jvp(self, i, u, v, du, dv, now: A, scene: A, tangent: A):
        return self.product(i, du, scene, scene.foundation) + self.product(i, u, scene, tangent.foundation)

    @ti.func
    def force_vjp(self, i, u, v, w, now: A, scene: A, adjoint: A):
        k = scene.foundation_slot[i]
        if k >= 0:
            for d in ti.static(range(3)):
                row = adjoint.foundation_adjoint[3 * k + d]
                adjoint.foundation_adjoint[3 * k + d] = row - w[d] * u
        return self.product(i, w, scene, scene.foundation), self.vector(0)


class FoundationOnHost(VertexwiseHostForce):
    """Of vertices that lie on one."""

    def __init__(self, vertices: np.ndarray):
        self.vertices = vertices

    def take(self, values, instant):
        self.K = values.foundation.reshape(-1, 3, 3)
        return super().take(values, instant)

    def own_blocks(self, u):
        return self.K

    def forces(self, u):
        return -summed_at(self.vertices, np.einsum("kij,kj->ki", self.K, u[self.vertices]), len(u))

    def energies(self, u):
        return -0.5 * (self.forces(u) * u)[self.vertices].sum(1)

    def stored(self, u):
        return dict(foundations=float(self.energies(u).sum()))

    def turning(self, u, w):
        return 0.0
