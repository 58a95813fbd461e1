"""Where obstacles are in an explicit pass, and how fast, with tangent and adjoint: by rows of their paths.

A path is a column of displacements, or the three of a pose that inputs/poses.py says; places of an obstacle that turns are
seven numbers, their changes and adjoints six (turned.py).
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.inputs.poses import COLUMNS
from diffsim_ti.mechanics.obstacles.obstacle_functions import ObstacleFunctions
from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles import turning

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class ObstaclePlaces(ObstacleFunctions):
    """Taichi functions of one vertex; `now` is the pass (state/schedule.py), g a group of obstacles, k a place in it."""

    @traced
    def column(self, g, k):
        """Of the path of an obstacle."""
        return g.path + COLUMNS * k if g.force.turns else g.path + k

    @ti.func
    def shift_at(self, g: A, k, share, now: A, path: A):
        """Displacement of an obstacle at a share of the step."""
        place = self.vector(0)
        if ti.static(g.path >= 0):
            start = path[now.row, self.column(g, k)]
            place = start + share * (path[now.next, self.column(g, k)] - start)
        return place

    @traced
    def place_at(self, g, k, share, now, path):
        """Displacement of an obstacle at a share of the step; of one that turns with its unit quaternion behind."""
        shift = self.shift_at(g, k, share, now, path)
        if not g.force.turns:
            return shift
        return self.turned.joined(shift, self.turn_at(g, k, share, now, path), 4)

    @ti.func
    def turn_at(self, g: A, k, share, now: A, path: A):
        c = self.column(g, k)
        start = turning.from_rodrigues(self.turned.short(path[now.row, c + 1]), self.fp)
        return turning.product(turning.quaternion(share * self.turned.short(path[now.row, c + 2]), self.fp), start)

    @traced
    def place(self, g, k, now, path):
        """The same when the pass begins."""
        return self.place_at(g, k, now.begin, now, path)

    @traced
    def seen_now(self, g, k, rest, now, scene):
        """X of a rest position when the pass begins (obstacle_functions.py)."""
        return self.seen(g, rest, self.place(g, k, now, scene.path))

    @traced
    def moved(self, g, k, X, u, dr, now, scene, tangent):
        """Change of the place for dr of X + u, and for that of the obstacle."""
        shift = self.shift_at(g, k, now.begin, now, tangent.path)
        if not g.force.turns:
            return dr - shift
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
    def speed(self, g: A, k, now: A, path: A):
        """Velocity of an obstacle in the pass, of one that turns that of the point which it turns about."""
        speed = self.vector(0)
        if ti.static(g.path >= 0):
            speed = now.per_step * (path[now.next, self.column(g, k)] - path[now.row, self.column(g, k)])
        return speed

    @ti.func
    def spin(self, g: A, k, now: A, path: A):
        """Angular velocity."""
        return now.per_step * self.turned.short(path[now.row, self.column(g, k) + 2])

    @traced
    def wall(self, g, k, X, u, now, scene):
        """Velocity of an obstacle at a vertex in the pass."""
        v = self.speed(g, k, now, scene.path)
        if not g.force.turns:
            return v
        r = self.turned.arm(g, g.first + k * g.size, X, u, scene)
        return self.turned.wall(self.turned.short(v), self.spin(g, k, now, scene.path), now.h, r)

    @traced
    def wall_jvp(self, g, k, X, u, dr, now, scene, tangent):
        """Its change, for dr of X + u."""
        dv = self.speed(g, k, now, tangent.path)
        return self.turned_wall_jvp(g, k, X, u, dr, dv, now, scene, tangent) if g.force.turns else dv

    @ti.func
    def turned_wall_jvp(self, g: A, k, X, u, dr, dv, now: A, scene: A, tangent: A):
        first = g.first + k * g.size
        arm, darm = self.turned.arm(g, first, X, u, scene), self.turned.short(dr)
        darm += -1 * self.turned.short(self.shift_at(g, k, now.begin, now, tangent.path))
        darm += -1 * self.turned.about(g, first, tangent.parameters)
        omega, domega = self.spin(g, k, now, scene.path), self.spin(g, k, now, tangent.path)
        return self.turned.wall_jvp(self.turned.short(dv), omega, domega, now.h, arm, darm)

    @traced
    def spread(self, g, k, i, X, u, by, by_wall, now, scene, adjoint, felt, column=None):
        """Adjoint of u for those of the changed place and of the obstacle's velocity there; adds those of its path to column
        `column` of felt.felt, and of the point that it turns about to column i of the sums."""
        column = i if column is None else column
        if g.force.turns:
            return self.spread_turned(g, k, i, column, X, u, by, by_wall, now, scene, adjoint, felt)
        self.add_to_path(g, k, column, now, by, by_wall, felt)
        return by

    @ti.func
    def spread_turned(self, g: A, k, i, column, X, u, by, by_wall, now: A, scene: A, adjoint: A, felt: A):
        first, b = g.first + k * g.size, self.turned.short(by_wall)
        r, omega = self.turned.arm(g, first, X, u, scene), self.spin(g, k, now, scene.path)
        by_omega, by_arm = self.turned.wall_vjp(omega, now.h, r, b)
        by_u, _, by_theta = self.turned.spread(g, first, i, X, u, by, by_arm, scene, adjoint.sums)
        self.add_to_path(g, k, column, now, by_u, by_wall, felt)
        self.add_to_turn(g, k, column, now, by_theta, by_omega, scene, felt)
        return by_u

    @ti.func
    def add_to_turn(self, g: A, k, i, now: A, by_theta, by_omega, scene: A, adjoint: A):
        """Adjoints of the rotation of the row and of that in the step."""
        phi, c = self.turned.short(scene.path[now.row, self.column(g, k) + 2]), now.felt + 2 * self.column(g, k)
        back = -now.begin * phi
        by_row = turning.rotated(back, by_theta, self.fp)
        by_phi = now.begin * turning.jacobian(back, by_theta, self.fp) + now.per_step * by_omega
        adjoint.felt[c + 2, i] = adjoint.felt[c + 2, i] + self.turned.long(by_row)
        adjoint.felt[c + 4, i] = adjoint.felt[c + 4, i] + self.turned.long(by_phi)

    @ti.func
    def add_to_path(self, g: A, k, i, now: A, by_X, by_wall, adjoint: A):
        """Adjoints of the rows of the path that vertex i felt; summed over the vertices where a step begins."""
        if ti.static(g.path >= 0):
            c, rate = now.felt + 2 * self.column(g, k), now.per_step * by_wall
            adjoint.felt[c, i] = adjoint.felt[c, i] - ((1 - now.begin) * by_X + rate)
            adjoint.felt[c + 1, i] = adjoint.felt[c + 1, i] - (now.begin * by_X - rate)

    @traced
    def way_of_wall(self, g, k, X, u, now, scene):
        """How far an obstacle goes in the pass at a vertex."""
        if g.force.turns:
            return now.h * self.wall(g, k, X, u, now, scene)
        return self.place_at(g, k, now.end, now, scene.path) - self.place(g, k, now, scene.path)
