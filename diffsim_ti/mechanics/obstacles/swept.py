"""How far the surface may move before a point of it meets an obstacle, and how far from one it is.

A distance d to a solid changes by no more than the way that is gone. So from a place where it is d a point may go on by d,
and again from there: conservative advancement (Mirtich 1996, Impulse-based Dynamic Simulation of Rigid Body Systems, 2.3).
A face is as near as its nearest point, which lies between bounds: the distance d of its middle, and d - r, where r is how
far its corners lie from there; for a convex obstacle, which lies on one side of each tangent plane, also d plus the least
way of a corner along the normal. Faces are cut in four, and their parts again, until the bounds are near each other.
To a hollow obstacle (the ground is one) a face is as near as its corners, and a part of a curved one nearer than its own
corners by its arch at most, a fourth of that of the part that it was cut from. Vertices are faces whose corners are one.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.obstacles.curved_faces import MOST_SHARES
from diffsim_ti.mechanics.obstacles.obstacle_functions import ObstacleFunctions
from diffsim_ti.runtime import Kernel, kernels_of, traced
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import SCENE, needed
from diffsim_ti.state.obstacle_poses import MORE
from diffsim_ti.terms.obstacles import turning

A = ti.template()
MARCHES = 200  # halts on a way
LEVELS, FINEST = 9, 12  # a side of a face is cut in 2^9 parts at most on a way, in 2^12 where it is looked at once
TINY = 1e-3  # share of the distance, or of the width if that is less: what counts as met

WAY = dict(places="vectors", drifts="vectors", step="vectors2", corners="ints")
FOUND = dict(found="scalars", blocker="ints")


@dataclass(frozen=True)
class SweptKernels(ObstacleFunctions):
    """Of each vertex and face: the free `shares` of a step, and `distances`; with the obstacle that they come from."""

    parallel: bool

    def _kernel(self, name: str, body) -> Kernel:
        own = dict(scene=needed(SCENE, self.features), way=WAY, at=dict(u="vectors2"), out=FOUND)
        return Kernel(
            name, body, self.precision, own, dict(num_vertices="int", count="int", most="float", kept="float")
        )

    @ti.func
    def length(self, v):
        return ti.sqrt(v.norm_sqr())

    @ti.func
    def clearance(self, g: A, first, X, u, scene: A):
        """(normal, distance) of a point to the obstacle whose numbers start at `first`."""
        return g.force.clearance(scene.parameters, first, X, u)

    # ---- a face ------------------------------------------------------------------------------------------------------

    @ti.func
    def part_of_face(self, code, level):
        """Corners of a part of a face, a row of three shares each: the digits of `code` in base 4 say which quarter of
        which quarter; quarter 0 is the middle one, which lies the other way round."""
        i, j, up = 0, 0, 1
        for m in range(level):
            quarter = (code >> (2 * (level - 1 - m))) & 3
            a, b = ti.select(quarter == 1, 1, 0), ti.select(quarter == 2, 1, 0)
            if quarter == 0:
                i = 2 * i + 1 - up
                j = 2 * j + 1 - up
                up = 1 - up
            elif up == 1:
                i = 2 * i + a
                j = 2 * j + b
            else:
                i = 2 * i + 1 - b
                j = 2 * j + 1 - a
        out, per = ti.Matrix.zero(self.fp, 3, 3), ti.cast(1, self.fp) / ti.cast(1 << level, self.fp)
        for c in ti.static(range(3)):
            x = ti.select(up == 1, i + ti.static(int(c == 1)), i + ti.static(int(c != 1)))
            y = ti.select(up == 1, j + ti.static(int(c == 2)), j + ti.static(int(c != 0)))
            out[c, 1], out[c, 2] = x * per, y * per
            out[c, 0] = 1 - (x + y) * per
        return out

    @ti.func
    def face_clearance(self, g: A, first, X, u, inner, scene: A, wanted, levels: A):
        """A distance [m] that a face keeps: `wanted` or more if it is that far away, else half of its own or more; not
        positive if a point of it was found to be in the obstacle. X, u: rows of its nodes."""
        code, level, far, half = 0, 0, ti.cast(1e30, self.fp), ti.cast(0.5, self.fp)
        nearest, least, arch = far, far, self.arch(X + u, inner)
        while level >= 0 and nearest > 0:
            part = self.part_of_face(code, level)
            Xs, us, third = self.part_of(part, X, inner), self.part_of(part, u, inner), ti.cast(1 / 3, self.fp)
            X0, u0 = self.vector(0), self.vector(0)
            for n in ti.static(range(4)):
                X0[n] = third * (Xs[0, n] + Xs[1, n] + Xs[2, n])
                u0[n] = third * (us[0, n] + us[1, n] + us[2, n])
            if ti.static(self.features.curved):
                X0, u0 = self.middle_of_part(part, X, inner), self.middle_of_part(part, u, inner)
            seen = self.clearance(g, first, X0, u0, scene)
            d, r, along = seen[3], ti.cast(0, self.fp), far
            for c in ti.static(range(3)):
                edge = self.vector(0)
                for n in ti.static(range(3)):
                    edge[n] = (Xs[c, n] - X0[n]) + (us[c, n] - u0[n])
                r = ti.max(r, self.length(edge))
                along = ti.min(along, seen.dot(edge))
            if ti.static(self.features.curved):
                bow = arch / ti.cast(1 << (2 * level), self.fp)
                r += bow
                along -= bow
            nearest, low = ti.min(nearest, d), d - r
            if ti.static(self.features.curved and g.force.hollow):
                of_corners = far
                for c in ti.static(range(3)):
                    x, y = self.row_of(Xs, c), self.row_of(us, c)
                    of_corners = ti.min(of_corners, self.clearance(g, first, x, y, scene)[3])
                nearest = ti.min(nearest, of_corners)
                low = ti.max(low, of_corners - arch / ti.cast(1 << (2 * level), self.fp))
            if ti.static(g.force.convex):
                low = ti.max(low, d + along)
            last = level == levels
            if last:  # by the plane there; what lies between is nearer than its middle by little
                low = ti.max(low, d + along, ti.cast(0.05, self.fp) * d)
            if last or low >= wanted or low >= half * nearest:
                least = ti.min(least, low)
                while level > 0 and (code & 3) == 3:
                    code = code >> 2
                    level -= 1
                code += 1
                if level == 0:
                    level = -1
            else:
                code = code << 2
                level += 1
        return ti.select(nearest <= 0, nearest, least)

    @traced
    def part_of(self, part, M, inner):
        """Corners of a part of a face whose nodes have the rows M."""
        return self.part_of_curved(part, M, inner) if self.features.curved else self.part_of_flat(part, M)

    @ti.func
    def part_of_flat(self, part, M):
        return part @ M

    @ti.func
    def part_of_curved(self, part, M, inner):
        out = self.rows(0)
        for c in ti.static(range(3)):
            x = self.mix(self.node_weights(ti.Vector([part[c, 0], part[c, 1], part[c, 2]]), inner), M)
            for m in ti.static(range(3)):
                out[c, m] = x[m]
        return out

    @ti.func
    def middle_of_part(self, part, M, inner):
        s = ti.Vector.zero(self.fp, 3)
        for c in ti.static(range(3)):
            s[c] = ti.cast(1 / 3, self.fp) * (part[0, c] + part[1, c] + part[2, c])
        return self.mix(self.node_weights(s, inner), M)

    @ti.func
    def is_inner(self, j, plan: A):
        """Whether a face is the triangle between the three others of a curved one; of vertices it does not matter."""
        return j >= plan.num_vertices and (j - plan.num_vertices) % 4 == 3

    @ti.func
    def corners_at(self, g: A, k, j, t, scene: A, way: A, at: A):
        """(X, u) of a face, relative to obstacle n, when the share t of the step is done: rows of its nodes."""
        X, u, n = self.rows(0), self.rows(0), g.number + k
        for a in ti.static(range(self.nodes)):
            i = way.corners[self.nodes * j + a]
            x, y = scene.rest[i] - way.places[n], at.u[0, i] + t * (way.step[0, i] - way.drifts[n])
            if ti.static(g.force.turns):
                c, q = self.turned.about(g, g.first + k * g.size, scene.parameters), self.rotation(g, k, t, way)
                x = self.turned.long(c + turning.turned(q, -1, self.turned.short(x) - c, self.fp))
                y = self.turned.long(turning.turned(q, -1, self.turned.short(y), self.fp))
            for c in ti.static(range(3)):
                X[a, c], u[a, c] = x[c], y[c]
        return X, u

    @ti.func
    def rotation(self, g: A, k, t, way: A):
        """Unit quaternion of an obstacle that turns when the share t of the step is done."""
        n = self.place_of_turn(g, k)
        return turning.at_share(self.turned.short(way.places[n]), self.turned.short(way.drifts[n]), t, self.fp)

    @traced
    def place_of_turn(self, g, k):
        return self.num_obstacles + MORE // 3 * (g.turning + k)

    @ti.func
    def speed_of(self, g: A, k, j, most, scene: A, way: A, at: A):
        """What a point of a face does not go farther than in the step, as the obstacle sees it [m].

        Of one that turns by psi, w = step - drift and r the arm: |w - psi x r| + most |psi| |w|, for r goes on by w.
        """
        speed, n = ti.cast(0, self.fp), g.number + k
        for a in ti.static(range(self.nodes)):
            i = way.corners[self.nodes * j + a]
            w = way.step[0, i] - way.drifts[n]
            if ti.static(g.force.turns):
                c = self.turned.about(g, g.first + k * g.size, scene.parameters)
                r = self.turned.short(scene.rest[i] - way.places[n] + at.u[0, i]) - c
                psi, ahead = self.turned.short(way.drifts[self.place_of_turn(g, k)]), self.turned.short(w)
                across = self.length(ahead - psi.cross(r)) + most * self.length(psi) * self.length(ahead)
                speed = ti.max(speed, across)
            else:
                speed = ti.max(speed, self.length(w))
        if ti.static(self.features.curved):
            speed *= ti.cast(MOST_SHARES, self.fp)
        return speed

    @ti.func
    def share_of_one(self, g: A, k, j, inner, scene: A, way: A, at: A, most, kept):
        """The free share of the step of vertex or face j before obstacle k of group g; all of it from within. Where the
        obstacle is met, the share `kept` of the distance, or of the width if that is less, is kept."""
        first = g.first + k * g.size
        width, none = g.force.width(scene.parameters, first), ti.cast(0, self.fp)
        speed = self.speed_of(g, k, j, most, scene, way, at)
        t, free, near, halt, share = none, none, none, none, most
        for m in range(MARCHES):
            left = speed * (most - t)
            X, u = self.corners_at(g, k, j, t, scene, way, at)
            d = self.face_clearance(g, first, X, u, inner, scene, left, LEVELS)
            if m == 0:
                near = ti.min(d, width)
                halt = ti.cast(TINY, self.fp) * near
                if d <= 0:
                    break
            if d <= 0:  # by rounding
                share = free
                break
            if d > left:
                break
            free = t
            if d <= halt:
                if halt > ti.cast(0.5, self.fp) * kept * near:
                    share = t
                    break
                halt, t, d = kept * near, none, near  # met: go there again, and halt sooner
            t += (d - ti.cast(0.5, self.fp) * halt) / speed
            if t >= most:
                break
            if m == MARCHES - 1:
                share = t
        return share

    @ti.func
    def all_shares(self, scene: A, way: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for j in range(plan.count):
            share, blocker = plan.most, -1
            for g in ti.static(self.features.groups):
                if ti.static(self.features.reaches(g)) or j < plan.num_vertices:
                    for k in range(g.count):
                        s = self.share_of_one(g, k, j, self.is_inner(j, plan), scene, way, at, plan.most, plan.kept)
                        if s < share:
                            share = s
                            blocker = g.number + k
            out.found[j] = share
            out.blocker[j] = blocker

    @cached_property
    def shares(self) -> Kernel:
        return self._kernel("shares", self.all_shares)

    # ---- distances ---------------------------------------------------------------------------------------------------

    @ti.func
    def all_distances(self, scene: A, way: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for j in range(plan.count):
            least, blocker, none = plan.most, -1, ti.cast(0, self.fp)
            for g in ti.static(self.features.groups):
                if ti.static(self.features.reaches(g)) or j < plan.num_vertices:
                    for k in range(g.count):
                        X, u = self.corners_at(g, k, j, none, scene, way, at)
                        inner, first = self.is_inner(j, plan), g.first + k * g.size
                        d = self.face_clearance(g, first, X, u, inner, scene, plan.most, FINEST)
                        if d < least:
                            least = d
                            blocker = g.number + k
            out.found[j] = least
            out.blocker[j] = blocker

    @cached_property
    def distances(self) -> Kernel:
        """Distances below `most`, at the places and displacements given; those of faces by half too small at most."""
        return self._kernel("distances", self.all_distances)


def swept_kernels(features: Features, precision: str, parallel: bool) -> SweptKernels:
    """Kernels for a scene's features."""
    return kernels_of(SweptKernels, features.of_state(), precision, parallel)
