"""Fibres of muscles in explicit passes, eight at a time: what line.py does with one, to the same digits.

A fibre is a line element with a given tension T, from the origin, which is no vertex, to a weighted sum of the vertices
of its tetrahedron. So the points, the corners and the numbers of eight fibres in a row lie at equal distances, and
each number of a formula is a vector of eight lanes.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.lines.pull import across
from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.runtime import LANES, assign, at, let, traced
from diffsim_ti.state.pass_table import between


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
        return [let(across(q, e, along, part)) for part, e in zip(x, unit)]

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
