"""What obstacles do in an explicit pass: where they are, what is noted, their forces, friction with tangent and adjoint.

Functions of a shape take positions relative to the obstacle, so that a displaced obstacle is a vertex whose rest position X
is displaced the other way. Obstacles of one kind are gone through in a loop (state/features.py).
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_places import ObstaclePlaces
from diffsim_ti.mechanics.supports.guides import Guides
from diffsim_ti.runtime import Bundle, at, let, traced
from diffsim_ti.state.pass_table import pass_at

A = ti.template()  # an array or Bundle handed to a Taichi function
# what a contact stage notes of obstacle o at vertex i, in state.stage[ROWS o + row, i]: (n, d); (stiffness, width, mu,
# friction speed); its velocity; (P, -dP/dy, adjoint of mu, of the friction speed); change or adjoint of (n, P)
PLANE, FELT, WALL, PUSH, SEED = range(5)
ROWS = 5


@dataclass(frozen=True)
class ObstacleStages(ObstaclePlaces):
    """Taichi functions of one vertex; `now` is the pass (state/schedule.py), g a group of obstacles, k a place in it."""

    @cached_property
    def guides(self) -> Guides:
        return Guides(self.precision, self.features.motion)

    @ti.func
    def may(self, i, x, scene: A):
        """What of x vertex i may do: all, unless it is held in some directions."""
        out = x
        if ti.static(self.features.guided):
            out = self.guides.free(i, x, scene)
        return out

    # ---- adjoints of paths -------------------------------------------------------------------------------------------

    @traced
    def noting(self, now, plan):
        """A pass on the way back with `felt`: where vertices note what they feel of paths in its step."""
        moving = self.features.moving
        return Bundle(**vars(now), felt=let(2 * moving * (now.row % plan.steps)) if moving else 0)

    @ti.func
    def fold_part(self, p, count, first, last, adjoint: A, table: A, plan: A):
        """Sum what every num_parts-th of `count` vertices (or faces) felt of a path in the steps that passes last .. first
        complete, in order."""
        low, high = pass_at(table, first - plan.window), pass_at(table, last - plan.window)
        for back in range(high.row - low.row + low.opens):
            self.fold_row(p, count, high.row - back, high.next, adjoint, plan)

    @ti.func
    def fold_row(self, p, count, row, last, adjoint: A, plan: A):
        """The same of one step; last: the last row that there is, or the next one."""
        c, part, moving = p // plan.num_parts, p % plan.num_parts, ti.static(self.features.moving)
        at, after = 2 * (moving * (row % plan.steps) + c), ti.min(row + 1, last)
        to_row, to_next = self.vector(0), self.vector(0)
        for m in range((count - part + plan.num_parts - 1) // plan.num_parts):
            i = part + m * plan.num_parts
            to_row += adjoint.felt[at, i]
            to_next += adjoint.felt[at + 1, i]
            adjoint.felt[at, i] = self.vector(0)
            adjoint.felt[at + 1, i] = self.vector(0)
        adjoint.path[row, p] = adjoint.path[row, p] + to_row
        adjoint.path[after, p] = adjoint.path[after, p] + to_next

    # ---- what is noted -----------------------------------------------------------------------------------------------

    @ti.func
    def note(self, i, u, u_next, now: A, scene: A, state: A):
        """How near vertex i comes to each obstacle in the pass, and how well the pass resolves it (state/watch.py)."""
        for g in ti.static(self.features.groups):
            if ti.static(g.force.watched):
                for k in range(g.count):
                    self.note_one(g, k, i, u, u_next, now, scene, state)

    @ti.func
    def note_one(self, g: A, k, i, u, u_next, now: A, scene: A, state: A):
        first, at = g.first + k * g.size, 3 * (g.number + k)
        X = self.seen_now(g, k, scene.rest[i], now, scene)
        move = u_next - u - self.way_of_wall(g, k, X, u, now, scene)
        d, width = g.force.gap(scene.parameters, first, X, u), g.force.width(scene.parameters, first)
        far = d - width if ti.static(self.features.stages) else d  # a stage feels where a pass leads to
        if d < width or move.dot(move) >= far * far:
            approach = g.force.approach(scene.parameters, first, X, u, move)
            reached = ti.min(d, d + approach)
            if reached < width:
                rigidity = self.on_area(g, i, g.force.rigidity(scene.parameters, first, X, u), scene)
                omega2 = self.felt_by(i, scene) * rigidity
                state.seen[at, i] = ti.min(state.seen[at, i], reached)
                state.seen[at + 1, i] = ti.max(state.seen[at + 1, i], now.h * now.h * omega2)
                state.seen[at + 2, i] = ti.max(state.seen[at + 2, i], ti.abs(approach) / width)

    @traced
    def felt_by(self, i, scene):
        """An inverse mass [1/kg] as a push on vertex i feels it, of a body's at the most."""
        return let(at(scene.body_reach if self.features.reduced else scene.inverse_mass, i))

    # ---- forces ------------------------------------------------------------------------------------------------------

    @ti.func
    def add_force(self, i, f, u, v, now: A, scene: A):
        """f and the force of all obstacles on vertex i."""
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                f += self.on_area(g, i, g.force.force(scene.parameters, g.first + k * g.size, X, u, v), scene)
        return f

    @ti.func
    def add_force_jvp(self, i, df, u, v, du, dv, now: A, scene: A, tangent: A):
        """df and its change."""
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                first = g.first + k * g.size
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                df += self.on_area(g, i, g.force.force_jvp(scene.parameters, first, X, u, v, moved, dv), scene)
                by = g.force.parameter_derivatives(scene.parameters, first, X, u, v)
                for m in ti.static(range(g.size)):
                    df += self.on_area(g, i, by[m], scene) * tangent.parameters[first + m]
                if ti.static(g.force.per_area):
                    df += tangent.surface[i] * g.force.force(scene.parameters, first, X, u, v)
        return df

    @ti.func
    def add_force_vjp(self, i, u_adj, v_adj, u, v, f_adj, now: A, scene: A, adjoint: A):
        """u_adj, v_adj and the adjoints of u and v for that of the force; adds those of all else."""
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                first = g.first + k * g.size
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                w = self.on_area(g, i, f_adj, scene)
                by_place, by_v = g.force.force_vjp(scene.parameters, first, X, u, v, w)
                by_u = self.spread(g, k, i, X, u, by_place, self.vector(0), now, scene, adjoint, adjoint)
                u_adj += by_u
                v_adj += by_v
                by = g.force.parameter_derivatives(scene.parameters, first, X, u, v)
                for m in ti.static(range(g.size)):
                    adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by[m].dot(w)
                if ti.static(g.force.per_area and self.features.shape):
                    pushed = g.force.force(scene.parameters, first, X, u, v)
                    self.add_to_area(g, i, pushed.dot(f_adj), adjoint)
                self.add_to_rest(i, by_u, adjoint)
        return u_adj, v_adj

    @ti.func
    def work_of_forces(self, i, u, v_plus, now: A, scene: A):
        """Work [J] that moving obstacles do on vertex i by their forces and their friction, v_plus being before that."""
        work, v = ti.cast(0, self.fp), v_plus
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                wall = self.wall(g, k, X, u, now, scene)
                if ti.static(g.path >= 0):
                    force = self.on_area(g, i, g.force.force(scene.parameters, first, X, u, v_plus), scene)
                    work += now.h * force.dot(wall)
                if ti.static(g.force.friction):
                    if scene.inverse_mass[i] > 0:
                        after = self.slide(g, k, i, u, v, now, scene)
                        work += (after - v).dot(wall) / scene.inverse_mass[i]
                        v = after
        return work

    # ---- friction, its tangent and its adjoint -----------------------------------------------------------------------

    @ti.func
    def slide(self, g: A, k, i, u, v, now: A, scene: A):
        """Velocity of vertex i after the friction of one obstacle."""
        first, after = g.first + k * g.size, v
        X = self.seen_now(g, k, scene.rest[i], now, scene)
        if g.force.touches(scene.parameters, first, X, u):
            wall = self.wall(g, k, X, u, now, scene)
            h_over_m = self.on_area(g, i, now.h * scene.inverse_mass[i], scene)
            after = g.force.slide(scene.parameters, first, X, u, v, wall, h_over_m)
        return after

    @ti.func
    def slide_all(self, i, u, v, now: A, scene: A):
        """Velocity of vertex i after the friction of all obstacles, one after the other."""
        for g in ti.static(self.features.rough):
            for k in range(g.count):
                v = self.slide(g, k, i, u, v, now, scene)
        return v

    @ti.func
    def slide_before(self, number, i, u, v, now: A, scene: A):
        """Velocity of vertex i after the friction of the obstacles before the one of that number."""
        for g in ti.static(self.features.rough):
            for k in range(ti.min(g.count, number - g.number)):
                v = self.slide(g, k, i, u, v, now, scene)
        return v

    @ti.func
    def slide_jvp(self, i, u, v, du, dv, now: A, scene: A, tangent: A):
        """Change of the velocity after friction, v and dv being those before it."""
        inverse = scene.inverse_mass[i]
        for g in ti.static(self.features.rough):
            h_over_m = self.on_area(g, i, now.h * inverse, scene)
            for k in range(g.count):
                first = g.first + k * g.size
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                    wall = self.wall(g, k, X, u, now, scene)
                    dwall = self.wall_jvp(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                    lighter = -h_over_m * inverse * tangent.mass[i]
                    if ti.static(g.force.per_area):
                        lighter += now.h * inverse * tangent.surface[i]
                    dv = g.force.slide_jvp(
                        scene.parameters, first, X, u, v, wall, h_over_m, tangent.parameters, moved, dv, dwall, lighter
                    )
                    v = g.force.slide(scene.parameters, first, X, u, v, wall, h_over_m)
        return dv

    @ti.func
    def slide_vjp(self, i, u, v, v_adj, now: A, scene: A, adjoint: A):
        """Adjoints of u and of the velocity v before friction, for the adjoint of that after it; adds those of all else."""
        inverse, u_adj = scene.inverse_mass[i], self.vector(0)
        for g in ti.static(self.features.rough_backwards):
            h_over_m = self.on_area(g, i, now.h * inverse, scene)
            for back in range(g.count):
                k = g.count - 1 - back
                first = g.first + k * g.size
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                if g.force.touches(scene.parameters, first, X, u):
                    start = self.slide_before(g.number + k, i, u, v, now, scene)
                    by_place, by_v, by_wall, by_ratio, by = g.force.slide_vjp(
                        scene.parameters, first, X, u, start, self.wall(g, k, X, u, now, scene), h_over_m, v_adj
                    )
                    by_u = self.spread(g, k, i, X, u, by_place, by_wall, now, scene, adjoint, adjoint)
                    v_adj = by_v
                    u_adj += by_u
                    for m in ti.static(range(g.size)):
                        adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by[m]
                    if ti.static(self.features.density):
                        row = ti.static(self.features.sums().first("mass"))
                        adjoint.sums[row, i] = adjoint.sums[row, i] - h_over_m * inverse * by_ratio
                    self.add_to_area(g, i, now.h * inverse * by_ratio, adjoint)
                    self.add_to_rest(i, by_u, adjoint)
        return u_adj, v_adj
