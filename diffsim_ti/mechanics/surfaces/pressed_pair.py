"""Where a pair of a list presses: its weights, its normal and the size of its force, with their derivatives."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import ListedPair
from diffsim_ti.mechanics.surfaces.proximity import BY_FIRST, BY_SECOND, EDGE_EDGE
from diffsim_ti.terms.obstacles import barrier

A = ti.template()


@dataclass(frozen=True)
class PressedPair(ListedPair):
    """Taichi functions of pair p at corners y1, y2, y3 relative to corner 0 (proximity.py)."""

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
