"""Contact of points within a face with an obstacle that its corners do not resolve.

    E = k c w^2 beta(s) phi(t),    s = (d - r) / w,    t = (sum_a s_a d_a - d) / w

d [m]: distance of the point, whose shares of the corners are s_a; d_a: those of the corners; k, w, beta: the obstacle's
stiffness, width and barrier (terms/obstacles/barrier.py); r: how far what lies between the points is from them; c: the
square of their distance in widths, so that the points in a square of one width are together as stiff as a vertex. t is how
much nearer the point is than its corners let expect: nothing before what is flat, hollow or far larger than the face, so
that it costs nothing there; before a needle, an edge or a corner the point is in contact as a vertex is. phi rises
from 0 to 1 between t = FLAT and BENT and is C2.

With a stiffness per area k, vertices and points are one integral over the surface. A vertex stands for a third of the
faces around it, as if distances were linear within them; a point says how much more there is, on its area c at rest,

    E = k c w^2 (beta(s) - beta(s + t)) phi(t)

s + t being the distance that the corners let expect. The areas of a face's lattice points sum up to the face's, those of
the corners included, and give each corner its third of it, so that nothing counts twice: where phi = 1 what the corners
said of a point is taken back, and its own energy stands. What is much narrower than a face touches little of it, and has
to stop as much of the body as vertices carry: phi grows on as 1 + 8 t^2, which refinement takes back. The sum
does not grow with the number of points, but for r, which is 0.16 w at most and lets a point touch what lies between it and
the next.
The points of a face lie on a lattice, a quarter of a width apart or closer, but for its largest number; corners are none of
them.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.curved_faces import CurvedPoints
from diffsim_ti.mechanics.obstacles.face_lattice import FLAT, point_curvatures, point_energy, point_slopes
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.state.obstacle_poses import MORE
from diffsim_ti.terms.obstacles import turning

A = ti.template()


@dataclass(frozen=True)
class FacePoints(CurvedPoints):
    """Sums over the points of the faces around vertex i, each with what it says of that vertex."""

    @ti.func
    def change_at(self, what: A, i, n, at: A, more: A):
        """How vertex i moves, relative to obstacle n."""
        w = self.vector(0)
        if ti.static(what in ("product", "numbers")):
            w = at.w[0, i]
        if ti.static(what == "jvp"):
            w = at.w[0, i] + more.rest[i] - more.poses[3 * n]
        return w

    @ti.func
    def around(self, what: A, i, scene: A, pass_: A, at: A, more: A):
        """The sum over the points around vertex i of: "energy" (in the first component), "force", "product" with at.w;
        "column" `more` of the product's matrix; "jvp" for changes `more` besides."""
        out = self.vector(0)
        for g in ti.static(self.features.groups):
            if ti.static(self.features.reaches(g)):
                for k in range(g.count):
                    found = self.around_one(what, g, k, i, scene, pass_, at, more)
                    out += self.with_turn(what, g, k, i, found, scene, pass_, at, more)
        return out

    @traced
    def around_one(self, what, g, k, i, scene, pass_, at, more):
        """The same of obstacle k of group g alone; of "numbers" nothing, but their adjoints for the adjoint at.w of the
        force go to `more`."""
        around = self.around_curved if self.features.curved else self.around_flat
        return around(what, g, k, i, scene, pass_, at, more)

    @ti.func
    def around_flat(self, what: A, g: A, k, i, scene: A, pass_: A, at: A, more: A):
        out, first, n = self.vector(0), g.first + k * g.size, g.number + k
        v_obstacle, width, q = pass_.poses[3 * n], g.force.width(scene.parameters, first), self.turn_of(g, k, pass_)
        X0, u0 = self.made(g, first, q, scene.rest[i] - v_obstacle, at.u[0, i], scene)
        own = g.force.clearance(scene.parameters, first, X0, u0)[3]
        for c in range(pass_.face_start[i], pass_.face_start[i + 1]):
            row = c * ti.static(self.num_obstacles) + n
            reach, size, i3 = pass_.face_reach[row], ti.cast(0, self.fp), ti.Vector([i, 0, 0])
            X, u, w = self.rows(0), self.rows(0), self.rows(0)
            for a in ti.static(range(3)):
                if ti.static(a > 0):
                    i3[a] = pass_.face_next[2 * c + a - 1]
                x, y = self.made(g, first, q, scene.rest[i3[a]] - v_obstacle, at.u[0, i3[a]], scene)
                z = self.change_of(what, g, k, i3[a], at, pass_, scene, more)
                if ti.static(what == "column"):
                    z = self.unit(more, a)
                z = self.turned_by(g, q, -1, z)
                edge = (x - X0) + (y - u0)
                size = ti.max(size, edge.norm_sqr())
                for m in ti.static(range(4)):
                    X[a, m], u[a, m], w[a, m] = x[m], y[m], z[m]
            if own - ti.sqrt(size) < width + reach:
                parts, weight, grown = pass_.face_parts[row], pass_.face_weight[row], ti.cast(0, self.fp)
                if ti.static(g.force.per_area):
                    normal, area = self.normal_of(scene.rest[i3[0]], scene.rest[i3[1]], scene.rest[i3[2]])
                    weight = area / ti.cast(parts * parts, self.fp)  # of one of the small triangles
                    if ti.static(what == "jvp"):
                        for a in ti.static(range(3)):
                            across = scene.rest[i3[(a + 2) % 3]] - scene.rest[i3[(a + 1) % 3]]
                            slope = ti.cast(0.5, self.fp) / area * normal.cross(self.short(across))
                            grown += slope.dot(self.short(more.rest[i3[a]]))
                found = self.points_of_face(what, g, first, X, u, w, reach, weight, grown, parts, i, scene, more)
                if ti.static(what == "numbers" and g.force.per_area and self.features.shape):
                    more.face_areas[c] = more.face_areas[c] + found[0] / weight / ti.cast(parts * parts, self.fp)
                out += found
        if ti.static(what != "energy"):
            out = self.turned_by(g, q, 1, out)
        return out

    # ---- an obstacle that turns: corners as it was made, and results turned as it is. Others are seen as they are. -------

    @traced
    def turn_of(self, g, k, pass_):
        """Unit quaternion."""
        if not g.force.turns:
            return None
        row = 3 * self.num_obstacles + MORE * (g.turning + k)
        return turning.from_rodrigues(self.turned.short(at(pass_.poses, row)), self.fp)

    @traced
    def made(self, g, first, q, X, u, scene):
        """(X, u)"""
        if not g.force.turns:
            return X, u
        c = self.turned.about(g, first, scene.parameters)
        place = let(c + turning.turned(q, -1, let(self.turned.short(X) - c), self.fp))
        return self.turned.long(place), self.turned_by(g, q, -1, u)

    @traced
    def turned_by(self, g, q, sign, x):
        """R x, or R^T x."""
        return self.turned.long(turning.turned(q, sign, self.turned.short(x), self.fp)) if g.force.turns else x

    @traced
    def change_of(self, what, g, k, i, at_, pass_, scene, more):
        """How vertex i moves, relative to an obstacle."""
        if not (g.force.turns and what == "jvp"):
            return self.change_at(what, i, g.number + k, at_, more)
        dr = at(at_.w, 0, i) + at(more.rest, i)
        return self.turned.long(self.moved_with(g, k, i, dr, at(at_.u, 0, i), pass_, scene, more))

    @ti.func
    def moved_with(self, g: A, k, i, dr, u, pass_: A, scene: A, more: A):
        n, row = 3 * (g.number + k), 3 * ti.static(self.num_obstacles) + MORE * (g.turning + k)
        X = self.turned.joined(scene.rest[i] - pass_.poses[n], self.turn_of(g, k, pass_), 4)
        dplace = self.turned.joined(more.poses[n], more.poses[row])
        return self.turned.moved(g, g.first + k * g.size, X, u, dr, dplace, scene, more)

    @ti.func
    def add_turn(self, g: A, k, i, f, scene: A, pass_: A, more: A):
        """The change of a force f of vertex i that turns with the obstacle."""
        theta = self.turned.short(more.poses[3 * ti.static(self.num_obstacles) + MORE * (g.turning + k)])
        return self.turned.long(theta.cross(self.turned.short(f)))

    @ti.func
    def spread(self, g: A, k, i, by_u, scene: A, pass_: A, at: A, adjoint: A):
        """Add what adjoints by_u of a vertex's place, for the adjoint at.w of its force, say of the obstacle's."""
        n, row = 3 * (g.number + k), 3 * ti.static(self.num_obstacles) + MORE * (g.turning + k)
        if ti.static(g.force.turns):
            f = self.around_one("force", g, k, i, scene, pass_, at, at)
            turn = self.turned.short(f).cross(self.turned.short(at.w[0, i]))
            X = self.turned.joined(scene.rest[i] - pass_.poses[n], self.turn_of(g, k, pass_), 4)
            by, none = self.turned.joined(by_u, turn), ti.Vector.zero(self.fp, 3)
            first = g.first + k * g.size
            _, _, by_theta = self.turned.spread(g, first, i, X, at.u[0, i], by, none, scene, adjoint.sums)
            adjoint.poses[row, i] = adjoint.poses[row, i] + self.turned.long(by_theta)
        adjoint.poses[n, i] = adjoint.poses[n, i] - by_u
        self.add_to_rest(i, by_u, adjoint)

    @traced
    def with_turn(self, what, g, k, i, found, scene, pass_, at_, more):
        """What `around_one` found, with the turn of an obstacle that turns."""
        if not (g.force.turns and what == "jvp"):
            return found
        f = self.around_one("force", g, k, i, scene, pass_, at_, at_)
        return let(found + self.add_turn(g, k, i, f, scene, pass_, more))

    @ti.func
    def short(self, v):
        return ti.Vector([v[0], v[1], v[2]])

    @ti.func
    def normal_of(self, a, b, c):
        """(unit normal, area) of a triangle."""
        n = self.short(b - a).cross(self.short(c - a))
        size = ti.sqrt(n.norm_sqr())
        return n / size, ti.cast(0.5, self.fp) * size

    @ti.func
    def unit(self, d, a: A):
        """Component d of the first corner (a = 0) moves by 1, others by nothing."""
        out = self.vector(0)
        for m in ti.static(range(3)):
            out[m] = ti.select(d == m and a == 0, ti.cast(1, self.fp), ti.cast(0, self.fp))
        return out

    @ti.func
    def points_of_face(self, what: A, g: A, first, X, u, w, reach, weight, grown, parts, i, scene: A, more: A):
        """The sum over the points of a face whose first corner is vertex i; X, u, w: rows of its corners; grown: share by
        which the weight changes. Of "numbers" the sum of force . at.w."""
        out, per, third = self.vector(0), ti.cast(1, self.fp) / ti.cast(parts, self.fp), ti.cast(1 / 3, self.fp)
        stiffness, width = scene.parameters[first + g.force.index.stiffness], g.force.width(scene.parameters, first)
        thirds = ti.Vector([third, third, third])
        corners, turns, middle = self.rows(0), self.rows(0), self.vector(0)  # (normal, distance) there, and its change
        for a in range(4):
            x, y = self.row_of(X, a), self.row_of(u, a)
            if a == 3:
                x = self.mix(thirds, X)
                y = self.mix(thirds, u)
            seen = g.force.contact_plane(scene.parameters, first, x, y)
            for m in ti.static(range(4)):
                middle[m] = seen[m]
                for b in ti.static(range(3)):
                    corners[b, m] = ti.select(a == b, seen[m], corners[b, m])
        # a convex obstacle is never nearer than the tangent plane at the middle says
        bent = ti.cast(1e30, self.fp)
        if ti.static(g.force.convex):
            bent = ti.cast(0, self.fp)
            for a in ti.static(range(3)):
                along = ti.cast(0, self.fp)
                for m in ti.static(range(3)):
                    mean = third * (X[0, m] + X[1, m] + X[2, m]) + third * (u[0, m] + u[1, m] + u[2, m])
                    along += middle[m] * (X[a, m] + u[a, m] - mean)
                bent = ti.max(bent, corners[a, 3] - middle[3] - along)
        if bent > ti.cast(FLAT, self.fp) * width:
            if ti.static(what in ("product", "column", "jvp")):
                for a in range(3):
                    t = self.turn(what, g, first, self.row_of(X, a), self.row_of(u, a), self.row_of(w, a), scene, more)
                    for m in ti.static(range(4)):
                        for b in ti.static(range(3)):
                            turns[b, m] = ti.select(a == b, t[m], turns[b, m])
            out = self.contact_points(
                what,
                g,
                first,
                X,
                u,
                w,
                corners,
                turns,
                stiffness,
                weight,
                grown,
                width,
                reach,
                parts,
                per,
                i,
                scene,
                more,
            )
        return out

    @ti.func
    def contact_points(
        self,
        what: A,
        g: A,
        first,
        X,
        u,
        w,
        corners,
        turns,
        stiffness,
        one,
        thicker,
        width,
        reach,
        parts,
        per,
        i,
        scene: A,
        more: A,
    ):
        out, c0, t0, w0 = self.vector(0), self.row_of(corners, 0), self.row_of(turns, 0), self.row_of(w, 0)
        by = self.rows(0)  # adjoints of `corners`
        step = self.step_of_lattice(X, u, per, None)
        for x in range(parts):
            onwards = 0
            for y in range(parts - x):
                if y >= onwards:
                    s1, s2 = x * per, y * per
                    s0 = 1 - s1 - s2
                    shares = ti.Vector([s0, s1, s2])
                    Xs, us = self.mix(shares, X), self.mix(shares, u)
                    now = g.force.contact_plane(scene.parameters, first, Xs, us)
                    ahead, _ = self.passed(g, now[3], width + reach, step, parts)
                    onwards = y + 1 + ahead
                    s = (now[3] - reach) / width
                    t = (s0 * corners[0, 3] + s1 * corners[1, 3] + s2 * corners[2, 3] - now[3]) / width
                    if x + y > 0 and s < 1 and t > ti.cast(FLAT, self.fp):
                        weight = one
                        if ti.static(g.force.per_area):
                            weight = ti.select(
                                x > 0 and y > 0, one + one, one
                            )  # the face beyond an edge has its own half
                        scale = 0 - s0 * weight * stiffness * width
                        if ti.static(what == "energy"):
                            F = point_energy(s, t, g.force, self.fp)
                            out[0] += s0 * weight * stiffness * width * width * F
                        elif ti.static(what == "force"):
                            Fs, Ft = point_slopes(s, t, g.force, self.fp)
                            out += scale * (Fs * now + Ft * (c0 - now))
                        elif ti.static(what == "numbers"):
                            Fs, Ft = point_slopes(s, t, g.force, self.fp)
                            Fss, Fst, Ftt = point_curvatures(s, t, g.force, self.fp)
                            along, across = now.dot(w0), (c0 - now).dot(w0)  # w0 has no fourth component
                            by_s = scale * (Fss * along + Fst * across)
                            by_t = scale * (Fst * along + Ftt * across)
                            f = scale * (Fs * along + Ft * across)
                            by_now = scale * (Fs - Ft) * w0
                            by_now[3] = (by_s - by_t) / width
                            g.force.contact_plane_vjp(scene.parameters, first, Xs, us, by_now, more.sums, i)
                            for m in ti.static(range(3)):
                                by[0, m] += scale * Ft * w0[m]
                            by[0, 3] += s0 * by_t / width
                            by[1, 3] += s1 * by_t / width
                            by[2, 3] += s2 * by_t / width
                            at_k, at_w = first + g.force.index.stiffness, first + g.force.index.width
                            more.sums[at_k, i] = more.sums[at_k, i] + f / stiffness
                            more.sums[at_w, i] = more.sums[at_w, i] + (f - s * by_s - t * by_t) / width
                            out[0] += f
                        else:
                            Fs, Ft = point_slopes(s, t, g.force, self.fp)
                            Fss, Fst, Ftt = point_curvatures(s, t, g.force, self.fp)
                            dn = self.turn(what, g, first, Xs, us, self.mix(shares, w), scene, more)
                            ds = dn[3] / width
                            dt = (s0 * turns[0, 3] + s1 * turns[1, 3] + s2 * turns[2, 3] - dn[3]) / width
                            grown = ti.cast(0, self.fp)
                            if ti.static(what == "jvp"):
                                dwidth = more.parameters[first + g.force.index.width] / width
                                ds, dt = ds - s * dwidth, dt - t * dwidth
                                grown = thicker + more.parameters[first + g.force.index.stiffness] / stiffness + dwidth
                            out += scale * (
                                (Fss * ds + Fst * dt) * now
                                + Fs * dn
                                + (Fst * ds + Ftt * dt) * (c0 - now)
                                + Ft * (t0 - dn)
                                + grown * (Fs * now + Ft * (c0 - now))
                            )
        if ti.static(what == "numbers"):
            self.corners_vjp(g, first, X, u, by, scene, more, i)
        if ti.static(what != "energy"):
            out[3] = 0
        return out
