"""What obstacles do in an explicit pass: where they are and how fast, what is noted, their forces and friction, all with
tangent and adjoint.

Functions of a shape take positions relative to the obstacle, so that a displaced obstacle is a vertex whose rest position X
is displaced the other way. Obstacles of one kind are gone through in a loop (state/features.py). A path is a column of
displacements, or the three of a pose that inputs/poses.py says; places of an obstacle that turns are seven numbers, their
changes and adjoints six (turned.py). Where robots move an obstacle (`g.led`), and how fast in the pass, stands in rows of
`offsets` (state/obstacle_poses.py).
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.inputs.poses import COLUMNS
from diffsim_ti.mechanics.obstacles.obstacle_functions import ObstacleFunctions
from diffsim_ti.mechanics.supports.sliding_supports import SlidingSupports
from diffsim_ti.runtime import A, Bundle, at, let, traced
from diffsim_ti.state.obstacle_poses import AT_BEGIN, RATE
from diffsim_ti.state.pass_table import pass_at
from diffsim_ti.terms.obstacles import turning

# what a contact stage notes of obstacle o at vertex i, in state.stage[ROWS o + row, i]: (n, d); (stiffness, width, mu,
# friction speed); its velocity; (P, -dP/dy, adjoint of mu, of the friction speed); change or adjoint of (n, P)
PLANE, NUMBERS, VELOCITY, PUSH, SEED = range(5)
ROWS = 5


@dataclass(frozen=True)
class ObstacleStages(ObstacleFunctions):
    """Taichi functions of one vertex; `now` is the pass (state/schedule.py), g a group of obstacles, k a place in it."""

    @cached_property
    def sliding_supports(self) -> SlidingSupports:
        return SlidingSupports(self.precision, self.features.motion)

    @ti.func
    def may(self, i, x, scene: A):
        """The admissible part of x for vertex i: all, unless it is fixed in some directions."""
        out = x
        if ti.static(self.features.partly_fixed):
            out = self.sliding_supports.free(i, x, scene)
        return out

    # ---- where obstacles are -----------------------------------------------------------------------------------------

    @traced
    def column(self, g, k):
        """Of the path of an obstacle."""
        return g.path + COLUMNS * k if g.force.turns else g.path + k

    @ti.func
    def shift_at(self, g: A, k, share, now: A, of: A):
        """Displacement of an obstacle at a share of the step, or its change; of: the scene, or its tangent."""
        place = self.vector(0)
        if ti.static(g.path >= 0):
            start = of.path[now.row, self.column(g, k)]
            place = start + share * (of.path[now.next, self.column(g, k)] - start)
        if ti.static(g.led):
            place = of.offsets[3 * (g.number + k) + AT_BEGIN]
        return place

    @traced
    def place_at(self, g, k, share, now, scene):
        """Displacement of an obstacle at a share of the step; of one that turns with its unit quaternion behind."""
        shift = self.shift_at(g, k, share, now, scene)
        if not g.force.turns:
            return shift
        if g.led:
            s = self.turned.short(at(scene.offsets, self.turning_row(g, k) + AT_BEGIN))
            return self.turned.joined(shift, turning.from_rodrigues(s, self.fp), 4)
        return self.turned.joined(shift, self.turn_at(g, k, share, now, scene.path), 4)

    @ti.func
    def turn_at(self, g: A, k, share, now: A, path: A):
        start, phi = path[now.row, self.column(g, k) + 1], path[now.row, self.column(g, k) + 2]
        return turning.at_share(self.turned.short(start), self.turned.short(phi), share, self.fp)

    @traced
    def place(self, g, k, now, scene):
        """The same when the pass begins."""
        return self.place_at(g, k, now.begin, now, scene)

    @traced
    def seen_now(self, g, k, rest, now, scene):
        """X of a rest position when the pass begins (obstacle_functions.py)."""
        return self.seen(g, rest, self.place(g, k, now, scene))

    @traced
    def moved(self, g, k, X, u, dr, now, scene, tangent):
        """Change of the place for dr of X + u, and for that of the obstacle."""
        shift = self.shift_at(g, k, now.begin, now, tangent)
        if not g.force.turns:
            return dr - shift
        if g.led:
            dplace = self.turned.joined(shift, at(tangent.offsets, self.turning_row(g, k) + AT_BEGIN))
        else:
            dplace = self.turned.joined(shift, self.turn_jvp(g, k, now, scene, tangent))
        return self.turned.moved(g, g.first + k * g.size, X, u, dr, dplace, scene, tangent)

    @ti.func
    def turn_jvp(self, g: A, k, now: A, scene: A, tangent: A):
        """theta when the pass begins."""
        c = self.column(g, k)
        a = now.begin * self.turned.short(scene.path[now.row, c + 2])
        theta, dphi = self.turned.short(tangent.path[now.row, c + 1]), self.turned.short(tangent.path[now.row, c + 2])
        return turning.rotated(a, theta, self.fp) + now.begin * turning.jacobian(a, dphi, self.fp)

    @ti.func
    def speed(self, g: A, k, now: A, of: A):
        """Velocity of an obstacle in the pass, of one that turns that of the point which it turns about; or its change."""
        speed = self.vector(0)
        if ti.static(g.path >= 0):
            speed = now.per_step * (of.path[now.next, self.column(g, k)] - of.path[now.row, self.column(g, k)])
        if ti.static(g.led):
            speed = of.offsets[3 * (g.number + k) + RATE]
        return speed

    @traced
    def spin(self, g, k, now, of):
        """Angular velocity, or its change."""
        if g.led:
            return self.turned.short(at(of.offsets, self.turning_row(g, k) + RATE))
        return let(now.per_step * self.turned.short(at(of.path, now.row, self.column(g, k) + 2)))

    @traced
    def v_obstacle(self, g, k, X, u, now, scene):
        """Velocity of an obstacle at a vertex in the pass."""
        v = self.speed(g, k, now, scene)
        if not g.force.turns:
            return v
        r = self.turned.arm(g, g.first + k * g.size, X, u, scene)
        return self.turned.v_obstacle(self.turned.short(v), self.spin(g, k, now, scene), now.h, r)

    @traced
    def obstacle_velocity_jvp(self, g, k, X, u, dr, now, scene, tangent):
        """Its change, for dr of X + u."""
        dv = self.speed(g, k, now, tangent)
        return self.turned_velocity_jvp(g, k, X, u, dr, dv, now, scene, tangent) if g.force.turns else dv

    @ti.func
    def turned_velocity_jvp(self, g: A, k, X, u, dr, dv, now: A, scene: A, tangent: A):
        first = g.first + k * g.size
        arm, darm = self.turned.arm(g, first, X, u, scene), self.turned.short(dr)
        darm += -1 * self.turned.short(self.shift_at(g, k, now.begin, now, tangent))
        darm += -1 * self.turned.about(g, first, tangent.parameters)
        omega, domega = self.spin(g, k, now, scene), self.spin(g, k, now, tangent)
        return self.turned.obstacle_velocity_jvp(self.turned.short(dv), omega, domega, now.h, arm, darm)

    @traced
    def spread(self, g, k, i, X, u, by, by_v_obstacle, now, scene, adjoint, paths, column=None):
        """Adjoint of u for those of the changed place and of the obstacle's velocity there; adds those of its path to column
        `column` of paths.path_adjoint, and of the point that it turns about to column i of the sums."""
        column = i if column is None else column
        if g.force.turns:
            return self.spread_turned(g, k, i, column, X, u, by, by_v_obstacle, now, scene, adjoint, paths)
        self.add_to_path(g, k, column, now, by, by_v_obstacle, paths)
        return by

    @ti.func
    def spread_turned(self, g: A, k, i, column, X, u, by, by_v_obstacle, now: A, scene: A, adjoint: A, paths: A):
        first, b = g.first + k * g.size, self.turned.short(by_v_obstacle)
        r, omega = self.turned.arm(g, first, X, u, scene), self.spin(g, k, now, scene)
        by_omega, by_arm = self.turned.obstacle_velocity_vjp(omega, now.h, r, b)
        by_u, _, by_theta = self.turned.spread(g, first, i, X, u, by, by_arm, scene, adjoint.sums)
        self.add_to_path(g, k, column, now, by_u, by_v_obstacle, paths)
        if ti.static(g.led):
            row = self.turning_row(g, k)
            paths.offsets[row + AT_BEGIN, column] = paths.offsets[row + AT_BEGIN, column] + self.turned.long(by_theta)
            paths.offsets[row + RATE, column] = paths.offsets[row + RATE, column] + self.turned.long(by_omega)
        else:
            self.add_to_turn(g, k, column, now, by_theta, by_omega, scene, paths)
        return by_u

    @ti.func
    def add_to_turn(self, g: A, k, i, now: A, by_theta, by_omega, scene: A, adjoint: A):
        """Adjoints of the rotation of the row and of that in the step."""
        phi, c = self.turned.short(scene.path[now.row, self.column(g, k) + 2]), now.path_adjoint + 2 * self.column(g, k)
        back = -now.begin * phi
        by_row = turning.rotated(back, by_theta, self.fp)
        by_phi = now.begin * turning.jacobian(back, by_theta, self.fp) + now.per_step * by_omega
        adjoint.path_adjoint[c + 2, i] = adjoint.path_adjoint[c + 2, i] + self.turned.long(by_row)
        adjoint.path_adjoint[c + 4, i] = adjoint.path_adjoint[c + 4, i] + self.turned.long(by_phi)

    @ti.func
    def add_to_path(self, g: A, k, i, now: A, by_X, by_v_obstacle, adjoint: A):
        """Adjoints of the rows of the path by vertex i; summed over the vertices where a step begins."""
        if ti.static(g.path >= 0):
            c, rate = now.path_adjoint + 2 * self.column(g, k), now.per_step * by_v_obstacle
            adjoint.path_adjoint[c, i] = adjoint.path_adjoint[c, i] - ((1 - now.begin) * by_X + rate)
            adjoint.path_adjoint[c + 1, i] = adjoint.path_adjoint[c + 1, i] - (now.begin * by_X - rate)
        if ti.static(g.led):
            row = 3 * (g.number + k)
            adjoint.offsets[row + AT_BEGIN, i] = adjoint.offsets[row + AT_BEGIN, i] - by_X
            adjoint.offsets[row + RATE, i] = adjoint.offsets[row + RATE, i] + by_v_obstacle

    @traced
    def displacement_of_obstacle(self, g, k, X, u, now, scene):
        """How far an obstacle goes in the pass at a vertex."""
        if g.force.turns:
            return now.h * self.v_obstacle(g, k, X, u, now, scene)
        return self.place_at(g, k, now.end, now, scene) - self.place(g, k, now, scene)

    # ---- adjoints of paths -------------------------------------------------------------------------------------------

    @traced
    def counted(self, now):
        """A pass with `into`: the first row of `impulse` of the frame that it leads to, -1 if none counts it."""
        if not self.features.recorded:
            return now
        if self.features.led:  # which are noted pass by pass
            return Bundle(**vars(now), into=let(0 * now.counted))
        return Bundle(**vars(now), into=let(ti.select(now.counted >= 0, 2 * self.num_obstacles * now.counted, -1)))

    @traced
    def noting(self, now, plan):
        """A pass on the way back, with where vertices accumulate adjoints of paths in its step."""
        moving = self.features.moving
        return Bundle(**vars(now), path_adjoint=let(2 * moving * (now.row % plan.steps)) if moving else 0)

    @ti.func
    def fold_part(self, p, count, first, last, adjoint: A, table: A, plan: A):
        """Sum what every num_parts-th of `count` vertices (or faces) accumulated for a path in the steps that passes
        last .. first complete, in order."""
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
            to_row += adjoint.path_adjoint[at, i]
            to_next += adjoint.path_adjoint[at + 1, i]
            adjoint.path_adjoint[at, i] = self.vector(0)
            adjoint.path_adjoint[at + 1, i] = self.vector(0)
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
        move = u_next - u - self.displacement_of_obstacle(g, k, X, u, now, scene)
        d, width = g.force.gap(scene.parameters, first, X, u), g.force.width(scene.parameters, first)
        far = d - width if ti.static(self.features.stages) else d  # a stage acts where a pass leads to
        if d < width or move.dot(move) >= far * far:
            approach = g.force.approach(scene.parameters, first, X, u, move)
            reached = g.force.reached(scene.parameters, first, X, u, move, d, approach)
            if reached < width:
                rigidity = self.on_area(g, i, g.force.rigidity(scene.parameters, first, X, u), scene)
                omega2 = self.inverse_mass(i, scene) * rigidity
                state.seen[at, i] = ti.min(state.seen[at, i], reached)
                state.seen[at + 1, i] = ti.max(state.seen[at + 1, i], now.h * now.h * omega2)
                state.seen[at + 2, i] = ti.max(state.seen[at + 2, i], ti.abs(approach) / width)

    @traced
    def inverse_mass(self, i, scene):
        """The inverse mass [1/kg] that a push on vertex i meets, of a body's at the most."""
        return let(at(scene.body_reach if self.features.reduced else scene.inverse_mass, i))

    # ---- forces ------------------------------------------------------------------------------------------------------

    @ti.func
    def add_force(self, i, f, u, v, now: A, scene: A):
        """f and the force of all obstacles on vertex i."""
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                f += self.force(g, k, i, self.seen_now(g, k, scene.rest[i], now, scene), u, v, scene)
        return f

    @ti.func
    def add_force_jvp(self, i, df, u, v, du, dv, now: A, scene: A, tangent: A):
        """df and its change."""
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                df += self.force_jvp(g, k, i, X, u, v, moved, dv, scene, tangent)
        return df

    @ti.func
    def add_force_vjp(self, i, u_adj, v_adj, u, v, f_adj, now: A, scene: A, adjoint: A):
        """u_adj, v_adj and the adjoints of u and v for that of the force; adds those of all else."""
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                by_place, by_v = self.force_vjp(g, k, i, X, u, v, f_adj, scene, adjoint)
                by_u = self.spread(g, k, i, X, u, by_place, self.vector(0), now, scene, adjoint, adjoint)
                u_adj += by_u
                v_adj += by_v
                self.add_to_rest(i, by_u, adjoint)
        return u_adj, v_adj

    @ti.func
    def work_of_forces(self, i, u, v_plus, now: A, scene: A):
        """Work [J] that moving obstacles do on vertex i by their forces and their friction, v_plus being before that."""
        work, v = ti.cast(0, self.fp), v_plus
        for g in ti.static(self.features.pressing):
            for k in range(g.count):
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                if ti.static(g.path >= 0):
                    work += now.h * self.force(g, k, i, X, u, v_plus, scene).dot(v_obstacle)
                if ti.static(g.force.friction):
                    if scene.inverse_mass[i] > 0:
                        after = self.slide(g, k, i, u, v, now, scene)
                        work += (after - v).dot(v_obstacle) / scene.inverse_mass[i]
                        v = after
        return work

    # ---- friction, its tangent and its adjoint -----------------------------------------------------------------------

    @ti.func
    def slide(self, g: A, k, i, u, v, now: A, scene: A):
        """Velocity of vertex i after the friction of one obstacle."""
        first, after = g.first + k * g.size, v
        X = self.seen_now(g, k, scene.rest[i], now, scene)
        if g.force.touches(scene.parameters, first, X, u):
            v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
            h_over_m = self.on_area(g, i, now.h * scene.inverse_mass[i], scene)
            after = g.force.slide(scene.parameters, first, X, u, v, v_obstacle, h_over_m)
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
                    v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                    dv_obstacle = self.obstacle_velocity_jvp(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                    lighter = -h_over_m * inverse * tangent.mass[i]
                    if ti.static(g.force.per_area):
                        lighter += now.h * inverse * tangent.surface[i]
                    both, changes = ti.static((v, v_obstacle), (dv, dv_obstacle))
                    dv = g.force.slide_jvp(
                        scene.parameters, first, X, u, both, h_over_m, tangent.parameters, moved, changes, lighter
                    )
                    v = g.force.slide(scene.parameters, first, X, u, v, v_obstacle, h_over_m)
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
                    by_place, by_v, by_v_obstacle, by_ratio, by = g.force.slide_vjp(
                        scene.parameters, first, X, u, start, self.v_obstacle(g, k, X, u, now, scene), h_over_m, v_adj
                    )
                    by_u = self.spread(g, k, i, X, u, by_place, by_v_obstacle, now, scene, adjoint, adjoint)
                    v_adj = by_v
                    u_adj += by_u
                    self.add_to_numbers(g, k, i, by, adjoint)
                    if ti.static(self.features.density):
                        row = ti.static(self.features.sums().first("mass"))
                        adjoint.sums[row, i] = adjoint.sums[row, i] - h_over_m * inverse * by_ratio
                    self.add_to_area(g, i, now.h * inverse * by_ratio, adjoint)
                    self.add_to_rest(i, by_u, adjoint)
        return u_adj, v_adj
