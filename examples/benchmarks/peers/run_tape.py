"""Jobs by a tape over Taichi kernels, as DiffTaichi's examples are written: every substep's state is kept, kernels are
differentiated by Taichi, and a vertex that meets the floor stops there, at its time of impact within the substep."""

import numpy as np
import taichi as ti
from job import answer_all, timed

ti.init(ti.cpu, default_fp=ti.f32, log_level=ti.ERROR)


def numbers_of(job) -> tuple:
    """What kernels are compiled for."""
    floor = 1.0 if job.ground.size else 0.0
    return float(job.h), float(job.keep), float(job.gravity), floor, job.substeps, job.frames


@ti.data_oriented
class Body:
    """Room for a job, which a smaller one may use after it."""

    def __init__(self, job):
        self.n, self.m, self.steps = len(job.vertices), len(job.tetrahedra), job.frames * job.substeps
        self.h, self.keep, self.gravity, self.floor, self.seen, frames = numbers_of(job)
        n, m = self.n, self.m
        self.x, self.v, self.f = (ti.Vector.field(3, ti.f32, (self.steps + 1, n), needs_grad=True) for _ in range(3))
        self.E, self.loss = (ti.field(ti.f32, (), needs_grad=True) for _ in range(2))
        self.seeds, self.nu = ti.Vector.field(3, ti.f32, (frames + 1, n)), ti.field(ti.f32, ())
        self.B, self.W, self.mass = ti.Matrix.field(3, 3, ti.f32, m), ti.field(ti.f32, m), ti.field(ti.f32, n)
        self.free, self.tet, self.count = ti.field(ti.f32, n), ti.field(ti.i32, (m, 4)), ti.field(ti.i32, 2)

    @ti.kernel
    def elastic(self, s: ti.i32):
        for e in range(self.count[0]):
            mu = self.E[None] / (2 * (1 + self.nu[None]))
            nu = self.nu[None]
            bulk = self.E[None] * nu / ((1 + nu) * (1 - 2 * nu)) + 5 * mu / 6
            a, b, c, d = self.tet[e, 0], self.tet[e, 1], self.tet[e, 2], self.tet[e, 3]
            x0 = self.x[s, a]
            F = ti.Matrix.cols([self.x[s, b] - x0, self.x[s, c] - x0, self.x[s, d] - x0]) @ self.B[e]
            p, q, r = F[:, 0], F[:, 1], F[:, 2]
            C = ti.Matrix.cols([q.cross(r), r.cross(p), p.cross(q)])
            m = 4 * mu / 3
            P = m * (1 - 1 / (F.norm_sqr() + 1)) * F + (bulk * (p.dot(q.cross(r)) - 1) - 0.75 * m) * C
            H = -self.W[e] * P @ self.B[e].transpose()
            self.f[s, b] += H[:, 0]
            self.f[s, c] += H[:, 1]
            self.f[s, d] += H[:, 2]
            self.f[s, a] -= H[:, 0] + H[:, 1] + H[:, 2]

    @ti.kernel
    def advance(self, s: ti.i32):
        for i in range(self.count[1]):
            pull = ti.Vector([0.0, self.gravity, 0.0])
            v = self.free[i] * self.keep * (self.v[s, i] + self.h * (self.f[s, i] / self.mass[i] + pull))
            x, toi, after = self.x[s, i], 0.0, v
            if self.floor > 0 and x[1] + self.h * v[1] < 0 and v[1] < -1e-4:
                toi = -x[1] / v[1]
                after = ti.Vector([0.0, 0.0, 0.0])
            self.v[s + 1, i] = after
            self.x[s + 1, i] = x + toi * v + (self.h - toi) * after

    @ti.kernel
    def watch(self):
        for j, i in self.seeds:
            self.loss[None] += self.seeds[j, i].dot(self.x[j * self.seen, i])

    def start(self, job):
        n, m = len(job.start), len(job.tetrahedra)
        x, v = (np.zeros((self.steps + 1, self.n, 3)) for _ in range(2))
        x[0, :n], v[0, :n] = job.start, job.velocities
        given = {self.x: x, self.v: v, self.B: np.linalg.inv(job.rest_edges), self.W: job.volumes}
        given |= {self.mass: job.masses, self.free: ~np.isin(np.arange(n), job.fixed), self.tet: job.tetrahedra}
        for field, array in given.items():
            filled(field, array)
        self.f.fill(0)
        self.E[None], self.nu[None], self.loss[None] = float(job.E), float(job.nu), 0.0
        self.count[0], self.count[1] = m, n

    def substeps(self):
        for s in range(self.steps):
            self.elastic(s)
            self.advance(s)


def filled(field, array) -> None:
    """The first rows of a field, zeros after them."""
    inner = (field.n, field.m)[: field.ndim] if isinstance(field, ti.MatrixField) else ()
    whole = np.zeros((*field.shape, *inner), np.int32 if field.dtype == ti.i32 else np.float32)
    whole[tuple(slice(k) for k in np.shape(array))] = array
    field.from_numpy(whole)


BODIES: dict = {}


def work(job):
    one, job = len(job.vertices), job.in_one()
    key, n = numbers_of(job), len(job.vertices)
    if key not in BODIES or BODIES[key].n < n or BODIES[key].m < len(job.tetrahedra):
        BODIES[key] = Body(job)
    body = BODIES[key]

    def run():
        body.start(job)
        body.substeps()
        positions = body.x.to_numpy()[:: job.substeps, :n]
        if not job.differentiates:
            return positions, {}
        filled(body.seeds, job.adjoints(positions))
        body.start(job)
        with ti.ad.Tape(body.loss):
            body.substeps()
            body.watch()
        by_start = body.x.grad.to_numpy()[0, :one].astype(float)
        return positions, dict(youngs_modulus=float(body.E.grad[None]), initial_positions=by_start)

    seconds, (positions, gradients) = timed(run, job.repeats, compiles=job.repeats > 1)
    return seconds, positions[:, :one], gradients


if __name__ == "__main__":
    answer_all(work)
