"""Forces that are given on vertices, in explicit passes: constant, for each step, or linear within steps."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import PRECISIONS
from diffsim_ti.state.features import Features

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class GivenForces:
    """Functions of one vertex i."""

    features: Features
    precision: str

    @property
    def fp(self):
        return PRECISIONS[self.precision]

    @property
    def vector(self):
        return ti.types.vector(4, self.fp)

    @ti.func
    def force(self, i, now: A, scene: A, forces: A):
        """External force on vertex i: of the present step, or of the two that share a kick their part."""
        f = self.vector(0)
        k = scene.force_slot[i]
        if k >= 0:
            if ti.static(self.features.forces_keyed):
                f = now.share0 * self.keyed_force(now.force0, k, now, forces)
                f += now.share1 * self.keyed_force(now.force1, k, now, forces)
            else:
                f = forces[0, k]
                if ti.static(self.features.forces_per_step):
                    f = now.share0 * forces[now.force0, k] + now.share1 * forces[now.force1, k]
        return f

    @ti.func
    def row_of_step(self, step):
        """The row of forces that holds in a step."""
        r = 0
        if ti.static(self.features.forces_per_step):
            r = step
        return r

    @ti.func
    def share_of_step(self, step, now: A):
        """How far in a step the pass lies: it ends a step before its own."""
        return ti.select(step == now.row, now.begin, ti.cast(1, self.fp))

    @ti.func
    def keyed_force(self, step, k, now: A, forces: A):
        """The force of a step that changes from its beginning to its end."""
        begin, end = forces[self.row_of_step(step), 2 * k], forces[self.row_of_step(step), 2 * k + 1]
        return begin + self.share_of_step(step, now) * (end - begin)

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
            if ti.static(self.features.forces_keyed):
                for step, weight in ti.static(((now.force0, now.share0), (now.force1, now.share1))):
                    r, share = self.row_of_step(step), self.share_of_step(step, now)
                    adjoint.forces[r, 2 * k] = adjoint.forces[r, 2 * k] + weight * (1 - share) * f_adj
                    adjoint.forces[r, 2 * k + 1] = adjoint.forces[r, 2 * k + 1] + weight * share * f_adj
            elif ti.static(self.features.forces_per_step):
                adjoint.forces[now.force0, k] = adjoint.forces[now.force0, k] + now.share0 * f_adj
                adjoint.forces[now.force1, k] = adjoint.forces[now.force1, k] + now.share1 * f_adj
            else:
                adjoint.forces[0, k] = adjoint.forces[0, k] + f_adj
