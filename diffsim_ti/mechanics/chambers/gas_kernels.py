"""Kernels of gases in chambers in explicit passes: volumes first, then corner forces p(V) dV/dx, and their derivatives.

A launch has two loops: sums over the triangles of each chamber, in parts of a fixed order, then all triangles, each of which
adds the parts up for itself. Triangle t writes corners `first + 3 t + a`, which vertices gather with those of tetrahedra;
those of lids (mesh/enclosure.py) have no force, but adjoints.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.runtime import Kernel
from diffsim_ti.state.pass_table import pass_at

A = ti.template()
CHAMBERS = dict.fromkeys(("triangles", "own", "chamber", "begins", "anchor", "first_row"), "ints") | dict(
    point="vectors", volume="scalars", felt="scalars"
)
SCENE = dict(rest="vectors", follower="vectors2")
TABLE = dict(ints="ints", floats="scalars")
NUMBERS = dict.fromkeys(("num_triangles", "num_sums", "pass_", "window", "slot", "first"), "int")


@dataclass(frozen=True)
class ChamberKernels(StepNumbers):
    """parts: sums that each chamber's triangles are cut into."""

    parts: int
    parallel: bool
    shape: bool

    @ti.func
    def sixth(self):
        return ti.cast(-1.0 / 6.0, self.fp)

    # ---- places ------------------------------------------------------------------------------------------------------

    @ti.func
    def place(self, t, a: A, u: A, s, scene: A, chambers: A):
        """Corner a of triangle t from where its chamber's volume is counted."""
        i, o = chambers.triangles[3 * t + a], chambers.anchor[chambers.chamber[t]]
        y = scene.rest[i] + u[s, i] - chambers.point[chambers.chamber[t]]
        if o >= 0:
            y = (scene.rest[i] - scene.rest[o]) + (u[s, i] - u[s, o])
        return y

    @ti.func
    def change(self, t, a: A, tangent: A, chambers: A):
        """Its change."""
        i, o = chambers.triangles[3 * t + a], chambers.anchor[chambers.chamber[t]]
        dy = tangent.rest[i] + tangent.u[0, i]
        if o >= 0:
            dy = dy - (tangent.rest[o] + tangent.u[0, o])
        return dy

    @ti.func
    def pull(self, t, adjoint: A, chambers: A):
        """Sum of the adjoints of the forces at its corners."""
        w = adjoint.w[0, chambers.triangles[3 * t]]
        for a in ti.static((1, 2)):
            w += adjoint.w[0, chambers.triangles[3 * t + a]]
        return w

    @ti.func
    def sums(self, q, what: A, scene: A, at: A, more: A, chambers: A, plan: A):
        """Part q: of the volume and, to `felt`, of its change or of the adjoint of the pressure."""
        c, volume, felt = q // self.parts, ti.cast(0, self.fp), ti.cast(0, self.fp)
        begin, end = chambers.begins[c] + q % self.parts, chambers.begins[c + 1]
        for k in range((end - begin + self.parts - 1) // self.parts):
            t = begin + k * self.parts
            y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
            volume += y[0].dot(self.cross(y[1], y[2]))
            if ti.static(what == "jvp"):
                for a in ti.static(range(3)):
                    felt += self.change(t, a, more, chambers).dot(self.cross(y[(a + 1) % 3], y[(a + 2) % 3]))
            if ti.static(what == "vjp"):
                if chambers.own[t] > 0:
                    felt += self.pull(t, more, chambers).dot(self.cross(y[1] - y[0], y[2] - y[0]))
        chambers.volume[q] = self.sixth() * volume
        chambers.felt[q] = self.sixth() * felt

    @ti.func
    def whole(self, c, parts: A):
        total = ti.cast(0, self.fp)
        for k in range(self.parts):
            total += parts[c * self.parts + k]
        return total

    # ---- the law -----------------------------------------------------------------------------------------------------

    @ti.func
    def filling(self, at, now: A, rows: A):
        """p_0, the mean of both kicks."""
        p = ti.cast(0, self.fp)
        for force, weight in ti.static(((now.force0, now.share0), (now.force1, now.share1))):
            ends = rows[self.row(force), at]
            p += weight * (ends[0] + self.share(force, now) * (ends[1] - ends[0]))
        return p

    @ti.func
    def law(self, at, V, now: A, rows: A):
        """(p - p_out, absolute p, (V_0 / V)^n, log(V_0 / V), V_0, n)"""
        outside, V0, n = rows[0, at + 1][0], rows[0, at + 2][0], rows[0, at + 3][0]
        log = ti.log(V0 / V)
        grown = ti.exp(n * log)
        absolute = self.filling(at, now, rows) * grown
        return absolute - outside, absolute, grown, log, V0, n

    @ti.func
    def law_jvp(self, at, swelling, now: A, absolute, grown, log, V0, n, rows: A):
        """Change of p - p_out for dV / V and changes of the chamber's numbers."""
        dp = grown * self.filling(at, now, rows) - n * absolute * swelling
        dp += absolute * (n / V0 * rows[0, at + 2][0] + log * rows[0, at + 3][0])
        return dp - rows[0, at + 1][0]

    # ---- loops -------------------------------------------------------------------------------------------------------

    @ti.func
    def all_forces(self, chambers: A, scene: A, at: A, out: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for q in range(plan.num_sums):
            self.sums(q, "value", scene, at, at, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            c, f = chambers.chamber[t], self.vector(0)
            if chambers.own[t] > 0:
                now = pass_at(table, plan.pass_ - plan.window)
                y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
                V = self.whole(c, chambers.volume)
                p, absolute, grown, log, V0, n = self.law(chambers.first_row[c], V, now, scene.follower)
                f = self.sixth() * p * self.cross(y[1] - y[0], y[2] - y[0])
            for a in ti.static(range(3)):
                out.corner[plan.first + 3 * t + a] = f

    @ti.func
    def all_jvp(self, chambers: A, scene: A, at: A, tangent: A, out: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for q in range(plan.num_sums):
            self.sums(q, "jvp", scene, at, tangent, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            c, df = chambers.chamber[t], self.vector(0)
            if chambers.own[t] > 0:
                now, first = pass_at(table, plan.pass_ - plan.window), chambers.first_row[c]
                y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
                dy = [self.change(t, a, tangent, chambers) for a in ti.static(range(3))]
                V, dV = self.whole(c, chambers.volume), self.whole(c, chambers.felt)
                p, absolute, grown, log, V0, n = self.law(first, V, now, scene.follower)
                dp = self.law_jvp(first, dV / V, now, absolute, grown, log, V0, n, tangent.follower)
                e, f, de, de2 = y[1] - y[0], y[2] - y[0], dy[1] - dy[0], dy[2] - dy[0]
                df = self.sixth() * (p * (self.cross(de, f) + self.cross(e, de2)) + dp * self.cross(e, f))
            for a in ti.static(range(3)):
                out.corner[plan.first + 3 * t + a] = df

    @ti.func
    def all_vjp(self, chambers: A, scene: A, at: A, adjoint: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for q in range(plan.num_sums):
            self.sums(q, "vjp", scene, at, adjoint, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            c, first = chambers.chamber[t], chambers.first_row[chambers.chamber[t]]
            now = pass_at(table, plan.pass_ - plan.window)
            y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
            V, felt = self.whole(c, chambers.volume), self.whole(c, chambers.felt)
            p, absolute, grown, log, V0, n = self.law(first, V, now, scene.follower)
            by_V = self.sixth() * (ti.cast(-1, self.fp) * felt * n * absolute / V)
            by0, by1 = by_V * self.cross(y[1], y[2]), by_V * self.cross(y[2], y[0])
            by2 = by_V * self.cross(y[0], y[1])
            if chambers.own[t] > 0:
                w, e, f = self.pull(t, adjoint, chambers), y[1] - y[0], y[2] - y[0]
                by_e, by_f = self.sixth() * p * self.cross(f, w), self.sixth() * p * self.cross(w, e)
                by0 = by0 - (by_e + by_f)
                by1 = by1 + by_e
                by2 = by2 + by_f
            for a, by in ti.static(enumerate((by0, by1, by2))):
                adjoint.corner[plan.first + 3 * t + a] = by
                if ti.static(self.shape):
                    adjoint.chamber_rest[3 * t + a] = adjoint.chamber_rest[3 * t + a] + by
            if t == chambers.begins[c]:
                self.add_numbers(4 * c, felt, absolute, grown, log, V0, n, now, adjoint)

    @ti.func
    def add_numbers(self, k, felt, absolute, grown, log, V0, n, now: A, adjoint: A):
        """Adds the adjoints of a gas's numbers, of which that of its pressure is `felt`."""
        for force, weight in ti.static(((now.force0, now.share0), (now.force1, now.share1))):
            share, r, ends = self.share(force, now), self.row(force), self.vector(0)
            by = weight * felt * grown
            ends[0], ends[1] = by * (1 - share), by * share
            adjoint.chamber_felt[r, k] = adjoint.chamber_felt[r, k] + ends
        for d, by in ti.static(((1, ti.cast(-1, self.fp)), (2, absolute * n / V0), (3, absolute * log))):
            one = self.vector(0)
            one[0] = felt * by
            adjoint.chamber_felt[0, k + d] = adjoint.chamber_felt[0, k + d] + one

    # ---- kernels -----------------------------------------------------------------------------------------------------

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(chambers=CHAMBERS, scene=SCENE, at=dict(u="vectors2")) | arrays | dict(table=TABLE)
        return Kernel(name, body, self.precision, own, NUMBERS)

    @cached_property
    def forces(self) -> Kernel:
        """Corner forces in a slot of the state, as pass `pass_` takes them."""
        return self._kernel("chamber_forces", self.all_forces, out=dict(corner="vectors"))

    @cached_property
    def jvp(self) -> Kernel:
        """Their change."""
        tangent = dict(u="vectors2", rest="vectors", follower="vectors2")
        return self._kernel("chamber_jvp", self.all_jvp, tangent=tangent, out=dict(corner="vectors"))

    @cached_property
    def vjp(self) -> Kernel:
        """Products of the transposed derivative with adjoint.w, to corners; adds the adjoints of numbers and of places."""
        own = dict(w="vectors2", corner="vectors", chamber_felt="vectors2", chamber_rest="vectors")
        return self._kernel("chamber_vjp", self.all_vjp, adjoint=own)
