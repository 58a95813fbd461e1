"""Kernels that follow the motion of a surface: whether a list of pairs still holds, and which of them may have come near.

A list holds until a vertex has used up its slack by moving relative to its body, or to the mean of all bodies. Two convex
sets that a plane parts cannot meet while their corners move in straight lines and stay parted.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.listed_pair import MARGIN, OPPOSITE, ListedPair, between, three
from diffsim_ti.runtime import A, Kernel, as_kernel

BLOCK = 256  # vertices whose motion one thread compares
AT = dict(u="vectors2")
FOLLOWED = dict(body="ints", marked="ints", flags="ints", slack="vectors", frame="vectors", farthest="scalars")
FOLLOWED |= dict(before="vectors", built="vectors")
SIZES = "num_bodies", "markers", "body_block", "body_blocks", "blocks", "size", "number"
NUMBERS = dict(lost="float") | dict.fromkeys(SIZES, "int")


@dataclass(frozen=True)
class MotionKernels(ListedPair):
    """`frame`: mean motion of each body's markers since the list was made, then their mean, then that since `forces`."""

    @ti.func
    def follow_frames(self, scene: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for b in range(plan.num_bodies):
            total = self.vec4(0)
            for k in range(b * plan.markers, (b + 1) * plan.markers):
                total += at.u[plan.slot, scene.surface[scene.marked[k]]] - scene.built[scene.marked[k]]
            scene.frame[b] = (ti.cast(1, self.fp) / ti.cast(plan.markers, self.fp)) * total
        ti.loop_config(serialize=ti.static(runtime.runs_on_cpu()))
        for c in range(plan.body_blocks):
            total, latest = self.vec4(0), self.vec4(0)
            for b in range(c * plan.body_block, ti.min((c + 1) * plan.body_block, plan.num_bodies)):
                s = scene.marked[b * plan.markers]
                total += scene.frame[b]
                latest += at.u[plan.slot, scene.surface[s]] - scene.before[s]
            scene.frame[plan.num_bodies + 2 + 2 * c], scene.frame[plan.num_bodies + 3 + 2 * c] = total, latest
        ti.loop_config(serialize=True)
        for _ in range(1):
            total, latest, n = self.vec4(0), self.vec4(0), plan.num_bodies
            for c in range(plan.body_blocks):
                total += scene.frame[n + 2 + 2 * c]
                latest += scene.frame[n + 3 + 2 * c]
            scene.frame[n] = (ti.cast(1, self.fp) / ti.cast(n, self.fp)) * total
            scene.frame[n + 1] = (ti.cast(1, self.fp) / ti.cast(n, self.fp)) * latest

    @ti.func
    def compare_slacks(self, scene: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            move = at.u[plan.slot, scene.surface[s]] - scene.built[s]
            for k in range(1 + ti.cast(plan.num_bodies > 1, ti.i32)):
                origin, limit = scene.frame[scene.body[s]], scene.slack[s][0]
                if k == 1:
                    origin, limit = scene.frame[plan.num_bodies], scene.slack[s][1]
                square = (move - origin).norm_sqr()
                if not square <= limit * limit:
                    scene.flags[0] = 1
                if not square <= (limit + plan.lost) * (limit + plan.lost):
                    scene.flags[1] = 1

    @ti.func
    def find_farthest(self, scene: A, at: A, plan: A):
        """`farthest`: twice the longest way of all vertices since `forces`, relative to the mean, by which no pair closes
        more: that spares most pairs the look at their corners; then squares of it, of each BLOCK of vertices and above."""
        ti.loop_config(serialize=not self.parallel)
        for b in range(plan.blocks):
            most = ti.cast(0, self.fp)
            for s in range(b * BLOCK, ti.min((b + 1) * BLOCK, plan.num_surface)):
                move = at.u[plan.slot, scene.surface[s]] - scene.before[s] - scene.frame[plan.num_bodies + 1]
                most = ti.max(most, move.norm_sqr())
            scene.farthest[1 + b] = most
        ti.loop_config(serialize=ti.static(runtime.runs_on_cpu()))
        for c in range(plan.number):
            most = ti.cast(0, self.fp)
            for b in range(c * plan.size, ti.min((c + 1) * plan.size, plan.blocks)):
                most = ti.max(most, scene.farthest[1 + b])
            scene.farthest[1 + plan.blocks + c] = most
        ti.loop_config(serialize=True)
        for _ in range(1):
            most = ti.cast(0, self.fp)
            for c in range(plan.number):
                most = ti.max(most, scene.farthest[1 + plan.blocks + c])
            scene.farthest[0] = ti.cast(2 * MARGIN, self.fp) * ti.sqrt(most)

    @ti.func
    def closing(self, kind: A, p, scene: A, at: A, plan: A):
        """How far the corners of pair p have come towards each other along n since `forces`."""
        n, most = three(scene.plane[p]), ti.cast(-1e30, self.fp)
        for a, b in ti.static(OPPOSITE[kind]):
            i, k = scene.pairs[4 * p + a], scene.pairs[4 * p + b]
            y = scene.before[scene.place[i]] - scene.before[scene.place[k]]
            most = ti.max(most, n.dot(between(at.u, i, k, plan.slot) + three(y)))
        return most

    @ti.func
    def hold_all(self, scene: A, at: A, plan: A):
        for k in ti.static(range(3)):
            scene.flags[k] = 0
        self.follow_frames(scene, at, plan)
        self.compare_slacks(scene, at, plan)

    @cached_property
    def holds(self) -> Kernel:
        """flags: a vertex has used up its slack (0), or that and `lost` (1)."""
        return self._kernel("holds", self.hold_all, AT, FOLLOWED, **NUMBERS)

    @as_kernel("find", AT, dict(near="ints") | FOLLOWED, **NUMBERS)
    def find(self, scene: A, at: A, plan: A):
        """`near`: which pairs may be nearer than their width, where `forces` left planes or here; flags: a vertex
        has used up its slack (0), there is such a pair (2)."""
        self.hold_all(scene, at, plan)
        self.find_farthest(scene, at, plan)
        self.each_pair(self.flag, scene, at, plan)

    @ti.func
    def flag(self, kind: A, p, scene: A, at: A, plan: A):
        left, near = scene.plane[p][3] - self.width(p, scene), 0
        if not scene.farthest[0] < left:
            if not ti.max(self.closing(kind, p, scene, at, plan), ti.cast(0, self.fp)) < left:
                near = 1
                scene.flags[2] = 1
        scene.near[p] = near

    @ti.func
    def measure(self, kind: A, p, scene: A, at: A, plan: A):
        """Distance at rest of pair p, D, its unit normal and the weights of the corners; far for two bodies."""
        one, two = scene.place[scene.pairs[4 * p]], scene.place[scene.pairs[4 * p + 2]]
        plane, weights = self.vec4(0, 0, 0, ti.cast(1e30, self.fp)), self.vec4(0)
        if scene.body[one] == scene.body[two]:
            y1, y2, y3 = self.changes_at_rest(p, scene, scene.rest)
            w, r, _ = self.nearest(kind, y1, y2, y3)
            D = ti.sqrt(r.norm_sqr())
            n = r / ti.max(D, ti.cast(self.tiny, self.fp))
            plane, weights = self.vec4(n[0], n[1], n[2], D), w
        scene.rest_plane[p], scene.rest_weights[p] = plane, weights
        if ti.static(self.mixed):
            if scene.per_area[self.contact_of(p, scene)] == 0:
                scene.area[p] = ti.cast(1, self.fp)
        scene.plane[p] = self.vec4(0)

    @as_kernel(
        "begin", AT, lambda self: dict(built="vectors", body="ints") | (dict(per_area="ints") if self.mixed else {})
    )
    def begin(self, scene: A, at: A, plan: A):
        """A new list: where the surface is, how far apart pairs are at rest, and no planes yet."""
        self.each_pair(self.measure, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            scene.built[s] = at.u[plan.slot, scene.surface[s]]
