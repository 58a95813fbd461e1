"""Kernels of gases in chambers in explicit passes: volumes first, then corner forces p(V) dV/dx, and their derivatives.

A launch has two loops: sums over the triangles of each chamber, in parts of a fixed order, then all triangles, each of which
adds the parts up for itself. Triangle t writes corners `first + 3 t + a`, which vertices gather with those of tetrahedra.

V = -1/6 sum over triangles of `weight` y_0 . (y_1 x y_2), y the places of the corners (mesh/enclosure.py). What the gas does
at corner a of a triangle is -p/6 `push` n_a. Of flat faces n_a = (y_1 - y_0) x (y_2 - y_0), a third of the triangle's own
area for each corner, and lids have no push. Of curved ones, whose triangles are weighted, n_a = y_b x y_c, so that the force
is p dV/dy_a. Summed over all triangles both are exact for what moves freely, and nothing is left of the place from where the
volume is counted.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.runtime import A, Kernel, as_kernel, at, cross, let, traced
from diffsim_ti.state.pass_table import pass_at
from diffsim_ti.terms.chambers import gas_law

CHAMBERS = dict.fromkeys(("triangles", "chamber", "begins", "anchor", "first_row"), "ints") | dict(
    point="vectors", volume="scalars", by_pressure="scalars", weight="scalars", push="scalars"
)
SCENE = dict(rest="vectors", follower="vectors2")
TABLE = dict(ints="ints", floats="scalars")
NUMBERS = dict.fromkeys(("num_triangles", "num_sums", "pass_", "window", "slot", "first"), "int")
law = ti.func(gas_law)


@dataclass(frozen=True)
class ChamberKernels(StepNumbers):
    """parts: sums that each chamber's triangles are cut into. curved: whether faces are."""

    parts: int
    parallel: bool
    shape: bool
    curved: bool

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

    @traced
    def places(self, t, state, scene, chambers, plan) -> list:
        return [let(self.place(t, a, state.u, plan.slot, scene, chambers)) for a in range(3)]

    @ti.func
    def change(self, t, a: A, tangent: A, chambers: A):
        """Its change."""
        i, o = chambers.triangles[3 * t + a], chambers.anchor[chambers.chamber[t]]
        dy = tangent.rest[i] + tangent.u[0, i]
        if o >= 0:
            dy = dy - (tangent.rest[o] + tangent.u[0, o])
        return dy

    @traced
    def changes(self, t, tangent, chambers) -> list:
        return [let(self.change(t, a, tangent, chambers)) for a in range(3)]

    @traced
    def pulls(self, t, adjoint, chambers) -> list:
        """Adjoints of the forces at its corners."""
        return [let(at(adjoint.w, 0, at(chambers.triangles, 3 * t + a))) for a in range(3)]

    @traced
    def swept(self, y) -> list:
        """-6 times the derivatives of a triangle's share of the volume by its corners."""
        return [let(cross(y[(a + 1) % 3], y[(a + 2) % 3])) for a in range(3)]

    @traced
    def swept_jvp(self, y, dy) -> list:
        """Their change, which is symmetric."""
        pairs = (((a + 1) % 3, (a + 2) % 3) for a in range(3))
        return [let(cross(dy[b], y[c]) + cross(y[b], dy[c])) for b, c in pairs]

    @traced
    def normals(self, y) -> list:
        """n_a of the three corners."""
        return self.swept(y) if self.curved else [let(cross(y[1] - y[0], y[2] - y[0]))] * 3

    @traced
    def normals_jvp(self, y, dy) -> list:
        if self.curved:
            return self.swept_jvp(y, dy)
        e, f, de, df = (let(x[a] - x[0]) for x in (y, dy) for a in (1, 2))
        return [let(cross(de, f) + cross(e, df))] * 3

    @traced
    def normals_vjp(self, y, w) -> list:
        """Adjoints of y for those of the normals."""
        if self.curved:
            return self.swept_jvp(y, w)
        e, f, total = let(y[1] - y[0]), let(y[2] - y[0]), let(w[0] + w[1] + w[2])
        by_e, by_f = let(cross(f, total)), let(cross(total, e))
        return [let(self.vector(0) - (by_e + by_f)), by_e, by_f]

    @ti.func
    def dots(self, x: A, y: A):
        """Sum of the inner products of what the corners have."""
        return x[0].dot(y[0]) + x[1].dot(y[1]) + x[2].dot(y[2])

    # ---- sums over a chamber -----------------------------------------------------------------------------------------

    @ti.func
    def sums(self, q, what: A, scene: A, at: A, more: A, chambers: A, plan: A):
        """Part q: of the volume and, to `by_pressure`, of its change or of the adjoint of the pressure."""
        c, volume, by_pressure = q // self.parts, ti.cast(0, self.fp), ti.cast(0, self.fp)
        begin, end = chambers.begins[c] + q % self.parts, chambers.begins[c + 1]
        for k in range((end - begin + self.parts - 1) // self.parts):
            t = begin + k * self.parts
            y = self.places(t, at, scene, chambers, plan)
            volume += chambers.weight[t] * y[0].dot(cross(y[1], y[2]))
            if ti.static(what == "jvp"):
                by_pressure += chambers.weight[t] * self.dots(self.changes(t, more, chambers), self.swept(y))
            if ti.static(what == "vjp"):
                by_pressure += chambers.push[t] * self.dots(self.pulls(t, more, chambers), self.normals(y))
        chambers.volume[q] = self.sixth() * volume
        chambers.by_pressure[q] = self.sixth() * by_pressure

    @ti.func
    def whole(self, c, parts: A):
        total = ti.cast(0, self.fp)
        for k in range(self.parts):
            total += parts[c * self.parts + k]
        return total

    @ti.func
    def numbers(self, c, now: A, rows: A, chambers: A):
        """(p_0, p_out, V_0, n) of chamber c; p_0 is the mean of both kicks."""
        at = chambers.first_row[c]
        return self.mean(at, now, rows), rows[0, at + 1][0], rows[0, at + 2][0], rows[0, at + 3][0]

    @ti.func
    def law_at(self, c, now: A, scene: A, chambers: A):
        """`gas_law` of chamber c."""
        p0, outside, V0, n = self.numbers(c, now, scene.follower, chambers)
        return law(p0, outside, V0, n, self.whole(c, chambers.volume))

    # ---- loops -------------------------------------------------------------------------------------------------------

    @ti.func
    def sum_up(self, what: A, scene: A, at: A, more: A, chambers: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for q in range(plan.num_sums):
            self.sums(q, what, scene, at, more, chambers, plan)

    @as_kernel("chamber_forces", out=dict(corner="vectors"))
    def forces(self, chambers: A, scene: A, at: A, out: A, table: A, plan: A):
        """Corner forces in a slot of the state, as pass `pass_` takes them."""
        self.sum_up("value", scene, at, at, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            now = pass_at(table, plan.pass_ - plan.window)
            p = self.law_at(chambers.chamber[t], now, scene, chambers)[0]
            factor = self.sixth() * p * chambers.push[t]
            normals = self.normals(self.places(t, at, scene, chambers, plan))
            for a in ti.static(range(3)):
                out.corner[plan.first + 3 * t + a] = factor * normals[a]

    @as_kernel(
        "chamber_jvp", tangent=dict(u="vectors2", rest="vectors", follower="vectors2"), out=dict(corner="vectors")
    )
    def jvp(self, chambers: A, scene: A, at: A, tangent: A, out: A, table: A, plan: A):
        """Their change."""
        self.sum_up("jvp", scene, at, tangent, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            now, c = pass_at(table, plan.pass_ - plan.window), chambers.chamber[t]
            p, by_p0, by_outside, by_V0, by_n, slope = self.law_at(c, now, scene, chambers)
            dp0, d_outside, dV0, dn = self.numbers(c, now, tangent.follower, chambers)
            dp = by_p0 * dp0 + by_outside * d_outside + by_V0 * dV0 + by_n * dn
            dp = dp + slope * self.whole(c, chambers.by_pressure)
            y, factor = self.places(t, at, scene, chambers, plan), self.sixth() * chambers.push[t]
            normals, changes = self.normals(y), self.normals_jvp(y, self.changes(t, tangent, chambers))
            for a in ti.static(range(3)):
                out.corner[plan.first + 3 * t + a] = factor * (p * changes[a] + dp * normals[a])

    @as_kernel(
        "chamber_vjp", adjoint=dict(w="vectors2", corner="vectors", chamber_adjoint="vectors2", chamber_rest="vectors")
    )
    def vjp(self, chambers: A, scene: A, at: A, adjoint: A, table: A, plan: A):
        """Products of the transposed derivative with adjoint.w, to corners; adds the adjoints of numbers and of places."""
        self.sum_up("vjp", scene, at, adjoint, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            now, c = pass_at(table, plan.pass_ - plan.window), chambers.chamber[t]
            p, by_p0, by_outside, by_V0, by_n, slope = self.law_at(c, now, scene, chambers)
            by_pressure = self.whole(c, chambers.by_pressure)  # the adjoint of p
            y = self.places(t, at, scene, chambers, plan)
            by_V = self.sixth() * chambers.weight[t] * (by_pressure * slope)
            by_n_a = self.sixth() * chambers.push[t] * p
            swept, turned = self.swept(y), self.normals_vjp(y, self.pulls(t, adjoint, chambers))
            for a in ti.static(range(3)):
                by = by_V * swept[a] + by_n_a * turned[a]
                adjoint.corner[plan.first + 3 * t + a] = by
                if ti.static(self.shape):
                    adjoint.chamber_rest[3 * t + a] = adjoint.chamber_rest[3 * t + a] + by
            if t == chambers.begins[c]:
                self.add_mean(4 * c, by_pressure * by_p0, now, adjoint.chamber_adjoint)
                for d, by in ti.static(((1, by_outside), (2, by_V0), (3, by_n))):
                    one = self.vector(0)
                    one[0] = by_pressure * by
                    adjoint.chamber_adjoint[0, 4 * c + d] = adjoint.chamber_adjoint[0, 4 * c + d] + one

    # ---- kernels -----------------------------------------------------------------------------------------------------

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(chambers=CHAMBERS, scene=SCENE, at=dict(u="vectors2")) | arrays | dict(table=TABLE)
        return Kernel(name, body, self.precision, own, NUMBERS)
