"""Kernels of the broad phase (broad_phase.py): near pairs, and piercings, by walks through trees of boxes."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.box_tree import GROUP, TREE, beyond, overlap, overlapping
from diffsim_ti.mechanics.surfaces.listed_pair import at_rest, between
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE, Pair
from diffsim_ti.runtime import A, Kernel

PLACE = dict(rest="vectors", u="vectors2")  # u[slot] holds the displacements


@ti.func
def sort(row: A, first, last):
    """Put row[first:last] in order."""
    for k in range(first + 1, last):
        value, at = row[k], k
        while at > first and row[at - 1] > value:
            row[at] = row[at - 1]
            at -= 1
        row[at] = value


@ti.func
def lowest(bits):
    """Number of the lowest bit that is set."""
    return 31 - ti.math.clz(bits & (0 - bits))


@ti.func
def bits_from(first):
    """Bits from number `first` on, of at most GROUP."""
    return ti.cast(-1, ti.i32) << ti.min(ti.max(first, 0), GROUP)


@ti.func
def reach_of(reach, mine, theirs):
    """Reach of a pair of primitives with slacks (own body, others, number of the body, what its reach is larger by)."""
    slack = mine[1] + theirs[1]
    if mine[2] == theirs[2]:
        slack = mine[0] + theirs[0]
    return reach + slack + mine[3] + theirs[3]


@ti.func
def apart(i, k, scene: A, slot):
    """x_k - x_i, without the rounding of the positions."""
    return at_rest(scene.rest, i, k) + between(scene.u, i, k, slot)


@dataclass(frozen=True)
class Search(Pair):
    """Partners of primitives: triangles of vertices, or edges of edges, as `kind` says."""

    parallel: bool
    kind: int

    @ti.func
    def is_near(self, gap, reach, y1, y2, y3):
        """Whether a pair is nearer than `reach`; `gap`, between boxes, and a simpler test spare most pairs the search."""
        near, limit = gap.norm_sqr() < reach * reach, ti.cast(0, self.fp)
        if near:
            near = self.may_be_near(self.kind, y1, y2, y3, reach)
        if near:
            w, r, g = self.nearest(self.kind, y1, y2, y3)
            limit = r.norm_sqr()
        return near and limit < reach * reach

    @ti.func
    def near_triangle(self, i, p, reach, scene: A, mine: A, theirs: A, slot):
        """Whether triangle p is near the vertex of number i of the surface."""
        i0, c1, c2, c3 = mine.corners[i], theirs.corners[3 * p], theirs.corners[3 * p + 1], theirs.corners[3 * p + 2]
        near = c1 != i0 and c2 != i0 and c3 != i0
        if near:
            y1, y2 = apart(i0, c1, scene, slot), apart(i0, c2, scene, slot)
            y3, zero = apart(i0, c3, scene, slot), ti.cast(0, self.fp)
            gap = ti.max(ti.max(ti.min(ti.min(y1, y2), y3), 0 - ti.max(ti.max(y1, y2), y3)), zero)
            near = self.is_near(gap, reach, y1, y2, y3)
        return near

    @ti.func
    def near_edge(self, e, p, reach, scene: A, mine: A, slot):
        """Whether edge p is near edge e."""
        i, j, i2, j2 = mine.corners[2 * e], mine.corners[2 * e + 1], mine.corners[2 * p], mine.corners[2 * p + 1]
        near = i2 != i and i2 != j and j2 != i and j2 != j
        if near:
            y1, y2 = apart(i, j, scene, slot), apart(i, i2, scene, slot)
            y3, zero = apart(i, j2, scene, slot), self.vec3(0)
            gap = ti.max(ti.min(y2, y3) - ti.max(y1, zero), ti.min(y1, zero) - ti.max(y2, y3))
            near = self.is_near(ti.max(gap, zero), reach, y1, y2, y3)
        return near

    @ti.func
    def visit(self, g, leaf, once: A, scene: A, mine: A, theirs: A, out: A, plan: A):
        """Compare the primitives of a leaf of each tree."""
        node = plan.their_leaves + leaf
        mask = overlapping(g, theirs.boxes[2 * node], theirs.boxes[2 * node + 1], mine.lanes)
        while mask != 0:
            a = GROUP * g + lowest(mask)
            mask &= mask - 1
            others = overlapping(leaf, mine.items[2 * a], mine.items[2 * a + 1], theirs.lanes)
            if ti.static(once):
                others &= bits_from(a + 1 - GROUP * leaf)
            while others != 0:
                b = GROUP * leaf + lowest(others)
                others &= others - 1
                e, p, near = mine.order[a], theirs.order[b], False
                if ti.static(once):
                    e, p = ti.min(e, p), ti.max(e, p)
                reach = reach_of(plan.reach, mine.slacks[e], theirs.slacks[p])
                if ti.static(self.kind == VERTEX_TRIANGLE):
                    near = self.near_triangle(e, p, reach, scene, mine, theirs, plan.slot)
                elif e < p and e < plan.own and (p < plan.meet or p >= plan.own):
                    near = self.near_edge(e, p, reach, scene, mine, plan.slot)
                if near:
                    k = out.row[e]
                    if ti.static(once):
                        k = ti.atomic_add(out.row[e], 1)  # any order: rows are sorted
                    else:
                        out.row[e] = k + 1
                    if k < plan.room:
                        out.partner[plan.room * e + k] = p

    @ti.func
    def search(self, scene: A, mine: A, theirs: A, out: A, plan: A):
        once = ti.static(self.kind == EDGE_EDGE and runtime.runs_on_cpu())
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.count):
            out.row[e] = 0
        ti.loop_config(serialize=not self.parallel)
        for g in range(plan.groups):
            node = 1
            if ti.static(once):
                node = plan.leaves + g
            while node > 0:
                if overlap(
                    node, mine.boxes[2 * (plan.leaves + g)], mine.boxes[2 * (plan.leaves + g) + 1], theirs.boxes
                ):
                    if node < plan.their_leaves:
                        node = 2 * node
                        continue
                    self.visit(g, node - plan.their_leaves, once, scene, mine, theirs, out, plan)
                node = beyond(node)
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.count):
            if out.row[e] > plan.room:
                ti.atomic_max(out.most[0], out.row[e])
            sort(out.partner, plan.room * e, plan.room * e + ti.min(out.row[e], plan.room))

    @cached_property
    def find(self) -> Kernel:
        """Partners of each primitive in the tree of `theirs`, in order, at most `room`, and their number.

        Of two edges the smaller number gets the larger one; edges below `own` are of bodies, and
        two of these meet below `meet`. On a CPU they walk from their own leaf on, so that each two
        meet once; elsewhere each looks at all and adds to its own row alone, as software Vulkan (Mesa 22.3) leaves a
        loop at its second atomic.
        """
        arrays = dict(scene=PLACE, mine=TREE, theirs=TREE, out=dict.fromkeys(("row", "partner", "most"), "ints"))
        numbers = dict.fromkeys(("slot", "count", "leaves", "groups", "their_leaves", "room", "own", "meet"), "int")
        return Kernel("find", self.search, self.precision, arrays, numbers | dict(reach="float"))


@dataclass(frozen=True)
class Piercing:
    """Edges that pass through triangles."""

    precision: str
    parallel: bool

    @ti.func
    def passes(self, i, j, c1, c2, c3, scene: A, slot):
        """Whether edge (i, j) passes through triangle (c1, c2, c3)."""
        y1, a = apart(i, c1, scene, slot), apart(i, j, scene, slot)
        e1, e2 = apart(c1, c2, scene, slot), apart(c1, c3, scene, slot)
        normal, inside = e1.cross(e2), False
        before, after = 0 - y1.dot(normal), (a - y1).dot(normal)
        if before * after <= 0 and before != after:
            x = (before / (before - after)) * a - y1
            s, t = x.cross(e2).dot(normal), e1.cross(x).dot(normal)
            inside = s >= 0 and t >= 0 and s + t <= normal.norm_sqr()
        return inside

    @ti.func
    def walk(self, scene: A, mine: A, theirs: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            e, node = mine.order[k], 1
            i, j, lo, hi = mine.corners[2 * e], mine.corners[2 * e + 1], mine.items[2 * k], mine.items[2 * k + 1]
            if e < plan.first:
                node = 0
            while node > 0:
                if overlap(node, lo, hi, theirs.boxes):
                    if node < plan.leaves:
                        node = 2 * node
                        continue
                    m = GROUP * (node - plan.leaves)
                    for b in range(m, ti.min(m + GROUP, plan.their_count)):
                        p = theirs.order[b]
                        c1, c2, c3 = theirs.corners[3 * p], theirs.corners[3 * p + 1], theirs.corners[3 * p + 2]
                        is_other = c1 != i and c2 != i and c3 != i and c1 != j and c2 != j and c3 != j
                        if is_other and overlap(b, lo, hi, theirs.items):
                            if self.passes(i, j, c1, c2, c3, scene, plan.slot):
                                out.pierced[e] = ti.max(out.pierced[e], p)
                node = beyond(node)

    @cached_property
    def find(self) -> Kernel:
        """pierced[e], -1 before: the triangle of largest number that edge e >= first passes through."""
        arrays = dict(scene=PLACE, mine=TREE, theirs=TREE, out=dict(pierced="ints"))
        numbers = dict.fromkeys(("slot", "count", "their_count", "leaves", "first"), "int")
        return Kernel("find_piercing", self.walk, self.precision, arrays, numbers)
