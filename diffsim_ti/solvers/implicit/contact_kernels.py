"""A kernel that brings contact to the finest level of a multigrid cycle."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, A, Kernel

ROTATIONS = 18  # the last ones change nothing
LEAST = 1e-9  # determinant of a block over its largest number, cubed, below which the host inverts it


@dataclass(frozen=True)
class ContactKernels:
    """scene: precision of contact's blocks; vectors: that they are worked on in."""

    scene: str
    vectors: str
    parallel: bool

    @property
    def fp(self):
        return PRECISIONS[self.vectors]

    @ti.func
    def to(self, fp: A, v):
        """Number by number: Taichi has no vector code for this."""
        return ti.Vector([ti.cast(v[0], fp), ti.cast(v[1], fp), ti.cast(v[2], fp), ti.cast(0, fp)])

    @ti.func
    def dot(self, a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    @ti.func
    def cross(self, a, b):
        x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        return ti.Vector([x, y, z, ti.cast(0, self.fp)])

    @ti.func
    def turned(self, v, i, frames: A):
        """R^T P v of vertex i: what it may do, turned back."""
        y = self.to(self.fp, frames.allowed[3 * i]) * v[0] + self.to(self.fp, frames.allowed[3 * i + 1]) * v[1]
        y += self.to(self.fp, frames.allowed[3 * i + 2]) * v[2]
        a, b = self.to(self.fp, frames.turned[3 * i]), self.to(self.fp, frames.turned[3 * i + 1])
        c = self.to(self.fp, frames.turned[3 * i + 2])
        return ti.Vector([self.dot(a, y), self.dot(b, y), self.dot(c, y), ti.cast(0, self.fp)])

    @ti.func
    def block_of(self, i, at: A, frames: A, body: A):
        """Columns of a diagonal block with the positive part of contact, by Jacobi's rotations: always of axes 0 and 1,
        which then change places with the third."""
        c0, c1 = self.to(self.fp, at.blocks[0, i]), self.to(self.fp, at.blocks[1, i])
        c2 = self.to(self.fp, at.blocks[2, i])
        one, none, half = ti.cast(1, self.fp), ti.cast(0, self.fp), ti.cast(0.5, self.fp)
        a, b, c = c0[0], c1[1], c2[2]
        ab, ac, bc = half * (c0[1] + c1[0]), half * (c0[2] + c2[0]), half * (c1[2] + c2[1])
        u, v, w = ti.Vector([one, 0, 0, 0]), ti.Vector([0, one, 0, 0]), ti.Vector([0, 0, one, 0])
        for _ in range(ROTATIONS):
            if ab != 0:
                theta = half * (b - a) / ab
                t = one / (ti.abs(theta) + ti.sqrt(theta * theta + one))
                if theta < 0:
                    t = none - t
                cos = one / ti.sqrt(t * t + one)
                sin, x, y, z = t * cos, ac, bc, u
                a, b, ab, ac, bc = a - t * ab, b + t * ab, none, cos * x - sin * y, sin * x + cos * y
                u, v = u * cos + v * (none - sin), z * sin + v * cos
            a, b, c, ab, ac, bc = b, c, a, bc, ab, ac
            u, v, w = v, w, u
        d0, d1, d2 = body.own[0, i], body.own[1, i], body.own[2, i]
        for _ in range(3):
            if a > 0:
                n = self.turned(u, i, frames)
                d0, d1, d2 = d0 + n * (a * n[0]), d1 + n * (a * n[1]), d2 + n * (a * n[2])
            a, b, c = b, c, a
            u, v, w = v, w, u
        return d0, d1, d2

    @ti.func
    def join_all(self, at: A, frames: A, turning: A, level: A, body: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.vertices):
            size = ti.cast(0, self.fp)
            for j in ti.static(range(3)):
                column = at.blocks[j, i]
                size += ti.cast(ti.abs(column[0]) + ti.abs(column[1]) + ti.abs(column[2]), self.fp)
            body.hard[i] = turning.hard[i]
            if size > 0 or body.touched[i] > 0:
                body.touched[i] = ti.cast(size > 0, ti.i32)
                d0, d1, d2 = self.block_of(i, at, frames, body)
                level.diagonal[3 * i] = self.to(ti.f32, d0)
                level.diagonal[3 * i + 1] = self.to(ti.f32, d1)
                level.diagonal[3 * i + 2] = self.to(ti.f32, d2)
                x0, x1, x2 = self.cross(d1, d2), self.cross(d2, d0), self.cross(d0, d1)
                det, most = self.dot(d0, x0), ti.max(d0[0], d1[1], d2[2])
                if det > ti.cast(LEAST, self.fp) * most * most * most:
                    factor = 1 / (det * plan.theta)
                    level.inverse[3 * i] = self.to(ti.f32, x0 * factor)
                    level.inverse[3 * i + 1] = self.to(ti.f32, x1 * factor)
                    level.inverse[3 * i + 2] = self.to(ti.f32, x2 * factor)
                else:
                    body.hard[i] = 1

    @cached_property
    def join(self) -> Kernel:
        """Diagonal blocks of a level, and their damped inverses, where contact is or was, edges and points that yield
        sideways left out, for which a cycle has no place; own: without contact. hard: the host has to look at it."""
        arrays = dict(at=dict(blocks=f"vectors2_{self.scene}"), frames=dict(turned="rows3", allowed="rows3"))
        arrays |= dict(turning=dict(hard="ints"), level=dict(diagonal="rows3", inverse="rows3"))
        arrays |= dict(body=dict(own="vectors2", touched="ints", hard="ints"))
        return Kernel("join", self.join_all, self.vectors, arrays, dict(vertices="int", theta="float"))
