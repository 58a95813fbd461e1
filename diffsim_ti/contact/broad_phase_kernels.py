"""Kernels of the broad phase (broad_phase.py): near pairs by walks through trees of boxes, pairs by vertex, piercings."""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.contact.box_tree import GROUP, tree_kernels
from diffsim_ti.contact.proximity import EDGE_EDGE, VERTEX_TRIANGLE, pair_functions
from diffsim_ti.runtime import Bundle

A = ti.template()


@lru_cache(maxsize=None)
def broad_phase_kernels(precision: str, parallel: bool) -> SimpleNamespace:
    """Kernels of the search; `slot` of u holds the displacements."""
    f, tree = pair_functions(precision), tree_kernels(precision, parallel)
    fp, vec3 = f.fp, f.vec3
    ints, vectors = ti.types.ndarray(ti.i32, 1), ti.types.ndarray(ti.types.vector(4, fp), 1)
    eights = ti.types.ndarray(tree.eight, 1)
    vectors2, scalars = ti.types.ndarray(ti.types.vector(4, fp), 2), ti.types.ndarray(fp, 1)

    @ti.func
    def between(i, k, scene: A, slot):
        """x_k - x_i, without the rounding of the positions."""
        y = (scene.rest[k] - scene.rest[i]) + (scene.u[slot, k] - scene.u[slot, i])
        return vec3(y[0], y[1], y[2])

    @ti.func
    def both(reach, mine, theirs):
        """Reach of a pair of primitives with slacks (own body, others, number of the body)."""
        slack = mine[1] + theirs[1]
        if mine[2] == theirs[2]:
            slack = mine[0] + theirs[0]
        return reach + slack

    @ti.func
    def is_near(kind: ti.template(), gap, reach, y1, y2, y3):
        """Whether a pair is nearer than `reach`; `gap`, between boxes, and a simpler test spare most pairs the search."""
        near, limit = gap.norm_sqr() < reach * reach, ti.cast(0, fp)
        if near:
            near = f.may_be_near(kind, y1, y2, y3, reach)
        if near:
            w, r, g = f.nearest(kind, y1, y2, y3)
            limit = r.norm_sqr()
        return near and limit < reach * reach

    @ti.func
    def sort(row: A, first, last):
        for k in range(first + 1, last):
            value, at = row[k], k
            while at > first and row[at - 1] > value:
                row[at] = row[at - 1]
                at -= 1
            row[at] = value

    @ti.func
    def near_triangle(i, p, reach, surface: A, triangles: A, scene: A, slot):
        """Whether triangle p is near the vertex of number i of the surface."""
        i0, c1, c2, c3 = surface[i], triangles[3 * p], triangles[3 * p + 1], triangles[3 * p + 2]
        near = c1 != i0 and c2 != i0 and c3 != i0
        if near:
            y1, y2, y3 = between(i0, c1, scene, slot), between(i0, c2, scene, slot), between(i0, c3, scene, slot)
            gap = ti.max(ti.max(ti.min(ti.min(y1, y2), y3), 0 - ti.max(ti.max(y1, y2), y3)), ti.cast(0, fp))
            near = is_near(VERTEX_TRIANGLE, gap, reach, y1, y2, y3)
        return near

    @ti.func
    def near_edge(e, p, reach, edges: A, scene: A, slot):
        """Whether edge p is near edge e."""
        i, j, i2, j2 = edges[2 * e], edges[2 * e + 1], edges[2 * p], edges[2 * p + 1]
        near = i2 != i and i2 != j and j2 != i and j2 != j
        if near:
            y1, y2, y3, zero = (
                between(i, j, scene, slot),
                between(i, i2, scene, slot),
                between(i, j2, scene, slot),
                vec3(0),
            )
            gap = ti.max(ti.min(y2, y3) - ti.max(y1, zero), ti.min(y1, zero) - ti.max(y2, y3))
            near = is_near(EDGE_EDGE, ti.max(gap, zero), reach, y1, y2, y3)
        return near

    @ti.func
    def lowest(bits):
        """Number of the lowest bit that is set."""
        return 31 - ti.math.clz(bits & (0 - bits))

    @ti.func
    def beyond_own(first):
        """Bits from number `first` on, of at most GROUP."""
        return ti.cast(-1, ti.i32) << ti.min(ti.max(first, 0), GROUP)

    def find_kernel(kind: int):
        @ti.kernel
        def find(
            rest: vectors,
            u: vectors2,
            corners: ints,
            order: ints,
            slacks: vectors,
            items: vectors,
            lanes: eights,
            boxes: vectors,
            their_corners: ints,
            their_order: ints,
            their_slacks: vectors,
            their_items: vectors,
            their_lanes: eights,
            their_boxes: vectors,
            row: ints,
            partner: ints,
            most: ints,
            slot: ti.i32,
            count: ti.i32,
            leaves: ti.i32,
            groups: ti.i32,
            their_leaves: ti.i32,
            reach: fp,
            room: ti.i32,
        ):
            """Partners of each primitive in the tree of `theirs`, in order, at most `room`, and their number.

            Of two edges the smaller number gets the larger one. On a CPU they walk from their own leaf on, so that each two
            meet once; elsewhere each looks at all and adds to its own row alone, as software Vulkan (Mesa 22.3) leaves a
            loop at its second atomic.
            """
            once = ti.static(kind == EDGE_EDGE and runtime.runs_on_cpu())
            scene = Bundle(rest=rest, u=u)
            ti.loop_config(serialize=not parallel)
            for e in range(count):
                row[e] = 0
            ti.loop_config(serialize=not parallel)
            for g in range(groups):
                node = 1
                if ti.static(once):
                    node = leaves + g
                while node > 0:
                    if tree.overlap(node, boxes[2 * (leaves + g)], boxes[2 * (leaves + g) + 1], their_boxes):
                        if node < their_leaves:
                            node = 2 * node
                            continue
                        leaf = node - their_leaves
                        mine = tree.overlapping(g, their_boxes[2 * node], their_boxes[2 * node + 1], lanes)
                        while mine != 0:
                            a = GROUP * g + lowest(mine)
                            mine &= mine - 1
                            theirs = tree.overlapping(leaf, items[2 * a], items[2 * a + 1], their_lanes)
                            if ti.static(once):
                                theirs &= beyond_own(a + 1 - GROUP * leaf)
                            while theirs != 0:
                                b = GROUP * leaf + lowest(theirs)
                                theirs &= theirs - 1
                                e, p, near = order[a], their_order[b], False
                                if ti.static(once):
                                    e, p = ti.min(e, p), ti.max(e, p)
                                limit = both(reach, slacks[e], their_slacks[p])
                                if ti.static(kind == VERTEX_TRIANGLE):
                                    near = near_triangle(e, p, limit, corners, their_corners, scene, slot)
                                elif e < p:
                                    near = near_edge(e, p, limit, corners, scene, slot)
                                if near:
                                    k = row[e]
                                    if ti.static(once):
                                        k = ti.atomic_add(row[e], 1)  # any order: rows are sorted
                                    else:
                                        row[e] = k + 1
                                    if k < room:
                                        partner[room * e + k] = p
                    node = tree.beyond(node)
            ti.loop_config(serialize=not parallel)
            for e in range(count):
                if row[e] > room:
                    ti.atomic_max(most[0], row[e])
                sort(partner, room * e, room * e + ti.min(row[e], room))

        return find

    @ti.kernel
    def write_pairs(
        surface: ints,
        triangles: ints,
        edges: ints,
        row_t: ints,
        row_e: ints,
        partner_t: ints,
        partner_e: ints,
        lengths: scalars,
        pairs: ints,
        scale: scalars,
        num_surface: ti.i32,
        num_edges: ti.i32,
        num_vt: ti.i32,
        room_t: ti.i32,
        room_e: ti.i32,
        factor: fp,
    ):
        """Corners of each pair, four indices of vertices; and, of edges, 1 / sqrt(threshold of |a x b|^2)."""
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            for p in range(row_t[s], row_t[s + 1]):
                pairs[4 * p] = surface[s]
                for k in ti.static(range(3)):
                    pairs[4 * p + 1 + k] = triangles[3 * partner_t[room_t * s + p - row_t[s]] + k]
        ti.loop_config(serialize=not parallel)
        for e in range(num_edges):
            for q in range(row_e[e], row_e[e + 1]):
                p, other = num_vt + q, partner_e[room_e * e + q - row_e[e]]
                for k in ti.static(range(2)):
                    pairs[4 * p + k] = edges[2 * e + k]
                    pairs[4 * p + 2 + k] = edges[2 * other + k]
                scale[q] = factor / (lengths[e] * lengths[other])

    @ti.kernel
    def count_corners(pairs: ints, place: ints, row: ints, count: ti.i32, num_surface: ti.i32):
        """How many corners of pairs meet at each surface vertex."""
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface + 1):
            row[s] = 0
        ti.loop_config(serialize=not parallel)
        for c in range(count):
            row[place[pairs[c]]] += 1  # whole numbers: their order does not matter

    @ti.kernel
    def fill_rows(pairs: ints, place: ints, row: ints, cursor: ints, corner: ints, count: ti.i32, num_surface: ti.i32):
        """The corners of pairs that meet at each surface vertex, in order."""
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            cursor[s] = row[s]
        ti.loop_config(serialize=not parallel)
        for c in range(count):
            k = ti.atomic_add(cursor[place[pairs[c]]], 1)
            corner[k] = c
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            sort(corner, row[s], row[s + 1])

    @ti.kernel
    def find_piercing(
        rest: vectors,
        u: vectors2,
        edges: ints,
        order: ints,
        items: vectors,
        triangles: ints,
        their_order: ints,
        their_items: vectors,
        boxes: vectors,
        pierced: ints,
        slot: ti.i32,
        count: ti.i32,
        their_count: ti.i32,
        leaves: ti.i32,
    ):
        """pierced[e]: the triangle of largest number that edge e passes through, or -1."""
        scene = Bundle(rest=rest, u=u)
        ti.loop_config(serialize=not parallel)
        for k in range(count):
            e, node = order[k], 1
            i, j, lo, hi = edges[2 * e], edges[2 * e + 1], items[2 * k], items[2 * k + 1]
            pierced[e] = -1
            while node > 0:
                if tree.overlap(node, lo, hi, boxes):
                    if node < leaves:
                        node = 2 * node
                        continue
                    m = GROUP * (node - leaves)
                    for b in range(m, ti.min(m + GROUP, their_count)):
                        p = their_order[b]
                        c1, c2, c3 = triangles[3 * p], triangles[3 * p + 1], triangles[3 * p + 2]
                        apart = c1 != i and c2 != i and c3 != i and c1 != j and c2 != j and c3 != j
                        if apart and tree.overlap(b, lo, hi, their_items):
                            y1, a = between(i, c1, scene, slot), between(i, j, scene, slot)
                            e1, e2 = between(c1, c2, scene, slot), between(c1, c3, scene, slot)
                            normal = e1.cross(e2)
                            before, after = 0 - y1.dot(normal), (a - y1).dot(normal)
                            if before * after <= 0 and before != after:
                                x = (before / (before - after)) * a - y1
                                s, t = x.cross(e2).dot(normal), e1.cross(x).dot(normal)
                                if s >= 0 and t >= 0 and s + t <= normal.norm_sqr():
                                    pierced[e] = ti.max(pierced[e], p)
                node = tree.beyond(node)

    return SimpleNamespace(
        find={kind: find_kernel(kind) for kind in (VERTEX_TRIANGLE, EDGE_EDGE)},
        write_pairs=write_pairs,
        count_corners=count_corners,
        fill_rows=fill_rows,
        find_piercing=find_piercing,
        fp=fp,
    )
