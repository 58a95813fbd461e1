"""Springs and cables in explicit passes: each a path of points with one tension along it.

Point p of a path lies at X_p + U_p, U_p the weighted sum of its vertices' displacements, and d_p leads from it to the next.
T = a + k e, e = sum (|d_p| - |D_p|) + s, D_p: d_p at rest (inputs/lines.py). Corner c of the paths' points writes corner
`first + c`, and vertices gather it with those of tetrahedra. Lengths come as changes of lengths, so that single precision
keeps its digits near rest.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.lines import pull
from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.state.pass_table import between

A = ti.template()  # an array or Bundle handed to a Taichi function
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
