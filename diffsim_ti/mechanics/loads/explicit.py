"""Prescribed forces on vertices, in explicit passes: constant, for each step, or linear within steps."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import A, number_type, traced, vector_type
from diffsim_ti.state.features import Features
from diffsim_ti.state.pass_table import between, kicks


@dataclass(frozen=True)
class AppliedForces:
    """Functions of one vertex i."""

    features: Features
    precision: str

    fp, vector = number_type, vector_type

    @traced
    def kicks(self, now) -> list:
        """(row, how far in its step the pass lies, weight) of the two steps that share the kicks of a pass."""
        return kicks(now, self.features.forces_per_step, self.fp)

    @property
    def over_time(self) -> bool:
        return self.features.forces_keyed or self.features.forces_per_step

    @ti.func
    def in_step(self, row, k, share, forces: A):
        """Force k of a step, at a share of it where it changes within steps."""
        f = self.vector(0)
        if ti.static(self.features.forces_keyed):
            f = between(forces[row, 2 * k], forces[row, 2 * k + 1], share)
        else:
            f = forces[row, k]
        return f

    @ti.func
    def force(self, i, now: A, scene: A, forces: A):
        """External force on vertex i: of the present step, or of the two that share a kick their part."""
        f = self.vector(0)
        k = scene.force_slot[i]
        if k >= 0:
            if ti.static(self.over_time):
                for row, share, weight in ti.static(self.kicks(now)):
                    f += weight * self.in_step(row, k, share, forces)
            else:
                f = forces[0, k]
        return f

    @ti.func
    def gathered(self, i, scene: A, plan: A, pulls: A):
        """What pressures do at vertex i, and what pulls, cables, of what it gathers: they are the last of its corners."""
        f, first, end = self.vector(0), plan.first_load, scene.start[i + 1]
        if ti.static(self.features.pulled and not pulls):
            first = plan.first_push
        for back in range(1, end - scene.start[i] + 1):
            c = scene.corner_of[end - back]
            if c < first:
                break
            f = f + scene.corner[c]
        return f

    @ti.func
    def add_vjp(self, i, f_adj, now: A, scene: A, adjoint: A):
        k = scene.force_slot[i]
        if k >= 0:
            if ti.static(not self.over_time):
                adjoint.forces[0, k] = adjoint.forces[0, k] + f_adj
            else:
                for row, share, weight in ti.static(self.kicks(now)):
                    if ti.static(self.features.forces_keyed):
                        adjoint.forces[row, 2 * k] = adjoint.forces[row, 2 * k] + weight * (1 - share) * f_adj
                        adjoint.forces[row, 2 * k + 1] = adjoint.forces[row, 2 * k + 1] + weight * share * f_adj
                    else:
                        adjoint.forces[row, k] = adjoint.forces[row, k] + weight * f_adj
