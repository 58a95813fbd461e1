"""Kernels over the pairs of a surface for Newton's method: the Hessian's convex part, and safe shares of a step.

They read the planes that `forces` (pair_kernels.py) left at the same displacement: a pair that its plane keeps beyond the
width has no part in the Hessian.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import OPPOSITE, SAFE, ListedPair, between, three
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE
from diffsim_ti.runtime import Kernel
from diffsim_ti.terms.obstacles import barrier

A = ti.template()
MOST_PLANES = 50  # that part a pair on its way


@dataclass(frozen=True)
class HessianKernels(ListedPair):
    """Products and diagonal of the convex part of the Hessian at u[slot]."""

    @ti.func
    def stiffness_along(self, kind: A, p, y1, y2, y3, scene: A, plan: A):
        """(weights of the corners, n, m phi''): the convex part of a pair's Hessian is m phi'' (w n)(w n)^T."""
        stiffness, width = self.numbers(p, scene)
        w, r, _ = self.nearest(kind, y1, y2, y3)
        length, k = ti.sqrt(r.norm_sqr()), ti.cast(0, self.fp)
        d = length - self.radius_of(p, scene)
        if d < width:
            k = stiffness * barrier.curvature(d / width, self.fp)
            if ti.static(kind == EDGE_EDGE):
                m, _, _ = self.mollifier((self.scale_of(kind, p, scene, plan) * y1.cross(y3 - y2)).norm_sqr())
                k *= m
        return w, r / ti.max(length, ti.cast(1e-30, self.fp)), k

    # ---- products ----------------------------------------------------------------------------------------------------

    @ti.func
    def product(self, kind: A, p, scene: A, at: A, plan: A):
        h1, h2, h3 = self.vec3(0), self.vec3(0), self.vec3(0)
        if self.is_active(p, scene):
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            dy1, dy2, dy3 = self.changes(p, scene, at.w, 0)
            w, n, k = self.stiffness_along(kind, p, y1, y2, y3, scene, plan)
            pull = k * (w[1] * n.dot(dy1) + w[2] * n.dot(dy2) + w[3] * n.dot(dy3)) * n
            h1, h2, h3 = w[1] * pull, w[2] * pull, w[3] * pull
        self.store(p, scene, h1, h2, h3)

    @cached_property
    def products(self) -> Kernel:
        """Change of the forces for changes w of the positions, of the convex part of the energy alone."""
        at = dict(u="vectors2", w="vectors2", out="vectors")
        return self.kernel("convex_products", self.all_products, at)

    # ---- diagonal ----------------------------------------------------------------------------------------------------

    @ti.func
    def root(self, kind: A, p, scene: A, at: A, plan: A):
        """Of each corner, the vector c with c c^T its diagonal block of the convex part."""
        c = (self.vec4(0), self.vec4(0), self.vec4(0), self.vec4(0))
        if self.is_active(p, scene):
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w, n, k = self.stiffness_along(kind, p, y1, y2, y3, scene, plan)
            for a in ti.static(range(4)):
                c[a] += self.four(w[a] * ti.sqrt(k) * n)
        for a in ti.static(range(4)):
            scene.corner[4 * p + a] = c[a]

    @ti.func
    def add_blocks(self, scene: A, at: A, plan: A):
        self.each_pair(self.root, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            for d in ti.static(range(3)):
                column = self.vec4(0)
                for k in range(scene.row[s], scene.row[s + 1]):
                    c = scene.corner[scene.corner_of[k]]
                    column += c[d] * c
                at.out[d, scene.surface[s]] += column

    @cached_property
    def blocks(self) -> Kernel:
        """Adds the 3x3 diagonal blocks of the convex part to rows 0..2 of `out`, one column of each vertex."""
        return self.kernel("blocks", self.add_blocks, dict(u="vectors2", out="vectors2"))

    # ---- how far a step may go ---------------------------------------------------------------------------------------

    @ti.func
    def closing(self, kind: A, n, p, scene: A, at: A):
        """How far the corners of pair p come towards each other along n in the whole step w, at most."""
        closing = ti.cast(1e-30, self.fp)
        for a, b in ti.static(OPPOSITE[kind]):
            i, k = scene.pairs[4 * p + a], scene.pairs[4 * p + b]
            closing = ti.max(closing, n.dot(between(at.w, i, k, 0)))
        return closing

    @ti.func
    def share(self, kind: A, p, scene: A, at: A, plan: A):
        """The share of the step w, if below `most`, after which the pair has closed all but 1 - SAFE of its gap, or half of
        the width if that is less, and half as much again, to out: planes that part it on the way say how far it may go on.
        Li, Kaufman, Jiang 2021, Codimensional Incremental Potential Contact, doi:10.1145/3450626.3459767, algorithm 1."""
        plane, one = scene.plane[p], ti.cast(1, self.fp)
        radius, half = self.radius_of(p, scene), ti.cast(0.5, self.fp) * self.width(p, scene)
        least = ti.min(ti.cast(1 - SAFE, self.fp) * plane[3], half)
        share = (plane[3] - least) / self.closing(kind, three(plane), p, scene, at)
        goes_on = share < plan.most
        if goes_on:
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w1, w2, w3 = self.changes(p, scene, at.w, 0)
            for _ in range(MOST_PLANES):
                if goes_on:
                    w, r, g = self.nearest(kind, y1 + share * w1, y2 + share * w2, y3 + share * w3)
                    length = ti.max(ti.sqrt(r.norm_sqr()), ti.cast(self.tiny, self.fp))
                    room = length - radius - least
                    goes_on = room > ti.cast(0.5, self.fp) * least
                    if goes_on:
                        share += room / self.closing(kind, (one / length) * r, p, scene, at)
                        goes_on = share < plan.most
        at.out[p] = share

    @ti.func
    def all_shares(self, scene: A, at: A, plan: A):
        self.each_pair(self.share, scene, at, plan)

    @cached_property
    def shares(self) -> Kernel:
        return self.kernel("shares", self.all_shares, dict(u="vectors2", w="vectors2", out="scalars"), most="float")
