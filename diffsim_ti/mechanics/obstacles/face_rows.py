"""Faces against obstacles in an explicit pass: their nodes as rows of a matrix, and how near they are."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.face_lattice import BENT
from diffsim_ti.mechanics.obstacles.limited_displacement import LimitedDisplacement
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.state.obstacle_poses import MORE
from diffsim_ti.terms.obstacles import turning

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class FaceRows(LimitedDisplacement):
    """Taichi functions of one face f; g is a group of obstacles, k a place in it (state/features.py).

    Where plan.between, obstacles are where the state is evaluated between passes, not where pass `now` begins.
    """

    @property
    def groups(self):
        """Obstacles that can reach into a face between its corners."""
        return tuple(group for group in self.features.groups if group.force.watched and self.features.reaches(group))

    @ti.func
    def where(self, g: A, k, now: A, scene: A, faces: A, plan: A):
        """Displacement of an obstacle, of one that turns with its unit quaternion behind."""
        place = self.offset(g, k, faces)
        if plan.between == 0:
            place = self.place(g, k, now, scene.path)
        return place

    @traced
    def offset(self, g, k, faces):
        shift = let(at(faces.offsets, 3 * (g.number + k)))
        if not g.force.turns:
            return shift
        s = self.turned.short(at(faces.offsets, 3 * self.num_obstacles + MORE * (g.turning + k)))
        return self.turned.joined(shift, turning.from_rodrigues(s, self.fp), 4)

    @traced
    def inner(self, f):
        """Whether a triangle is the one between the three others of a curved face."""
        return let(f % 4 == 3) if self.features.curved else None

    # ---- nodes as an obstacle that turns was made; others are seen as they are ---------------------------------------

    @traced
    def made_rows(self, g, k, f, place, scene, faces):
        """Rest positions of the corners of a face relative to an obstacle at a place."""
        if not g.force.turns:
            return self.rest_rows(f, scene.rest, place, faces)
        return self.made_of(g, k, f, place, scene, faces)

    @ti.func
    def made_of(self, g: A, k, f, place, scene: A, faces: A):
        c, q = self.turned.about(g, g.first + k * g.size, scene.parameters), self.turned.quaternion(place)
        out = self.rest_rows(f, scene.rest, self.turned.long(place), faces)
        for a in ti.static(range(self.nodes)):
            x = c + turning.turned(q, -1, self.turned.short(self.row_of(out, a)) - c, self.fp)
            for m in ti.static(range(3)):
                out[a, m] = x[m]
        return out

    @traced
    def turned_rows(self, g, place, sign, rows):
        """Rows turned as the obstacle is, or with sign -1 back."""
        return self.all_turned(self.turned.quaternion(place), sign, rows) if g.force.turns else rows

    @ti.func
    def all_turned(self, q, sign: ti.template(), rows):
        out = rows
        for a in ti.static(range(self.nodes)):
            x = turning.turned(q, sign, self.turned.short(self.row_of(rows, a)), self.fp)
            for m in ti.static(range(3)):
                out[a, m] = x[m]
        return out

    @ti.func
    def way_between(self, g: A, k, f, u0, begin, u1, end, now: A, scene: A, faces: A):
        """Rows of the corners' moves from u0 to u1, and shares of the step, as the obstacle was made."""
        before, after = self.place_at(g, k, begin, now, scene.path), self.place_at(g, k, end, now, scene.path)
        X0, X1 = self.made_rows(g, k, f, before, scene, faces), self.made_rows(g, k, f, after, scene, faces)
        return (X1 - X0) + (self.turned_rows(g, after, -1, u1) - self.turned_rows(g, before, -1, u0))

    @ti.func
    def middle_of(self, f, M):
        """The row of the middle of a face."""
        one = ti.cast(1 / 3, self.fp)
        return self.mix(self.node_weights(ti.Vector([one, one, one]), self.inner(f)), M)

    @ti.func
    def longest(self, M):
        """Length of the longest of the first three rows."""
        most = ti.cast(0, self.fp)
        for a in ti.static(range(3)):
            most = ti.max(most, M[a, 0] * M[a, 0] + M[a, 1] * M[a, 1] + M[a, 2] * M[a, 2])
        return ti.sqrt(most)

    @ti.func
    def size_of_rows(self, f, M):
        """How long what rows say of the nodes of face f is at most at a point of it."""
        size = self.longest(M)
        if ti.static(self.features.curved):
            size += self.arch(M, self.inner(f))
        return size

    @ti.func
    def rows_at(self, f, array: A, slot, faces: A):
        """array[slot, i] at the nodes of a face."""
        out = self.rows(0)
        for a in ti.static(range(self.nodes)):
            x = array[slot, faces.corners[self.nodes * f + a]]
            for m in ti.static(range(4)):
                out[a, m] = x[m]
        return out

    @ti.func
    def rows_of(self, f, array: A, k, faces: A):
        """array[k, s] of the surface vertices that are the nodes of a face."""
        out = self.rows(0)
        for a in ti.static(range(self.nodes)):
            x = array[k, faces.own[self.nodes * f + a]]
            for m in ti.static(range(4)):
                out[a, m] = x[m]
        return out

    @ti.func
    def rest_rows(self, f, rest: A, place, faces: A):
        """rest[i] - place at the nodes of a face."""
        out = self.rows(0)
        for a in ti.static(range(self.nodes)):
            x = rest[faces.corners[self.nodes * f + a]] - place
            for m in ti.static(range(3)):
                out[a, m] = x[m]
        return out

    # ---- what is noted -------------------------------------------------------------------------------------------------

    @ti.func
    def nearest(self, g: A, k, f, X, u, move, scene: A, faces: A):
        """The least distance d of the points of face f, now or, along the normal, on the way `move` that led here.

        Where a point is nearer than r, so that what lies between points may be in the obstacle, d - r.
        """
        first, row = g.first + k * g.size, f * ti.static(self.num_obstacles) + g.number + k
        parts, reach, least = faces.parts[row], faces.reach[row], ti.cast(1e30, self.fp)
        per, gaps = ti.cast(1, self.fp) / ti.cast(parts, self.fp), ti.Vector.zero(self.fp, 3)
        width = g.force.width(scene.parameters, first)
        for a in range(3):
            d = g.force.gap(scene.parameters, first, self.row_of(X, a), self.row_of(u, a))
            for b in ti.static(range(3)):
                gaps[b] = ti.select(a == b, d, gaps[b])
        step, felt = self.step_of_lattice(X, u, per, self.inner(f)), width + reach + self.size_of_rows(f, move)
        for x in range(parts + 1):
            onwards = 0
            for y in range(parts + 1 - x):
                if y >= onwards:
                    s1, s2 = x * per, y * per
                    s = ti.Vector([1 - s1 - s2, s1, s2])
                    N = self.node_weights(s, self.inner(f))
                    now = g.force.contact_plane(scene.parameters, first, self.mix(N, X), self.mix(N, u))
                    ahead, _ = self.passed(g, now[3], felt, step, parts)
                    onwards = y + 1 + ahead
                    d, before = now[3], now[3] - self.dot3(now, self.mix(N, move))
                    bent = s.dot(gaps) - d > ti.cast(BENT, self.fp) * width
                    if bent and d <= reach:
                        d -= reach
                    if before <= 0 and (bent or d <= 0):
                        d = ti.min(d, before)
                    if bent or d <= 0:
                        least = ti.min(least, d)
        return least

    # ---- what faces do to their nodes ---------------------------------------------------------------------------------

    @ti.func
    def direct(self, f):
        """Without the fourth component."""
        out = f
        out[3] = ti.cast(0, self.fp)
        return out

    @ti.func
    def store(self, f, rows, faces: A):
        for a in ti.static(range(self.nodes)):
            x = self.vector(0)
            for m in ti.static(range(4)):
                x[m] = rows[a, m]
            faces.share[self.nodes * f + a] = x

    @property
    def rough(self) -> bool:
        """Whether some obstacle has friction at points within faces."""
        return any(g.force.friction for g in self.groups)

    @traced
    def pushed_row(self, f, o, a):
        """Place in `impulse` of node a of face f and obstacle o."""
        return let((f * self.num_obstacles + o) * self.nodes + a)
