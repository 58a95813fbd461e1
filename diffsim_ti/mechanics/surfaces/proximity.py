"""Distance of a vertex to a triangle and of two edges, the barrier energy of such a pair, and their derivatives.

A pair has four corners x_0..x_3: (vertex, triangle) or (first edge, second edge). Its nearest points lie at parameters
t = (t_1, t_2), and r = sum_i w_i(t) x_i joins them, w affine in t. A constraint at the border of the triangle or of an edge
leaves 2, 1 or 0 of the parameters free, and that is all that differs between face, edge and vertex:

    grad_i d^2 = 2 r w_i                                    by the envelope theorem
    dt = -G (E^T dr_t + dE^T r),   E_k = dr / dt_k          G = (E^T E)^-1 on the free parameters, zero elsewhere

with dr_t the change of r at fixed t; then dr = dr_t + E dt and dw_i = (dw_i / dt) dt. Energy of a pair:

    m(q) stiffness width^2 beta((d - radius) / width)       beta: barrier.py

where m = q (2 - q) for q < 1, else 1, fades out edges that become parallel, whose nearest points jump:
q = |a x b|^2 / (10^-3 A^2 B^2), with A, B the lengths at rest. Vertex and triangle: m = 1.
Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425. Vectors are relative to corner 0.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import A, number_type, vector_type
from diffsim_ti.terms.obstacles import barrier

VERTEX_TRIANGLE, EDGE_EDGE = 0, 1
PARALLEL = 1e-3  # threshold of q, in squared lengths at rest
ROOM = 1e-3  # of an edge's length or of the reach, that the cheap test of nearness leaves for rounding
# how the weights of the corners change with the two parameters
BY_FIRST = ((0, 1, -1, 0), (-1, 1, 0, 0))
BY_SECOND = ((0, 1, 0, -1), (0, 0, 1, -1))


@dataclass(frozen=True)
class Pair:
    """Taichi functions of one pair; `kind` is VERTEX_TRIANGLE or EDGE_EDGE, known when kernels compile."""

    precision: str

    fp, vec4 = number_type, vector_type

    @property
    def vec3(self):
        return ti.types.vector(3, self.fp)

    @property
    def flat(self):
        """sin^2 of an angle below which edges and triangles are degenerate: their inner solution is lost to rounding."""
        return 1e-6 if self.precision == "f32" else 1e-14

    @property
    def tiny(self):
        return 1e-30 if self.precision == "f32" else 1e-200

    @ti.func
    def along(self, q, e):
        """Nearest parameter in [0, 1] of the line t e to the point q, and 1 / |e|^2 if it is free, else 0."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        square = ti.max(e.norm_sqr(), ti.cast(self.tiny, self.fp))
        t, free = q.dot(e) / square, one / square
        if t <= zero:
            t, free = zero, zero
        if t >= one:
            t, free = one, zero
        return t, free

    @ti.func
    def nearest_on_triangle(self, y1, y2, y3):
        """(t_1, t_2, (G_11, G_12, G_22)) of the origin and the triangle y1 + t_1 (y2 - y1) + t_2 (y3 - y1)."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        e1, e2, q = y2 - y1, y3 - y1, 0 * y1 - y1
        a11, a12, a22, normal = e1.norm_sqr(), e1.dot(e2), e2.norm_sqr(), e1.cross(e2)
        det = normal.norm_sqr()
        inverse = one / ti.max(det, ti.cast(self.tiny, self.fp))
        # cross products lose fewer digits than b_1 a_22 - b_2 a_12
        s, t = q.cross(e2).dot(normal) * inverse, e1.cross(q).dot(normal) * inverse
        g = self.vec3(a22, 0 - a12, a11) * inverse
        if not (det > ti.cast(self.flat, self.fp) * a11 * a22 and s > zero and t > zero and s + t < one):
            s1, free1 = self.along(q, e1)
            t2, free2 = self.along(q, e2)
            t3, free3 = self.along(q - e1, e2 - e1)
            d1, d2, d3 = (q - s1 * e1).norm_sqr(), (q - t2 * e2).norm_sqr(), (q - e1 - t3 * (e2 - e1)).norm_sqr()
            s, t, g = s1, zero, self.vec3(free1, zero, zero)
            if d2 < d1:
                s, t, g, d1 = zero, t2, self.vec3(zero, zero, free2), d2
            if d3 < d1:
                s, t, g = one - t3, t3, self.vec3(free3, 0 - free3, free3)
        return s, t, g

    @ti.func
    def nearest_of_edges(self, y1, y2, y3):
        """(t_1, t_2, (G_11, G_12, G_22)) of the edges t_1 y1 and y2 + t_2 (y3 - y2)."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        a, b = y1, y3 - y2
        aa, ab, bb, normal = a.norm_sqr(), a.dot(b), b.norm_sqr(), a.cross(b)
        det = normal.norm_sqr()
        inverse = one / ti.max(det, ti.cast(self.tiny, self.fp))
        s, t = y2.cross(b).dot(normal) * inverse, y2.cross(a).dot(normal) * inverse
        g = self.vec3(bb, ab, aa) * inverse
        if not (det > ti.cast(self.flat, self.fp) * aa * bb and s > zero and s < one and t > zero and t < one):
            t0, free0 = self.along(0 * y2 - y2, b)
            t1, free1 = self.along(a - y2, b)
            s0, free2 = self.along(y2, a)
            s1, free3 = self.along(y3, a)
            s, t, g = zero, t0, self.vec3(zero, zero, free0)
            best = (y2 + t0 * b).norm_sqr()
            d = (a - y2 - t1 * b).norm_sqr()
            if d < best:
                s, t, g, best = one, t1, self.vec3(zero, zero, free1), d
            d = (s0 * a - y2).norm_sqr()
            if d < best:
                s, t, g, best = s0, zero, self.vec3(free2, zero, zero), d
            d = (s1 * a - y3).norm_sqr()
            if d < best:
                s, t, g = s1, one, self.vec3(free3, zero, zero)
        return s, t, g

    @ti.func
    def nearest(self, kind: A, y1, y2, y3):
        """Weights w of the corners, r, and G, as (w, r, (G_11, G_12, G_22))."""
        one, w, s, t, g = ti.cast(1, self.fp), self.vec4(0), ti.cast(0, self.fp), ti.cast(0, self.fp), self.vec3(0)
        if ti.static(kind == VERTEX_TRIANGLE):
            s, t, g = self.nearest_on_triangle(y1, y2, y3)
            w = self.vec4(one, s + t - one, 0 - s, 0 - t)
        else:
            s, t, g = self.nearest_of_edges(y1, y2, y3)
            w = self.vec4(one - s, s, t - one, 0 - t)
        return w, w[1] * y1 + w[2] * y2 + w[3] * y3, g

    @ti.func
    def clamp(self, t):
        return ti.min(ti.max(t, ti.cast(0, self.fp)), ti.cast(1, self.fp))

    @ti.func
    def edges_may_be_near(self, y1, y2, y3, reach):
        """False only for edges (0, y1), (y2, y3) farther apart than `reach`; no branches, some room for parallel ones."""
        a, b, least = y1, y3 - y2, ti.cast(self.tiny, self.fp)
        aa, ab, bb, p, q = a.norm_sqr(), a.dot(b), b.norm_sqr(), a.dot(y2), b.dot(y2)
        s = self.clamp((p * bb - ab * q) / ti.max(aa * bb - ab * ab, least))
        t = self.clamp((ab * s - q) / ti.max(bb, least))
        s = self.clamp((ab * t + p) / ti.max(aa, least))
        limit = reach + ti.cast(ROOM, self.fp) * ti.sqrt(aa)
        return (y2 + t * b - s * a).norm_sqr() < limit * limit

    @ti.func
    def triangle_may_be_near(self, y1, y2, y3, reach):
        """False only for a triangle farther from the origin than `reach`: by its plane, or a side and the plane."""
        normal = (y2 - y1).cross(y3 - y1)
        square = ti.max(normal.norm_sqr(), ti.cast(self.tiny, self.fp))
        height, limit = y1.dot(normal), ti.cast(1 + ROOM, self.fp) * reach
        room = limit * limit * square - height * height
        near = room >= 0
        for a, b in ti.static(((y1, y2), (y2, y3), (y3, y1))):
            out = b.cross(a).dot(normal)  # beyond the side a b if > 0
            near &= (out <= 0) | (out * out <= room * (b - a).norm_sqr())
        return near

    @ti.func
    def may_be_near(self, kind: A, y1, y2, y3, reach):
        """False only for a pair farther apart than `reach`; much cheaper than `nearest`."""
        near = False
        if ti.static(kind == VERTEX_TRIANGLE):
            near = self.triangle_may_be_near(y1, y2, y3, reach)
        else:
            near = self.edges_may_be_near(y1, y2, y3, reach)
        return near

    @ti.func
    def combine(self, weights: A, y1, y2, y3):
        """sum_i weights_i y_i with constant weights of -1, 0, 1."""
        out = self.vec3(0)
        for k in ti.static(range(3)):
            if ti.static(weights[k + 1] != 0):
                out += ti.cast(weights[k + 1], self.fp) * (y1, y2, y3)[k]
        return out

    @ti.func
    def nearest_jvp(self, kind: A, y1, y2, y3, dy1, dy2, dy3, w, r, g):
        """Changes (dw, dr) for changes of the corners relative to corner 0, and dr at fixed parameters."""
        first, second = ti.static(BY_FIRST[kind], BY_SECOND[kind])
        dr = w[1] * dy1 + w[2] * dy2 + w[3] * dy3
        e1, e2 = self.combine(first, y1, y2, y3), self.combine(second, y1, y2, y3)
        b1 = e1.dot(dr) + self.combine(first, dy1, dy2, dy3).dot(r)
        b2 = e2.dot(dr) + self.combine(second, dy1, dy2, dy3).dot(r)
        ds, dt = 0 - (g[0] * b1 + g[1] * b2), 0 - (g[1] * b1 + g[2] * b2)
        dw = self.vec4(0)
        for k in ti.static(range(4)):
            dw[k] = ti.cast(first[k], self.fp) * ds + ti.cast(second[k], self.fp) * dt
        return dw, dr + ds * e1 + dt * e2, dr

    @ti.func
    def mollifier(self, q):
        """m(q), m', m''"""
        one, m, slope, curvature = ti.cast(1, self.fp), ti.cast(1, self.fp), ti.cast(0, self.fp), ti.cast(0, self.fp)
        if q < one:
            m, slope, curvature = q * (2 - q), 2 * (one - q), ti.cast(-2, self.fp)
        return m, slope, curvature

    @ti.func
    def gradient(self, kind: A, w, r, y1, y2, y3, scale, stiffness, width, radius):
        """(energy, n, d, g1, g2, g3): gradient of the energy by corners 1 to 3; corner 0 balances them; w, r: `nearest`.

        d = |r| - radius, n = r / |r|. scale: 1 / sqrt(threshold of |a x b|^2), not used for vertex and triangle.
        """
        length = ti.sqrt(r.norm_sqr())
        d, n = length - radius, r / ti.max(length, ti.cast(self.tiny, self.fp))
        energy, g1, g2, g3 = ti.cast(0, self.fp), self.vec3(0), self.vec3(0), self.vec3(0)
        if d < width:
            s = d / width
            phi = stiffness * width * width * barrier.value(s, self.fp)
            slope, m = stiffness * width * barrier.slope(s, self.fp), ti.cast(1, self.fp)
            if ti.static(kind == EDGE_EDGE):
                a, b = y1, y3 - y2
                x = scale * a.cross(b)
                m, by_q, _ = self.mollifier(x.norm_sqr())
                by_b = (2 * phi * by_q * scale) * x.cross(a)
                g1, g2, g3 = (2 * phi * by_q * scale) * b.cross(x), 0 - by_b, by_b
            energy = m * phi
            force = (m * slope) * n
            g1, g2, g3 = g1 + w[1] * force, g2 + w[2] * force, g3 + w[3] * force
        return energy, n, d, g1, g2, g3

    @ti.func
    def gradient_jvp(self, kind: A, w, r, g, y: A, dy: A, numbers: A, changes: A):
        """(h1, h2, h3, by_stiffness, by_width, by_radius): change of the gradient of corners 1 to 3 (0 balances them) for
        changes dy of corners y and those of the last of the numbers (scale, stiffness, width, radius); and the products of
        dy with the gradient's derivatives by these."""
        y1, y2, y3 = ti.static(y)
        dy1, dy2, dy3 = ti.static(dy)
        scale, stiffness, width, radius = ti.static(numbers)
        d_stiffness, d_width, d_radius = ti.static(changes)
        length = ti.sqrt(r.norm_sqr())
        d = length - radius
        h1, h2, h3 = self.vec3(0), self.vec3(0), self.vec3(0)
        by_stiffness, by_width, by_radius = ti.cast(0, self.fp), ti.cast(0, self.fp), ti.cast(0, self.fp)
        if d < width:
            inverse = ti.cast(1, self.fp) / ti.max(length, ti.cast(self.tiny, self.fp))
            n, s = inverse * r, d / width
            dw, dr, fixed = self.nearest_jvp(kind, y1, y2, y3, dy1, dy2, dy3, w, r, g)
            dd = n.dot(fixed)
            dn = inverse * (dr - n.dot(dr) * n)
            # phi = stiffness width^2 beta, its derivatives by d, and by width
            beta, beta1, beta2 = barrier.value(s, self.fp), barrier.slope(s, self.fp), barrier.curvature(s, self.fp)
            phi, slope, curvature = stiffness * width * width * beta, stiffness * width * beta1, stiffness * beta2
            phi_by_width, slope_by_width = stiffness * width * (2 * beta - s * beta1), stiffness * (beta1 - s * beta2)
            relative = d_stiffness / stiffness
            d_phi = slope * (dd - d_radius) + relative * phi + d_width * phi_by_width
            d_slope = curvature * (dd - d_radius) + relative * slope + d_width * slope_by_width
            m, dm = ti.cast(1, self.fp), ti.cast(0, self.fp)
            if ti.static(kind == EDGE_EDGE):
                a, b, da, db = y1, y3 - y2, dy1, dy3 - dy2
                x, dx = scale * a.cross(b), scale * (da.cross(b) + a.cross(db))
                dq = 2 * x.dot(dx)
                q_a, q_b = (2 * scale) * b.cross(x), (2 * scale) * x.cross(a)
                dq_a, dq_b = (2 * scale) * (db.cross(x) + b.cross(dx)), (2 * scale) * (dx.cross(a) + x.cross(da))
                value, by_q, by_qq = self.mollifier(x.norm_sqr())
                m, dm = value, by_q * dq
                change, factor = d_phi * by_q + phi * by_qq * dq, phi * by_q
                by_b = change * q_b + factor * dq_b
                h1, h2, h3 = change * q_a + factor * dq_a, 0 - by_b, by_b
                by_stiffness += factor * dq / stiffness
                by_width += phi_by_width * by_q * dq
                by_radius = by_radius - slope * by_q * dq
            by_stiffness += m * slope * dd / stiffness
            by_width += m * slope_by_width * dd
            by_radius = by_radius - m * curvature * dd
            along_n, turned = (m * d_slope + dm * slope) * n, (m * slope) * dn
            shifted = (m * slope) * n
            h1 += w[1] * (along_n + turned) + dw[1] * shifted
            h2 += w[2] * (along_n + turned) + dw[2] * shifted
            h3 += w[3] * (along_n + turned) + dw[3] * shifted
        return h1, h2, h3, by_stiffness, by_width, by_radius
