"""Friction in the contact stage of explicit passes, with tangent and adjoint: that of each obstacle after the other's."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.solvers.explicit.contact_impulses import friction_by_mass, note_friction_jvp, seed_of_friction
from diffsim_ti.solvers.explicit.obstacle_stages import FELT, PLANE, PUSH, ROWS, SEED, WALL, ObstacleStages
from diffsim_ti.terms.obstacles import stage

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class ContactSlides(ObstacleStages):
    """Taichi functions of one vertex, whose pushes are noted (contact_stage.py)."""

    @ti.func
    def normal(self, plane):
        return self.vector(plane.x, plane.y, plane.z, ti.cast(0, self.fp))

    @ti.func
    def slide(self, o, i, v, ratio, state: A):
        """Velocity after the friction of an obstacle, whose push is noted."""
        pushed, felt, after = state.stage[ROWS * o + PUSH, i], state.stage[ROWS * o + FELT, i], v
        if pushed.x > 0 and felt.z > 0:
            plane, wall = state.stage[ROWS * o + PLANE, i], state.stage[ROWS * o + WALL, i]
            after = stage.slide(self.fp, plane, pushed.x, v, wall, ratio, felt.z, felt.w)
        return after

    @ti.func
    def slide_by(self, count, i, v, ratio, state: A):
        """Velocity after the friction of the first `count` obstacles, one after the other."""
        for o in range(count):
            v = self.slide(ti.static(self.features.first_staged) + o, i, v, ratio, state)
        return v

    @ti.func
    def slide_all(self, i, v, ratio, state: A):
        """Velocity after the friction of all obstacles."""
        if ti.static(len(self.features.staged_rough) > 0):
            v = self.slide_by(ti.static(self.features.num_staged), i, v, ratio, state)
        return v

    @ti.func
    def slide_all_jvp(self, i, v, dv, ratio, dratio, now: A, scene: A, state: A, tangent: A):
        """Velocity after friction, and its change."""
        for g in ti.static(self.features.staged_rough):
            for k in range(g.count):
                row, numbers = ROWS * (g.number + k), g.first + k * g.size + g.force.count
                pushed, felt = state.stage[row + PUSH, i], state.stage[row + FELT, i]
                if pushed.x > 0:
                    plane, wall = state.stage[row + PLANE, i], state.stage[row + WALL, i]
                    dwall, change = self.speed(g, k, now, tangent.path), state.stage[row + SEED, i]
                    dmu, deps = tangent.parameters[numbers + 2], tangent.parameters[numbers + 3]
                    dafter = stage.slide_jvp(
                        self.fp, plane, pushed.x, v, wall, ratio, felt.z, felt.w, change, dv, dwall, dratio, dmu, deps
                    )
                    after = stage.slide(self.fp, plane, pushed.x, v, wall, ratio, felt.z, felt.w)
                    if ti.static(self.features.recorded):
                        note_friction_jvp(self, g.number + k, i, after - v, dafter - dv, now, scene, tangent)
                    v, dv = after, dafter
        return v, dv

    @ti.func
    def slide_all_vjp(self, i, v, v_adj, ratio, now: A, scene: A, state: A, adjoint: A):
        """(adjoint of the velocity v before friction, of h / m); notes those of all else, of the wall in its place."""
        by_ratio = ti.cast(0, self.fp)
        for back in range(ti.static(self.features.num_staged)):
            before = ti.static(self.features.num_staged) - 1 - back
            row = ROWS * (ti.static(self.features.first_staged) + before)
            pushed, felt, by_wall = state.stage[row + PUSH, i], state.stage[row + FELT, i], self.vector(0)
            if pushed.x > 0 and felt.z > 0:
                start = self.slide_by(before, i, v, ratio, state)
                plane, wall = state.stage[row + PLANE, i], state.stage[row + WALL, i]
                if ti.static(self.features.recorded):
                    v_adj += seed_of_friction(self, before, i, now, scene, adjoint)
                by_plane, by_v, of_wall, more, by_mu, by_eps = stage.slide_vjp(
                    self.fp, plane, pushed.x, start, wall, ratio, felt.z, felt.w, v_adj
                )
                v_adj, by_wall = by_v, of_wall
                if ti.static(self.features.recorded):
                    v_adj += -1 * seed_of_friction(self, before, i, now, scene, adjoint)
                    friction_by_mass(self, before, i, start, ratio, now, state, adjoint)
                by_ratio += more
                state.stage[row + SEED, i] = state.stage[row + SEED, i] + by_plane
                pushed.z, pushed.w = by_mu, by_eps
                state.stage[row + PUSH, i] = pushed
            state.stage[row + WALL, i] = by_wall
        return v_adj, by_ratio
