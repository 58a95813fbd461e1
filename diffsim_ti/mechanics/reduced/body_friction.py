"""Friction of obstacles on vertices of bodies of few numbers (terms/obstacles/grip.py): sums over a vertex's obstacles."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_stages import ObstacleStages
from diffsim_ti.runtime import A
from diffsim_ti.terms.obstacles import grip


@dataclass(frozen=True)
class BodyFriction(ObstacleStages):
    """Functions of one vertex i on the surface; v is its velocity before friction, total the body's C."""

    @ti.func
    def time(self, g: A, i, now: A, scene: A):
        """h, on the vertex's area where the stiffness is per area."""
        return self.on_area(g, i, now.h, scene)

    @ti.func
    def load(self, i, u, now: A, scene: A):
        """Sum of h mu N."""
        out = ti.cast(0, self.fp)
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    out += grip.load(g.force, scene.parameters, first, X, u, self.time(g, i, now, scene))
        return out

    @ti.func
    def impulse(self, i, u, v, total, now: A, scene: A):
        out = self.vector(0)
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                    time = self.time(g, i, now, scene)
                    out += grip.impulse(g.force, scene.parameters, first, X, u, v, v_obstacle, time, total)
        return out

    @ti.func
    def dtime(self, g: A, i, now: A, tangent: A):
        out = ti.cast(0, self.fp)
        if ti.static(g.force.per_area):
            out = now.h * tangent.surface[i]
        return out

    @ti.func
    def load_jvp(self, i, u, du, now: A, scene: A, tangent: A):
        out = ti.cast(0, self.fp)
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                    time, dtime = self.time(g, i, now, scene), self.dtime(g, i, now, tangent)
                    out += grip.load_jvp(g.force, scene.parameters, first, X, u, time, tangent.parameters, moved, dtime)
        return out

    @ti.func
    def impulse_jvp(self, i, u, v, total, du, dv, dtotal, now: A, scene: A, tangent: A):
        out = self.vector(0)
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                    v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                    dv_obstacle = self.obstacle_velocity_jvp(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                    time, dtime = self.time(g, i, now, scene), self.dtime(g, i, now, tangent)
                    both, changes = ti.static((v, v_obstacle), (dv, dv_obstacle))
                    numbers, by = ti.static((time, total), (dtime, dtotal))
                    out += grip.impulse_jvp(
                        g.force, scene.parameters, first, X, u, both, numbers, tangent.parameters, moved, changes, by
                    )
        return out

    @ti.func
    def total_vjp(self, i, u, v, total, w, now: A, scene: A):
        """Adjoint of C for that of the impulse."""
        out = ti.cast(0, self.fp)
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                    time = self.time(g, i, now, scene)
                    out += grip.total_vjp(g.force, scene.parameters, first, X, u, v, v_obstacle, time, total, w)
        return out

    @ti.func
    def vjp(self, i, u, v, total, w, load_adj, now: A, scene: A, adjoint: A):
        """(adjoint of u, of v, the impulse with the load as a fourth component) for the adjoints of the impulse and of the
        load; adds those of all else."""
        u_adj, v_adj, impulse = self.vector(0), self.vector(0), self.vector(0)
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                    time = self.time(g, i, now, scene)
                    by_place, by_v, by_v_obstacle, by_time, by, own = grip.vjp(
                        g.force, scene.parameters, first, X, u, v, v_obstacle, time, total, w, load_adj
                    )
                    by_u = self.spread(g, k, i, X, u, by_place, by_v_obstacle, now, scene, adjoint, adjoint)
                    u_adj += by_u
                    v_adj += by_v
                    impulse += own
                    self.add_to_numbers(g, k, i, by, adjoint)
                    self.add_to_area(g, i, now.h * by_time, adjoint)
                    self.add_to_rest(i, by_u, adjoint)
        return u_adj, v_adj, impulse
