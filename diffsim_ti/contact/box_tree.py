"""Boxes of surface primitives in a binary tree, to find those that overlap a given box without a look at the others.

Primitives follow a space-filling curve, and each leaf holds the next GROUP of them; a group walks the tree as one. Node k
has children 2 k and 2 k + 1, so that links need no memory and the next node of a walk without the present node's children
is k + 1, halved while it is even. Each box is widened by half the base reach and by the slack of its corners, so that boxes
of primitives within reach of each other overlap, whatever their slack.
Morton 1966; Karras 2012, Maximizing Parallelism in the Construction of BVHs, HPG 2012, 33-37.
"""

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime import Bundle

A = ti.template()
GROUP = 8  # primitives in a leaf
SUBTREES = 64  # that threads gather up, each by itself
MARGIN = 1.01  # of the widening; a hundredth more than the exact distances of the pairs take


@lru_cache(maxsize=None)
def tree_kernels(precision: str, parallel: bool) -> SimpleNamespace:
    """Kernels and Taichi functions of trees; `slot` of u holds the displacements."""
    fp = runtime.PRECISIONS[precision]
    vec3, vec4 = ti.types.vector(3, fp), ti.types.vector(4, fp)
    ints, vectors, vectors2 = ti.types.ndarray(ti.i32, 1), ti.types.ndarray(vec4, 1), ti.types.ndarray(vec4, 2)
    eight = ti.types.vector(GROUP, fp)
    eights = ti.types.ndarray(eight, 1)
    rounding = 4 * float(np.finfo(runtime.to_numpy_dtype(fp)).eps)

    @ti.func
    def at(i, scene: A, slot):
        """Position of vertex i."""
        x = scene.rest[i] + scene.u[slot, i]
        return vec3(x[0], x[1], x[2])

    @ti.func
    def slack_of(p, size: ti.template(), corners: A, scene: A):
        """Largest slacks of the corners of primitive p, towards its own body and others, and the number of the body."""
        s = scene.place[corners[size * p]]
        own, other = scene.slack[s][0], scene.slack[s][1]
        for k in ti.static(range(1, size)):
            slack = scene.slack[scene.place[corners[size * p + k]]]
            own, other = ti.max(own, slack[0]), ti.max(other, slack[1])
        return vec4(own, other, ti.cast(scene.body[s], fp), ti.cast(0, fp))

    @ti.func
    def box(p, size: ti.template(), corners: A, slack, scene: A, slot, reach):
        """Box of primitive p, widened by half the reach, its larger slack, and what rounding takes."""
        lo = at(corners[size * p], scene, slot)
        hi = lo
        for k in ti.static(range(1, size)):
            x = at(corners[size * p + k], scene, slot)
            lo, hi = ti.min(lo, x), ti.max(hi, x)
        wide = ti.cast(MARGIN, fp) * (ti.cast(0.5, fp) * reach + ti.max(slack[0], slack[1]))
        wide += ti.cast(rounding, fp) * ti.max(ti.abs(lo), ti.abs(hi)).max()
        return lo - wide, hi + wide

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

    @ti.func
    def merge(node, boxes: A):
        boxes[2 * node] = ti.min(boxes[4 * node], boxes[4 * node + 2])
        boxes[2 * node + 1] = ti.max(boxes[4 * node + 1], boxes[4 * node + 3])

    def refit_kernel(size: int):
        @ti.kernel
        def refit(
            rest: vectors,
            u: vectors2,
            corners: ints,
            order: ints,
            place: ints,
            body: ints,
            slack: vectors,
            slacks: vectors,
            items: vectors,
            lanes: eights,
            boxes: vectors,
            slot: ti.i32,
            count: ti.i32,
            leaves: ti.i32,
            subtrees: ti.i32,
            reach: fp,
        ):
            """Slacks of primitives from those of vertices, and boxes of all nodes where the vertices are now."""
            scene = Bundle(rest=rest, u=u, place=place, body=body, slack=slack)
            ti.loop_config(serialize=not parallel)
            for k in range(leaves):
                low, high = vec4(ti.cast(1e30, fp)), vec4(ti.cast(-1e30, fp))
                for m in range(GROUP * k, ti.min(GROUP * (k + 1), count)):
                    p = order[m]
                    slacks[p] = slack_of(p, size, corners, scene)
                    lo, hi = box(p, size, corners, slacks[p], scene, slot, reach)
                    items[2 * m] = vec4(lo[0], lo[1], lo[2], ti.cast(0, fp))
                    items[2 * m + 1] = vec4(hi[0], hi[1], hi[2], ti.cast(0, fp))
                    low, high = ti.min(low, items[2 * m]), ti.max(high, items[2 * m + 1])
                    for d in ti.static(range(3)):
                        lanes[6 * k + d][m - GROUP * k], lanes[6 * k + 3 + d][m - GROUP * k] = lo[d], hi[d]
                boxes[2 * (leaves + k)], boxes[2 * (leaves + k) + 1] = low, high
            ti.loop_config(serialize=not parallel)
            for r in range(subtrees):
                first, number = leaves + r * (leaves // subtrees), leaves // subtrees
                while number > 1:
                    first, number = first >> 1, number >> 1
                    for node in range(first, first + number):
                        merge(node, boxes)
            ti.loop_config(serialize=True)
            for k in range(1, subtrees):
                merge(subtrees - k, boxes)

        return refit

    return SimpleNamespace(
        overlap=overlap,
        overlapping=overlapping,
        beyond=beyond,
        vector=vec4,
        eight=eight,
        fp=fp,
        refit={size: refit_kernel(size) for size in (1, 2, 3)},
    )


class BoxTree:
    """The tree of one kind of primitives (corners: vertices of each, shape (count, 1, 2 or 3))."""

    sort_every = 8  # refits, after which the leaves are put in order anew

    def __init__(self, corners: np.ndarray, precision: str, parallel: bool, launch):
        self.count, self.size = corners.shape
        self.kernels, self.launch, self._host = tree_kernels(precision, parallel), launch, corners
        self.groups = -(-self.count // GROUP)
        self.leaves = 1 << max(self.groups - 1, 1).bit_length()
        self.corners, self.order = runtime.upload(corners.ravel(), ti.i32), runtime.array(ti.i32, self.count)
        self.slacks = runtime.array(self.kernels.vector, self.count)
        # lowest and highest corners: of primitives as they follow each other, and of nodes
        self.items = runtime.array(self.kernels.vector, 2 * self.count)
        self.boxes = runtime.array(self.kernels.vector, 4 * self.leaves)
        # of primitives leaf by leaf: lowest x of all in it, lowest y, z, highest x, y, z; a place left over is nowhere
        self.lanes = runtime.upload(
            np.tile(np.repeat([1e30, -1e30], 3)[:, None], (self.groups, GROUP)), self.kernels.eight
        )
        self.arrays = self.corners, self.order, self.slacks, self.items, self.lanes, self.boxes
        self.refits = 0

    def refit(self, rest, u, place, body, slack, slot: int, reach: float) -> None:
        """Put the boxes where primitives are; all within `reach` [m] + slacks of each other will overlap."""
        if self.refits % self.sort_every == 0:
            host = runtime.view(u)
            x = runtime.fetch(rest) + (runtime.fetch(u) if host is None else host)[slot, :, :3]
            runtime.fill(self.order, curve_order(x[self._host].mean(1)))
        self.refits += 1
        self.launch(
            self.kernels.refit[self.size],
            rest,
            u,
            self.corners,
            self.order,
            place,
            body,
            slack,
            self.slacks,
            self.items,
            self.lanes,
            self.boxes,
        )(slot, self.count, self.leaves, min(SUBTREES, self.leaves), reach)


def curve_order(points: np.ndarray) -> np.ndarray:
    """Indices of points, shape (n, 3), in the order of Morton's curve through their bounding box."""
    lowest = points.min(0)
    cells = (
        ((points - lowest) * (2**20 / max(np.ptp(points, axis=0).max(), 1e-300))).astype(np.int64).clip(0, 2**20 - 1)
    )
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | (cells << shift)) & mask
    return np.argsort(cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2), kind="stable")
