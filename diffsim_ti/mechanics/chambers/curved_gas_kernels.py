"""Kernels of gases in chambers whose faces have six nodes: weighted triangles (mesh/enclosure.py), those of lids among them.

The force of a triangle on its corner a is p dV/dy_a = -p w / 6 y_b x y_c. Summed over all triangles that is exact for what
moves freely, and nothing is left of the place from where the volume is counted.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.chambers.gas_kernels import CHAMBERS, NUMBERS, SCENE, TABLE, ChamberKernels
from diffsim_ti.runtime import Kernel
from diffsim_ti.state.pass_table import pass_at

A = ti.template()
WEIGHTED = CHAMBERS | dict(weight="scalars")


@dataclass(frozen=True)
class CurvedChamberKernels(ChamberKernels):
    """As ChamberKernels, for weighted triangles."""

    @ti.func
    def sums(self, q, what: A, scene: A, at: A, more: A, chambers: A, plan: A):
        """Part q: of the volume and, to `felt`, of its change or of the adjoint of the pressure."""
        c, volume, felt = q // self.parts, ti.cast(0, self.fp), ti.cast(0, self.fp)
        begin, end = chambers.begins[c] + q % self.parts, chambers.begins[c + 1]
        for k in range((end - begin + self.parts - 1) // self.parts):
            t = begin + k * self.parts
            weight = chambers.weight[t]
            y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
            volume += weight * y[0].dot(self.cross(y[1], y[2]))
            for a in ti.static(range(3)):
                if ti.static(what == "jvp"):
                    dy = self.change(t, a, more, chambers)
                    felt += weight * dy.dot(self.cross(y[(a + 1) % 3], y[(a + 2) % 3]))
                if ti.static(what == "vjp"):
                    w = more.w[0, chambers.triangles[3 * t + a]]
                    felt += weight * w.dot(self.cross(y[(a + 1) % 3], y[(a + 2) % 3]))
        chambers.volume[q] = self.sixth() * volume
        chambers.felt[q] = self.sixth() * felt

    @ti.func
    def all_forces(self, chambers: A, scene: A, at: A, out: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for q in range(plan.num_sums):
            self.sums(q, "value", scene, at, at, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            c, now = chambers.chamber[t], pass_at(table, plan.pass_ - plan.window)
            y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
            V = self.whole(c, chambers.volume)
            p, absolute, grown, log, V0, n = self.law(chambers.first_row[c], V, now, scene.follower)
            factor = self.sixth() * p * chambers.weight[t]
            for a in ti.static(range(3)):
                out.corner[plan.first + 3 * t + a] = factor * self.cross(y[(a + 1) % 3], y[(a + 2) % 3])

    @ti.func
    def all_jvp(self, chambers: A, scene: A, at: A, tangent: A, out: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for q in range(plan.num_sums):
            self.sums(q, "jvp", scene, at, tangent, chambers, plan)
        ti.loop_config(serialize=not self.parallel)
        for t in range(plan.num_triangles):
            c, now = chambers.chamber[t], pass_at(table, plan.pass_ - plan.window)
            first = chambers.first_row[c]
            y = [self.place(t, a, at.u, plan.slot, scene, chambers) for a in ti.static(range(3))]
            dy = [self.change(t, a, tangent, chambers) for a in ti.static(range(3))]
            V, dV = self.whole(c, chambers.volume), self.whole(c, chambers.felt)
            p, absolute, grown, log, V0, n = self.law(first, V, now, scene.follower)
            dp = self.law_jvp(first, dV / V, now, absolute, grown, log, V0, n, tangent.follower)
            sixth = self.sixth() * chambers.weight[t]
            for a in ti.static(range(3)):
                b, c_ = y[(a + 1) % 3], y[(a + 2) % 3]
                turned = self.cross(dy[(a + 1) % 3], c_) + self.cross(b, dy[(a + 2) % 3])
                out.corner[plan.first + 3 * t + a] = sixth * (p * turned + dp * self.cross(b, c_))

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
            w = [adjoint.w[0, chambers.triangles[3 * t + a]] for a in ti.static(range(3))]
            V, felt = self.whole(c, chambers.volume), self.whole(c, chambers.felt)
            p, absolute, grown, log, V0, n = self.law(first, V, now, scene.follower)
            sixth = self.sixth() * chambers.weight[t]
            by_V = sixth * (ti.cast(-1, self.fp) * felt * n * absolute / V)
            for a in ti.static(range(3)):
                by = by_V * self.cross(y[(a + 1) % 3], y[(a + 2) % 3])
                turned = self.cross(w[(a + 1) % 3], y[(a + 2) % 3]) + self.cross(y[(a + 1) % 3], w[(a + 2) % 3])
                by += sixth * p * turned
                adjoint.corner[plan.first + 3 * t + a] = by
                if ti.static(self.shape):
                    adjoint.chamber_rest[3 * t + a] = adjoint.chamber_rest[3 * t + a] + by
            if t == chambers.begins[c]:
                self.add_numbers(4 * c, felt, absolute, grown, log, V0, n, now, adjoint)

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(chambers=WEIGHTED, scene=SCENE, at=dict(u="vectors2")) | arrays | dict(table=TABLE)
        return Kernel(f"curved_{name}", body, self.precision, own, NUMBERS)
