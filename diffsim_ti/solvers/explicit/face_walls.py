"""Vertices that contact within faces leads towards an obstacle of their own: what they take of the way (held_back.py)."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.solvers.explicit.face_forces import FaceForces

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class FaceWalls(FaceForces):
    """Taichi functions of vertex i, which a pass without contact within faces leads to u, and that by e from there."""

    @ti.func
    def towards(self, i, e, u, now: A, scene: A):
        """(x, number of the obstacle that has it, or -1)."""
        most, number = ti.cast(0, self.fp), -1
        for g in ti.static(self.features.staged):
            for k in range(g.count):
                plane = self.plane(g, k, i, u, now.end, now, scene)
                x = -self.dot3(plane, e) / plane[3]
                if plane[3] > 0 and x > most:
                    most, number = x, g.number + k
        return most, number

    @ti.func
    def taken(self, i, e, u, now: A, scene: A):
        """What vertex i takes of e."""
        x, _ = self.towards(i, e, u, now, scene)
        c, _ = self.share_and_slope(x)
        return c * e

    @ti.func
    def taken_jvp(self, i, e, de, u, du, now: A, scene: A, tangent: A):
        """Its change."""
        x, number = self.towards(i, e, u, now, scene)
        c, slope = self.share_and_slope(x)
        out = c * de
        if slope < 0:
            for g in ti.static(self.features.staged):
                k = number - g.number
                if k >= 0 and k < g.count:
                    plane = self.plane(g, k, i, u, now.end, now, scene)
                    turned = self.plane_jvp(g, k, i, u, du, now.end, now, scene, tangent)
                    dx = -(self.dot3(turned, e) + self.dot3(plane, de) + x * turned[3]) / plane[3]
                    out += slope * dx * e
        return out

    @ti.func
    def taken_vjp(self, i, s, e, p, u, now: A, then: A, scene: A, adjoint: A, out: A):
        """(adjoint of e, of u) for that of what is taken; adds those of all else.

        s: number of i among the surface's vertices; then: the end of the pass, on the way back.
        """
        x, number = self.towards(i, e, u, now, scene)
        c, slope = self.share_and_slope(x)
        by_e, by_u = c * p, self.vector(0)
        if slope < 0:
            for g in ti.static(self.features.staged):
                k = number - g.number
                if k >= 0 and k < g.count:
                    plane, seed = self.plane(g, k, i, u, now.end, now, scene), self.vector(0)
                    ratio = slope * self.dot3(p, e) / plane[3]
                    for m in ti.static(range(3)):
                        seed[m] = -ratio * e[m]
                        by_e[m] = by_e[m] - ratio * plane[m]
                    seed[3] = -ratio * x
                    by_u = self.plane_vjp(g, k, i, u, seed, now.end, now, scene, adjoint)
                    self.add_to_path(g, k, s, then, by_u, self.vector(0), out)
            out.rest_adj[s] = out.rest_adj[s] + by_u
        return by_e, by_u
