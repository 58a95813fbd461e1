"""Kernels over the pairs of a surface for Newton's method: forces, the Hessian and its convex part, safe shares of a step.

A list has many more pairs than are nearer than their width. `place` says which these are, and all else reads what it left
at the same displacement.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import OPPOSITE, SAFE, ListedPair, between, three
from diffsim_ti.mechanics.surfaces.pair_kernels import PairKernels
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE
from diffsim_ti.runtime import A, Kernel, as_kernel, kernels_of
from diffsim_ti.terms.obstacles import barrier

MOST_PLANES = 50  # that part a pair on its way
ACTING = dict(acting="ints", nearest="vectors", inverse="vectors")


@dataclass(frozen=True)
class HessianKernels(ListedPair):
    """Forces at u[slot], and products and diagonals of the Hessian there.

    acting: of each row of `corner_of` those of pairs that are nearer than the width, then -1; nearest, inverse: of these
    pairs the weights of the corners, and G (proximity.py).
    """

    @cached_property
    def pair(self) -> PairKernels:
        return kernels_of(PairKernels, self.precision, self.first, self.parallel, True)

    @ti.func
    def nearest_of(self, p, scene: A, y1, y2, y3):
        """(weights of the corners, r) that `place` has found of pair p."""
        w = scene.nearest[p]
        return w, w[1] * y1 + w[2] * y2 + w[3] * y3

    # ---- forces ------------------------------------------------------------------------------------------------------

    @as_kernel("place", dict(u="vectors2", out="vectors"), ACTING | dict(energy="scalars", touched="ints"), exact="int")
    def place(self, scene: A, at: A, plan: A):
        """As `forces` of PairKernels; and which corners are of pairs that act."""
        self.each_pair(self.pair.force, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total, k, end = self.vec4(0), scene.row[s], scene.row[s + 1]
            if scene.touched[s] > 0:
                scene.touched[s] = 0
                for m in range(scene.row[s], end):
                    corner = scene.corner_of[m]
                    if self.is_active(corner >> 2, scene):
                        total += scene.corner[corner]
                        scene.acting[k] = corner
                        k += 1
            if k < end:
                scene.acting[k] = -1
            at.out[plan.first_out + s] = total

    @ti.func
    def sum_corners(self, scene: A, out: A, plan: A):
        """What the pairs that act have stored for each surface vertex."""
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total = self.vec4(0)
            for k in range(scene.row[s], scene.row[s + 1]):
                if scene.acting[k] < 0:
                    break
                total += scene.corner[scene.acting[k]]
            out[plan.first_out + s] = total

    @ti.func
    def stiffness_along(self, kind: A, p, y1, y2, y3, scene: A, plan: A):
        """(weights of the corners, n, m phi''): the convex part of a pair's Hessian is m phi'' (w n)(w n)^T."""
        stiffness, width = self.numbers(p, scene)
        w, r = self.nearest_of(p, scene, y1, y2, y3)
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
        if self.is_active(p, scene):
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            dy1, dy2, dy3 = self.changes(p, scene, at.w, 0)
            stiffness, width = self.numbers(p, scene)
            scale, radius, none = self.scale_of(kind, p, scene, plan), self.radius_of(p, scene), ti.cast(0, self.fp)
            w, r = self.nearest_of(p, scene, y1, y2, y3)
            g = three(scene.inverse[p])
            h1, h2, h3, by_stiffness, by_width, by_radius = self.gradient_jvp(
                kind, w, r, g, (y1, y2, y3), (dy1, dy2, dy3), (scale, stiffness, width, radius), (none, none, none)
            )
            self.store(p, scene, h1, h2, h3)

    @cached_property
    def products(self) -> Kernel:
        """Change of the forces for changes w of the positions."""
        at = dict(u="vectors2", w="vectors2", out="vectors")
        return self._kernel("pair_products", self.all_products, at, ACTING)

    @ti.func
    def convex_product(self, kind: A, p, scene: A, at: A, plan: A):
        if self.is_active(p, scene):
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            dy1, dy2, dy3 = self.changes(p, scene, at.w, 0)
            w, n, k = self.stiffness_along(kind, p, y1, y2, y3, scene, plan)
            pull = k * (w[1] * n.dot(dy1) + w[2] * n.dot(dy2) + w[3] * n.dot(dy3)) * n
            self.store(p, scene, w[1] * pull, w[2] * pull, w[3] * pull)

    @as_kernel("convex_products", dict(u="vectors2", w="vectors2", out="vectors"), ACTING)
    def convex_products(self, scene: A, at: A, plan: A):
        """The same of the convex part of the energy alone."""
        self.each_pair(self.convex_product, scene, at, plan)
        self.sum_corners(scene, at.out, plan)

    # ---- diagonal ----------------------------------------------------------------------------------------------------

    @ti.func
    def root(self, kind: A, p, scene: A, at: A, plan: A):
        """Of each corner, the vector c with c c^T its diagonal block of the convex part."""
        if self.is_active(p, scene):
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w, n, k = self.stiffness_along(kind, p, y1, y2, y3, scene, plan)
            for a in ti.static(range(4)):
                scene.corner[4 * p + a] = self.four(w[a] * ti.sqrt(k) * n)

    @ti.func
    def root_or_none(self, kind: A, p, scene: A, at: A, plan: A):
        for a in ti.static(range(4)):
            scene.corner[4 * p + a] = self.vec4(0)
        self.root(kind, p, scene, at, plan)

    @as_kernel("pair_roots", dict(u="vectors2"), ACTING)
    def roots(self, scene: A, at: A, plan: A):
        """Of each corner its vector c: the convex part between corners a and b is c_a c_b^T; zero where none acts."""
        self.each_pair(self.root_or_none, scene, at, plan)

    @as_kernel("pair_blocks", dict(u="vectors2", out="vectors2"), ACTING, anew="int")
    def blocks(self, scene: A, at: A, plan: A):
        """Adds the 3x3 diagonal blocks of the convex part to rows 0..2 of `out`, one column of each vertex; or puts them
        there `anew`."""
        self.each_pair(self.root, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            for d in ti.static(range(3)):
                column = self.vec4(0)
                for k in range(scene.row[s], scene.row[s + 1]):
                    if scene.acting[k] < 0:
                        break
                    c = scene.corner[scene.acting[k]]
                    column += c[d] * c
                if plan.anew == 0:
                    column += at.out[d, scene.surface[s]]
                at.out[d, scene.surface[s]] = column

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
    def flag(self, kind: A, p, scene: A, at: A, plan: A):
        if not self.first_share(kind, p, scene, at) >= plan.most:
            scene.flags[2] = 1

    @as_kernel("clear", dict(w="vectors2"), dict(flags="ints"), most="float")
    def clear(self, scene: A, at: A, plan: A):
        """flags[2]: some pair is not kept apart by its plane, from where `place` has been, on all of the step w."""
        self.each_pair(self.flag, scene, at, plan)

    @ti.func
    def first_share(self, kind: A, p, scene: A, at: A):
        """The share of the step w up to which the plane of a pair keeps as much of its gap as `share` says."""
        plane = scene.plane[p]
        return (plane[3] - self.least_gap(p, scene)) / self.closing(kind, three(plane), p, scene, at)

    @ti.func
    def least_gap(self, p, scene: A):
        half = ti.cast(0.5, self.fp) * self.width(p, scene)
        return ti.min(ti.cast(1 - SAFE, self.fp) * scene.plane[p][3], half)

    @ti.func
    def share(self, kind: A, p, scene: A, at: A, plan: A):
        """The share of the step w, if below `most`, after which the pair has closed all but 1 - SAFE of its gap, or half of
        the width if that is less, and half as much again: planes that part it on the way say how far it may go on.
        Li, Kaufman, Jiang 2021, Codimensional Incremental Potential Contact, doi:10.1145/3450626.3459767, algorithm 1."""
        one, radius, least = ti.cast(1, self.fp), self.radius_of(p, scene), self.least_gap(p, scene)
        share = self.first_share(kind, p, scene, at)
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
        scene.share[p] = share

    @as_kernel("shares", dict(u="vectors2", w="vectors2"), dict(share="scalars"), most="float")
    def shares(self, scene: A, at: A, plan: A):
        """`share` of every pair, from where `place` has been."""
        self.each_pair(self.share, scene, at, plan)
