"""What obstacles do to points within a face in an explicit pass: forces of the energy of faces.py, and more.

Of a face and an obstacle, corner a feels

    f_a = -c k w sum_q s_a ((F_s - F_t) n + F_t n_a)    (curved: -c k w sum_q N_a (F_s - F_t) n + s_a F_t n_a)

q: points of the lattice, s_a: their shares of the corners; n, n_a: normals at the point and at the corner; F(s, t):
face_lattice.py. Beside it stands

    D_a = c k sum_q s_a beta''(s) phi(t)    [N/m]

whose sum over the faces around a vertex is no less than the stiffness that they have there, for s (x) s <= diag(s) where
shares s sum up to 1; of curved faces with 5/3 |N_a|, since N (x) N <= diag(|N|) sum |N|. It says in how many parts a pass is
to be gone (explicit_face_kernels.py).
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.curved_faces import MOST_SHARES
from diffsim_ti.mechanics.obstacles.face_lattice import (
    FLAT,
    fade,
    felt,
    hollow_stiffness,
    point_curvatures,
    point_energy,
    point_slopes,
)
from diffsim_ti.mechanics.obstacles.face_rows import FaceRows
from diffsim_ti.terms.obstacles import barrier

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class FaceForces(FaceRows):
    """Taichi functions of one face f and its forces."""

    # ---- a face and an obstacle ----------------------------------------------------------------------------------------

    @ti.func
    def face(self, what: A, g: A, k, f, X, u, w, scene: A, faces: A, out: A):
        """(rows, least) of face f, whose corners have the rows X of rest positions relative to the obstacle and u; least:
        of d - r of all its points, or less.

        Of "force" rows (f_a, D_a), the energy going to `faces`, of "push" not; of "jvp" change of f_a for changes w, those
        of the obstacle's numbers being in `out`; "vjp": adjoints of u for adjoints w of f_a, those of the obstacle's
        numbers going to `out`.
        """
        found, first, row = self.rows(0), g.first + k * g.size, f * ti.static(self.num_obstacles) + g.number + k
        reach, width = faces.reach[row], g.force.width(scene.parameters, first)
        Xm, um, around = self.middle_of(f, X), self.middle_of(f, u), self.rows(0)
        for a in ti.static(range(self.nodes)):
            for m in ti.static(range(3)):
                around[a, m] = (X[a, m] - Xm[m]) + (u[a, m] - um[m])
        middle, size = g.force.clearance(scene.parameters, first, Xm, um), self.size_of_rows(f, around)
        least = middle[3] - size - reach
        if least < width:
            least = ti.cast(1e30, self.fp)  # unless points are told apart, corners stand for them
            corners, turns = self.rows(0), self.rows(0)  # (normal, distance) there, and its change
            bent = ti.cast(1e30, self.fp)
            for a in range(3):
                seen = self.corner(g, first, self.row_of(X, a), self.row_of(u, a), scene)
                for m in ti.static(range(4)):
                    for b in ti.static(range(3)):
                        corners[b, m] = ti.select(a == b, seen[m], corners[b, m])
            # a convex obstacle is never nearer than the tangent plane at the middle says
            flat = ti.cast(FLAT, self.fp) * width
            if ti.static(g.force.hollow):  # nor one that is flat or hollow than the corners do, but by the arch
                bent, flat = self.arch(around, self.inner(f)), ti.cast(0, self.fp)
            elif ti.static(g.force.convex):
                bent = self.arch(around, self.inner(f))
                for a in ti.static(range(3)):
                    along = self.dot3(middle, self.row_of(around, a))
                    bent = ti.max(bent, corners[a, 3] - middle[3] - along)
            if bent > flat:
                if ti.static(what in ("jvp", "vjp")):
                    for a in range(3):
                        x, y, z = self.row_of(X, a), self.row_of(u, a), self.row_of(w, a)
                        t = self.corner_turn(what, g, first, x, y, z, scene, out)
                        for m in ti.static(range(4)):
                            for b in ti.static(range(3)):
                                turns[b, m] = ti.select(a == b, t[m], turns[b, m])
                found, least = self.points(
                    what, g, first, f, row, X, u, w, corners, turns, reach, width, scene, faces, out
                )
        return found, least

    @ti.func
    def points(self, what: A, g: A, first, f, row, X, u, w, corners, turns, reach, width, scene: A, faces: A, out: A):
        found, by, least = self.rows(0), self.rows(0), ti.cast(1e30, self.fp)
        parts = faces.parts[row]
        one, thicker = self.one_point(what, g, f, row, X, parts, faces, out)
        per = ti.cast(1, self.fp) / ti.cast(parts, self.fp)
        step = self.step_of_lattice(X, u, per, self.inner(f))
        for x in range(parts + 1):
            onwards = 0
            for y in range(parts + 1 - x):
                if y >= onwards:
                    s1, s2 = x * per, y * per
                    s = ti.Vector([1 - s1 - s2, s1, s2])
                    N = self.node_weights(s, self.inner(f))
                    Xs, us = self.mix(N, X), self.mix(N, u)
                    now = g.force.contact_plane(scene.parameters, first, Xs, us)
                    ahead, far = self.passed(g, now[3], width + reach, step, parts)
                    least = ti.min(least, ti.min(far, now[3]) - reach)
                    onwards = y + 1 + ahead
                    sigma = (now[3] - reach) / width
                    said = s[0] * corners[0, 3] + s[1] * corners[1, 3] + s[2] * corners[2, 3]
                    t = self.besides(g, said, now[3]) / width
                    inner = x < parts and y < parts and x + y > 0
                    weight = one
                    if ti.static(g.force.per_area):
                        weight = ti.select(x > 0 and y > 0 and x + y < parts, one + one, one)  # edges have two faces
                    if inner and felt(sigma, t, g.force, self.fp):
                        turned, mixed = self.vector(0), self.vector(0)
                        if ti.static(what in ("jvp", "vjp")):
                            mixed = self.mix(N, w)
                            turned = self.turn(what, g, first, Xs, us, mixed, scene, out)
                        if ti.static(what == "force"):
                            value = point_energy(sigma, t, g.force, self.fp)
                            stiff = weight * scene.parameters[first + g.force.index.stiffness]
                            faces.energy[f] = faces.energy[f] + stiff * width * width * value
                        found += self.point(
                            what,
                            g,
                            first,
                            s,
                            N,
                            sigma,
                            t,
                            now,
                            turned,
                            mixed,
                            corners,
                            turns,
                            weight,
                            thicker,
                            width,
                            scene,
                            out,
                        )
                        if ti.static(what == "vjp"):
                            by += self.numbers(
                                g, first, f, s, sigma, t, now, Xs, us, mixed, w, corners, weight, width, scene, out
                            )
        if ti.static(what == "vjp"):
            self.corners_vjp(g, first, X, u, by, scene, out, f)
        return found, least

    @ti.func
    def one_point(self, what: A, g: A, f, row, X, parts, faces: A, out: A):
        """(c of a point on an edge, and the share by which it changes)."""
        c, share = faces.weight[row], ti.cast(0, self.fp)
        if ti.static(g.force.per_area):
            a, b = ti.Vector.zero(self.fp, 3), ti.Vector.zero(self.fp, 3)
            for m in ti.static(range(3)):
                a[m], b[m] = X[1, m] - X[0, m], X[2, m] - X[0, m]
            n = a.cross(b)
            twice = ti.sqrt(n.norm_sqr())
            c = ti.cast(0.5, self.fp) * twice / ti.cast(parts * parts, self.fp)  # that of one of the small triangles
            if ti.static(what == "jvp"):
                da, db = ti.Vector.zero(self.fp, 3), ti.Vector.zero(self.fp, 3)
                moved = self.rest_rows(f, out.rest, self.vector(0), faces)
                if ti.static(g.force.turns):
                    moved = self.turned_rows(g, out.place, -1, moved)
                for m in ti.static(range(3)):
                    da[m], db[m] = moved[1, m] - moved[0, m], moved[2, m] - moved[0, m]
                share = n.dot(da.cross(b) + a.cross(db)) / (twice * twice)
        return c, share

    @ti.func
    def point(
        self,
        what: A,
        g: A,
        first,
        s,
        N,
        sigma,
        t,
        now,
        dn,
        mixed,
        corners,
        turns,
        weight,
        thicker,
        width,
        scene: A,
        out: A,
    ):
        """What a point adds to the rows of the corners; dn: change of (normal, distance) there."""
        found, stiffness = self.rows(0), scene.parameters[first + g.force.index.stiffness]
        scale, stiff = 0 - weight * stiffness * width, weight * stiffness
        Fs, Ft = point_slopes(sigma, t, g.force, self.fp)
        push = self.besides(g, Fs, Ft)
        if ti.static(what in ("force", "push")):
            phi, _, _ = fade(t, g.force, self.fp)
            G, of_corners = barrier.curvature(sigma, self.fp) * phi, ti.cast(0, self.fp)
            if ti.static(g.force.hollow):
                G, of_corners = hollow_stiffness(sigma, t, self.fp)
            for a in ti.static(range(3)):
                for m in ti.static(range(3)):
                    found[a, m] = scale * s[a] * (push * now[m] + Ft * corners[a, m])
                found[a, 3] = stiff * s[a] * G
            if ti.static(self.features.curved):
                for a in ti.static(range(6)):
                    for m in ti.static(range(3)):
                        found[a, m] += scale * self.beyond(N, s, a) * push * now[m]
                    found[a, 3] = ti.cast(MOST_SHARES, self.fp) * stiff * ti.abs(N[a]) * G
                    if ti.static(a < 3):
                        size = self.dot3(self.row_of(corners, a), self.row_of(corners, a))
                        found[a, 3] += stiff * s[a] * of_corners * size
        else:
            Fss, Fst, Ftt = point_curvatures(sigma, t, g.force, self.fp)
            ds, zero = dn[3] / width, ti.cast(0, self.fp)
            said = s[0] * turns[0, 3] + s[1] * turns[1, 3] + s[2] * turns[2, 3]
            dt = self.besides(g, said, dn[3]) / width
            dk, dw = zero, zero
            if ti.static(what == "jvp"):
                dk = thicker + out.parameters[first + g.force.index.stiffness] / stiffness
                dw = out.parameters[first + g.force.index.width] / width
                ds, dt = ds - sigma * dw, dt - t * dw
            dFs, dFt = Fss * ds + Fst * dt, Fst * ds + Ftt * dt
            dpush = self.besides(g, dFs, dFt)
            for a in ti.static(range(3)):
                for m in ti.static(range(3)):
                    found[a, m] = scale * s[a] * (dpush * now[m] + push * dn[m])
                    found[a, m] += scale * s[a] * (dFt * corners[a, m] + Ft * turns[a, m])
                    if ti.static(what == "jvp"):
                        found[a, m] += (dk + dw) * scale * s[a] * (push * now[m] + Ft * corners[a, m])
            if ti.static(self.features.curved):
                for a in ti.static(range(6)):
                    more = scale * self.beyond(N, s, a)
                    for m in ti.static(range(3)):
                        found[a, m] += more * ((dpush + (dk + dw) * push) * now[m] + push * dn[m])
        return found

    @ti.func
    def beyond(self, N, s, a: A):
        """What node a of a curved face has of a point besides its share as a corner."""
        more = N[a]
        if ti.static(a < 3):
            more -= s[a]
        return more

    @ti.func
    def numbers(self, g: A, first, f, s, sigma, t, now, Xs, us, mixed, w, corners, weight, width, scene: A, out: A):
        """Adjoints of (normal, distance) at the corners; adds those of the obstacle's numbers."""
        by, stiffness = self.rows(0), scene.parameters[first + g.force.index.stiffness]
        scale = 0 - weight * stiffness * width
        Fs, Ft = point_slopes(sigma, t, g.force, self.fp)
        Fss, Fst, Ftt = point_curvatures(sigma, t, g.force, self.fp)
        along, across = self.dot3(now, mixed), ti.cast(0, self.fp)
        for a in ti.static(range(3)):
            across += s[a] * (corners[a, 0] * w[a, 0] + corners[a, 1] * w[a, 1] + corners[a, 2] * w[a, 2])
        push = self.besides(g, Fs, Ft)
        by_s = scale * (self.besides(g, Fss, Fst) * along + Fst * across)
        by_t = scale * (self.besides(g, Fst, Ftt) * along + Ftt * across)
        of_force, by_now = scale * (push * along + Ft * across), scale * push * mixed
        by_now[3] = self.besides(g, by_s, by_t) / width
        g.force.contact_plane_vjp(scene.parameters, first, Xs, us, by_now, out.sums, f)
        for a in ti.static(range(3)):
            for m in ti.static(range(3)):
                by[a, m] = scale * Ft * s[a] * w[a, m]
            by[a, 3] = s[a] * by_t / width
        at_k, at_w = first + g.force.index.stiffness, first + g.force.index.width
        out.sums[at_k, f] = out.sums[at_k, f] + of_force / stiffness
        if ti.static(g.force.per_area):
            out.by_areas[f] = out.by_areas[f] + of_force
        out.sums[at_w, f] = out.sums[at_w, f] + (of_force - sigma * by_s - t * by_t) / width
        return by
