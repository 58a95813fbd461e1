"""Potential energy of obstacles at a vertex: barrier and friction, with all derivatives.

Obstacles are taken where they are in the pass, which `pass_.poses` says (state/obstacle_poses.py). `pass_.lag` holds
two rows: the displacement of the body where the pass begins, from which friction takes its normal force, and x, so that
(u - x) per_gamma is the velocity.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_functions import ObstacleFunctions
from diffsim_ti.runtime import A, assign, at, let, traced
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, RATE, TAU
from diffsim_ti.terms.obstacles import turning


@dataclass(frozen=True)
class ObstaclePotential(ObstacleFunctions):
    """Taichi functions of one vertex; g is a group of obstacles, k a place in it (state/features.py)."""

    @ti.func
    def rest_now(self, g: A, k, i, scene: A, pass_: A):
        """Rest position of vertex i relative to an obstacle where forces are taken."""
        return self.seen(g, scene.rest[i], self.place_of(g, k, AT_STAGE, pass_))

    @traced
    def place_of(self, g, k, m, pass_):
        """Displacement of an obstacle, of one that turns with its unit quaternion, where forces are taken (m = AT_STAGE) or
        the pass begins (AT_BEGIN)."""
        shift = at(pass_.poses, 3 * (g.number + k) + m)
        if not g.force.turns:
            return shift
        s = self.turned.short(at(pass_.poses, self.turning_row(g, k) + m))
        return self.turned.joined(shift, turning.from_rodrigues(s, self.fp), 4)

    @traced
    def moved(self, g, k, m, X, u, dr, scene, tangent):
        """Change of the place of a vertex for dr of X + u, and for that of the obstacle."""
        shift = at(tangent.poses, 3 * (g.number + k) + m)
        if not g.force.turns:
            return dr - shift
        dplace = self.turned.joined(shift, at(tangent.poses, self.turning_row(g, k) + m))
        return self.turned.moved(g, g.first + k * g.size, X, u, dr, dplace, scene, tangent)

    @traced
    def spread(self, g, k, m, i, X, u, by, scene, adjoint, by_arm=None):
        """Adjoint of u for that of the changed place, and of the arm; adds those of what the obstacle's place is."""
        if not g.force.turns:
            return by, self.vector(0) - by
        none = ti.Vector.zero(self.fp, 3)
        first, by_arm = g.first + k * g.size, none if by_arm is None else by_arm
        by_u, by_t, by_theta = self.turned.spread(g, first, i, X, u, by, by_arm, scene, adjoint.sums)
        row = self.turning_row(g, k) + m
        assign(at(adjoint.poses, row, i), at(adjoint.poses, row, i) + self.turned.long(by_theta))
        return by_u, by_t

    # ---- friction ----------------------------------------------------------------------------------------------------

    @ti.func
    def velocity(self, i, u, pass_: A, plan: A):
        return plan.per_gamma * (u - pass_.lag[1, i])

    @ti.func
    def rest_before(self, g: A, k, i, scene: A, pass_: A):
        """Rest position of vertex i relative to an obstacle where the pass begins."""
        return self.seen(g, scene.rest[i], self.place_of(g, k, AT_BEGIN, pass_))

    # The velocity of an obstacle that turns is that at the place where the pass begins, so that it is no function of u.

    @traced
    def v_obstacle(self, g, k, i, scene, pass_):
        """Velocity of an obstacle at a vertex."""
        v = at(pass_.poses, 3 * (g.number + k) + RATE)
        return self.turned_velocity(g, k, i, v, scene, pass_) if g.force.turns else v

    @ti.func
    def arm(self, g: A, k, i, scene: A, pass_: A):
        X = self.rest_before(g, k, i, scene, pass_)
        return self.turned.arm(g, g.first + k * g.size, X, pass_.lag[0, i], scene)

    @ti.func
    def spin(self, g: A, k, poses: A):
        """Angular velocity."""
        return self.turned.short(poses[self.turning_row(g, k) + RATE])

    @ti.func
    def turned_velocity(self, g: A, k, i, v, scene: A, pass_: A):
        tau, r = pass_.poses[self.turning_row(g, k) + TAU][0], self.arm(g, k, i, scene, pass_)
        return self.turned.v_obstacle(self.turned.short(v), self.spin(g, k, pass_.poses), tau, r)

    @traced
    def obstacle_velocity_jvp(self, g, k, i, scene, pass_, tangent):
        """Its change."""
        dv = at(tangent.poses, 3 * (g.number + k) + RATE)
        return self.turned_velocity_jvp(g, k, i, dv, scene, pass_, tangent) if g.force.turns else dv

    @ti.func
    def turned_velocity_jvp(self, g: A, k, i, dv, scene: A, pass_: A, tangent: A):
        n, dr = 3 * (g.number + k), tangent.lag[0, i] + tangent.rest[i]
        darm = self.turned.short(dr - tangent.poses[n + AT_BEGIN])
        darm += -1 * self.turned.about(g, g.first + k * g.size, tangent.parameters)
        tau, r = pass_.poses[self.turning_row(g, k) + TAU][0], self.arm(g, k, i, scene, pass_)
        omega, domega = self.spin(g, k, pass_.poses), self.spin(g, k, tangent.poses)
        return self.turned.obstacle_velocity_jvp(self.turned.short(dv), omega, domega, tau, r, darm)

    @ti.func
    def turned_velocity_vjp(self, g: A, k, i, by_place, by_v_obstacle, scene: A, pass_: A, adjoint: A):
        """(adjoints of the place where the pass begins, of the obstacle's displacement there), of the velocity's and of six
        numbers by_place; adds those of all else."""
        row, r = self.turning_row(g, k), self.arm(g, k, i, scene, pass_)
        tau, omega = pass_.poses[row + TAU][0], self.spin(g, k, pass_.poses)
        by_omega, by_arm = self.turned.obstacle_velocity_vjp(omega, tau, r, self.turned.short(by_v_obstacle))
        adjoint.poses[row + RATE, i] = adjoint.poses[row + RATE, i] + self.turned.long(by_omega)
        X = self.rest_before(g, k, i, scene, pass_)
        by_u, by_t = self.spread(g, k, AT_BEGIN, i, X, pass_.lag[0, i], by_place, scene, adjoint, by_arm)
        return by_u, by_t

    @ti.func
    def has_friction_at(self, g: A, k, i, scene: A, pass_: A):
        """Whether friction of an obstacle acts."""
        X = self.rest_before(g, k, i, scene, pass_)
        return g.force.touches(scene.parameters, g.first + k * g.size, X, pass_.lag[0, i])

    @traced
    def lagged_at(self, g, k, i, scene, pass_):
        """The place where friction takes its normal force from, as `friction_force` has it."""
        return self.rest_before(g, k, i, scene, pass_), let(at(pass_.lag, 0, i))

    @traced
    def sliding(self, g, k, i, u, scene, pass_, plan) -> tuple:
        """What friction of an obstacle reads: all numbers, where its own begin, the place, both velocities."""
        v, v_obstacle = let(self.velocity(i, u, pass_, plan)), let(self.v_obstacle(g, k, i, scene, pass_))
        return scene.parameters, let(g.first + k * g.size), self.lagged_at(g, k, i, scene, pass_), v, v_obstacle

    @traced
    def lost(self, g, k, i, u, scene, pass_, plan):
        """Potential of friction by the velocity [W]."""
        return g.force.dissipation(*self.sliding(g, k, i, u, scene, pass_, plan))

    @ti.func
    def push(self, g: A, k, i, u, scene: A, pass_: A):
        return self.force(g, k, i, self.rest_now(g, k, i, scene, pass_), u, self.vector(0), scene)

    @traced
    def drag(self, g, k, i, u, scene, pass_, plan):
        return g.force.friction_force(*self.sliding(g, k, i, u, scene, pass_, plan))

    @traced
    def drag_product(self, g, k, i, u, w, scene, pass_, plan):
        """Change of `drag` for a change w of the displacement."""
        return g.force.friction_product(*self.sliding(g, k, i, u, scene, pass_, plan), let(plan.per_gamma * w))

    # ---- barrier and friction; `rough`: whether friction counts -------------------------------------------------------

    @ti.func
    def total_energy(self, i, u, scene: A, pass_: A, plan: A, rough: A):
        """Energy of the barriers and the potential of friction [J]."""
        value = ti.cast(0, self.fp)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                X = self.rest_now(g, k, i, scene, pass_)
                value += self.on_area(g, i, g.force.energy(scene.parameters, g.first + k * g.size, X, u), scene)
                if ti.static(rough and g.force.friction):
                    if self.has_friction_at(g, k, i, scene, pass_):
                        lost = self.lost(g, k, i, u, scene, pass_, plan)
                        value += self.on_area(g, i, lost, scene) / plan.per_gamma
        return value

    @ti.func
    def total_force(self, i, u, scene: A, pass_: A, plan: A):
        f = self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.push(g, k, i, u, scene, pass_)
                if ti.static(g.force.friction):
                    if self.has_friction_at(g, k, i, scene, pass_):
                        f += self.on_area(g, i, self.drag(g, k, i, u, scene, pass_, plan), scene)
        return f

    @ti.func
    def total_product(self, i, u, w, scene: A, pass_: A, plan: A, rough: A):
        """Change of the force for a change w of the displacement."""
        f, zero = self.vector(0), self.vector(0)
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                X = self.rest_now(g, k, i, scene, pass_)
                change = g.force.force_jvp(scene.parameters, g.first + k * g.size, X, u, zero, w, zero)
                f += self.on_area(g, i, change, scene)
                if ti.static(rough and g.force.friction):
                    if self.has_friction_at(g, k, i, scene, pass_):
                        f += self.on_area(g, i, self.drag_product(g, k, i, u, w, scene, pass_, plan), scene)
        return f

    # ---- derivatives by everything -----------------------------------------------------------------------------------

    @ti.func
    def push_jvp(self, g: A, k, i, u, du, scene: A, pass_: A, tangent: A):
        zero, X = self.vector(0), self.rest_now(g, k, i, scene, pass_)
        moved = self.moved(g, k, AT_STAGE, X, u, du + tangent.rest[i], scene, tangent)
        return self.force_jvp(g, k, i, X, u, zero, moved, zero, scene, tangent)

    @ti.func
    def drag_jvp(self, g: A, k, i, u, du, scene: A, pass_: A, tangent: A, plan: A):
        f = self.on_area(g, i, self.drag_change(g, k, i, u, du, scene, pass_, tangent, plan), scene)
        if ti.static(g.force.per_area):
            f += tangent.surface[i] * self.drag(g, k, i, u, scene, pass_, plan)
        return f

    @traced
    def drag_change(self, g, k, i, u, du, scene, pass_, tangent, plan):
        """The same on one square metre."""
        moved, dv = self.lagged_jvp(g, k, i, scene, pass_, tangent), let(plan.per_gamma * (du - at(tangent.lag, 1, i)))
        changes = tangent.parameters, moved, dv, self.obstacle_velocity_jvp(g, k, i, scene, pass_, tangent)
        return g.force.friction_force_jvp(*self.sliding(g, k, i, u, scene, pass_, plan), *changes)

    @traced
    def lagged_jvp(self, g, k, i, scene, pass_, tangent):
        """Change of the place where friction takes its normal force from."""
        X, u = self.rest_before(g, k, i, scene, pass_), at(pass_.lag, 0, i)
        return self.moved(g, k, AT_BEGIN, X, u, at(tangent.lag, 0, i) + at(tangent.rest, i), scene, tangent)

    @ti.func
    def add_jvp(self, i, f, u, du, scene: A, pass_: A, tangent: A, plan: A):
        """f and the change of the force for changes of everything that it depends on."""
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.push_jvp(g, k, i, u, du, scene, pass_, tangent)
                if ti.static(g.force.friction):
                    if self.has_friction_at(g, k, i, scene, pass_):
                        f += self.drag_jvp(g, k, i, u, du, scene, pass_, tangent, plan)
        return f

    @ti.func
    def push_vjp(self, g: A, k, i, u, w, scene: A, pass_: A, adjoint: A):
        n, zero, X = 3 * (g.number + k), self.vector(0), self.rest_now(g, k, i, scene, pass_)
        by_place, _ = self.force_vjp(g, k, i, X, u, zero, w, scene, adjoint)
        by_u, by_t = self.spread(g, k, AT_STAGE, i, X, u, by_place, scene, adjoint)
        self.add_to_rest(i, by_u, adjoint)
        adjoint.poses[n + AT_STAGE, i] = by_t
        adjoint.poses[n + AT_BEGIN, i] = zero
        adjoint.poses[n + RATE, i] = zero
        return by_u

    @ti.func
    def drag_vjp(self, g: A, k, i, u, w, scene: A, pass_: A, adjoint: A, plan: A):
        n, first = 3 * (g.number + k), g.first + k * g.size
        if ti.static(g.force.per_area and self.features.shape):
            self.add_to_area(g, i, self.drag(g, k, i, u, scene, pass_, plan).dot(w), adjoint)
        w = self.on_area(g, i, w, scene)
        v, v_obstacle = self.velocity(i, u, pass_, plan), self.v_obstacle(g, k, i, scene, pass_)
        by_lagged, by_v, by_v_obstacle = g.force.friction_force_vjp(
            scene.parameters, first, self.lagged_at(g, k, i, scene, pass_), v, v_obstacle, w, adjoint.sums, i
        )
        by_u, by_t = self.lagged_vjp(g, k, i, by_lagged, by_v_obstacle, scene, pass_, adjoint)
        self.add_to_rest(i, by_u, adjoint)
        adjoint.lag[0, i] = adjoint.lag[0, i] + by_u
        adjoint.poses[n + AT_BEGIN, i] = by_t
        adjoint.poses[n + RATE, i] = by_v_obstacle
        adjoint.lag[1, i] = adjoint.lag[1, i] - plan.per_gamma * by_v
        return plan.per_gamma * by_v

    @traced
    def lagged_vjp(self, g, k, i, by_lagged, by_v_obstacle, scene, pass_, adjoint):
        """Adjoints of the place where the pass begins and of the obstacle's displacement there."""
        if not g.force.turns:
            return by_lagged, self.vector(0) - by_lagged
        return self.turned_velocity_vjp(g, k, i, by_lagged, by_v_obstacle, scene, pass_, adjoint)

    @ti.func
    def add_vjp(self, i, f, u, w, scene: A, pass_: A, adjoint: A, plan: A):
        """f and the adjoint of u for the adjoint w of the force; adds those of all else."""
        for g in ti.static(self.features.groups):
            for k in range(g.count):
                f += self.push_vjp(g, k, i, u, w, scene, pass_, adjoint)
                if ti.static(g.force.friction):
                    if self.has_friction_at(g, k, i, scene, pass_):
                        f += self.drag_vjp(g, k, i, u, w, scene, pass_, adjoint, plan)
        return f
