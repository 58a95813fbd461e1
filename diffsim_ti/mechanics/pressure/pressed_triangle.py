"""The triangle under a pressure that follows it: corner forces -p n / 3, their differential and adjoint.

n = (x_1 - x_0) x (x_2 - x_0) / 2, x = X + u. Corner a of pressed triangle t writes corner `first + 3 t + a`, and vertices
gather it with those of tetrahedra.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.interaction import ItemForce, edges, store_alike
from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.runtime import traced

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class PressedTriangle(StepNumbers, ItemForce):
    """Functions of one triangle in a pass; per_step: whether pressures have a row for each step; shape: of adjoints."""

    shape: bool
    nodes = 3
    name, reads_rest, asks_for_steps = "pressed", True, True
    arrays, derived = dict.fromkeys(("pressed", "pressed_load"), "ints"), dict(follower="vectors2")
    adjoints = dict(pressure_adjoint="vectors2", pressed_rest="vectors")

    @traced
    def sizes(self, plan) -> dict:
        return super().sizes(plan) | dict(pressure_adjoint=plan.num_pressed, pressed_rest=self.nodes * plan.num_pressed)

    @ti.func
    def factor(self, t, now: A, rows: A, scene: A):
        """-p / 6, by which the product of edges gives the force of a corner."""
        return self.mean(scene.pressed_load[t], now, rows) * ti.cast(-1.0 / 6.0, self.fp)

    @ti.func
    def forces(self, t, now: A, scene: A, state: A, s, plan: A):
        e, f = edges(scene.pressed, t, state.u, scene.rest, s)
        store_alike(self.factor(t, now, scene.follower, scene) * self.cross(e, f), scene.corner, self.first(plan), t)

    @ti.func
    def forces_jvp(self, t, now: A, scene: A, state: A, s, tangent: A, plan: A):
        e, f = edges(scene.pressed, t, state.u, scene.rest, s)
        de, df = edges(scene.pressed, t, tangent.u, tangent.rest, 0)
        p, dp = self.factor(t, now, scene.follower, scene), self.factor(t, now, tangent.follower, scene)
        change = p * (self.cross(de, f) + self.cross(e, df)) + dp * self.cross(e, f)
        store_alike(change, scene.corner, self.first(plan), t)

    @ti.func
    def forces_vjp(self, t, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        """Products of the transposed derivative with adjoint.w, to corners; adds the adjoints of pressures to
        adjoint.pressure_adjoint and, if `shape`, those of places to adjoint.pressed_rest."""
        e, f = edges(scene.pressed, t, state.u, scene.rest, s)
        w = adjoint.w[0, scene.pressed[3 * t]]
        for a in ti.static((1, 2)):
            w += adjoint.w[0, scene.pressed[3 * t + a]]
        p = self.factor(t, now, scene.follower, scene)
        by_e, by_f = p * self.cross(f, w), p * self.cross(w, e)
        balance = ti.cast(-1, self.fp) * (by_e + by_f)
        for a, by in ti.static(enumerate((balance, by_e, by_f))):
            adjoint.corner[self.first(plan) + 3 * t + a] = by
            if ti.static(self.shape):
                adjoint.pressed_rest[3 * t + a] = adjoint.pressed_rest[3 * t + a] + by
        self.add_mean(t, ti.cast(-1.0 / 6.0, self.fp) * w.dot(self.cross(e, f)), now, adjoint.pressure_adjoint)
