"""A part of an explicit pass with near pairs in one launch: what contact_parts.py says, by one thread in float64.

Rows of B and of J (contact_parts.py) have `room` places for each pair. The linear systems of Newton's method,
(1 + J^T K J) x = r, are solved for the pairs, x = r - J^T K^1/2 q with (1 + K^1/2 J J^T K^1/2) q = K^1/2 J r, by conjugate
gradients with a diagonal preconditioner: pairs are few, and as stiff as they may be.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.surfaces import host_geometry as host
from diffsim_ti.mechanics.surfaces.listed_pair import OPPOSITE, behind, first_of, three
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE, Pair
from diffsim_ti.runtime import A, Kernel, as_kernel
from diffsim_ti.terms.obstacles import barrier
from diffsim_ti.terms.obstacles.friction import KERNELS, slip_in_kernels

WALL = 1e-3  # share of the width beneath which a second barrier begins
LONGEST, RESOLVED = 0.2, 0.02  # of the width that near surfaces move in a part; and where it need not be resolved
HALF = 0.5  # share of a distance by which a resolved part may close it before normals are taken
MOST_LOOKS = 200  # at the pairs of a pass
MOST_ROUNDS = 60
SURE = 1e-9  # relative change of distances at which Newton's method takes its last step
EXACT = 1e-20  # relative square of the residual that conjugate gradients leave
TOO_LONG, TAKEN, UNSOLVED = range(3)  # what came of a part
LOOK, CHECK, CHECK_BEGIN, CHECK_END, DONE = range(5)  # steps of a part: normals are taken, surfaces are apart

PAIRS = dict.fromkeys(("corners", "number", "chosen", "acting"), "ints")
PAIRS |= dict.fromkeys(("scale", "stiffness", "width", "radius", "mu", "speed"), "scalars")
NODES = dict(start="ints", index="ints", weight="scalars", rest="vectors", x="vectors", motion="vectors")
NODES |= dict(inverse="scalars", free="vectors", set="ints", sets="ints", factor="vectors", sizes="scalars")
OF_SETS = FIRST, COUNT, MEMBER, MEMBERS, FACTOR, SIZES, TWIST = range(7)  # what stands in `sets` of each
STATE = dict.fromkeys(("e", "b", "e_next", "b_next", "xi"), "vectors")
OF_NODES = dict.fromkeys(("f", "residual", "step", "sum"), "vectors") | dict.fromkeys(
    ("root", "load", "met"), "scalars"
)
OF_POINTS = dict.fromkeys(("at_begin", "at_look", "moved", "at_end"), "vectors")
OF_PAIRS = dict(filled="ints", open="ints", n="vectors")
OF_PAIRS |= dict.fromkeys(("fading", "begin", "end", "change", "P", "K", "stiff", "q", "r", "z", "p", "Ap"), "scalars")
OF_ROWS = dict(node="ints", share="scalars", row="vectors")
RESULT = dict(result="ints", numbers="scalars")
WORK = OF_NODES | OF_POINTS | OF_PAIRS | OF_ROWS | dict(gauss="scalars")


@dataclass(frozen=True)
class PartKernels(Pair):
    """pairs: of a set, those of vertex and triangle first; `acting` are those of them that a part moves, and its kernel is
    given their numbers for num_vt and num_pairs. nodes: C (points, nodes) by rows; `set` that of a node, or -1. Of a set
    (sets_in_contact.py): COUNT nodes from FIRST stand for its numbers, so that their inverse mass is 1, and MEMBERS
    from MEMBER are vertices, whose is 0; F, (members, COUNT, 3, 3), by rows from FACTOR, where W = F F^T; bounds from SIZES;
    the node of the twist, or -1."""

    # ---- the barrier (host_geometry.py) --------------------------------------------------------------------------------

    @ti.func
    def value(self, s):
        t, out = s - host.FLOOR, 0 * s
        if t < 0:
            out = host.VALUE + t * (host.SLOPE + t * (host.CURVATURE / 2))
        elif s < 1:
            out = barrier.value_within(s, ti.log(s))
        return out

    @ti.func
    def slope(self, s):
        t, out = s - host.FLOOR, 0 * s
        if t < 0:
            out = host.SLOPE + t * host.CURVATURE
        elif s < 1:
            out = barrier.slope_within(s, ti.log(s))
        return out

    @ti.func
    def curvature(self, s):
        out = 0 * s
        if s < host.FLOOR:
            out = 0 * s + host.CURVATURE
        elif s < 1:
            out = barrier.curvature_within(s, ti.log(s))
        return out

    @ti.func
    def secant(self, s, t, gauss: A):
        """(sigma, its derivative by t)"""
        low, high = ti.min(s, t), ti.max(s, t)
        value, by_t = 0 * s, 0 * s
        if high - low < host.NEAR * low and high < 1 and low > host.FLOOR:
            for k in range(ti.static(len(host.NODES))):
                node, share = gauss[2 * k], gauss[2 * k + 1]
                at = s + (t - s) * node
                log = ti.log(at)
                value += share * barrier.slope_within(at, log)
                by_t += share * node * barrier.curvature_within(at, log)
        elif low < 1:
            step = ti.select(t == s, 1.0, t - s)
            value = (self.value(t) - self.value(s)) / step
            by_t = (self.slope(t) - value) / step
        return value, by_t

    @ti.func
    def push(self, p, y, c, wall, pairs: A, work: A):
        """(P, -dP/dy) of pair p where it ends at the distance y."""
        width = pairs.width[p]
        s, t, P, K = work.begin[p] / width, y / width, 0 * y, 0 * y
        if s < 1 or t < 1:
            sigma, by_t = 0 * y, 0 * y
            if c < 1:
                sigma, by_t = self.secant(s, t, work.gauss)
            k, m = pairs.stiffness[p], work.fading[p]
            P = k * (0 - c * self.slope(t) - (1 - c) * sigma) - wall * self.slope(t / WALL)
            K = k * (c * self.curvature(t) + (1 - c) * by_t) + wall * self.curvature(t / WALL) / WALL
            P, K = m * width * P, m * K
        return P, K

    # ---- pairs ---------------------------------------------------------------------------------------------------------

    @ti.func
    def four(self, y):
        return self.vec4(y[0], y[1], y[2], 0)

    @ti.func
    def relative(self, p, x: A, pairs: A):
        """Corners 1 to 3 of pair p relative to corner 0, of vectors of the points."""
        x0 = three(x[pairs.corners[4 * p]])
        return (
            three(x[pairs.corners[4 * p + 1]]) - x0,
            three(x[pairs.corners[4 * p + 2]]) - x0,
            three(x[pairs.corners[4 * p + 3]]) - x0,
        )

    @ti.func
    def parted(self, kind: A, p, n, x: A, pairs: A):
        """The smallest distance along n of corners of different primitives."""
        out = ti.cast(1e300, self.fp)
        for a, b in ti.static(OPPOSITE[kind]):
            one, other = x[pairs.corners[4 * p + a]], x[pairs.corners[4 * p + b]]
            out = ti.min(out, n.dot(three(one) - three(other)))
        return out

    @ti.func
    def spread(self, target: A, source: A, nodes: A, plan: A):
        """target = C source"""
        for i in range(plan.num_points):
            total = self.vec4(0)
            for m in range(nodes.start[i], nodes.start[i + 1]):
                total += nodes.weight[m] * source[nodes.index[m]]
            target[i] = total

    @ti.func
    def set_row(self, p, w, pairs: A, nodes: A, work: A, plan: A):
        """Row p of B: what each node has of the gap."""
        filled, first = 0, p * plan.room
        for k in ti.static(range(4)):
            if w[k] != 0:
                corner = pairs.corners[4 * p + k]
                for m in range(nodes.start[corner], nodes.start[corner + 1]):
                    at = first
                    while at < first + filled and work.node[at] != nodes.index[m]:
                        at += 1
                    if at == first + filled:
                        work.node[at], work.share[at] = nodes.index[m], 0.0
                        filled += 1
                    work.share[at] += w[k] * nodes.weight[m]
        work.filled[p] = filled

    @ti.func
    def freed(self, i, x, nodes: A):
        """What node i may do of x."""
        y = self.vec3(0)
        for d in ti.static(range(3)):
            y[d] = three(nodes.free[3 * i + d]).dot(x)
        return y

    @ti.func
    def of_set(self, i, k: A, nodes: A):
        return nodes.sets[ti.static(len(OF_SETS)) * nodes.set[i] + k]

    @ti.func
    def factor(self, i, b, d, nodes: A):
        """Row d of F for node i and vector b of its set."""
        count = self.of_set(i, COUNT, nodes)
        member = i - self.of_set(i, MEMBER, nodes)
        return three(nodes.factor[self.of_set(i, FACTOR, nodes) + 3 * (count * member + b) + d])

    @ti.func
    def gather(self, x: A, nodes: A, plan: A):
        """F^T x of each set, to the nodes that stand for its numbers, where x is zero."""
        for i in range(plan.num_nodes):
            if nodes.set[i] >= 0:
                for b in range(self.of_set(i, COUNT, nodes)):
                    for d in ti.static(range(3)):
                        x[self.of_set(i, FIRST, nodes) + b] += self.four(x[i][d] * self.factor(i, b, d, nodes))

    @ti.func
    def lightened(self, i, x: A, nodes: A):
        """What impulses x on the nodes change of the velocity of node i."""
        out = nodes.inverse[i] * self.freed(i, three(x[i]), nodes)
        if nodes.set[i] >= 0:
            for b in range(self.of_set(i, COUNT, nodes)):
                of_set = three(x[self.of_set(i, FIRST, nodes) + b])
                for d in ti.static(range(3)):
                    out[d] += self.factor(i, b, d, nodes).dot(of_set)
        return out

    @ti.func
    def lightened_sizes(self, i, x: A, nodes: A):
        """The same of numbers, by bounds of inverse masses."""
        out = nodes.inverse[i] * x[i]
        if nodes.set[i] >= 0:
            first, count = self.of_set(i, MEMBER, nodes), self.of_set(i, MEMBERS, nodes)
            for k in range(count):
                out += nodes.sizes[self.of_set(i, SIZES, nodes) + count * (i - first) + k] * x[first + k]
        return out

    @ti.func
    def add_set_to_row(self, p, k, filled, n, nodes: A, work: A, plan: A):
        """Add to row p of J, which has `filled` entries, what the k-th does by the numbers of its set; how many it then
        has."""
        i, begin, size = work.node[k], p * plan.room, filled
        first, count, at = self.of_set(i, FIRST, nodes), self.of_set(i, COUNT, nodes), p * plan.room
        while at < begin + size and work.node[at] != first:
            at += 1
        if at == begin + size:
            for b in range(count):
                work.node[at + b], work.share[at + b], work.row[at + b] = first + b, 0.0, self.vec4(0)
            size += count
        for b in range(count):
            pulled = self.vec3(0)
            for d in ti.static(range(3)):
                pulled += n[d] * self.factor(i, b, d, nodes)
            work.row[at + b] += work.share[k] * work.root[first + b] * self.four(pulled)
        return size

    @ti.func
    def place_points(self, target: A, source: A, nodes: A, plan: A):
        """target = rest + C source"""
        self.spread(target, source, nodes, plan)
        for i in range(plan.num_points):
            target[i] += nodes.rest[i]

    # ---- which pairs come near -----------------------------------------------------------------------------------------

    @ti.func
    def near(self, kind: A, p, pairs: A, work: A):
        a1, a2, a3 = self.relative(p, work.at_begin, pairs)
        m1, m2, m3 = self.relative(p, work.moved, pairs)
        far = ti.sqrt(ti.max(m1.norm_sqr(), m2.norm_sqr(), m3.norm_sqr()))
        looks = 1 + ti.cast(ti.min(MOST_LOOKS, 2 * far / pairs.width[p]), ti.i32)
        limit, k, out = pairs.width[p] + pairs.radius[p], 0, 0
        while k <= looks and out == 0:
            at = ti.cast(k, self.fp) / looks
            _, r, G = self.nearest(kind, a1 + at * m1, a2 + at * m2, a3 + at * m3)
            if r.norm_sqr() < limit * limit:
                out = 1
            k += 1
        return out

    @as_kernel("choose_near", dict(list=dict(near="ints")))
    def choose(self, list: A, pairs: A, nodes: A, state: A, work: A, plan: A):
        """Choose those of the pairs that the list flags which come near between x and x + motion, by looks so often that
        none misses a crossing; result: how many are new, where in `acting` those chosen of each kind end."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.place_points(work.at_begin, nodes.x, nodes, plan)
            self.spread(work.moved, nodes.motion, nodes, plan)
            more, count = 0, 0
            for kind in ti.static((VERTEX_TRIANGLE, EDGE_EDGE)):
                for p in range(first_of(kind, plan), behind(kind, plan)):
                    if list.near[pairs.number[p]] > 0 and pairs.chosen[p] == 0:
                        pairs.chosen[p] = self.near(kind, p, pairs, work)
                        more += pairs.chosen[p]
                    if pairs.chosen[p] > 0:
                        pairs.acting[count] = p
                        count += 1
                state.result[1 + kind] = count
            state.result[0] = more

    def _kernel(self, name: str, body, more: dict | None = None, **numbers) -> Kernel:
        arrays = (more or {}) | dict(pairs=PAIRS, nodes=NODES, state=STATE | RESULT, work=WORK)
        sizes = dict.fromkeys(("num_vt", "num_pairs", "num_points", "num_nodes", "room"), "int")
        return Kernel(name, body, self.precision, arrays, sizes | numbers)

    # ---- a part --------------------------------------------------------------------------------------------------------

    @ti.func
    def place(self, c, pairs: A, nodes: A, state: A, work: A, plan: A):
        """Points where the part begins, and where normals are taken; the square of the share of the width that the farthest
        pair moves."""
        theta, alpha = 0.5 * (1 - c), plan.share * plan.alpha
        for i in range(plan.num_nodes):
            work.f[i] = plan.share * nodes.motion[i] + alpha * state.b[i]
            work.sum[i] = nodes.x[i] + plan.begin * nodes.motion[i] + state.e[i]
            work.root[i] = ti.sqrt(alpha * 0.5 * (1 + c) * plan.share * plan.h * nodes.inverse[i])
        self.place_points(work.at_begin, work.sum, nodes, plan)
        self.spread(work.moved, work.f, nodes, plan)
        for i in range(plan.num_points):
            work.at_look[i] = work.at_begin[i] + theta * work.moved[i]
        farthest = ti.cast(0, self.fp)
        for k in range(plan.num_pairs):
            p = pairs.acting[k]
            m1, m2, m3 = self.relative(p, work.moved, pairs)
            square = ti.max(m1.norm_sqr(), m2.norm_sqr(), m3.norm_sqr())
            farthest = ti.max(farthest, square / (pairs.width[p] * pairs.width[p]))
        return farthest

    @ti.func
    def look(self, kind: A, p, step, c, room, pairs: A, nodes: A, work: A, plan: A):
        """LOOK: where pair p is and how it would go; whether a part resolves it. After the part: whether a plane parts it
        where the part begins and where it ends, and so all the way: the plane from LOOK, or one where points look."""
        w, r, m, n = self.vec4(0), self.vec3(0), ti.cast(1, self.fp), three(work.n[p])
        if step != CHECK:
            y1, y2, y3 = self.relative(p, work.at_look, pairs)
            w, r, G = self.nearest(kind, y1, y2, y3)
            n = r / ti.max(ti.sqrt(r.norm_sqr()), 1e-300)
            if ti.static(kind == EDGE_EDGE):
                m, by_q, by_qq = self.mollifier((pairs.scale[p] * y1.cross(y3 - y2)).norm_sqr())
        before, fine = self.parted(kind, p, n, work.at_begin, pairs) - pairs.radius[p], False
        if step == LOOK:
            f1, f2, f3 = self.relative(p, work.moved, pairs)
            d, theta, along = n.dot(r) - pairs.radius[p], 0.5 * (1 - c), n.dot(w[1] * f1 + w[2] * f2 + w[3] * f3)
            work.n[p], work.fading[p] = self.four(n), m
            work.begin[p], work.end[p] = d - theta * along, d + (1 - theta) * along
            self.set_row(p, w, pairs, nodes, work, plan)
            filled = work.filled[p]
            for k in range(p * plan.room, p * plan.room + work.filled[p]):
                i = work.node[k]
                work.row[k] = work.share[k] * work.root[i] * self.four(self.freed(i, n, nodes))
                if nodes.set[i] >= 0:
                    filled = self.add_set_to_row(p, k, filled, n, nodes, work, plan)
            work.filled[p] = filled
            fine = before > 0 and d > HALF * before
        else:
            fine = ti.min(before, self.parted(kind, p, n, work.at_end, pairs) - pairs.radius[p]) > room
        return fine

    @ti.func
    def across(self, p, x: A, work: A, plan: A):
        """(J x)_p"""
        out = ti.cast(0, self.fp)
        for k in range(p * plan.room, p * plan.room + work.filled[p]):
            out += three(work.row[k]).dot(three(x[work.node[k]]))
        return out

    @ti.func
    def add_row(self, p, factor, x: A, work: A, plan: A):
        """x += factor J_p^T"""
        for k in range(p * plan.room, p * plan.room + work.filled[p]):
            x[work.node[k]] += factor * work.row[k]

    @ti.func
    def push_all(self, share, c, wall, pairs: A, work: A, plan: A):
        """P and K where the part ends at end + share change; P . change."""
        out = ti.cast(0, self.fp)
        for k in range(plan.num_pairs):
            p = pairs.acting[k]
            work.P[p], work.K[p] = self.push(p, work.end[p] + share * work.change[p], c, wall, pairs, work)
            out += work.P[p] * work.change[p]
        return out

    @ti.func
    def find_step(self, pairs: A, work: A, plan: A):
        """step = -(1 + J^T K J)^-1 residual; whether it was found."""
        for i in range(plan.num_nodes):
            work.step[i] = -1.0 * work.residual[i]
        rz, rounds, failed = ti.cast(0, self.fp), 0, False
        for k in range(plan.num_pairs):
            p, square = pairs.acting[k], ti.cast(0, self.fp)
            for m in range(p * plan.room, p * plan.room + work.filled[p]):
                square += work.row[m].norm_sqr()
            work.stiff[p], work.q[p] = ti.sqrt(work.K[p]), 0.0
            work.r[p], work.z[p] = (
                work.stiff[p] * self.across(p, work.residual, work, plan),
                1 / (1 + work.K[p] * square),
            )
            work.p[p] = work.z[p] * work.r[p]
            rz += work.p[p] * work.r[p]
        least = EXACT * rz
        while rz > least and not failed:
            for i in range(plan.num_nodes):
                work.sum[i] = self.vec4(0)
            for k in range(plan.num_pairs):
                p = pairs.acting[k]
                self.add_row(p, work.stiff[p] * work.p[p], work.sum, work, plan)
            along, after = ti.cast(0, self.fp), ti.cast(0, self.fp)
            for k in range(plan.num_pairs):
                p = pairs.acting[k]
                work.Ap[p] = work.p[p] + work.stiff[p] * self.across(p, work.sum, work, plan)
                along += work.p[p] * work.Ap[p]
            for k in range(plan.num_pairs):
                p = pairs.acting[k]
                work.q[p] += rz / along * work.p[p]
                work.r[p] = work.r[p] - rz / along * work.Ap[p]
                after += work.z[p] * work.r[p] * work.r[p]
            for k in range(plan.num_pairs):
                p = pairs.acting[k]
                work.p[p] = work.z[p] * work.r[p] + after / rz * work.p[p]
            rz, rounds = after, rounds + 1
            failed = rounds > 50 + 4 * plan.num_pairs
        for k in range(plan.num_pairs):
            p = pairs.acting[k]
            self.add_row(p, work.stiff[p] * work.q[p], work.step, work, plan)
        return not failed

    @ti.func
    def balance(self, c, wall, pairs: A, state: A, work: A, plan: A):
        """xi where pushes balance it, and P there; whether it was found."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        rounds, found, sure, share, along, square, before = 0, 0, 0, zero, zero, zero, zero
        for i in range(plan.num_nodes):
            state.xi[i], work.step[i] = self.vec4(0), self.vec4(0)
        for k in range(plan.num_pairs):
            work.change[pairs.acting[k]] = 0.0
        while found == 0 and rounds < MOST_ROUNDS:
            pushed = self.push_all(share, c, wall, pairs, work, plan)
            if sure == 0 and along + share * square - pushed > 0.5 * before and share >= 1e-9:
                share *= 0.5
            else:
                for i in range(plan.num_nodes):
                    state.xi[i] += share * work.step[i]
                    work.residual[i] = state.xi[i]
                pressing = 0
                for k in range(plan.num_pairs):
                    p = pairs.acting[k]
                    work.end[p] += share * work.change[p]
                    self.add_row(p, -1.0 * work.P[p], work.residual, work, plan)
                    pressing += ti.cast(work.P[p] > 0, ti.i32)
                rounds += 1
                if sure > 0 or (pressing == 0 and rounds == 1):
                    found = 1
                elif not self.find_step(pairs, work, plan):
                    rounds = MOST_ROUNDS
                else:
                    sure, share, along, square, before = 1, one, zero, zero, zero
                    for k in range(plan.num_pairs):
                        p = pairs.acting[k]
                        work.change[p] = self.across(p, work.step, work, plan)
                        if not ti.abs(work.change[p]) <= SURE * (ti.abs(work.end[p]) + ti.abs(work.begin[p])):
                            sure = 0
                    for i in range(plan.num_nodes):
                        before = before - work.residual[i].dot(work.step[i])
                        along += state.xi[i].dot(work.step[i])
                        square += work.step[i].norm_sqr()
        return found == 1

    @ti.func
    def act(self, c, pairs: A, nodes: A, state: A, work: A, plan: A):
        """e and b after the part (PartSolver.take); the work of what holds nodes, or moves obstacles, against pushes [J]."""
        h, alpha = plan.share * plan.h, plan.share * plan.alpha
        done = ti.cast(0, self.fp)
        for i in range(plan.num_nodes):
            work.residual[i], work.sum[i], work.load[i] = self.vec4(0), self.vec4(0), 0.0
            work.step[i] = nodes.motion[i] / plan.alpha + state.b[i]
        for k in range(plan.num_pairs):
            p = pairs.acting[k]
            for m in range(p * plan.room, p * plan.room + work.filled[p]):
                work.residual[work.node[m]] += work.share[m] * work.P[p] * work.n[p]
                work.load[work.node[m]] += ti.abs(work.share[m]) * pairs.mu[p] * work.P[p]
        if plan.rough > 0:
            for i in range(plan.num_nodes):
                work.met[i] = self.lightened_sizes(i, work.load, nodes)
        for k in range(plan.num_pairs * plan.rough):
            p, v, bound = pairs.acting[k], self.vec4(0), ti.cast(0, self.fp)
            for m in range(p * plan.room, p * plan.room + work.filled[p]):
                i = work.node[m]
                v += work.share[m] * work.step[i]
                bound += h * ti.abs(work.share[m]) * work.met[i]
            t = v - work.n[p].dot(v) * work.n[p]
            kappa, f, y, slip = slip_in_kernels(ti.sqrt(t.norm_sqr()), bound, pairs.speed[p], KERNELS)
            impulse = (-1.0 * h * pairs.mu[p] * work.P[p] * kappa) * t
            for m in range(p * plan.room, p * plan.room + work.filled[p]):
                work.sum[work.node[m]] += work.share[m] * impulse
        self.gather(work.residual, nodes, plan)
        self.gather(work.sum, nodes, plan)
        for i in range(plan.num_nodes):
            delta = h * self.lightened(i, work.residual, nodes)
            friction = self.lightened(i, work.sum, nodes)
            given = h * three(work.residual[i]) + three(work.sum[i])
            if nodes.inverse[i] > 0:  # what holds it in some directions takes the rest
                given = given - self.freed(i, given, nodes)
            elif nodes.set[i] >= 0:
                given = self.vec3(0)
            done = done - given.dot(three(nodes.motion[i])) / plan.h
            way = three(state.b[i]) + 0.5 * (1 + c) * delta + friction
            state.e_next[i] = state.e[i] + alpha * self.four(way)
            state.b_next[i] = state.b[i] + self.four(delta + friction)
        for i in range(plan.num_nodes):
            if nodes.set[i] >= 0:
                if self.of_set(i, TWIST, nodes) >= 0:
                    moved = state.e[i] + (plan.begin - 0.5) * nodes.motion[i] + 0.5 * (1 - c) * work.f[i]
                    given = h * three(work.residual[i]) + three(work.sum[i])
                    state.e_next[self.of_set(i, TWIST, nodes)] += self.four(three(moved).cross(given))
        for i in range(plan.num_nodes):
            work.sum[i] = nodes.x[i] + (plan.begin + plan.share) * nodes.motion[i] + state.e_next[i]
        self.place_points(work.at_end, work.sum, nodes, plan)
        return done

    @ti.func
    def farthest_place(self, pairs: A, work: A, plan: A):
        """The largest coordinate of a corner at the end."""
        out = ti.cast(0, self.fp)
        for k in range(plan.num_pairs):
            for m in ti.static(range(4)):
                x = work.at_end[pairs.corners[4 * pairs.acting[k] + m]]
                out = ti.max(out, ti.abs(x[0]), ti.abs(x[1]), ti.abs(x[2]))
        return out

    @as_kernel(
        "take_part",
        rough="int",
        **dict.fromkeys(("begin", "share", "h", "alpha", "damping", "wall", "rounding"), "float"),
    )
    def take(self, pairs: A, nodes: A, state: A, work: A, plan: A):
        """The part `begin` .. `begin + share` of a pass of length h; result: what came of it; numbers: its damping, and
        the work of all parts since `NearSet.start`."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            c, result, step, room, done = plan.damping, TOO_LONG, LOOK, ti.cast(0, self.fp), ti.cast(0, self.fp)
            square = self.place(c, pairs, nodes, state, work, plan)
            if square > LONGEST**2:
                step = DONE
            for k in range(plan.num_pairs):
                work.open[k] = 1
            while step < DONE:
                left = 0  # pairs that are not fine
                for kind in ti.static((VERTEX_TRIANGLE, EDGE_EDGE)):
                    for k in range(first_of(kind, plan), behind(kind, plan)):
                        if work.open[k] > 0:
                            fine = self.look(kind, pairs.acting[k], step, c, room, pairs, nodes, work, plan)
                            if fine and step > LOOK:
                                work.open[k] = 0
                            left += ti.cast(not fine, ti.i32)
                if step == LOOK and c < 1 and left > 0:
                    if square > RESOLVED**2:
                        step = DONE
                    c = 1.0
                    for i in range(plan.num_nodes):
                        work.root[i] = ti.sqrt(2 / (1 + plan.damping)) * work.root[i]
                    for i in range(plan.num_points):
                        work.at_look[i] = work.at_begin[i]
                elif step == LOOK:
                    result, step = UNSOLVED, DONE
                    if self.balance(c, plan.wall / (plan.share * plan.h) ** 2, pairs, state, work, plan):
                        done = self.act(c, pairs, nodes, state, work, plan)
                        room, step = plan.rounding * (1 + self.farthest_place(pairs, work, plan)), CHECK
                elif left == 0:
                    result, step = TAKEN, DONE
                    state.numbers[1] += done
                    for i in range(plan.num_nodes):
                        state.e[i], state.b[i] = state.e_next[i], state.b_next[i]
                else:
                    result, step = TOO_LONG, step + 1
                    for i in range(plan.num_points):
                        work.at_look[i] = work.at_begin[i]
                        if step == CHECK_END:
                            work.at_look[i] = work.at_end[i]
            state.result[0], state.numbers[0] = result, c
