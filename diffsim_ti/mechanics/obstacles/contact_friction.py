"""Friction of the contact stage: that of each obstacle, one after the other, with the pushes that the stage has noted.

Friction with one obstacle may lead a vertex towards another one, which the stage has not asked. With e the way that friction
adds, n_o the normals of tangent planes that obstacles have where the pass begins, and y_o > 0 the distances from these to
which the stage leads (contact_stage.py), the vertex takes the share c(x) of all friction:

    x = max_o -e . n_o / y_o,    c(x) = 1 for x <= 1/2,    c(x) = (1 - exp(1 - 2 x) / 2) / x beyond,

which leaves it y_o exp(1 - 2 x) / 2 or more of each. The slope of c is continuous; where x <= 1/2 nothing is changed.
Planes that a vertex is behind, since it went past an obstacle, do not count.

A vertex that is fixed in some directions takes of each friction what lies in the others, and along the obstacle there: what
would lead it to or from the obstacle is left out, as if it were across the normal.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.contact_impulses import (
    friction_by_mass,
    friction_by_share,
    note_friction_jvp,
    seed_of_friction,
)
from diffsim_ti.mechanics.obstacles.obstacle_stages import NUMBERS, PLANE, PUSH, ROWS, SEED, VELOCITY, ObstacleStages
from diffsim_ti.runtime import A, at, let, traced
from diffsim_ti.terms.obstacles import stage, turning


@dataclass(frozen=True)
class ContactFriction(ObstacleStages):
    """Taichi functions of one vertex; `now` is the pass (state/schedule.py), g a group of obstacles, k a place in it."""

    @ti.func
    def led_normal(self, i, n, scene: A):
        """(m, 1 / m . m) of what vertex i may do of the normal n; (0, 0) where that is held."""
        m, inverse = self.may(i, n, scene), ti.cast(0, self.fp)
        if m.dot(m) > ti.cast(1e-6, self.fp):
            inverse = ti.cast(1, self.fp) / m.dot(m)
        return m, inverse

    @ti.func
    def along(self, i, n, e, scene: A):
        """A friction e without what leads vertex i to or from the obstacle, (e . m) m / m . m."""
        out = e
        if ti.static(self.features.partly_fixed):
            if scene.sliding_slot[i] >= 0:
                m, inverse = self.led_normal(i, n, scene)
                out = e + -inverse * e.dot(m) * m
        return out

    @ti.func
    def along_jvp(self, i, n, dn, e, de, scene: A):
        """Its change."""
        out = de
        if ti.static(self.features.partly_fixed):
            if scene.sliding_slot[i] >= 0:
                m, inverse = self.led_normal(i, n, scene)
                dm, size = self.may(i, dn, scene), e.dot(m)
                lost = de.dot(m) + e.dot(dm) - 2 * inverse * size * m.dot(dm)
                out = de + -inverse * (lost * m + size * dm)
        return out

    @ti.func
    def along_vjp(self, i, n, e, e_adj, scene: A):
        """(adjoint of e, of n) for that of what is left of e."""
        by_e, by_n = e_adj, self.vector(0)
        if ti.static(self.features.partly_fixed):
            if scene.sliding_slot[i] >= 0:
                m, inverse = self.led_normal(i, n, scene)
                size, seen = e.dot(m), e_adj.dot(m)
                by_e = e_adj + -inverse * seen * m
                by_m = -inverse * (seen * e + size * e_adj) + 2 * inverse * inverse * size * seen * m
                by_n = self.may(i, by_m, scene)
        return by_e, by_n

    @ti.func
    def slide(self, o, i, v, ratio, scene: A, state: A):
        """Velocity after the friction of an obstacle, whose push is noted."""
        pushed, law, after = state.stage[ROWS * o + PUSH, i], state.stage[ROWS * o + NUMBERS, i], v
        if pushed.x > 0 and law.z > 0:
            plane, v_obstacle = state.stage[ROWS * o + PLANE, i], state.stage[ROWS * o + VELOCITY, i]
            after = stage.slide(self.fp, plane, pushed.x, v, v_obstacle, ratio, law.z, law.w)
            if ti.static(self.features.partly_fixed):
                after = v + self.along(i, self.normal(plane), after - v, scene)
        return after

    @ti.func
    def led(self, i, v, after, scene: A):
        """Velocity of vertex i where friction alone would make v that after it."""
        out = after
        if ti.static(self.features.partly_fixed):
            out = v + self.may(i, after - v, scene)
        return out

    @ti.func
    def slide_by(self, count, i, v, ratio, scene: A, state: A):
        """Velocity after the friction of the first `count` obstacles, one after the other."""
        for o in range(count):
            after = self.slide(ti.static(self.features.first_staged) + o, i, v, ratio, scene, state)
            v = self.led(i, v, after, scene)
        return v

    @ti.func
    def slide_all(self, i, v, ratio, scene: A, state: A):
        """Velocity after the friction of all obstacles."""
        if ti.static(len(self.features.staged_rough) > 0):
            v = self.slide_by(ti.static(self.features.num_staged), i, v, ratio, scene, state)
        return v

    # ---- what of it a vertex takes -------------------------------------------------------------------------------------

    @ti.func
    def share_and_slope(self, x):
        """(c, dc / dx); the slope is 0 where nothing is changed."""
        half, c, slope = ti.cast(0.5, self.fp), ti.cast(1, self.fp), ti.cast(0, self.fp)
        if x > half:
            left = ti.exp(1 - (x + x))
            c = (1 - half * left) / x
            slope = (left - c) / x
        return c, slope

    @ti.func
    def way_to(self, g: A, k, i, u, z, now: A, scene: A):
        """A move z from u as the obstacle sees it."""
        return z - now.h * self.v_obstacle(g, k, self.seen_now(g, k, scene.rest[i], now, scene), u, now, scene)

    @ti.func
    def change_of_x(self, g: A, k, i, u, du, z, dz, e, de, x, now: A, scene: A, tangent: A):
        """Change of x, which obstacle k has, for a vertex that the stage has moved by z from u."""
        first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
        moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
        plane = g.force.contact_plane(scene.parameters, first, X, u)
        turned = g.force.contact_plane_jvp(scene.parameters, first, X, u, moved, tangent.parameters)
        n, dn, way = self.normal(plane), self.normal(turned), self.way_to(g, k, i, u, z, now, scene)
        dway = dz - now.h * self.obstacle_velocity_jvp(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
        dy = turned.w + dn.dot(way) + n.dot(dway)
        return -(dn.dot(e) + n.dot(de) + x * dy) / (plane.w + n.dot(way))

    @ti.func
    def adjoint_of_x(self, g: A, k, i, column, u, z, e, x, by_x, now: A, scene: A, adjoint: A, out: A):
        """(adjoints of e, z, u) for that of x; adds those of the obstacle's numbers, and of its path to out.path_adjoint.

        The change of n by u is symmetric.
        """
        first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
        plane = g.force.contact_plane(scene.parameters, first, X, u)
        n, way = self.normal(plane), self.way_to(g, k, i, u, z, now, scene)
        ratio = by_x / (plane.w + n.dot(way))
        by_y = -ratio * x
        by_e, by_z, seed = -ratio * n, by_y * n, by_y * way + -ratio * e
        seed.w = by_y
        turned = g.force.contact_plane_jvp(scene.parameters, first, X, u, seed)
        g.force.contact_plane_vjp(scene.parameters, first, X, u, seed, adjoint.sums, i)
        by_place = self.turn_of_plane(g, self.normal(turned) + by_y * n, n, seed)
        by_u = self.spread(g, k, i, X, u, by_place, -now.h * by_z, now, scene, adjoint, out, column)
        return by_e, by_z, by_u

    @traced
    def turn_of_plane(self, g, by_place, n, seed):
        """With the adjoint of theta by that of n, of an obstacle that turns."""
        if not g.force.turns:
            return by_place
        by_theta = turning.cross([at(n, d) for d in range(3)], [at(seed, d) for d in range(3)])
        return self.turned.joined(by_place, let(ti.types.vector(3, self.fp)(*by_theta)))

    @ti.func
    def crowding(self, i, v, after, z, now: A, state: A):
        """(x, number of the obstacle that has it, or -1) for the velocities before and after friction and the move z."""
        most, number, e = ti.cast(0, self.fp), -1, now.alpha * (after - v)
        if ti.static(self.features.num_staged > 1 and len(self.features.staged_rough) > 0):
            for c in range(ti.static(self.features.num_staged)):
                row = ROWS * (ti.static(self.features.first_staged) + c)
                plane = state.stage[row + PLANE, i]
                n = self.normal(plane)
                y = plane.w + n.dot(z - now.h * state.stage[row + VELOCITY, i])
                x = -n.dot(e) / y
                if y > 0 and x > most:
                    most, number = x, ti.static(self.features.first_staged) + c
        return most, number

    @ti.func
    def after_friction(self, i, v, z, ratio, now: A, scene: A, state: A):
        """Velocity after friction."""
        after = self.slide_all(i, v, ratio, scene, state)
        x, _ = self.crowding(i, v, after, z, now, state)
        c, slope = self.share_and_slope(x)
        if slope < 0:
            after = v + c * (after - v)
        return after

    # ---- tangent -------------------------------------------------------------------------------------------------------

    @ti.func
    def slide_jvp_of(self, g: A, k, i, u, du, v, dv, ratio, dratio, now: A, scene: A, state: A, tangent: A):
        """Velocity after the friction of one obstacle, and its change."""
        row, first = ROWS * (g.number + k), g.first + k * g.size
        pushed, law = state.stage[row + PUSH, i], state.stage[row + NUMBERS, i]
        if pushed.x > 0:
            plane, v_obstacle = state.stage[row + PLANE, i], state.stage[row + VELOCITY, i]
            X = self.seen_now(g, k, scene.rest[i], now, scene)
            dv_obstacle = self.obstacle_velocity_jvp(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
            change = state.stage[row + SEED, i]
            dmu = tangent.parameters[first + g.force.index.friction]
            deps = tangent.parameters[first + g.force.index.friction_speed]
            dafter = stage.slide_jvp(
                self.fp, plane, pushed.x, v, v_obstacle, ratio, law.z, law.w, change, dv, dv_obstacle, dratio, dmu, deps
            )
            after = stage.slide(self.fp, plane, pushed.x, v, v_obstacle, ratio, law.z, law.w)
            if ti.static(self.features.partly_fixed):
                n, dn, e = self.normal(plane), self.normal(change), after - v
                dafter = dv + self.along_jvp(i, n, dn, e, dafter - dv, scene)
                after = v + self.along(i, n, e, scene)
            v, dv = after, dafter
        return v, dv

    @ti.func
    def slide_all_jvp(self, i, u, du, v, dv, ratio, dratio, now: A, scene: A, state: A, tangent: A):
        """Velocity after friction, and its change."""
        for g in ti.static(self.features.staged_rough):
            for k in range(g.count):
                after, change = self.slide_jvp_of(g, k, i, u, du, v, dv, ratio, dratio, now, scene, state, tangent)
                v, dv = self.led(i, v, after, scene), self.led(i, dv, change, scene)
        return v, dv

    @ti.func
    def after_friction_jvp(self, i, u, du, v, dv, z, dz, ratio, dratio, dalpha, now: A, scene: A, state: A, tangent: A):
        """Velocity after friction, and its change."""
        after, change = self.slide_all_jvp(i, u, du, v, dv, ratio, dratio, now, scene, state, tangent)
        x, number = self.crowding(i, v, after, z, now, state)
        c, slope = self.share_and_slope(x)
        dc, start, dstart = ti.cast(0, self.fp), v, dv
        if slope < 0:
            way, dway, dx = after - v, change - dv, ti.cast(0, self.fp)
            e, de = now.alpha * way, dalpha * way + now.alpha * dway
            for g in ti.static(self.features.staged):
                k = number - g.number
                if k >= 0 and k < g.count:
                    dx = self.change_of_x(g, k, i, u, du, z, dz, e, de, x, now, scene, tangent)
            dc = slope * dx
            after, change = v + c * way, dv + c * dway + dc * way
        if ti.static(self.features.recorded):
            note_friction_jvp(self, i, u, du, start, dstart, c, dc, ratio, dratio, now, scene, state, tangent)
        return after, change

    # ---- adjoint -------------------------------------------------------------------------------------------------------

    @ti.func
    def slide_all_vjp(self, i, v, v_adj, ratio, share, now: A, scene: A, state: A, adjoint: A):
        """(adjoint of the velocity v before friction, of h / m); notes those of all else, of the obstacle's velocity in
        its place.

        share: what of it the vertex takes, for impulses that are asked for.
        """
        by_ratio = ti.cast(0, self.fp)
        for back in range(ti.static(self.features.num_staged)):
            before = ti.static(self.features.num_staged) - 1 - back
            row = ROWS * (ti.static(self.features.first_staged) + before)
            pushed, law, by_v_obstacle = state.stage[row + PUSH, i], state.stage[row + NUMBERS, i], self.vector(0)
            if pushed.x > 0 and law.z > 0:
                start, held_adj = self.slide_by(before, i, v, ratio, scene, state), self.vector(0)
                if ti.static(self.features.partly_fixed):
                    held_adj = self.sliding_supports.held(i, v_adj, scene)
                    v_adj = v_adj + -1 * held_adj
                plane, v_obstacle = state.stage[row + PLANE, i], state.stage[row + VELOCITY, i]
                if ti.static(self.features.recorded):
                    v_adj += share * seed_of_friction(self, before, i, now, scene, adjoint)
                by_n = self.vector(0)
                if ti.static(self.features.partly_fixed):
                    raw = stage.slide(self.fp, plane, pushed.x, start, v_obstacle, ratio, law.z, law.w)
                    by_e, by_n = self.along_vjp(i, self.normal(plane), raw - start, v_adj, scene)
                    held_adj += v_adj - by_e
                    v_adj = by_e
                by_plane, by_v, of_v_obstacle, more, by_mu, by_eps = stage.slide_vjp(
                    self.fp, plane, pushed.x, start, v_obstacle, ratio, law.z, law.w, v_adj
                )
                v_adj, by_v_obstacle = by_v + held_adj if ti.static(self.features.partly_fixed) else by_v, of_v_obstacle
                if ti.static(self.features.recorded):
                    v_adj += -share * seed_of_friction(self, before, i, now, scene, adjoint)
                    friction_by_mass(self, before, i, start, share, ratio, now, scene, state, adjoint)
                by_ratio += more
                state.stage[row + SEED, i] = state.stage[row + SEED, i] + by_plane
                if ti.static(self.features.partly_fixed):
                    state.stage[row + SEED, i] = state.stage[row + SEED, i] + by_n
                pushed.z, pushed.w = by_mu, by_eps
                state.stage[row + PUSH, i] = pushed
            state.stage[row + VELOCITY, i] = by_v_obstacle
        return v_adj, by_ratio

    @ti.func
    def after_friction_vjp(self, i, u, v, v_adj, z, ratio, now: A, scene: A, state: A, adjoint: A):
        """(adjoints of v before friction, of h / m, of the move z, of alpha, of u); notes or adds those of all else."""
        after, by_z, by_u = self.slide_all(i, v, ratio, scene, state), self.vector(0), self.vector(0)
        x, number = self.crowding(i, v, after, z, now, state)
        c, slope = self.share_and_slope(x)
        displacement_adj, own, by_alpha = v_adj, self.vector(0), ti.cast(0, self.fp)
        if slope < 0:
            way = after - v
            by_x = slope * v_adj.dot(way)
            if ti.static(self.features.recorded):
                by_x += slope * friction_by_share(self, i, v, ratio, now, scene, state, adjoint)
            displacement_adj = c * v_adj
            for g in ti.static(self.features.staged):
                k = number - g.number
                if k >= 0 and k < g.count:
                    of_e, of_z, of_u = self.adjoint_of_x(
                        g, k, i, i, u, z, now.alpha * way, x, by_x, now, scene, adjoint, adjoint
                    )
                    displacement_adj += now.alpha * of_e
                    by_alpha += of_e.dot(way)
                    by_z += of_z
                    by_u += of_u
            self.add_to_rest(i, by_u, adjoint)
            own = v_adj - displacement_adj
        by_v, by_ratio = self.slide_all_vjp(i, v, displacement_adj, ratio, c, now, scene, state, adjoint)
        return by_v + own, by_ratio, by_z, by_alpha, by_u
