"""Vertices that contact within faces leads towards an obstacle of their own: what they take of the way
(limited_displacement.py)."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.face_forces import FaceForces

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class LimitedFaceContact(FaceForces):
    """Taichi functions of vertex i; a pass without contact within faces moves it from u by z, and that by e from there."""

    @ti.func
    def towards(self, i, u, z, e, now: A, scene: A):
        """(x, number of the obstacle that has it, or -1)."""
        most, number = ti.cast(0, self.fp), -1
        for g in ti.static(self.features.staged):
            for k in range(g.count):
                plane = self.plane(g, k, i, u, now, scene)
                y = plane.w + self.normal(plane).dot(self.way_to(g, k, i, u, z, now, scene))
                x = -self.normal(plane).dot(e) / y
                if y > 0 and x > most:
                    most, number = x, g.number + k
        return most, number

    @ti.func
    def taken(self, i, u, z, e, now: A, scene: A):
        """What vertex i takes of e."""
        x, _ = self.towards(i, u, z, e, now, scene)
        c, _ = self.share_and_slope(x)
        return c * e

    @ti.func
    def taken_jvp(self, i, u, du, z, dz, e, de, now: A, scene: A, tangent: A):
        """Its change."""
        x, number = self.towards(i, u, z, e, now, scene)
        c, slope = self.share_and_slope(x)
        out = c * de
        if slope < 0:
            for g in ti.static(self.features.staged):
                k = number - g.number
                if k >= 0 and k < g.count:
                    out += slope * self.change_of_x(g, k, i, u, du, z, dz, e, de, x, now, scene, tangent) * e
        return out

    @ti.func
    def taken_vjp(self, i, s, u, z, e, p, now: A, scene: A, adjoint: A, out: A):
        """(adjoints of e, z, u) for that of what is taken; adds those of all else. s: number of i on the surface."""
        x, number = self.towards(i, u, z, e, now, scene)
        c, slope = self.share_and_slope(x)
        by_e, by_z, by_u = c * p, self.vector(0), self.vector(0)
        if slope < 0:
            for g in ti.static(self.features.staged):
                k = number - g.number
                if k >= 0 and k < g.count:
                    by_x = slope * p.dot(e)
                    of_e, of_z, of_u = self.adjoint_of_x(g, k, i, s, u, z, e, x, by_x, now, scene, adjoint, out)
                    by_e += of_e
                    by_z += of_z
                    by_u += of_u
            out.rest_adj[s] = out.rest_adj[s] + by_u
        return by_e, by_z, by_u
