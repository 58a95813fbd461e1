"""Jobs by a tape over Taichi kernels, as DiffTaichi's examples are written: every substep's state is kept, kernels are
differentiated by Taichi, and a vertex that meets the floor stops there, at its time of impact within the substep."""

import numpy as np
import taichi as ti
from job import answer_all, timed

ti.init(ti.cpu, default_fp=ti.f32, log_level=ti.ERROR)


def numbers_of(job) -> tuple:
    """What kernels are compiled for."""
    floor = 1.0 if job.ground.size else 0.0
    sizes = job.substeps, job.frames, len(job.vertices), len(job.tetrahedra)
    return float(job.h), float(job.keep), float(job.gravity), floor, *sizes


@ti.data_oriented
class Body:
    def __init__(self, job):
        n, m, self.steps = len(job.vertices), len(job.tetrahedra), job.frames * job.substeps
        self.h, self.keep, self.gravity, self.floor, self.seen, *_ = numbers_of(job)
        self.x, self.v, self.f = (ti.Vector.field(3, ti.f32, (self.steps + 1, n), needs_grad=True) for _ in range(3))
        self.E, self.loss = (ti.field(ti.f32, (), needs_grad=True) for _ in range(2))
        self.seeds, self.nu = ti.Vector.field(3, ti.f32, (job.frames + 1, n)), ti.field(ti.f32, ())
        self.B, self.W, self.m = ti.Matrix.field(3, 3, ti.f32, m), ti.field(ti.f32, m), ti.field(ti.f32, n)
        self.free, self.tet = ti.field(ti.f32, n), ti.field(ti.i32, (m, 4))

    @ti.kernel
    def elastic(self, s: ti.i32):
        for e in self.W:
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
        for i in self.m:
            pull = ti.Vector([0.0, self.gravity, 0.0])
            v = self.free[i] * self.keep * (self.v[s, i] + self.h * (self.f[s, i] / self.m[i] + pull))
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
        x, v = (np.zeros((self.steps + 1, len(job.start), 3), np.float32) for _ in range(2))
        x[0], v[0] = job.start, job.velocities
        free = ~np.isin(np.arange(len(job.start)), job.fixed)
        given = {self.B: np.linalg.inv(job.rest_edges), self.W: job.volumes, self.m: job.masses, self.free: free}
        for field, array in (given | {self.x: x, self.v: v}).items():
            field.from_numpy(np.ascontiguousarray(array, np.float32))
        self.tet.from_numpy(np.ascontiguousarray(job.tetrahedra, np.int32))
        self.f.fill(0)
        self.E[None], self.nu[None], self.loss[None] = float(job.E), float(job.nu), 0.0

    def substeps(self):
        for s in range(self.steps):
            self.elastic(s)
            self.advance(s)


BODIES: dict = {}


def work(job):
    one, job = len(job.vertices), job.in_one()
    key = numbers_of(job)
    if key not in BODIES:
        BODIES[key] = Body(job)
    body = BODIES[key]

    def run():
        body.start(job)
        body.substeps()
        positions = body.x.to_numpy()[:: job.substeps]
        if not job.differentiates:
            return positions, {}
        body.seeds.from_numpy(job.adjoints(positions).astype(np.float32))
        body.start(job)
        with ti.ad.Tape(body.loss):
            body.substeps()
            body.watch()
        by_start = body.x.grad.to_numpy()[0].astype(float)
        return positions, dict(youngs_modulus=float(body.E.grad[None]), initial_positions=by_start[:one])

    seconds, (positions, gradients) = timed(run, job.repeats, compiles=job.repeats > 1)
    return seconds, positions[:, :one], gradients


if __name__ == "__main__":
    answer_all(work)
