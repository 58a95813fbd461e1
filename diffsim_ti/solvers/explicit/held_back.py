"""Ways that would lead a vertex behind an obstacle, of which it takes a share.

The stage leads a vertex to a distance d > 0 from each obstacle's tangent plane, normal n (contact_stage.py). What comes
after that, friction and contact within faces, adds a way e to it, of which the vertex takes the share c(x):

    x = max_o -e . n_o / d_o,    c(x) = 1 for x <= 1/2,    c(x) = (1 - exp(1 - 2 x) / 2) / x beyond,

which leaves it d_o exp(1 - 2 x) / 2 or more of each. The slope of c is continuous; where x <= 1/2 nothing is changed.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.solvers.explicit.obstacle_stages import ObstacleStages

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class HeldBack(ObstacleStages):
    """Taichi functions of vertex i; an obstacle stands where it is at a share of the step."""

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
    def plane(self, g: A, k, i, u, share, now: A, scene: A):
        """(n, d) of an obstacle at u."""
        X = scene.rest[i] - self.place_at(g, k, share, now, scene.path)
        return g.force.outlook(scene.parameters, g.first + k * g.size, X, u)

    @ti.func
    def plane_jvp(self, g: A, k, i, u, du, share, now: A, scene: A, tangent: A):
        """Its change."""
        X = scene.rest[i] - self.place_at(g, k, share, now, scene.path)
        moved = du + tangent.rest[i] - self.place_at(g, k, share, now, tangent.path)
        return g.force.outlook_jvp(scene.parameters, g.first + k * g.size, X, u, moved, tangent.parameters)

    @ti.func
    def plane_vjp(self, g: A, k, i, u, seed, share, now: A, scene: A, adjoint: A):
        """Adjoint of u for that of (n, d); adds those of the obstacle's numbers. The change of n by u is symmetric."""
        first, X = g.first + k * g.size, scene.rest[i] - self.place_at(g, k, share, now, scene.path)
        plane, by_u = g.force.outlook(scene.parameters, first, X, u), self.vector(0)
        turned = g.force.outlook_jvp(scene.parameters, first, X, u, seed)
        g.force.outlook_vjp(scene.parameters, first, X, u, seed, adjoint.sums, i)
        for m in ti.static(range(3)):
            by_u[m] = turned[m] + seed[3] * plane[m]
        return by_u
