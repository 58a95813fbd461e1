"""Potential energy of obstacles at a vertex: barrier and friction, with all derivatives.

Obstacles are looked at where they are in the pass. `pass_.walls` holds three vectors for each: its displacement where forces
are taken, its displacement where the pass begins, its velocity. `pass_.lag` holds two rows: the displacement of the body
where the pass begins, from which friction takes its normal force, and x, so that (u - x) per_gamma is the velocity.
`pass_.pressed` holds a row for each obstacle (`reaches`).
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import at, let, traced
from diffsim_ti.state.obstacle_functions import ObstacleFunctions

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class ObstaclePotential(ObstacleFunctions):
    """Taichi functions of one vertex; g is a group of obstacles, k a place in it (state/features.py)."""

    @ti.func
    def rest_now(self, g: A, k, i, scene: A, pass_: A):
        """Rest position of vertex i relative to an obstacle where forces are taken."""
        return scene.rest[i] - pass_.walls[3 * (g.number + k)]

    # ---- the barrier -------------------------------------------------------------------------------------------------

    @ti.func
    def energy(self, i, u, scene: A, pass_: A):
        """Energy of the barriers [J]."""
        value = ti.cast(0, self.fp)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                X = self.rest_now(g, k, i, scene, pass_)
                value += self.on_area(g, i, g.force.energy(scene.parameters, g.first + k * g.size, X, u), scene)
        return value

    @ti.func
    def product(self, i, u, w, scene: A, pass_: A):
        """Change of the barriers' force for a change w of the displacement."""
        f, zero = self.vector(0), self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                X = self.rest_now(g, k, i, scene, pass_)
                change = g.force.force_jvp(scene.parameters, g.first + k * g.size, X, u, zero, w, zero)
                f += self.on_area(g, i, change, scene)
        return f

    # ---- with friction -----------------------------------------------------------------------------------------------
    # Of obstacles that reach into faces, points within them push as well: N and its direction are then the size and the
    # direction of `pass_.pressed`, all that an obstacle pushes a vertex with where the pass begins.

    def reaches(self, g) -> bool:
        """Whether friction of a group takes its normal force from `pressed`."""
        return g.force.friction and not g.force.hollow

    @ti.func
    def velocity(self, i, u, pass_: A, plan: A):
        return plan.per_gamma * (u - pass_.lag[1, i])

    @ti.func
    def rest_before(self, g: A, k, i, scene: A, pass_: A):
        """Rest position of vertex i relative to an obstacle where the pass begins."""
        return scene.rest[i] - pass_.walls[3 * (g.number + k) + 1]

    @ti.func
    def on_rubbed_area(self, g: A, i, x, scene: A):
        """Friction on the area of vertex i; `pressed` is of the whole already."""
        out = x
        if ti.static(not self.reaches(g)):
            out = self.on_area(g, i, x, scene)
        return out

    @ti.func
    def is_rubbed(self, g: A, k, i, scene: A, pass_: A):
        """Whether friction of an obstacle is felt."""
        felt = False
        if ti.static(self.reaches(g)):
            felt = pass_.pressed[g.number + k, i].norm_sqr() > 0
        else:
            X = self.rest_before(g, k, i, scene, pass_)
            felt = g.force.touches(scene.parameters, g.first + k * g.size, X, pass_.lag[0, i])
        return felt

    @traced
    def felt_at(self, g, k, i, scene, pass_):
        """What friction takes its normal force from, as `rub` has it: a place, or `pressed`."""
        if self.reaches(g):
            return None, let(at(pass_.pressed, g.number + k, i))
        return self.rest_before(g, k, i, scene, pass_), let(at(pass_.lag, 0, i))

    @ti.func
    def lost(self, g: A, k, i, u, scene: A, pass_: A, plan: A):
        """Potential of friction by the velocity [W]."""
        v, wall, first = self.velocity(i, u, pass_, plan), pass_.walls[3 * (g.number + k) + 2], g.first + k * g.size
        return g.force.dissipation(scene.parameters, first, self.felt_at(g, k, i, scene, pass_), v, wall)

    @ti.func
    def push(self, g: A, k, i, u, scene: A, pass_: A):
        X = self.rest_now(g, k, i, scene, pass_)
        return g.force.force(scene.parameters, g.first + k * g.size, X, u, self.vector(0))

    @ti.func
    def drag(self, g: A, k, i, u, scene: A, pass_: A, plan: A):
        v, wall, first = self.velocity(i, u, pass_, plan), pass_.walls[3 * (g.number + k) + 2], g.first + k * g.size
        return g.force.rub(scene.parameters, first, self.felt_at(g, k, i, scene, pass_), v, wall)

    @ti.func
    def drag_product(self, g: A, k, i, u, w, scene: A, pass_: A, plan: A):
        """Change of `drag` for a change w of the displacement."""
        v, wall, first = self.velocity(i, u, pass_, plan), pass_.walls[3 * (g.number + k) + 2], g.first + k * g.size
        dv = plan.per_gamma * w
        return g.force.rub_product(scene.parameters, first, self.felt_at(g, k, i, scene, pass_), v, wall, dv)

    @ti.func
    def whole_energy(self, i, u, scene: A, pass_: A, plan: A):
        """Energy of the barriers and the potential of friction [J]."""
        value = ti.cast(0, self.fp)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                X = self.rest_now(g, k, i, scene, pass_)
                value += self.on_area(g, i, g.force.energy(scene.parameters, g.first + k * g.size, X, u), scene)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        lost = self.lost(g, k, i, u, scene, pass_, plan)
                        value += self.on_rubbed_area(g, i, lost, scene) / plan.per_gamma
        return value

    @ti.func
    def whole_force(self, i, u, scene: A, pass_: A, plan: A):
        f = self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.on_area(g, i, self.push(g, k, i, u, scene, pass_), scene)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        f += self.on_rubbed_area(g, i, self.drag(g, k, i, u, scene, pass_, plan), scene)
        return f

    @ti.func
    def whole_product(self, i, u, w, scene: A, pass_: A, plan: A):
        """Change of the force for a change w of the displacement."""
        f, zero = self.vector(0), self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                X = self.rest_now(g, k, i, scene, pass_)
                change = g.force.force_jvp(scene.parameters, g.first + k * g.size, X, u, zero, w, zero)
                f += self.on_area(g, i, change, scene)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        f += self.on_rubbed_area(g, i, self.drag_product(g, k, i, u, w, scene, pass_, plan), scene)
        return f

    # ---- derivatives by everything -----------------------------------------------------------------------------------

    @ti.func
    def push_jvp(self, g: A, k, i, u, du, scene: A, pass_: A, tangent: A):
        n, first, zero = 3 * (g.number + k), g.first + k * g.size, self.vector(0)
        X, moved = self.rest_now(g, k, i, scene, pass_), du + tangent.rest[i] - tangent.walls[n]
        f = g.force.force_jvp(scene.parameters, first, X, u, zero, moved, zero)
        by = g.force.parameter_derivatives(scene.parameters, first, X, u, zero)
        for m in ti.static(range(g.size)):
            f += by[m] * tangent.parameters[first + m]
        f = self.on_area(g, i, f, scene)
        if ti.static(g.force.per_area):
            f += tangent.surface[i] * self.push(g, k, i, u, scene, pass_)
        return f

    @ti.func
    def drag_jvp(self, g: A, k, i, u, du, scene: A, pass_: A, tangent: A, plan: A):
        n, first = 3 * (g.number + k), g.first + k * g.size
        v, wall, dwall = self.velocity(i, u, pass_, plan), pass_.walls[n + 2], tangent.walls[n + 2]
        moved, dv = self.vector(0), plan.per_gamma * (du - tangent.lag[1, i])
        if ti.static(self.reaches(g)):
            moved = tangent.pressed[g.number + k, i]
        else:
            moved = tangent.lag[0, i] + tangent.rest[i] - tangent.walls[n + 1]
        f = g.force.rub_jvp(
            scene.parameters, first, self.felt_at(g, k, i, scene, pass_), v, wall, tangent.parameters, moved, dv, dwall
        )
        f = self.on_rubbed_area(g, i, f, scene)
        if ti.static(g.force.per_area and not self.reaches(g)):
            f += tangent.surface[i] * self.drag(g, k, i, u, scene, pass_, plan)
        return f

    @ti.func
    def add_jvp(self, i, f, u, du, scene: A, pass_: A, tangent: A, plan: A):
        """f and the change of the force for changes of everything that it depends on."""
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.push_jvp(g, k, i, u, du, scene, pass_, tangent)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        f += self.drag_jvp(g, k, i, u, du, scene, pass_, tangent, plan)
        return f

    @ti.func
    def push_vjp(self, g: A, k, i, u, w, scene: A, pass_: A, adjoint: A):
        n, first, zero = 3 * (g.number + k), g.first + k * g.size, self.vector(0)
        if ti.static(g.force.per_area and self.features.shape):
            self.add_to_area(g, i, self.push(g, k, i, u, scene, pass_).dot(w), adjoint)
        w = self.on_area(g, i, w, scene)
        X = self.rest_now(g, k, i, scene, pass_)
        by_u, _ = g.force.force_vjp(scene.parameters, first, X, u, zero, w)
        by = g.force.parameter_derivatives(scene.parameters, first, X, u, zero)
        for m in ti.static(range(g.size)):
            adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by[m].dot(w)
        self.add_to_rest(i, by_u, adjoint)
        adjoint.walls[n, i] = zero - by_u
        adjoint.walls[n + 1, i] = zero
        adjoint.walls[n + 2, i] = zero
        return by_u

    @ti.func
    def drag_vjp(self, g: A, k, i, u, w, scene: A, pass_: A, adjoint: A, plan: A):
        n, first = 3 * (g.number + k), g.first + k * g.size
        if ti.static(g.force.per_area and self.features.shape and not self.reaches(g)):
            self.add_to_area(g, i, self.drag(g, k, i, u, scene, pass_, plan).dot(w), adjoint)
        w = self.on_rubbed_area(g, i, w, scene)
        v, wall = self.velocity(i, u, pass_, plan), pass_.walls[n + 2]
        by_felt, by_v, by_wall, by = g.force.rub_vjp(
            scene.parameters, first, self.felt_at(g, k, i, scene, pass_), v, wall, w
        )
        for m in ti.static(range(g.size)):
            adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by[m]
        if ti.static(self.reaches(g)):
            adjoint.pressed[g.number + k, i] = by_felt
        else:
            self.add_to_rest(i, by_felt, adjoint)
            adjoint.lag[0, i] = adjoint.lag[0, i] + by_felt
            adjoint.walls[n + 1, i] = self.vector(0) - by_felt
        adjoint.walls[n + 2, i] = by_wall
        adjoint.lag[1, i] = adjoint.lag[1, i] - plan.per_gamma * by_v
        return plan.per_gamma * by_v

    @ti.func
    def add_vjp(self, i, f, u, w, scene: A, pass_: A, adjoint: A, plan: A):
        """f and the adjoint of u for the adjoint w of the force; adds those of all else."""
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.push_vjp(g, k, i, u, w, scene, pass_, adjoint)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        f += self.drag_vjp(g, k, i, u, w, scene, pass_, adjoint, plan)
        return f
