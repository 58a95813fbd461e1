"""Points within curved faces, which lie on them by their six nodes (mesh/curved_triangles.py), in the energy of faces.py.

d_a stay the distances of a triangle's own corners, so that t is what the bow of the face adds as well. Obstacles that are
flat or hollow, to which no point of a flat triangle is nearer than its corners, act by

    E = k c w^2 beta(s) h(1 - r),    r = sum_a s_a beta(d_a / w) / beta(s),    h(x) = x^3 (6 - 8 x + 3 x^2) for x > 0

what the corners' barriers do not say already: nothing on a flat triangle, for beta is convex, all of it where no corner
is near, and C2 between. There r of the distances is 0, c is 1 at most, and lattices are as fine as the arch asks for.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.face_lattice import FLAT, felt, point_curvatures, point_energy, point_slopes
from diffsim_ti.mechanics.obstacles.obstacle_functions import ObstacleFunctions

A = ti.template()
MOST_SHARES = 5 / 3  # sum of the sizes of six shape functions at a point, at most


@dataclass(frozen=True)
class CurvedPoints(ObstacleFunctions):
    """Sums over the points of the triangles on which vertex i has a part. See FacePoints for what they are asked for."""

    @ti.func
    def around_curved(self, what: A, g: A, k, i, scene: A, pass_: A, at: A, more: A):
        out, first, n = self.vector(0), g.first + k * g.size, g.number + k
        v_obstacle, width, q = pass_.poses[3 * n], g.force.width(scene.parameters, first), self.turn_of(g, k, pass_)
        X0, u0 = self.made(g, first, q, scene.rest[i] - v_obstacle, at.u[0, i], scene)
        own = g.force.clearance(scene.parameters, first, X0, u0)[3]
        for c in range(pass_.face_start[i], pass_.face_start[i + 1]):
            row, most, six = c * ti.static(self.num_obstacles) + n, ti.cast(0, self.fp), ti.Vector([0] * 6)
            spot, inner = pass_.face_next[8 * c + 6], pass_.face_next[8 * c + 7]
            X, u, w = self.rows(0), self.rows(0), self.rows(0)
            for a in ti.static(range(6)):
                six[a] = pass_.face_next[8 * c + a]
                x, y = self.made(g, first, q, scene.rest[six[a]] - v_obstacle, at.u[0, six[a]], scene)
                z = self.change_of(what, g, k, six[a], at, pass_, scene, more)
                if ti.static(what == "column"):
                    z = self.moved_alone(more, a == spot)
                z = self.turned_by(g, q, -1, z)
                edge = (x - X0) + (y - u0)
                most = ti.max(most, edge.norm_sqr())
                for m in ti.static(range(4)):
                    X[a, m], u[a, m], w[a, m] = x[m], y[m], z[m]
            if own - ti.cast(MOST_SHARES, self.fp) * ti.sqrt(most) < width + pass_.face_reach[row]:
                parts, weight, grown = pass_.face_parts[row], pass_.face_weight[row], ti.cast(0, self.fp)
                if ti.static(g.force.per_area):
                    normal, area = self.normal_of(scene.rest[six[0]], scene.rest[six[1]], scene.rest[six[2]])
                    weight = area / ti.cast(parts * parts, self.fp)  # of one of the small triangles
                    if ti.static(what == "jvp"):
                        for a in ti.static(range(3)):
                            across = scene.rest[six[(a + 2) % 3]] - scene.rest[six[(a + 1) % 3]]
                            slope = ti.cast(0.5, self.fp) / area * normal.cross(self.short(across))
                            grown += slope.dot(self.short(more.rest[six[a]]))
                reach = pass_.face_reach[row]
                found = self.points_of_curved(
                    what, g, first, X, u, w, reach, weight, grown, parts, spot, inner, i, scene, more
                )
                if ti.static(what == "numbers" and g.force.per_area and self.features.shape):
                    more.face_areas[c] = more.face_areas[c] + found[0] / weight / ti.cast(parts * parts, self.fp)
                out += found
        if ti.static(what != "energy"):
            out = self.turned_by(g, q, 1, out)
        return out

    @ti.func
    def moved_alone(self, d, moves):
        """Component d of one node moves by 1, if it is the one that `moves`."""
        out = self.vector(0)
        for m in ti.static(range(3)):
            out[m] = ti.select(d == m and moves, ti.cast(1, self.fp), ti.cast(0, self.fp))
        return out

    @ti.func
    def may_be_nearer(self, g: A, first, X, u, corners, inner, scene: A):
        """More than 0 if a point of a triangle may have some energy, whose corners say the rows `corners`."""
        out, arch, one = ti.cast(1e30, self.fp), self.arch(X + u, inner), ti.cast(1 / 3, self.fp)
        if ti.static(g.force.hollow):
            out = arch  # to what is flat or hollow, no point of the flat triangle is
        elif ti.static(g.force.convex):  # which is never nearer than the tangent plane at the middle says
            W = self.node_weights(ti.Vector([one, one, one]), inner)
            Xm, um, out = self.mix(W, X), self.mix(W, u), ti.cast(0, self.fp)
            middle = g.force.contact_plane(scene.parameters, first, Xm, um)
            for a in ti.static(range(3)):
                along = ti.cast(0, self.fp)
                for m in ti.static(range(3)):
                    along += middle[m] * ((X[a, m] - Xm[m]) + (u[a, m] - um[m]))
                out = ti.max(out, corners[a, 3] - middle[3] - along)
            out += arch - ti.cast(FLAT, self.fp) * g.force.width(scene.parameters, first)
        return out

    @ti.func
    def points_of_curved(
        self, what: A, g: A, first, X, u, w, reach, one, thicker, parts, spot, inner, i, scene: A, more: A
    ):
        """The sum over the points of a triangle as whose node number `spot` vertex i stands; X, u, w: rows of its nodes;
        thicker: share by which the weight changes. Of "numbers" the sum of force . at.w."""
        out, by, per = self.vector(0), self.rows(0), ti.cast(1, self.fp) / ti.cast(parts, self.fp)
        stiffness, width = scene.parameters[first + g.force.index.stiffness], g.force.width(scene.parameters, first)
        corners, turns, wi = self.rows(0), self.rows(0), self.row_of(w, spot)
        for a in range(3):
            seen = self.corner(g, first, self.row_of(X, a), self.row_of(u, a), scene)
            for m in ti.static(range(4)):
                for b in ti.static(range(3)):
                    corners[b, m] = ti.select(a == b, seen[m], corners[b, m])
        if self.may_be_nearer(g, first, X, u, corners, inner, scene) > 0:
            if ti.static(what in ("product", "column", "jvp")):
                for a in range(3):
                    x, y, z = self.row_of(X, a), self.row_of(u, a), self.row_of(w, a)
                    t = self.corner_turn(what, g, first, x, y, z, scene, more)
                    for m in ti.static(range(4)):
                        for b in ti.static(range(3)):
                            turns[b, m] = ti.select(a == b, t[m], turns[b, m])
            ni, ti_ = self.row_of(corners, spot), self.row_of(turns, spot)  # nothing of a node that is no corner
            step = self.step_of_lattice(X, u, per, inner)
            for x in range(parts + 1):
                onwards = 0
                for y in range(parts + 1 - x):
                    if y >= onwards:
                        s1, s2 = x * per, y * per
                        s = ti.Vector([1 - s1 - s2, s1, s2])
                        W, of_corner = self.node_weights(s, inner), ti.cast(0, self.fp)
                        own = ti.cast(0, self.fp)
                        for a in ti.static(range(6)):
                            own = ti.select(spot == a, W[a], own)
                            if ti.static(a < 3):
                                of_corner = ti.select(spot == a, s[a], of_corner)
                        Xs, us = self.mix(W, X), self.mix(W, u)
                        now = g.force.contact_plane(scene.parameters, first, Xs, us)
                        ahead, _ = self.passed(g, now[3], width + reach, step, parts)
                        onwards = y + 1 + ahead
                        sigma = (now[3] - reach) / width
                        said = s[0] * corners[0, 3] + s[1] * corners[1, 3] + s[2] * corners[2, 3]
                        t = self.besides(g, said, now[3]) / width
                        if x < parts and y < parts and x + y > 0 and felt(sigma, t, g.force, self.fp):
                            weight = one
                            if ti.static(g.force.per_area):  # the face beyond an edge has its own half
                                weight = ti.select(x > 0 and y > 0 and x + y < parts, one + one, one)
                            scale = 0 - weight * stiffness * width
                            if ti.static(what == "energy"):
                                out[0] += (
                                    of_corner
                                    * weight
                                    * stiffness
                                    * width
                                    * width
                                    * point_energy(sigma, t, g.force, self.fp)
                                )
                            elif ti.static(what == "force"):
                                Fs, Ft = point_slopes(sigma, t, g.force, self.fp)
                                out += scale * (self.besides(g, Fs, Ft) * own * now + Ft * of_corner * ni)
                            elif ti.static(what == "numbers"):
                                Fs, Ft = point_slopes(sigma, t, g.force, self.fp)
                                Fss, Fst, Ftt = point_curvatures(sigma, t, g.force, self.fp)
                                along, across = own * self.dot3(now, wi), of_corner * self.dot3(ni, wi)
                                by_s = scale * (self.besides(g, Fss, Fst) * along + Fst * across)
                                by_t = scale * (self.besides(g, Fst, Ftt) * along + Ftt * across)
                                push = self.besides(g, Fs, Ft)
                                f, by_now = scale * (push * along + Ft * across), scale * push * own * wi
                                by_now[3] = self.besides(g, by_s, by_t) / width
                                g.force.contact_plane_vjp(scene.parameters, first, Xs, us, by_now, more.sums, i)
                                for a in ti.static(range(3)):
                                    of_a = ti.select(spot == a, scale * Ft * s[a], ti.cast(0, self.fp))
                                    for m in ti.static(range(3)):
                                        by[a, m] += of_a * wi[m]
                                    by[a, 3] += s[a] * by_t / width
                                at_k, at_w = first + g.force.index.stiffness, first + g.force.index.width
                                more.sums[at_k, i] = more.sums[at_k, i] + f / stiffness
                                more.sums[at_w, i] = more.sums[at_w, i] + (f - sigma * by_s - t * by_t) / width
                                out[0] += f
                            else:
                                Fs, Ft = point_slopes(sigma, t, g.force, self.fp)
                                Fss, Fst, Ftt = point_curvatures(sigma, t, g.force, self.fp)
                                dn = self.turn(what, g, first, Xs, us, self.mix(W, w), scene, more)
                                ds = dn[3] / width
                                said = s[0] * turns[0, 3] + s[1] * turns[1, 3] + s[2] * turns[2, 3]
                                dt = self.besides(g, said, dn[3]) / width
                                grown = ti.cast(0, self.fp)
                                if ti.static(what == "jvp"):
                                    dwidth = more.parameters[first + g.force.index.width] / width
                                    ds, dt = ds - sigma * dwidth, dt - t * dwidth
                                    grown = (
                                        thicker + more.parameters[first + g.force.index.stiffness] / stiffness + dwidth
                                    )
                                dFs, dFt = Fss * ds + Fst * dt + grown * Fs, Fst * ds + Ftt * dt + grown * Ft
                                out += scale * own * (self.besides(g, dFs, dFt) * now + self.besides(g, Fs, Ft) * dn)
                                out += scale * of_corner * (dFt * ni + Ft * ti_)
        if ti.static(what == "numbers"):
            self.corners_vjp(g, first, X, u, by, scene, more, i)
        if ti.static(what != "energy"):
            out[3] = 0
        return out
