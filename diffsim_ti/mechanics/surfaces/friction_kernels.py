"""Kernels of friction between the pairs of a surface in implicit passes: what presses where a pass begins."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import ListedPair, behind, first_of, three
from diffsim_ti.mechanics.surfaces.proximity import BY_FIRST, BY_SECOND, EDGE_EDGE, VERTEX_TRIANGLE
from diffsim_ti.runtime import A, as_kernel
from diffsim_ti.terms.obstacles import barrier
from diffsim_ti.terms.self_contact import SelfContact

OWN = dict(weights="vectors", pressing="vectors", label="ints", row_of="ints")
DOT = dict(weights_dot="vectors", pressing_dot="vectors")
SUMS = dict(numbers="vectors", mu_adj="scalars", sums="vectors", rest_adj="vectors")
CHANGED = dict(u="vectors2", w="vectors2", rest_dot="vectors", parameters_dot="scalars")
ADJ = dict(weights_adj="vectors", pressing_adj="vectors")


@dataclass(frozen=True)
class FrictionKernels(ListedPair):
    """`weights` and `pressing`, (n, mu N), of each pair, 0 where it does not press.

    Parameters after stiffness and width: friction speed, coefficients. `row_of` has that of two labels of vertices, or -1.
    `weights_dot` and `pressing_dot`, `weights_adj` and `pressing_adj` are changes and adjoints of `weights` and `pressing`.
    """

    num_labels: int

    @ti.func
    def row(self, p, scene: A):
        """Which coefficient pair p has, or -1; of contacts of obstacles they follow those of bodies."""
        of_obstacle = -1
        if ti.static(self.mixed):
            of_obstacle = self.contact_of(p, scene) - 1
        a, b = scene.label[scene.place[scene.pairs[4 * p]]], scene.label[scene.place[scene.pairs[4 * p + 2]]]
        out = scene.row_of[a * self.num_labels + b]
        if of_obstacle >= 0:
            out = scene.row_of[self.num_labels * self.num_labels + of_obstacle]
        return out

    @ti.func
    def at_mu(self, row, scene: A):
        """Where among the parameters a coefficient stands."""
        out = self.first + SelfContact.index.friction + row
        if ti.static(self.mixed):
            out = scene.at_row[row]
        return out

    @ti.func
    def mu(self, p, scene: A):
        k, out = self.row(p, scene), ti.cast(0, self.fp)
        if k >= 0:
            out = scene.parameters[self.at_mu(k, scene)]
        return out

    @ti.func
    def sum_of_corners(self, s, scene: A):
        """What the pairs of surface vertex s with friction have stored for it."""
        total = self.vec4(0)
        for k in range(scene.row[s], scene.row[s + 1]):
            if scene.pressing[scene.corner_of[k] >> 2][3] > 0:
                total += scene.corner[scene.corner_of[k]]
        return total

    # ---- where pair p presses, at corners y1, y2, y3 relative to corner 0 (proximity.py) ----------------------------------

    @ti.func
    def fading(self, kind: A, p, y1, y2, y3, scene: A, plan: A):
        """(m, dm / dq, x): of edges that become parallel."""
        m, by_q, x = ti.cast(1, self.fp), ti.cast(0, self.fp), self.vec3(0)
        if ti.static(kind == EDGE_EDGE):
            x = self.scale_of(kind, p, scene, plan) * y1.cross(y3 - y2)
            m, by_q, _ = self.mollifier(x.norm_sqr())
        return m, by_q, x

    @ti.func
    def pressed(self, kind: A, p, y1, y2, y3, scene: A, plan: A):
        """(weights w of the corners, unit normal n, N >= 0 [N])"""
        stiffness, width = self.numbers(p, scene)
        w, r, _ = self.nearest(kind, y1, y2, y3)
        length = ti.sqrt(r.norm_sqr())
        d, N = length - self.radius_of(p, scene), ti.cast(0, self.fp)
        n = r / ti.max(length, ti.cast(self.tiny, self.fp))
        if d < width:
            m, _, _ = self.fading(kind, p, y1, y2, y3, scene, plan)
            N = 0 - m * stiffness * width * barrier.slope(d / width, self.fp)
        return w, n, N

    @ti.func
    def pressed_jvp(self, kind: A, p, y1, y2, y3, dy1, dy2, dy3, dk, dw, d_radius, scene: A, plan: A):
        """Their changes; dk, dw, d_radius: of the pair's stiffness, width and radius."""
        stiffness, width = self.numbers(p, scene)
        w, r, g = self.nearest(kind, y1, y2, y3)
        d_weights, dr, fixed = self.nearest_jvp(kind, y1, y2, y3, dy1, dy2, dy3, w, r, g)
        length = ti.max(ti.sqrt(r.norm_sqr()), ti.cast(self.tiny, self.fp))
        n, dN, d = r / length, ti.cast(0, self.fp), length - self.radius_of(p, scene)
        dd = n.dot(fixed) - d_radius
        if d < width:
            s = d / width
            slope, curvature = barrier.slope(s, self.fp), barrier.curvature(s, self.fp)
            m, by_q, x = self.fading(kind, p, y1, y2, y3, scene, plan)
            dm = ti.cast(0, self.fp)
            if ti.static(kind == EDGE_EDGE):
                dx = dy1.cross(y3 - y2) + y1.cross(dy3 - dy2)
                dm = 2 * by_q * self.scale_of(kind, p, scene, plan) * x.dot(dx)
            change = dk * width * slope + stiffness * ((slope - s * curvature) * dw + curvature * dd)
            dN = 0 - dm * stiffness * width * slope - m * change
        return d_weights, (dr - n.dot(dr) * n) / length, dN

    @ti.func
    def pressed_vjp(self, kind: A, p, y1, y2, y3, w_adj, n_adj, N_adj, scene: A, plan: A):
        """(adjoints of y1, y2, y3, of the pair's stiffness, width and radius)"""
        stiffness, width = self.numbers(p, scene)
        w, r, g = self.nearest(kind, y1, y2, y3)
        length, zero = ti.max(ti.sqrt(r.norm_sqr()), ti.cast(self.tiny, self.fp)), ti.cast(0, self.fp)
        n, d = r / length, length - self.radius_of(p, scene)
        by_k, by_width, by_d, h = zero, zero, zero, (self.vec3(0), self.vec3(0), self.vec3(0))
        if d < width:
            s = d / width
            slope, curvature = barrier.slope(s, self.fp), barrier.curvature(s, self.fp)
            m, by_q, x = self.fading(kind, p, y1, y2, y3, scene, plan)
            by_k, by_width = 0 - m * width * slope * N_adj, 0 - m * stiffness * (slope - s * curvature) * N_adj
            by_d = 0 - m * stiffness * curvature * N_adj
            if ti.static(kind == EDGE_EDGE):
                factor = -2 * stiffness * width * slope * N_adj * by_q * self.scale_of(kind, p, scene, plan)
                by_b = factor * x.cross(y1)
                h[0] += factor * (y3 - y2).cross(x)
                h[1] += 0 - by_b
                h[2] += by_b
        r_adj = (n_adj - n.dot(n_adj) * n) / length + by_d * n
        first, second = ti.static(BY_FIRST[kind], BY_SECOND[kind])
        e1, e2 = self.combine(first, y1, y2, y3), self.combine(second, y1, y2, y3)
        t1, t2 = e1.dot(r_adj), e2.dot(r_adj)
        for k in ti.static(range(4)):
            t1 += ti.cast(first[k], self.fp) * w_adj[k]
            t2 += ti.cast(second[k], self.fp) * w_adj[k]
        s1, s2 = 0 - (g[0] * t1 + g[1] * t2), 0 - (g[1] * t1 + g[2] * t2)
        along = r_adj + s1 * e1 + s2 * e2
        for k in ti.static(range(3)):
            turned = ti.cast(first[k + 1], self.fp) * s1 + ti.cast(second[k + 1], self.fp) * s2
            h[k] += w[k + 1] * along + turned * r
        return h[0], h[1], h[2], by_k, by_width, 0 - by_d

    # ---- all pairs -----------------------------------------------------------------------------------------------------

    @ti.func
    def measure_pair(self, kind: A, p, scene: A, at: A, plan: A):
        pressing = self.vec4(0)
        mu = self.mu(p, scene)
        if self.is_active(p, scene) and mu > 0:
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w, n, N = self.pressed(kind, p, y1, y2, y3, scene, plan)
            pressing = self.vec4(n[0], n[1], n[2], mu * N)
            scene.weights[p] = w
        scene.pressing[p] = pressing

    @as_kernel("measure", dict(u="vectors2"), OWN)
    def measure(self, scene: A, at: A, plan: A):
        """Weights, normals and forces at u[slot], after `forces` there."""
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_pairs):  # of both kinds: each loop takes time to start
            if p < plan.num_vt:
                self.measure_pair(VERTEX_TRIANGLE, p, scene, at, plan)
            else:
                self.measure_pair(EDGE_EDGE, p, scene, at, plan)

    @ti.func
    def each_pressing(self, act: A, scene: A, at: A, plan: A):
        """act(kind, p, scene, at, plan) of all pairs that press."""
        for kind in ti.static((VERTEX_TRIANGLE, EDGE_EDGE)):
            ti.loop_config(serialize=not self.parallel)
            for p in range(first_of(kind, plan), behind(kind, plan)):
                if scene.pressing[p][3] > 0:
                    act(kind, p, scene, at, plan)

    # ---- derivatives -------------------------------------------------------------------------------------------------

    @ti.func
    def measure_pair_jvp(self, kind: A, p, scene: A, at: A, plan: A):
        y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
        dy1, dy2, dy3 = self.changes(p, scene, at.w, 0)
        r1, r2, r3 = self.changes_at_rest(p, scene, at.rest_dot)
        rest = scene.rest_weights[p]
        d_rest = three(scene.rest_plane[p]).dot(rest[1] * r1 + rest[2] * r2 + rest[3] * r3)
        d_stiffness, d_width = self.of_term(p, scene, at.parameters_dot)
        d_radius = ti.cast(0, self.fp)
        if ti.static(self.mixed):
            d_radius = at.numbers_dot[self.contact_of(p, scene)][2]
        dk, dw = self.numbers_jvp(p, scene, d_stiffness, d_width, d_rest)
        d_weights, dn, dN = self.pressed_jvp(
            kind, p, y1, y2, y3, dy1 + r1, dy2 + r2, dy3 + r3, dk, dw, d_radius, scene, plan
        )
        mu = self.mu(p, scene)
        d_mu = at.parameters_dot[self.at_mu(self.row(p, scene), scene)]
        scene.weights_dot[p] = d_weights
        scene.pressing_dot[p] = self.vec4(dn[0], dn[1], dn[2], mu * dN + d_mu / mu * scene.pressing[p][3])

    @as_kernel("measure_jvp", lambda self: CHANGED | (dict(numbers_dot="vectors") if self.mixed else {}), OWN | DOT)
    def measure_jvp(self, scene: A, at: A, plan: A):
        """Changes for those w of the displacements u[slot], of the rest shape and of the numbers."""
        self.each_pressing(self.measure_pair_jvp, scene, at, plan)

    @ti.func
    def measure_pair_vjp(self, kind: A, p, scene: A, at: A, plan: A):
        pressing = scene.pressing[p]
        w_adj, of_pressing, mu = scene.weights_adj[p], scene.pressing_adj[p], self.mu(p, scene)
        by_load = of_pressing[3]
        y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
        h1, h2, h3, by_k, by_width, by_radius = self.pressed_vjp(
            kind, p, y1, y2, y3, w_adj, three(of_pressing), mu * by_load, scene, plan
        )
        by_stiffness, by_W, by_D = self.numbers_vjp(p, scene, by_k, by_width)
        scene.numbers[p] = self.vec4(by_stiffness, by_W, by_D, by_radius)
        scene.mu_adj[p] = by_load * pressing[3] / mu
        self.store(p, scene, 0 - h1, 0 - h2, 0 - h3)

    @ti.func
    def collect_vertex(self, s, scene: A, at: A, plan: A):
        by_place = self.sum_of_corners(s, scene)
        at.by_place[s] = by_place
        total, by_rest = self.vec4(0), by_place
        for k in range(scene.row[s], scene.row[s + 1]):
            p, corner = scene.corner_of[k] >> 2, scene.corner_of[k] & 3
            if scene.pressing[p][3] > 0:
                numbers = scene.numbers[p]
                if corner == self.corner_of_contact(p, scene):
                    total += numbers
                    at_mu = s * plan.num_rows + self.row(p, scene)
                    at.by_mu[at_mu] = at.by_mu[at_mu] + scene.mu_adj[p]
                if numbers[2] != 0:
                    weight = numbers[2] * self.entry(scene.rest_weights[p], corner)
                    by_rest += self.four(weight * three(scene.rest_plane[p]))
        scene.sums[s] = scene.sums[s] + total
        scene.rest_adj[s] = scene.rest_adj[s] + by_rest

    @as_kernel("measure_vjp", dict(u="vectors2", by_place="vectors", by_mu="scalars"), OWN | ADJ | SUMS, num_rows="int")
    def measure_vjp(self, scene: A, at: A, plan: A):
        """Adjoint of the displacement u[slot] (`by_place`) for `weights_adj` and `pressing_adj`; adds those of the
        numbers and of the rest shape."""
        self.each_pressing(self.measure_pair_vjp, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            self.collect_vertex(s, scene, at, plan)
