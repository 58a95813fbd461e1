"""Potential energy of obstacles at a vertex: barrier and friction, with all derivatives.

Obstacles are looked at where they are in the pass. `pass_.walls` holds three vectors for each: its displacement where forces
are taken, its displacement where the pass begins, its velocity. `pass_.lag` holds two rows: the displacement of the body
where the pass begins, from which friction takes its normal force, and x, so that (u - x) per_gamma is the velocity.
"""

from dataclasses import dataclass

import taichi as ti

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

    @ti.func
    def velocity(self, i, u, pass_: A, plan: A):
        return plan.per_gamma * (u - pass_.lag[1, i])

    @ti.func
    def rest_before(self, g: A, k, i, scene: A, pass_: A):
        """Rest position of vertex i relative to an obstacle where the pass begins."""
        return scene.rest[i] - pass_.walls[3 * (g.number + k) + 1]

    @ti.func
    def is_rubbed(self, g: A, k, i, scene: A, pass_: A):
        """Whether friction of an obstacle is felt."""
        X = self.rest_before(g, k, i, scene, pass_)
        return g.force.touches(scene.parameters, g.first + k * g.size, X, pass_.lag[0, i])

    @ti.func
    def whole_energy(self, i, u, scene: A, pass_: A, plan: A):
        """Energy of the barriers and the potential of friction [J]."""
        value = ti.cast(0, self.fp)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                first = g.first + k * g.size
                held = g.force.energy(scene.parameters, first, self.rest_now(g, k, i, scene, pass_), u)
                value += self.on_area(g, i, held, scene)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        v, wall = self.velocity(i, u, pass_, plan), pass_.walls[3 * (g.number + k) + 2]
                        X = self.rest_before(g, k, i, scene, pass_)
                        lost = g.force.dissipation(scene.parameters, first, X, pass_.lag[0, i], v, wall)
                        value += self.on_area(g, i, lost, scene) / plan.per_gamma
        return value

    @ti.func
    def whole_force(self, i, u, scene: A, pass_: A, plan: A):
        f = self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.on_area(g, i, self.force_of_one(g, k, i, u, scene, pass_, plan), scene)
        return f

    @ti.func
    def force_of_one(self, g: A, k, i, u, scene: A, pass_: A, plan: A):
        first, zero = g.first + k * g.size, self.vector(0)
        f = g.force.force(scene.parameters, first, self.rest_now(g, k, i, scene, pass_), u, zero)
        if ti.static(g.force.friction):
            if self.is_rubbed(g, k, i, scene, pass_):
                v, wall = self.velocity(i, u, pass_, plan), pass_.walls[3 * (g.number + k) + 2]
                X = self.rest_before(g, k, i, scene, pass_)
                f += g.force.rub(scene.parameters, first, X, pass_.lag[0, i], v, wall)
        return f

    @ti.func
    def whole_product(self, i, u, w, scene: A, pass_: A, plan: A):
        """Change of the force for a change w of the displacement."""
        f, zero = self.vector(0), self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                first = g.first + k * g.size
                X = self.rest_now(g, k, i, scene, pass_)
                change = g.force.force_jvp(scene.parameters, first, X, u, zero, w, zero)
                if ti.static(g.force.friction):
                    if self.is_rubbed(g, k, i, scene, pass_):
                        v, wall = self.velocity(i, u, pass_, plan), pass_.walls[3 * (g.number + k) + 2]
                        before, dv = self.rest_before(g, k, i, scene, pass_), plan.per_gamma * w
                        change += g.force.rub_product(scene.parameters, first, before, pass_.lag[0, i], v, wall, dv)
                f += self.on_area(g, i, change, scene)
        return f

    # ---- derivatives by everything -----------------------------------------------------------------------------------

    @ti.func
    def add_jvp(self, i, f, u, du, scene: A, pass_: A, tangent: A, plan: A):
        """f and the change of the force for changes of everything that it depends on."""
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.jvp_of_one(g, k, i, u, du, scene, pass_, tangent, plan)
        return f

    @ti.func
    def jvp_of_one(self, g: A, k, i, u, du, scene: A, pass_: A, tangent: A, plan: A):
        n, first, zero = 3 * (g.number + k), g.first + k * g.size, self.vector(0)
        X, moved = self.rest_now(g, k, i, scene, pass_), du + tangent.rest[i] - tangent.walls[n]
        f = g.force.force_jvp(scene.parameters, first, X, u, zero, moved, zero)
        by = g.force.parameter_derivatives(scene.parameters, first, X, u, zero)
        for m in ti.static(range(g.size)):
            f += by[m] * tangent.parameters[first + m]
        if ti.static(g.force.friction):
            if self.is_rubbed(g, k, i, scene, pass_):
                v, wall, dwall = self.velocity(i, u, pass_, plan), pass_.walls[n + 2], tangent.walls[n + 2]
                du_before = tangent.lag[0, i] + tangent.rest[i] - tangent.walls[n + 1]
                dv = plan.per_gamma * (du - tangent.lag[1, i])
                before = self.rest_before(g, k, i, scene, pass_)
                f += g.force.rub_jvp(
                    scene.parameters, first, before, pass_.lag[0, i], v, wall, tangent.parameters, du_before, dv, dwall
                )
        f = self.on_area(g, i, f, scene)
        if ti.static(g.force.per_area):
            f += tangent.surface[i] * self.force_of_one(g, k, i, u, scene, pass_, plan)
        return f

    @ti.func
    def add_vjp(self, i, f, u, w, scene: A, pass_: A, adjoint: A, plan: A):
        """f and the adjoint of u for the adjoint w of the force; adds those of all else."""
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.vjp_of_one(g, k, i, u, w, scene, pass_, adjoint, plan)
        return f

    @ti.func
    def vjp_of_one(self, g: A, k, i, u, w, scene: A, pass_: A, adjoint: A, plan: A):
        n, first, zero = 3 * (g.number + k), g.first + k * g.size, self.vector(0)
        if ti.static(g.force.per_area and self.features.shape):
            self.add_to_area(g, i, self.force_of_one(g, k, i, u, scene, pass_, plan).dot(w), adjoint)
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
        if ti.static(g.force.friction):
            if self.is_rubbed(g, k, i, scene, pass_):
                v, wall = self.velocity(i, u, pass_, plan), pass_.walls[n + 2]
                before = self.rest_before(g, k, i, scene, pass_)
                by_lag, by_v, by_wall, by_numbers = g.force.rub_vjp(
                    scene.parameters, first, before, pass_.lag[0, i], v, wall, w
                )
                for m in ti.static(range(g.size)):
                    adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by_numbers[m]
                self.add_to_rest(i, by_lag, adjoint)
                by_u += plan.per_gamma * by_v
                adjoint.lag[0, i] = adjoint.lag[0, i] + by_lag
                adjoint.lag[1, i] = adjoint.lag[1, i] - plan.per_gamma * by_v
                adjoint.walls[n + 1, i] = zero - by_lag
                adjoint.walls[n + 2, i] = by_wall
        return by_u
