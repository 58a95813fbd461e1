"""Kernels of how far each vertex of a body has turned, in float32."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import Kernel

A = ti.template()
ROUNDS, NEAR = 8, 1e-7  # of Newton's iteration for rotations, at most; the square of a change that makes it the last


@dataclass(frozen=True)
class FrameKernels:
    """precision: of displacements."""

    precision: str
    parallel: bool

    @ti.func
    def cofactors(self, x):
        a = ti.Vector([x[0, 0], x[1, 0], x[2, 0]], ti.f32)
        b = ti.Vector([x[0, 1], x[1, 1], x[2, 1]], ti.f32)
        c = ti.Vector([x[0, 2], x[1, 2], x[2, 2]], ti.f32)
        return ti.Matrix.cols([b.cross(c), c.cross(a), a.cross(b)])

    @ti.func
    def strain(self, p, at: A, body: A, plan: A):
        """Volume times du/dX at a point, by columns."""
        h = ti.Matrix.zero(ti.f32, 3, 3)
        for a in range(plan.nodes):
            N, u = body.gradients[plan.nodes * p + a], at.u[0, body.nodes[plan.nodes * p + a]]
            for i, j in ti.static(ti.ndrange(3, 3)):
                h[i, j] += ti.cast(u[i], ti.f32) * N[j]
        for j in ti.static(range(3)):
            body.strains[3 * p + j] = ti.Vector([h[0, j], h[1, j], h[2, j], 0.0], ti.f32)

    @ti.func
    def rotation(self, F, i, body: A):
        """The rotation next to F by X <- (X + X^-T) / 2; the identity and a mark where F is nearly singular or mirrored."""
        R, C = ti.Matrix.identity(ti.f32, 3), self.cofactors(F)
        det = F[0, 0] * C[0, 0] + F[1, 0] * C[1, 0] + F[2, 0] * C[2, 0]
        body.hard[i] = 1
        size = F.norm_sqr() * ti.cast(1 / 3, ti.f32)
        if det > ti.cast(0.05, ti.f32) * size * ti.sqrt(size):
            body.hard[i] = 0
            X = F
            for _ in range(ROUNDS):
                C = self.cofactors(X)
                det = X[0, 0] * C[0, 0] + X[1, 0] * C[1, 0] + X[2, 0] * C[2, 0]
                change = ti.cast(0.5, ti.f32) * (C / det - X)
                X += change
                if change.norm_sqr() < ti.cast(NEAR, ti.f32):
                    break
            R = X
        return R

    @ti.func
    def turn(self, at: A, body: A, frames: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.points):
            self.strain(p, at, body, plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.vertices):
            F = ti.Matrix.identity(ti.f32, 3)
            for k in range(body.start[i], body.start[i + 1]):
                for j in ti.static(range(3)):
                    column = body.strains[3 * body.point[k] + j]
                    for d in ti.static(range(3)):
                        F[d, j] += column[d] * body.share[i]
            R = self.rotation(F, i, body)
            for j in ti.static(range(3)):
                frames.turned[3 * i + j] = ti.Vector([R[0, j], R[1, j], R[2, j], 0.0], ti.f32)

    @cached_property
    def frames(self) -> Kernel:
        """The rotation next to the mean of du/dX + 1 around each vertex, by columns."""
        body = dict(nodes="ints", gradients="rows3", strains="rows3", start="ints", point="ints", share="singles")
        arrays = dict(at=dict(u="vectors2"), body=body | dict(hard="ints"), frames=dict(turned="rows3"))
        numbers = dict(points="int", nodes="int", vertices="int")
        return Kernel("frames", self.turn, self.precision, arrays, numbers)
