"""Springs, cables and muscles of a scene in explicit passes: one by one, and fibres of muscles eight at a time.

Springs and cables are paths of points with one tension along each. Point p of a path lies at X_p + U_p, U_p the weighted
sum of its vertices' displacements, and d_p leads from it to the next. T = a + k e, e = sum (|d_p| - |D_p|) + s, D_p: d_p at
rest (inputs/lines.py). Corner c of the paths' points writes corner `first + c`, and vertices gather it with those of
tetrahedra. Lengths come as changes of lengths, so that single precision keeps its digits near rest.

A fibre is a line element with a given tension T, from the origin, which is no vertex, to a weighted sum of the vertices
of its tetrahedron. So the points, the corners and the numbers of eight fibres in a row lie at equal distances, and
each number of a formula is a vector of eight lanes: to the same digits as one by one.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.interaction import ItemForce
from diffsim_ti.mechanics.lines import pull
from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.runtime import LANES, A, assign, at, let, traced
from diffsim_ti.state.pass_table import between

tension, tension_jvp, across = (ti.func(f) for f in (pull.tension, pull.tension_jvp, pull.across))


@dataclass(frozen=True)
class LineElement(StepNumbers):
    """Functions of one line element in a pass; per_step: whether its numbers have a row for each step."""

    @ti.func
    def length(self, d):
        return ti.sqrt(d.norm_sqr())  # `norm` adds a float64 zero

    @ti.func
    def unit(self, d):
        size, out = self.length(d), self.vector(0)
        if size > 0:
            out = d / size
        return out

    @ti.func
    def moved(self, p, x: A, s, scene: A):
        """Displacement of point p."""
        out = self.vector(0)
        for c in range(scene.point_start[p], scene.point_start[p + 1]):
            out += scene.point_weight[c] * x[s, scene.point_vertex[c]]
        return out

    @ti.func
    def parted(self, p, x: A, s, scene: A):
        """How much more than point p the next one moves."""
        return self.moved(p + 1, x, s, scene) - self.moved(p, x, s, scene)

    @ti.func
    def numbers(self, t, now: A, rows: A):
        """(a, s, k), the mean of both kicks."""
        out = self.vector(0)
        for r, share, weight in ti.static(self.kicks(now)):
            pull, slack = rows[r, 2 * t], rows[r, 2 * t + 1]
            out[0] += weight * between(pull[0], pull[1], share)
            out[1] += weight * between(slack[0], slack[1], share)
            out[2] += weight * pull[2]
        return out

    @ti.func
    def stretch(self, t, u: A, s, scene: A):
        """L - L0."""
        out = ti.cast(0, self.fp)
        for p in range(scene.line_start[t], scene.line_start[t + 1] - 1):
            D, moved = scene.line_segments[p], self.parted(p, u, s, scene)
            both = self.length(D) + self.length(D + moved)
            if both > 0:
                out += moved.dot(D + (D + moved)) / both
        return out

    @ti.func
    def pull(self, t, n, u: A, s, scene: A):
        """(T, e as far as it pulls, k as far as e does)"""
        e, k, zero = ti.cast(0, self.fp), n[2], ti.cast(0, self.fp)
        if scene.line_sides[t] >= 0:
            e = self.stretch(t, u, s, scene) + n[1]
            if scene.line_sides[t] > 0 and e <= 0:
                e, k = zero, zero
        return self.vector(tension(n[0], n[2], e), e, k, zero)

    @ti.func
    def is_single(self, t, scene: A):
        """Whether it runs through two points, as springs and muscles do."""
        return scene.line_start[t + 1] - scene.line_start[t] == 2

    @ti.func
    def store_both(self, p, f, first, scene: A, corner: A):
        """The force of a segment on its ends, p and the next point."""
        self.store(p, f, first, scene, corner)
        self.store(p + 1, self.vector(0) - f, first, scene, corner)

    @ti.func
    def store(self, p, f, first, scene: A, corner: A):
        """The force of a point, to its vertices."""
        for c in range(scene.point_start[p], scene.point_start[p + 1]):
            corner[first + c] = scene.point_weight[c] * f

    @ti.func
    def across(self, T, k, d, x):
        """T/|d| of what of x lies across d; of a spring without length k x."""
        size, t = self.length(d), self.unit(d)
        q = k
        if size > 0:
            q = T / size
        return across(q, t, t.dot(x), x)

    @ti.func
    def forces(self, t, now: A, scene: A, state: A, s, first):
        T = self.pull(t, self.numbers(t, now, scene.lines), state.u, s, scene)[0]
        before, begin, last = self.vector(0), scene.line_start[t], scene.line_start[t + 1] - 1
        if self.is_single(t, scene):
            f = T * self.unit(scene.line_segments[begin] + self.parted(begin, state.u, s, scene))
            self.store_both(begin, f, first, scene, scene.corner)
        else:
            for p in range(begin, last + 1):
                after = self.vector(0)
                if p < last:
                    after = T * self.unit(scene.line_segments[p] + self.parted(p, state.u, s, scene))
                self.store(p, after - before, first, scene, scene.corner)
                before = after

    @ti.func
    def forces_jvp(self, t, now: A, scene: A, state: A, s, tangent: A, first):
        n, dn = self.numbers(t, now, scene.lines), self.numbers(t, now, tangent.lines)
        pulled, de = self.pull(t, n, state.u, s, scene), dn[1]
        last = scene.line_start[t + 1] - 1
        for p in range(scene.line_start[t], last):
            D, dD = scene.line_segments[p], tangent.line_segments[p]
            d, dd = D + self.parted(p, state.u, s, scene), dD + self.parted(p, tangent.u, 0, scene)
            de += self.unit(d).dot(dd) - self.unit(D).dot(dD)
        dT = tension_jvp(pulled[2], pulled[1], dn[0], dn[2], de)
        before = self.vector(0)
        for p in range(scene.line_start[t], last + 1):
            after = self.vector(0)
            if p < last:
                d = scene.line_segments[p] + self.parted(p, state.u, s, scene)
                dd = tangent.line_segments[p] + self.parted(p, tangent.u, 0, scene)
                after = dT * self.unit(d) + self.across(pulled[0], n[2], d, dd)
            self.store(p, after - before, first, scene, scene.corner)
            before = after

    @ti.func
    def forces_vjp(self, t, now: A, scene: A, state: A, s, adjoint: A, first):
        """Products of the derivative, which is symmetric, with adjoint.w, to corners; adds the adjoints of a line
        element's numbers to adjoint.line_adjoint and those of its segments at rest to adjoint.line_rest."""
        n, zero = self.numbers(t, now, scene.lines), ti.cast(0, self.fp)
        pulled, T_adj, e_adj = self.pull(t, n, state.u, s, scene), zero, zero
        begin, last, before = scene.line_start[t], scene.line_start[t + 1] - 1, self.vector(0)
        if self.is_single(t, scene):
            D = scene.line_segments[begin]
            d, w = D + self.parted(begin, state.u, s, scene), self.vector(0) - self.parted(begin, adjoint.w, 0, scene)
            T_adj = self.unit(d).dot(w)
            e_adj = T_adj * pulled[2]
            push = e_adj * self.unit(d) + self.across(pulled[0], n[2], d, w)
            adjoint.line_rest[begin] = adjoint.line_rest[begin] + push - e_adj * self.unit(D)
            self.store_both(begin, self.vector(0) - push, first, scene, adjoint.corner)
        else:
            for p in range(begin, last):
                d = scene.line_segments[p] + self.parted(p, state.u, s, scene)
                T_adj += self.unit(d).dot(self.vector(0) - self.parted(p, adjoint.w, 0, scene))
            e_adj = T_adj * pulled[2]
            for p in range(begin, last + 1):
                after = self.vector(0)
                if p < last:
                    D = scene.line_segments[p]
                    d, w = D + self.parted(p, state.u, s, scene), self.vector(0) - self.parted(p, adjoint.w, 0, scene)
                    after = e_adj * self.unit(d) + self.across(pulled[0], n[2], d, w)
                    adjoint.line_rest[p] = adjoint.line_rest[p] + after - e_adj * self.unit(D)
                self.store(p, before - after, first, scene, adjoint.corner)
                before = after
        for r, share, weight in ti.static(self.kicks(now)):
            by_a, by_s = weight * T_adj, weight * e_adj
            pull = self.vector((1 - share) * by_a, share * by_a, weight * T_adj * pulled[1], zero)
            slack = self.vector((1 - share) * by_s, share * by_s, zero, zero)
            adjoint.line_adjoint[r, 2 * t] = adjoint.line_adjoint[r, 2 * t] + pull
            adjoint.line_adjoint[r, 2 * t + 1] = adjoint.line_adjoint[r, 2 * t + 1] + slack


@dataclass(frozen=True)
class FibreBlock(StepNumbers):
    """Functions of fibres t .. t + 7; nodes: of a tetrahedron; shape: of adjoints."""

    nodes: int
    shape: bool

    @cached_property
    def lanes(self):
        return ti.types.vector(LANES, self.fp)

    @traced
    def place(self, t, scene):
        """(the first point of fibre t, the first corner)"""
        p = let(at(scene.line_start, t))
        return p, let(at(scene.point_start, p + 1))

    @traced
    def weight(self, c, a: int, scene) -> list:
        """Of node a, a number for each fibre."""
        return [let(at(scene.point_weight, c + (self.nodes * k + a))) for k in range(LANES)]

    @traced
    def gathered(self, vectors: list) -> list:
        """Components in lanes of a vector for each fibre."""
        return [let(self.lanes(*(at(x, d) for x in vectors))) for d in range(3)]

    @traced
    def parted(self, c, x, s, scene) -> list:
        """How much the ends of the fibres move against the origin."""
        out = None
        for a in range(self.nodes):
            vertices = (at(scene.point_vertex, c + (self.nodes * k + a)) for k in range(LANES))
            moved = self.gathered([let(at(x, s, i)) for i in vertices])
            w = let(self.lanes(*self.weight(c, a, scene)))
            own = [let(w * part) for part in moved]
            out = own if out is None else [let(before + part) for before, part in zip(out, own)]
        return out

    @traced
    def at_rest(self, p, array) -> list:
        """Vectors of the segments at rest, from an array of points."""
        return self.gathered([let(at(array, p + 2 * k if k else p)) for k in range(LANES)])

    @traced
    def dot(self, x: list, y: list):
        return let(x[0] * y[0] + x[1] * y[1] + x[2] * y[2])

    @traced
    def known(self, d: list) -> tuple:
        """(1 where a fibre has a length, else 0; its length, 1 where it has none; its direction)"""
        size = let(ti.sqrt(self.dot(d, d)))
        zero, one = self.lanes(0), self.lanes(1)
        there = let(ti.select(size > zero, one, zero))
        size = let(ti.select(size > zero, size, one))
        return there, size, [let(x / size) for x in d]

    @traced
    def tension(self, t, now, rows):
        """The mean of both kicks, from rows of steps."""
        out = None
        for r, share, weight in self.kicks(now):
            pulls = [let(at(rows, r, 2 * t + 2 * k)) for k in range(LANES)]
            begin, end = (let(self.lanes(*(at(x, d) for x in pulls))) for d in (0, 1))
            own = let(weight * between(begin, end, share))
            out = own if out is None else let(out + own)
        return out

    @traced
    def across(self, T, size, there, unit: list, x: list) -> list:
        """T/|d| of what of x lies across d."""
        q, along = let(there * (T / size)), self.dot(unit, x)
        return [let(pull.across(q, e, along, part)) for part, e in zip(x, unit)]

    @traced
    def store(self, c, first, f: list, scene, corner) -> None:
        """Weights of the nodes times f to their corners."""
        zero = ti.cast(0, self.fp)
        for a in range(self.nodes):
            for k, w in enumerate(self.weight(c, a, scene)):
                force = self.vector(*(w * at(x, k) for x in f), zero)
                assign(at(corner, first + c + (self.nodes * k + a)), force)

    @traced
    def minus(self, x: list) -> list:
        return [let(self.lanes(0) - part) for part in x]

    @traced
    def stretched(self, c, p, u, s, scene) -> list:
        """d, from the origins to the ends of the fibres."""
        return [let(D + moved) for D, moved in zip(self.at_rest(p, scene.line_segments), self.parted(c, u, s, scene))]

    @traced
    def forces(self, t, now, scene, state, s, first) -> None:
        p, c = self.place(t, scene)
        there, _, unit = self.known(self.stretched(c, p, state.u, s, scene))
        T = let(self.tension(t, now, scene.lines) * there)
        self.store(c, first, self.minus([let(T * e) for e in unit]), scene, scene.corner)

    @traced
    def forces_jvp(self, t, now, scene, state, s, tangent, first) -> None:
        p, c = self.place(t, scene)
        there, size, unit = self.known(self.stretched(c, p, state.u, s, scene))
        T, dT = self.tension(t, now, scene.lines), let(self.tension(t, now, tangent.lines) * there)
        moved = zip(self.at_rest(p, tangent.line_segments), self.parted(c, tangent.u, 0, scene))
        across = self.across(T, size, there, unit, [let(dD + part) for dD, part in moved])
        change = [let(dT * e + part) for e, part in zip(unit, across)]
        self.store(c, first, self.minus(change), scene, scene.corner)

    @traced
    def forces_vjp(self, t, now, scene, state, s, adjoint, first) -> None:
        """As of LineElement; adds to adjoint.line_rest only where adjoints of the shape are wanted."""
        p, c = self.place(t, scene)
        there, size, unit = self.known(self.stretched(c, p, state.u, s, scene))
        w = self.minus(self.parted(c, adjoint.w, 0, scene))
        push = self.across(self.tension(t, now, scene.lines), size, there, unit, w)
        self.store(c, first, push, scene, adjoint.corner)
        zero = ti.cast(0, self.fp)
        if self.shape:
            for k in range(LANES):
                target = at(adjoint.line_rest, p + 2 * k if k else p)
                assign(target, target + self.vector(*(at(x, k) for x in push), zero))
        by_T = let(self.dot(unit, w) * there)
        for r, share, weight in self.kicks(now):
            by = let(weight * by_T)
            begin, end = let((1 - share) * by), let(share * by)
            for k in range(LANES):
                target = at(adjoint.line_adjoint, r, 2 * t + 2 * k)
                assign(target, target + self.vector(at(begin, k), at(end, k), zero, zero))


@dataclass(frozen=True)
class LineForce(ItemForce):
    """per_step: whether their numbers have a row for each step; cables: whether some are cables, which are loads;
    fibres: whether the last ones are fibres that go eight at a time, of tetrahedra of `nodes` nodes; shape: of adjoints."""

    per_step: bool
    cables: bool
    fibres: bool
    nodes: int
    shape: bool

    name, pulls, asks_for_steps = "lines", True, True
    arrays = dict.fromkeys(("line_start", "point_start", "point_vertex", "line_sides"), "ints")
    arrays |= dict(point_weight="scalars")
    # between points at rest (points, 3) [m]; numbers of each (inputs/lines.py), (1 or steps, 2 elements, 3)
    derived = dict(line_segments="vectors", lines="vectors2")
    adjoints = dict(line_adjoint="vectors2", line_rest="vectors")

    @property
    def is_load(self) -> bool:
        return self.cables

    @property
    def counts(self) -> tuple[str, ...]:
        return (*super().counts, *(("num_fibre_blocks",) if self.fibres else ()))

    def alone(self) -> "LineForce":
        return replace(self, fibres=False)

    @cached_property
    def line(self) -> LineElement:
        return LineElement(self.precision, self.per_step)

    @cached_property
    def fibre(self) -> FibreBlock:
        return FibreBlock(self.precision, self.per_step, self.nodes, self.shape)

    @traced
    def sizes(self, plan) -> dict:
        return super().sizes(plan) | dict(line_adjoint=plan.len_lines, line_rest=plan.len_line_segments)

    @traced
    def num_single(self, plan):
        """Number of line elements that go one by one."""
        return let(plan.num_lines - LANES * plan.num_fibre_blocks) if self.fibres else plan.num_lines

    @traced
    def count(self, plan):
        return let(self.num_single(plan) + plan.num_fibre_blocks) if self.fibres else plan.num_lines

    @traced
    def first_fibre(self, k, plan):
        """The line element with which the block that item k is begins."""
        single = self.num_single(plan)
        return let(single + LANES * (k - single))

    @ti.func
    def forces(self, k, now: A, scene: A, state: A, s, plan: A):
        if ti.static(not self.fibres):
            self.line.forces(k, now, scene, state, s, self.first(plan))
        elif k < self.num_single(plan):
            self.line.forces(k, now, scene, state, s, self.first(plan))
        else:
            self.fibre.forces(self.first_fibre(k, plan), now, scene, state, s, self.first(plan))

    @ti.func
    def forces_jvp(self, k, now: A, scene: A, state: A, s, tangent: A, plan: A):
        if ti.static(not self.fibres):
            self.line.forces_jvp(k, now, scene, state, s, tangent, self.first(plan))
        elif k < self.num_single(plan):
            self.line.forces_jvp(k, now, scene, state, s, tangent, self.first(plan))
        else:
            self.fibre.forces_jvp(self.first_fibre(k, plan), now, scene, state, s, tangent, self.first(plan))

    @ti.func
    def forces_vjp(self, k, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        if ti.static(not self.fibres):
            self.line.forces_vjp(k, now, scene, state, s, adjoint, self.first(plan))
        elif k < self.num_single(plan):
            self.line.forces_vjp(k, now, scene, state, s, adjoint, self.first(plan))
        else:
            self.fibre.forces_vjp(self.first_fibre(k, plan), now, scene, state, s, adjoint, self.first(plan))
