"""The distance of a place to what is nearest of a tree of triangles, in kernels, and its derivatives (surface_tree.py).

With p = sum_i w_i y_i the nearest point of the corners y, r = x - p, and E the directions in which p is free (two inside of
a triangle, one on a side, none at a corner), G = (E^T E)^-1:

    d = s |r| - radius,    n = s r / |r|,    dn / dx = s / |r| (1 - n n^T - E G E^T)
    dd / dy_i = -w_i n,    dn / dy_i = -w_i dn / dx - g_i n^T,    with g_i the columns of E G dE^T / dy_i

s is -1 behind what has an inside, else 1. Inside of a triangle n is its normal, and dn / dx = 0 exactly.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import number_type
from diffsim_ti.terms.obstacles.surface_tree import FLAT, GROUP, HEADER

A = ti.template()  # an array handed to a Taichi function


@dataclass(frozen=True)
class SurfaceDistance:
    """Taichi functions of a place x, three numbers; the table starts at `table` of the parameters. sided: whether parts of
    the surface have an inside."""

    precision: str
    table: int
    sided: bool

    fp = number_type

    @property
    def vec3(self):
        return ti.types.vector(3, self.fp)

    @property
    def stride(self) -> int:
        """Numbers of a primitive."""
        return 13 if self.sided else 3

    @property
    def flat(self) -> float:
        return 1e-6 if self.precision == "f32" else FLAT

    @property
    def tiny(self) -> float:
        return 1e-30 if self.precision == "f32" else 1e-200

    @ti.func
    def number(self, k, parameters: A):
        """A whole number of the table."""
        return ti.cast(parameters[self.table + k], ti.i32)

    @ti.func
    def vector(self, first, parameters: A):
        return self.vec3(parameters[first], parameters[first + 1], parameters[first + 2])

    @ti.func
    def square(self, node, x, parameters: A):
        """Squared distance to the box of a node."""
        first, out = self.table + HEADER + 6 * node, ti.cast(0, self.fp)
        for d in ti.static(range(3)):
            gap = ti.max(parameters[first + d] - x[d], x[d] - parameters[first + 3 + d], ti.cast(0, self.fp))
            out += gap * gap
        return out

    @ti.func
    def corner(self, m, k, parameters: A):
        """Three times the number of the vertex that is corner k of primitive m."""
        return 3 * ti.cast(parameters[self.table + self.number(2, parameters) + self.stride * m + k], ti.i32)

    @ti.func
    def vertices(self, parameters: A):
        """Where vertices that no input moves begin in the parameters."""
        return self.table + self.number(3, parameters)

    @ti.func
    def nearer_child(self, node, x, parameters: A):
        """The child of a node whose box has the nearer middle."""
        first, nearer = self.table + HEADER + 12 * node, ti.cast(0, self.fp)
        for d in ti.static(range(3)):
            left = parameters[first + d] + parameters[first + 3 + d]
            right = parameters[first + 6 + d] + parameters[first + 9 + d]
            nearer += (right - left) * (4 * x[d] - left - right)
        return 2 * node + ti.cast(nearer > 0, ti.i32)

    @ti.func
    def find(self, x, begin, parameters: A):
        """(primitive, feature, shares of its corners) of what is nearest; begin: where vertices begin in the parameters."""
        leaves, count = self.number(0, parameters), self.number(1, parameters)
        best, m, feature, w = ti.cast(1e30, self.fp), 0, 0, self.vec3(0)
        node, down = 1, True
        while node > 0:
            if down:
                down = False  # when all below is done
                if self.square(node, x, parameters) < best:
                    if node < leaves:
                        node = self.nearer_child(node, x, parameters)
                        down = True
                    else:
                        for j in range(GROUP * (node - leaves), ti.min(GROUP * (node - leaves + 1), count)):
                            a = self.vector(begin + self.corner(j, 0, parameters), parameters)
                            b = self.vector(begin + self.corner(j, 1, parameters), parameters)
                            c = self.vector(begin + self.corner(j, 2, parameters), parameters)
                            own, shares, square = self.nearest(x, a, b, c)
                            if square < best:
                                best, m, feature, w = square, j, own, shares
            elif node == 1:
                node = 0
            elif node == self.nearer_child(node >> 1, x, parameters):
                node = node ^ 1
                down = True
            else:
                node = node >> 1
        return m, feature, w

    @ti.func
    def nearest(self, x, a, b, c):
        """(feature, shares of the corners, squared distance) of a triangle."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        e1, e2, q = b - a, c - a, x - a
        normal = e1.cross(e2)
        det = normal.norm_sqr()
        inverse = one / ti.max(det, ti.cast(self.tiny, self.fp))
        s, t = q.cross(e2).dot(normal) * inverse, e1.cross(q).dot(normal) * inverse
        height = q.dot(normal)
        feature, w, square = 0, self.vec3(one - s - t, s, t), height * height * inverse
        flat = not det > ti.cast(self.flat, self.fp) * e1.norm_sqr() * e2.norm_sqr()
        if flat or not (s > zero and t > zero and s + t < one):
            square = ti.cast(1e30, self.fp)
            for k in ti.static(range(3)):
                begin = (a, b, c)[k]
                side, r = (b, c, a)[k] - begin, x - begin
                length = ti.max(side.norm_sqr(), ti.cast(self.tiny, self.fp))
                share, own = r.dot(side) / length, 1 + k
                if share <= zero:
                    share, own = zero, 4 + k
                if share >= one:
                    share, own = one, 4 + (k + 1) % 3
                new = (r - share * side).norm_sqr()
                if new < square:
                    square, feature, w = new, own, self.vec3(0)
                    w[k] = one - share
                    w[(k + 1) % 3] = share
        return feature, w, square

    @ti.func
    def look(self, x, begin, parameters: A):
        """((d without the radius, n, dn / dx: xx, xy, xz, yy, yz, zz), rows of the parameters where the corners begin, w, g
        as columns)"""
        one, zero = ti.cast(1, self.fp), ti.cast(0, self.fp)
        m, feature, w = self.find(x, begin, parameters)
        rows, y, g = ti.Vector([0, 0, 0]), ti.Matrix.zero(self.fp, 3, 3), ti.Matrix.zero(self.fp, 3, 3)
        for k in ti.static(range(3)):
            rows[k] = begin + self.corner(m, k, parameters)
            for i in ti.static(range(3)):
                y[i, k] = parameters[rows[k] + i]
        r = x - y @ w
        a, b = self.column(y, 1) - self.column(y, 0), self.column(y, 2) - self.column(y, 0)
        out, n, d, bend, along = ti.Vector.zero(self.fp, 10), a.cross(b), zero, zero, self.vec3(0)
        if feature == 0:
            square = n.norm_sqr()
            b1, b2 = b.cross(n) / square, n.cross(a) / square  # that have the products 1 and 0 with a and b
            n = n / ti.sqrt(square)
            d = r.dot(n)
            if d < 0 and not self.has_inside(m, parameters):
                n = zero * n - n
                d = zero - d
            for i in ti.static(range(3)):
                g[i, 0], g[i, 1], g[i, 2] = zero - b1[i] - b2[i], b1[i], b2[i]
        else:
            if feature < 4:
                first = feature - 1
                following = (first + 1) % 3
                for i in ti.static(range(3)):
                    for k in ti.static(range(3)):
                        share = ti.cast(following == k, self.fp) - ti.cast(first == k, self.fp)
                        along[i] += share * y[i, k]
                square = along.norm_sqr()
                for i in ti.static(range(3)):
                    for k in ti.static(range(3)):
                        share = ti.cast(following == k, self.fp) - ti.cast(first == k, self.fp)
                        g[i, k] = share * along[i] / square
                along = along / ti.sqrt(square)
            d = ti.sqrt(r.norm_sqr())
            sign = self.sign(m, feature, r, parameters)
            bend = sign / ti.max(d, ti.cast(self.tiny, self.fp))
            n = bend * r
            if d <= ti.cast(self.tiny, self.fp):
                n = self.vec3(one, zero, zero)
            d = sign * d
        out[0] = d
        for k in ti.static(range(6)):
            i, j = ti.static(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))[k])
            if ti.static(k < 3):
                out[1 + k] = n[k]
            out[4 + k] = bend * (ti.cast(i == j, self.fp) - n[i] * n[j] - along[i] * along[j])
        return out, rows, w, g

    @ti.func
    def column(self, y, k: A):
        return self.vec3(y[0, k], y[1, k], y[2, k])

    @ti.func
    def has_inside(self, m, parameters: A):
        out = False
        if ti.static(self.sided):
            out = parameters[self.table + self.number(2, parameters) + self.stride * m + 3] > 0
        return out

    @ti.func
    def sign(self, m, feature, r, parameters: A):
        """-1 behind the side or corner of primitive m that is nearest, else 1."""
        out = ti.cast(1, self.fp)
        if ti.static(self.sided):
            if self.has_inside(m, parameters):
                first = self.table + self.number(2, parameters) + self.stride * m + 4 + 3 * (feature - 1)
                if feature > 3:
                    first = self.vertices(parameters) + self.number(4, parameters)
                    first += self.corner(m, feature - 4, parameters)
                if r.dot(self.vector(first, parameters)) < 0:
                    out = ti.cast(-1, self.fp)
        return out
