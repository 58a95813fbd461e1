"""Boxes of surface primitives in a binary tree, to find those that overlap a given box without a look at the others.

Primitives follow a space-filling curve, and each leaf holds the next GROUP of them; a group walks the tree as one. Node k
has children 2 k and 2 k + 1, so that links need no memory and the next node of a walk without the present node's children
is k + 1, halved while it is even. Each box is widened by half the base reach and by the slack of its corners, so that boxes
of primitives within reach of each other overlap, whatever their slack.
Morton 1966; Karras 2012, Maximizing Parallelism in the Construction of BVHs, HPG 2012, 33-37.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import put
from diffsim_ti.mesh.geometry import curve_order
from diffsim_ti.runtime import LANES, NUMPY, A, Kernel, kernels_of, number_type, vector_type

GROUP = LANES  # primitives in a leaf
SUBTREES = 64  # that a CPU's threads gather up, each by itself; a GPU has so many leaves in each
MARGIN = 1.01  # of the widening; a hundredth more than the exact distances of the pairs take
TREE = dict(corners="ints", order="ints", slacks="vectors", items="vectors", lanes="blocks", boxes="vectors")


# ---- walks -----------------------------------------------------------------------------------------------------------


@ti.func
def overlap(k, lo, hi, boxes: A):
    """Whether box k overlaps; one comparison, as branches of many would be mispredicted."""
    a, b = boxes[2 * k], boxes[2 * k + 1]
    gap = ti.max(a[0] - hi[0], lo[0] - b[0])
    gap = ti.max(gap, ti.max(a[1] - hi[1], lo[1] - b[1]))
    return ti.max(gap, ti.max(a[2] - hi[2], lo[2] - b[2])) <= 0


@ti.func
def overlapping(k, lo, hi, lanes: A):
    """Which primitives of leaf k overlap, a bit for each, by comparing all at once."""
    x = ti.max(lanes[6 * k] - hi[0], lo[0] - lanes[6 * k + 3])
    y = ti.max(lanes[6 * k + 1] - hi[1], lo[1] - lanes[6 * k + 4])
    z = ti.max(lanes[6 * k + 2] - hi[2], lo[2] - lanes[6 * k + 5])
    gap, bits = ti.max(x, ti.max(y, z)), 0
    for j in ti.static(range(GROUP)):
        bits |= ti.cast(gap[j] <= 0, ti.i32) << j
    return bits


@ti.func
def beyond(node):
    """The next node of a walk that leaves out the children of `node`; 0 at the end."""
    following = node + 1
    while (following & 1) == 0:
        following >>= 1
    if following == 1:
        following = 0
    return following


# ---- boxes -----------------------------------------------------------------------------------------------------------


@ti.func
def merge(node, boxes: A):
    """The box of a node from those of its children."""
    boxes[2 * node] = ti.min(boxes[4 * node], boxes[4 * node + 2])
    boxes[2 * node + 1] = ti.max(boxes[4 * node + 1], boxes[4 * node + 3])


@ti.func
def gather_up(node, number, boxes: A):
    """The boxes of a node and of all below it, down to above the `number` that are there."""
    first = node * number
    while number > 1:
        first, number = first >> 1, number >> 1
        for k in range(first, first + number):
            merge(k, boxes)


@dataclass(frozen=True)
class BoxKernels:
    """Boxes of primitives of `size` corners; `slot` of u holds the displacements."""

    precision: str
    parallel: bool

    fp, vector = number_type, vector_type

    @property
    def rounding(self) -> float:
        return 4 * float(np.finfo(NUMPY[self.precision]).eps)

    @ti.func
    def at(self, i, scene: A, plan: A):
        """Position of vertex i."""
        return scene.rest[i] + scene.u[plan.slot, i]

    @ti.func
    def slack_of(self, p, scene: A, tree: A, plan: A):
        """Largest slacks of the corners of primitive p, towards its own body and others, the number of the body, and what
        its reach is larger by."""
        s = scene.place[tree.corners[plan.size * p]]
        own, other = scene.slack[s][0], scene.slack[s][1]
        for k in range(1, plan.size):
            slack = scene.slack[scene.place[tree.corners[plan.size * p + k]]]
            own, other = ti.max(own, slack[0]), ti.max(other, slack[1])
        return self.vector(own, other, ti.cast(scene.body[s], self.fp), scene.slack[s][2])

    @ti.func
    def box(self, p, scene: A, tree: A, plan: A):
        """Box of primitive p, widened by half the reach, its larger slack, and what rounding takes."""
        lo, slack = self.at(tree.corners[plan.size * p], scene, plan), tree.slacks[p]
        hi = lo
        for k in range(1, plan.size):
            x = self.at(tree.corners[plan.size * p + k], scene, plan)
            lo, hi = ti.min(lo, x), ti.max(hi, x)
        wide = ti.cast(MARGIN, self.fp) * (ti.cast(0.5, self.fp) * plan.reach + ti.max(slack[0], slack[1]) + slack[3])
        largest = ti.max(ti.abs(lo), ti.abs(hi))
        wide += ti.cast(self.rounding, self.fp) * ti.max(largest[0], ti.max(largest[1], largest[2]))
        widening = self.vector(wide, wide, wide, ti.cast(0, self.fp))
        return lo - widening, hi + widening

    @ti.func
    def fit_boxes(self, scene: A, tree: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.leaves):
            low, high = self.vector(ti.cast(1e30, self.fp)), self.vector(ti.cast(-1e30, self.fp))
            for m in range(GROUP * k, ti.min(GROUP * (k + 1), plan.count)):
                p = tree.order[m]
                tree.slacks[p] = self.slack_of(p, scene, tree, plan)
                lo, hi = self.box(p, scene, tree, plan)
                tree.items[2 * m], tree.items[2 * m + 1] = lo, hi
                low, high = ti.min(low, lo), ti.max(high, hi)
                for d in ti.static(range(3)):
                    tree.lanes[6 * k + d][m - GROUP * k], tree.lanes[6 * k + 3 + d][m - GROUP * k] = lo[d], hi[d]
            if GROUP * k < plan.count:
                for m in range(plan.count, GROUP * (k + 1)):  # a place left over is nowhere
                    for d in ti.static(range(3)):
                        tree.lanes[6 * k + d][m - GROUP * k] = ti.cast(1e30, self.fp)
                        tree.lanes[6 * k + 3 + d][m - GROUP * k] = ti.cast(-1e30, self.fp)
            tree.boxes[2 * (plan.leaves + k)], tree.boxes[2 * (plan.leaves + k) + 1] = low, high
        ti.loop_config(serialize=not self.parallel)
        for r in range(plan.subtrees):
            gather_up(plan.subtrees + r, plan.leaves // plan.subtrees, tree.boxes)
        ti.loop_config(serialize=ti.static(runtime.runs_on_cpu()))
        for r in range(plan.roots):
            gather_up(plan.roots + r, plan.subtrees // plan.roots, tree.boxes)
        ti.loop_config(serialize=True)
        for _ in range(1):
            gather_up(1, plan.roots, tree.boxes)

    @cached_property
    def refit(self) -> Kernel:
        """Slacks of primitives from those of vertices, and boxes of all nodes where the vertices are now."""
        scene = dict(rest="vectors", u="vectors2", place="ints", body="ints", slack="vectors")
        numbers = dict.fromkeys(("slot", "size", "count", "leaves", "subtrees", "roots"), "int") | dict(reach="float")
        return Kernel("refit", self.fit_boxes, self.precision, dict(scene=scene, tree=TREE), numbers)


class BoxTree:
    """The tree of one kind of primitives (corners: vertices of each, shape (count, 1, 2 or 3))."""

    sort_every = 8  # refits, after which the leaves are put in order anew

    def __init__(self, corners: np.ndarray, precision: str, parallel: bool, launch):
        self.count, self.size = corners.shape
        self.launch, self._host = launch, corners
        self.kernels = kernels_of(BoxKernels, precision, parallel)
        self.groups = -(-self.count // GROUP)
        self.leaves = 1 << max(self.groups - 1, 1).bit_length()
        self.corners, self.order = runtime.upload(corners.ravel(), ti.i32), runtime.array(ti.i32, self.count)
        self.slacks = runtime.array(self.kernels.vector, self.count)
        # lowest and highest corners: of primitives as they follow each other, and of nodes
        self.items = runtime.array(self.kernels.vector, 2 * self.count)
        self.boxes = runtime.array(self.kernels.vector, 4 * self.leaves)
        # of primitives leaf by leaf: lowest x of all in it, lowest y, z, highest x, y, z
        self.lanes = runtime.array(ti.types.vector(GROUP, self.kernels.fp), 6 * self.groups)
        self.refits = 0

    def refit(self, scene: tuple, slot: int, reach: float) -> None:
        """Put the boxes where primitives are; all within `reach` [m] + slacks of each other will overlap.

        scene: (record of rest and u, record of place, body and slack).
        """
        if self.refits % self.sort_every == 0:
            x = runtime.fetch(scene[0].rest) + runtime.fetch(scene[0].u, slot)
            put(self.order, curve_order(x[self._host].mean(1)))
        self.refits += 1
        self.launch(self.kernels.refit, scene=scene, tree=self)(slot=slot, reach=reach, **self._counts())

    def _counts(self) -> dict[str, int]:
        """Sizes of the tree, and of its parts: subtrees of leaves, and those of which they are the leaves."""
        subtrees, roots = min(SUBTREES, self.leaves), 1
        if not runtime.runs_on_cpu():
            subtrees = max(1, self.leaves // SUBTREES)
            roots = max(1, subtrees // SUBTREES)
        return dict(size=self.size, count=self.count, leaves=self.leaves, subtrees=subtrees, roots=roots)
