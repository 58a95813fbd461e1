"""The distance of a place to what is nearest of a tree of triangles, in kernels, and its derivatives (surface_tree.py).

With z = sum_i w_i y_i the nearest point of the corners y, r = x - z, and E the directions in which z is free (two inside of
a triangle, one on a side, none at a corner), G = (E^T E)^-1:

    d = s |r| - radius,    n = s r / |r|,    dn / dx = s / |r| (1 - n n^T - E G E^T)
    dd / dy_i = -w_i n,    dn / dy_i = -w_i dn / dx - g_i n^T,    with g_i the columns of E G dE^T / dy_i

s is -1 behind what has an inside, else 1. Inside of a triangle n is its normal, and dn / dx = 0 exactly.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import A, number_type
from diffsim_ti.terms.obstacles import barrier
from diffsim_ti.terms.obstacles.surface_tree import FLAT, GROUP, HEADER, NODE

ENERGY, FORCE, JVP, VJP = range(4)


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
        return 20 if self.sided else 10

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
        first, out = self.table + HEADER + NODE * node, ti.cast(0, self.fp)
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
        first = self.table + HEADER + NODE * node + 6
        right = self.vector(first, parameters).dot(x) > parameters[first + 3]
        return 2 * node + ti.cast(right, ti.i32)

    @ti.func
    def find(self, x, begin, parameters: A):
        """(primitive, feature, s, t) of what is nearest, as `nearest` has them; begin: where vertices begin in the
        parameters."""
        leaves, count = self.number(0, parameters), self.number(1, parameters)
        best, m, feature, s, t = ti.cast(1e30, self.fp), 0, 0, ti.cast(0, self.fp), ti.cast(0, self.fp)
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
                            own, own_s, own_t, square = self.nearest(x, a, b, c)
                            if square < best:
                                best, m, feature, s, t = square, j, own, own_s, own_t
            elif node == 1:
                node = 0
            elif node == self.nearer_child(node >> 1, x, parameters):
                node = node ^ 1
                down = True
            else:
                node = node >> 1
        return m, feature, s, t

    @ti.func
    def free_share(self, x, there, begin, parameters: A):
        """The share of the way from x to another place before the first triangle on it; 1 where none is."""
        leaves, count, node, out = self.number(0, parameters), self.number(1, parameters), 1, ti.cast(1, self.fp)
        while node > 0:
            first, meets = self.table + HEADER + NODE * node, True
            for d in ti.static(range(3)):
                meets = meets and parameters[first + d] <= ti.max(x[d], there[d])
                meets = meets and parameters[first + 3 + d] >= ti.min(x[d], there[d])
            if meets and node < leaves:
                node = 2 * node
            else:
                if meets:
                    for j in range(GROUP * (node - leaves), ti.min(GROUP * (node - leaves + 1), count)):
                        a = self.vector(begin + self.corner(j, 0, parameters), parameters)
                        b = self.vector(begin + self.corner(j, 1, parameters), parameters)
                        c = self.vector(begin + self.corner(j, 2, parameters), parameters)
                        out = ti.min(out, self.share_before(x, there, a, b, c))
                node = self.after(node)
        return out

    @ti.func
    def after(self, node):
        """The node that a walk from left to right has behind all that is below a node; 0: none."""
        node += 1
        while (node & 1) == 0:
            node >>= 1
        return ti.select(node == 1, 0, node)

    @ti.func
    def following(self, j, x, reach, parameters: A):
        """The next primitive behind j, or the first behind -1, of leaves whose boxes are within reach of x; -1: none."""
        leaves, count, out, node = self.number(0, parameters), self.number(1, parameters), j + 1, 0
        if (j + 1) % GROUP == 0 or j + 1 == count:
            out, node = -1, 1
            if j >= 0:
                node = self.after(leaves + j // GROUP)
        while node > 0:
            if not self.square(node, x, parameters) < reach * reach:
                node = self.after(node)
            elif node < leaves:
                node = 2 * node
            else:
                out, node = GROUP * (node - leaves), 0
        return out

    @ti.func
    def part(self, j, k, x, begin, parameters: A):
        """(feature, s, t, squared distance) of part k of primitive j: itself (0), its sides with their ends, its corners."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        feature, s, t, square = k, zero, zero, zero
        first = self.first_of(k)
        a = self.vector(begin + self.corner(j, first, parameters), parameters)
        b = self.vector(begin + self.corner(j, (first + 1) % 3, parameters), parameters)
        if k == 0:
            c = self.vector(begin + self.corner(j, 2, parameters), parameters)
            feature, s, t, square = self.nearest(x, a, b, c)
        else:
            if k < 4:
                s = (x - a).dot(b - a) / ti.max((b - a).norm_sqr(), ti.cast(self.tiny, self.fp))
                if s <= zero:
                    feature, s = 3 + k, zero
                if s >= one:
                    feature, s = 4 + k % 3, zero
                    a = b
            square = (x - a - s * (b - a)).norm_sqr()
        return feature, s, t, square

    @ti.func
    def pushed(self, x, j, feature, s, t, share, behind: A, radius, width, begin, parameters: A):
        """Of a feature, with a share of a barrier of stiffness one: (energy, f = -dE/dx, df/dx: xx, xy, xz, yy, yz, zz,
        df/dwidth, df/dradius), and rows, s, t, g, h of `seen`. behind: whether it acts from the other side."""
        out = ti.Vector.zero(self.fp, 16)
        found, rows, s_of_it, t_of_it, g, h = self.seen(x, j, feature, s, t, begin, parameters)
        side = ti.cast(1, self.fp)
        if found[0] < 0 and not behind:
            side = side - 2
        y = (side * found[0] - radius) / width
        slope, curvature = barrier.slope_and_curvature(y, self.fp)
        slope, curvature = share * slope, share * curvature
        for a in ti.static(range(3)):
            n = side * found[1 + a]
            out[1 + a] = 0 - width * slope * n
            out[10 + a] = (y * curvature - slope) * n
            out[13 + a] = curvature * n
        for b in ti.static(range(6)):
            i, e = ti.static(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))[b])
            out[4 + b] = 0 - side * width * slope * found[4 + b] - curvature * found[1 + i] * found[1 + e]
        return out, rows, s_of_it, t_of_it, g, h

    @ti.func
    def is_inside(self, x, m, feature, s, t, begin, parameters: A):
        """Whether x is behind what is nearest to it."""
        first = self.first_of(feature)
        p = self.vector(begin + self.corner(m, first, parameters), parameters)
        q = self.vector(begin + self.corner(m, (first + 1) % 3, parameters), parameters)
        r = self.vector(begin + self.corner(m, (first + 2) % 3, parameters), parameters)
        away, n = x - p - s * (q - p) - t * (r - p), (q - p).cross(r - p)
        return (feature == 0 and away.dot(n) < 0) or (feature > 0 and self.sign(m, feature, away, parameters) < 0)

    @ti.func
    def first_part(self, x, begin, parameters: A):
        """(primitive, feature, s, t, whether it is alone): what is nearest to a place that has got inside; else -1, behind
        which `next_part` goes on."""
        j, feature, s, t, inside = -1, 0, ti.cast(0, self.fp), ti.cast(0, self.fp), False
        if ti.static(self.sided):
            j, feature, s, t = self.find(x, begin, parameters)
            inside = self.has_inside(j, parameters) and self.is_inside(x, j, feature, s, t, begin, parameters)
            if not inside:
                j = -1
        return j, feature, s, t, inside

    @ti.func
    def next_part(self, j, k, x, reach, begin, parameters: A):
        """(primitive, number of its part, feature, s, t, squared distance, SurfaceMesh.shares) of what comes behind part k
        of primitive j within reach of x and counts; primitive -1: nothing."""
        zero, found = ti.cast(0, self.fp), False
        feature, s, t, share, square = 0, zero, zero, zero, zero
        while not found:
            k += 1
            if j < 0 or k == 7:
                j, k = self.following(j, x, reach, parameters), 0
            found = j < 0
            if not found:
                share = parameters[self.table + self.number(2, parameters) + self.stride * j + 3 + k]
                if k == 0 or share != 0:
                    feature, s, t, square = self.part(j, k, x, begin, parameters)
                    found = share != 0 and square < reach * reach
                    if k == 0 and not square < reach * reach:
                        k = 6  # no part of it is nearer
        return j, k, feature, s, t, square, share

    @ti.func
    def over_parts(self, what: A, x, w, radius, width, begin, parameters: A, dot: A, sums: A, i):
        """The sum over all that is within reach, with SurfaceMesh.shares, or at a place that has got inside what is nearest
        alone; what: ENERGY; FORCE, `pushed`; JVP, the change of f for changes `dot` of all parameters, by corners; VJP adds
        to sums[.., i] for the adjoint w of f."""
        total, reach, zero, one = ti.Vector.zero(self.fp, 16), radius + width, ti.cast(0, self.fp), ti.cast(1, self.fp)
        j, feature, s, t, inside = self.first_part(x, begin, parameters)
        k, share, square, more = 6, one, zero, True
        while more:
            if not inside:
                j, k, feature, s, t, square, share = self.next_part(j, k, x, reach, begin, parameters)
            more = j >= 0 and not inside
            if j >= 0:
                if ti.static(what == ENERGY):
                    d = ti.sqrt(square)
                    if inside:
                        d = self.seen(x, j, feature, s, t, begin, parameters)[0][0]
                    total[0] += share * width * width * barrier.value((d - radius) / width, self.fp)
                else:
                    by, rows, s_of, t_of, g, h = self.pushed(
                        x, j, feature, s, t, share, inside, radius, width, begin, parameters
                    )
                    if ti.static(what == FORCE):
                        total += by
                    else:
                        f, turn = self.vec3(by[1], by[2], by[3]), 0 - g - h
                        for c in ti.static(range(3)):
                            weight = (one - s_of - t_of, s_of, t_of)[c]
                            if ti.static(c > 0):
                                turn = (g, h)[c - 1]
                            if ti.static(what == JVP):
                                dy = self.vector(rows[c], dot)
                                change = self.symmetric(by, dy)
                                for a in ti.static(range(3)):
                                    total[1 + a] += 0 - weight * change[a] - turn[a] * f.dot(dy)
                            else:
                                Hw = self.symmetric(by, w)
                                for a in ti.static(range(3)):
                                    by_corner = 0 - weight * Hw[a] - f[a] * turn.dot(w)
                                    sums[rows[c] + a, i] = sums[rows[c] + a, i] + by_corner
        return total

    @ti.func
    def symmetric(self, found, w):
        """The product of df/dx with a vector."""
        out = self.vec3(0)
        for a in ti.static(range(3)):
            for b in ti.static(range(3)):
                out[a] += found[4 + ti.static(((0, 1, 2), (1, 3, 4), (2, 4, 5))[a][b])] * w[b]
        return out

    @ti.func
    def share_before(self, x, there, a, b, c):
        """The same of one triangle, with room for rounding at its sides."""
        out, e1, e2 = ti.cast(1, self.fp), b - a, c - a
        normal = e1.cross(e2)
        begin, end, det = (x - a).dot(normal), (there - a).dot(normal), normal.norm_sqr()
        if begin * end < 0 and det > 0:
            share, room = begin / (begin - end), ti.cast(16 * self.flat**0.5, self.fp)
            q = x - a + share * (there - x)
            s, t = q.cross(e2).dot(normal) / det, e1.cross(q).dot(normal) / det
            if ti.min(s, t) > 0 - room and s + t < 1 + room:
                out = share
        return out

    @ti.func
    def nearest(self, x, a, b, c):
        """(feature, s, t, squared distance) of a triangle: the nearest point is p + s (q - p) + t (r - p), p, q, r being its
        corners from that on which `first_of` says."""
        zero, one = ti.cast(0, self.fp), ti.cast(1, self.fp)
        e1, e2, y = b - a, c - a, x - a
        normal = e1.cross(e2)
        det = normal.norm_sqr()
        inverse = one / ti.max(det, ti.cast(self.tiny, self.fp))
        s, t = y.cross(e2).dot(normal) * inverse, e1.cross(y).dot(normal) * inverse
        height = y.dot(normal)
        feature, square = 0, height * height * inverse
        flat = not det > ti.cast(self.flat, self.fp) * e1.norm_sqr() * e2.norm_sqr()
        if flat or not (s > zero and t > zero and s + t < one):
            square, t = ti.cast(1e30, self.fp), zero
            begin, end, third = a, b, c
            for k in range(3):
                side, r, own = end - begin, x - begin, 1 + k
                share = r.dot(side) / ti.max(side.norm_sqr(), ti.cast(self.tiny, self.fp))
                if share <= zero:
                    share, own = zero, 4 + k
                if share >= one:
                    share, own = one, 4 + (k + 1) % 3
                new = (r - share * side).norm_sqr()
                if new < square:
                    square, feature, s = new, own, ti.select(own < 4, share, zero)
                before = begin
                begin = end
                end = third
                third = before
        return feature, s, t, square

    @ti.func
    def first_of(self, feature):
        """The corner where the nearest side begins, or the nearest corner."""
        return (feature + 2) % 3 * ti.cast(feature > 0, ti.i32)

    @ti.func
    def look(self, x, begin, parameters: A):
        """`seen` of what is nearest."""
        return self.seen(x, *self.find(x, begin, parameters), begin, parameters)

    @ti.func
    def seen(self, x, m, feature, s, t, begin, parameters: A):
        """((d without the radius, n, dn / dx: xx, xy, xz, yy, yz, zz), where its corners p, q, r begin in the parameters,
        s, t, those columns g of q and r that p balances) of a feature of primitive m, where s and t say."""
        one, zero = ti.cast(1, self.fp), ti.cast(0, self.fp)
        first = self.first_of(feature)
        rows = ti.Vector([begin + self.corner(m, (first + k) % 3, parameters) for k in ti.static(range(3))])
        p = self.vector(rows[0], parameters)
        e, f = self.vector(rows[1], parameters) - p, self.vector(rows[2], parameters) - p
        r = x - p - s * e - t * f
        n, d, bend, g, h, along = e.cross(f), zero, zero, self.vec3(0), self.vec3(0), self.vec3(0)
        if feature == 0:
            square = n.norm_sqr()
            g, h = f.cross(n) / square, n.cross(e) / square  # have the products 1 and 0 with e and f
            n = n / ti.sqrt(square)
            d = r.dot(n)
            if d < 0 and not self.has_inside(m, parameters):
                n = zero * n - n
                d = zero - d
        else:
            if feature < 4:
                square = e.norm_sqr()
                g, along = e / square, e / ti.sqrt(square)
            d = ti.sqrt(r.norm_sqr())
            sign = self.sign(m, feature, r, parameters)
            bend = sign / ti.max(d, ti.cast(self.tiny, self.fp))
            n = bend * r
            if d <= ti.cast(self.tiny, self.fp):
                n = self.vec3(one, zero, zero)
            d = sign * d
        out = ti.Vector.zero(self.fp, 10)
        out[0] = d
        for k in ti.static(range(6)):
            i, j = ti.static(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))[k])
            if ti.static(k < 3):
                out[1 + k] = n[k]
            out[4 + k] = bend * (ti.cast(i == j, self.fp) - n[i] * n[j] - along[i] * along[j])
        return out, rows, s, t, g, h

    @ti.func
    def has_inside(self, m, parameters: A):
        out = False
        if ti.static(self.sided):
            out = parameters[self.table + self.number(2, parameters) + self.stride * m + 10] > 0
        return out

    @ti.func
    def sign(self, m, feature, r, parameters: A):
        """-1 behind the side or corner of primitive m that is nearest, else 1."""
        out = ti.cast(1, self.fp)
        if ti.static(self.sided):
            if self.has_inside(m, parameters):
                first = self.table + self.number(2, parameters) + self.stride * m + 11 + 3 * (feature - 1)
                if feature > 3:
                    first = self.vertices(parameters) + self.number(4, parameters)
                    first += self.corner(m, self.first_of(feature), parameters)
                if r.dot(self.vector(first, parameters)) < 0:
                    out = ti.cast(-1, self.fp)
        return out
