"""Displacements that would lead a vertex behind an obstacle, of which it takes a share.

The stage moves a vertex by z to a distance y > 0 from the tangent plane, normal n, that each obstacle has where the pass
begins (contact_stage.py). What comes after that, friction, adds a way e, of which the vertex takes the share c(x):

    x = max_o -e . n_o / y_o,    c(x) = 1 for x <= 1/2,    c(x) = (1 - exp(1 - 2 x) / 2) / x beyond,

which leaves it y_o exp(1 - 2 x) / 2 or more of each. The slope of c is continuous; where x <= 1/2 nothing is changed.
Planes that a vertex is behind, since it went past an obstacle, do not count.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_stages import ObstacleStages
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.terms.obstacles import turning

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class LimitedDisplacement(ObstacleStages):
    """Taichi functions of vertex i; `now` is the pass (state/schedule.py), g a group of obstacles, k a place in it."""

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
    def plane(self, g: A, k, i, u, now: A, scene: A):
        """(n, d) of an obstacle at u, where it is when the pass begins."""
        X = self.seen_now(g, k, scene.rest[i], now, scene)
        return g.force.contact_plane(scene.parameters, g.first + k * g.size, X, u)

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
