"""How far each vertex of a body has turned."""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime import ROWS, A, Kernel, kernels_of

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
        for a in range(plan.each):
            N, u = body.gradients[plan.each * p + a], at.u[0, body.nodes[plan.each * p + a]]
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
                    column = body.strains[body.point[k] + j]
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
        numbers = dict(points="int", each="int", vertices="int")
        return Kernel("frames", self.turn, self.precision, arrays, numbers)


class Frames:
    """Mean rotations of the vertices of a potential's body, weighted by volume, on the device: `turned`, by columns."""

    def __init__(self, potential, parallel: bool):
        points, n, self.potential = potential.stress_points, potential.arrays.num_vertices, potential
        self.count = len(points.volumes), points.nodes.shape[1], n
        at = points.nodes.ravel()
        order = np.argsort(at, kind="stable")
        around = np.bincount(at, minlength=n)
        share = 1 / (np.bincount(at, np.repeat(points.volumes, self.count[1]), n) + 1e-300)
        gradients = points.gradients * points.volumes[:, None, None]
        self.turned = runtime.array(ROWS[3], 3 * n)
        self.body = SimpleNamespace(
            nodes=runtime.upload(at, ti.i32),
            gradients=runtime.upload(gradients.reshape(-1, 3), ROWS[3]),
            strains=runtime.array(ROWS[3], 3 * len(points.volumes)),
            start=runtime.upload(np.concatenate([[0], np.cumsum(around)]), ti.i32),
            point=runtime.upload(3 * (order // self.count[1]), ti.i32),  # where its strains begin
            share=runtime.upload(np.where(around > 0, share, 0), ti.f32),
            hard=runtime.array(ti.i32, n),
        )
        a, records = potential.arrays, dict(at=potential, body=self.body, frames=self)
        within, alone = parallel and not a.by_scene, parallel  # in one kernel with others, and in its own
        within, alone = (kernels_of(FrameKernels, a.precision, p).frames for p in (within, alone))
        self.part = within, records, dict(zip(("points", "each", "vertices"), self.count))
        self._launch = alone.bind(**records)

    def update(self) -> None:
        """To the displacement at which the potential is placed."""
        self._launch(**self.part[2])
        hard = np.nonzero(runtime.fetch(self.body.hard))[0]
        if len(hard):
            R = self.matrices()
            R[hard] = rotations_of(self._means()[hard])
            self.put(R)

    def matrices(self) -> np.ndarray:
        """Shape (num_vertices, 3, 3)."""
        return np.swapaxes(runtime.fetch(self.turned).reshape(-1, 3, 3), 1, 2).astype(np.float64)

    def put(self, R: np.ndarray) -> None:
        """Set them."""
        runtime.fill(self.turned, np.swapaxes(R, 1, 2).reshape(-1, 3))

    def _means(self) -> np.ndarray:
        """Mean deformation gradients."""
        b = {name: runtime.fetch(getattr(self.body, name)) for name in ("strains", "point", "start", "share")}
        columns = b["strains"].reshape(-1, 9)[b["point"] // 3]
        at = np.repeat(np.arange(self.count[2]), np.diff(b["start"]))
        sums = np.stack([np.bincount(at, columns[:, k], self.count[2]) for k in range(9)], 1) * b["share"][:, None]
        return np.swapaxes(sums.reshape(-1, 3, 3), 1, 2) + np.eye(3)


def rotations_of(F: np.ndarray) -> np.ndarray:
    """The rotation next to each F, shape (k, 3, 3): by Newton's iteration R <- (R + R^-T) / 2, which takes a fourth of the
    time of singular values; by those where F is nearly singular or mirrored.

    Higham 1986, Computing the Polar Decomposition, doi:10.1137/0907079.
    """
    x = np.ascontiguousarray(F.reshape(-1, 9).T)
    _, det = _cofactors(x)
    hard = ~(det > 0.05 * ((x**2).sum(0) / 3) ** 1.5)
    x[:, hard] = np.eye(3).reshape(9, 1)
    for _ in range(8):
        cofactors, det = _cofactors(x)
        x = 0.5 * (x + cofactors / det)
    R = x.T.reshape(-1, 3, 3).copy()
    if hard.any():
        U, _, V = np.linalg.svd(F[hard])
        U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
        R[hard] = U @ V
    return R


def _cofactors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cofactors and determinants of matrices whose numbers are rows of x, shape (9, k)."""
    a, b, c, d, e, f, g, h, i = x
    out = [e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g, b * g - a * h]
    out += [b * f - c * e, c * d - a * f, a * e - b * d]
    return np.stack(out), a * out[0] + b * out[1] + c * out[2]
