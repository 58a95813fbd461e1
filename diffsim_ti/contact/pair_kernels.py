"""Kernels over the pairs of a surface: forces and their derivatives, energies, and whether a pass may have gone too far.

Each pair writes to its four corners, and each surface vertex sums its corners in order, so that there are no atomics; what
vertex s gets is written to `out[first_out + s]`, one more corner for the gather of the tetrahedra's forces. Most pairs of a
list are beyond the width: they write nothing but their plane, and vertices with no other pairs sum nothing.
"""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.contact.proximity import EDGE_EDGE, VERTEX_TRIANGLE, pair_functions
from diffsim_ti.runtime import Bundle

A = ti.template()
MARGIN = 1.001
BLOCK = 256  # vertices whose motion one thread compares
SAFE = 0.9  # share of its gap by which a pair may close in one pass
# which corners belong to different primitives
OPPOSITE = (((0, 1), (0, 2), (0, 3)), ((0, 2), (0, 3), (1, 2), (1, 3)))


@lru_cache(maxsize=None)
def pair_kernels(precision: str, first: int, parallel: bool) -> SimpleNamespace:
    """Kernels for the numbers (stiffness, width) at `first` in the parameter array."""
    f = pair_functions(precision)
    fp, vec3, vec4 = f.fp, f.vec3, ti.types.vector(4, f.fp)
    ints, scalars = ti.types.ndarray(ti.i32, 1), ti.types.ndarray(fp, 1)
    vectors, vectors2 = ti.types.ndarray(vec4, 1), ti.types.ndarray(vec4, 2)

    @ti.func
    def of(x: A, i, k, slot):
        """x_k - x_i of the vertices' vectors in a slot."""
        y = x[slot, k] - x[slot, i]
        return vec3(y[0], y[1], y[2])

    @ti.func
    def at_rest(rest: A, i, k):
        y = rest[k] - rest[i]
        return vec3(y[0], y[1], y[2])

    @ti.func
    def corners(p, scene: A, slot):
        """Corners 1 to 3 of pair p relative to corner 0."""
        c0, c1, c2, c3 = scene.pairs[4 * p], scene.pairs[4 * p + 1], scene.pairs[4 * p + 2], scene.pairs[4 * p + 3]
        return (
            at_rest(scene.rest, c0, c1) + of(scene.u, c0, c1, slot),
            at_rest(scene.rest, c0, c2) + of(scene.u, c0, c2, slot),
            at_rest(scene.rest, c0, c3) + of(scene.u, c0, c3, slot),
        )

    @ti.func
    def changes(p, scene: A):
        """The same of the vectors w, plus those of the rest shape if `scene.by_rest`."""
        c0, c1, c2, c3 = scene.pairs[4 * p], scene.pairs[4 * p + 1], scene.pairs[4 * p + 2], scene.pairs[4 * p + 3]
        y1, y2, y3 = of(scene.w, c0, c1, 0), of(scene.w, c0, c2, 0), of(scene.w, c0, c3, 0)
        if scene.by_rest > 0:
            y1 += at_rest(scene.rest_dot, c0, c1)
            y2 += at_rest(scene.rest_dot, c0, c2)
            y3 += at_rest(scene.rest_dot, c0, c3)
        return y1, y2, y3

    @ti.func
    def store(p, corner: A, g1, g2, g3):
        """Forces, minus the gradient, of the four corners."""
        g0, zero = g1 + g2 + g3, ti.cast(0, fp)
        corner[4 * p] = vec4(g0[0], g0[1], g0[2], zero)
        corner[4 * p + 1] = vec4(0 - g1[0], 0 - g1[1], 0 - g1[2], zero)
        corner[4 * p + 2] = vec4(0 - g2[0], 0 - g2[1], 0 - g2[2], zero)
        corner[4 * p + 3] = vec4(0 - g3[0], 0 - g3[1], 0 - g3[2], zero)

    @ti.func
    def apart(kind: ti.template(), n, y1, y2, y3):
        """How far apart along n all corners of the two primitives are: their distance is at least that, whatever n."""
        y, d = (0 * y1, y1, y2, y3), ti.cast(1e30, fp)
        for a, b in ti.static(OPPOSITE[kind]):
            d = ti.min(d, n.dot(y[a] - y[b]))
        return d

    @ti.func
    def unit(v):
        return v / ti.max(ti.sqrt(v.norm_sqr()), ti.cast(1e-30, fp))

    @ti.func
    def guess(kind: ti.template(), y1, y2, y3):
        """A normal along which the two primitives are likely to be apart: across both, or from one middle to the other."""
        across, between = y1.cross(y3 - y2), ti.cast(0.5, fp) * (y1 - y2 - y3)
        if ti.static(kind == VERTEX_TRIANGLE):
            across, between = (y2 - y1).cross(y3 - y1), 0 - (y1 + y2 + y3)
        if across.dot(between) < 0:
            across = 0 - across
        n, other = unit(across), unit(between)
        if apart(kind, other, y1, y2, y3) > apart(kind, n, y1, y2, y3):
            n = other
        return n

    @ti.func
    def force(kind: ti.template(), p, scale, scene: A, slot):
        stiffness, width = scene.parameters[first], scene.parameters[first + 1]
        y1, y2, y3 = corners(p, scene, slot)
        last = scene.plane[p]
        n, energy, g1, g2, g3 = vec3(last[0], last[1], last[2]), ti.cast(0, fp), vec3(0), vec3(0), vec3(0)
        if last[0] == 0 and last[1] == 0 and last[2] == 0:  # a new list
            n = guess(kind, y1, y2, y3)
        d = apart(kind, n, y1, y2, y3)
        # the plane of the pass before spares most pairs the search; the margin is for rounding
        if not d > ti.cast(MARGIN, fp) * width or scene.exact > 0:
            energy, n, d, g1, g2, g3 = f.gradient(kind, y1, y2, y3, scale, stiffness, width)
        scene.plane[p] = vec4(n[0], n[1], n[2], d)
        scene.energy[p] = energy
        if not d > width:
            store(p, scene.corner, g1, g2, g3)
            for k in ti.static(range(4)):
                scene.touched[scene.place[scene.pairs[4 * p + k]]] = 1

    @ti.kernel
    def forces(
        pairs: ints,
        scales: scalars,
        surface: ints,
        place: ints,
        row: ints,
        corner_of: ints,
        rest: vectors,
        parameters: scalars,
        u: vectors2,
        corner: vectors,
        plane: vectors,
        energy: scalars,
        touched: ints,
        before: vectors,
        out: vectors,
        slot: ti.i32,
        num_vt: ti.i32,
        num_ee: ti.i32,
        num_surface: ti.i32,
        first_out: ti.i32,
        exact: ti.i32,
    ):
        """Forces at u[slot]; keeps a plane (n, d) that parts each pair, and where the surface was.

        d is the distance of a pair that is nearer than the width or if `exact`, else a lower bound of it.
        """
        scene = Bundle(
            pairs=pairs,
            place=place,
            rest=rest,
            parameters=parameters,
            u=u,
            corner=corner,
            plane=plane,
            energy=energy,
            touched=touched,
            exact=exact,
        )
        ti.loop_config(serialize=not parallel)
        for p in range(num_vt):
            force(VERTEX_TRIANGLE, p, ti.cast(0, fp), scene, slot)
        ti.loop_config(serialize=not parallel)
        for q in range(num_ee):
            force(EDGE_EDGE, num_vt + q, scales[q], scene, slot)
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            total = vec4(0)
            if touched[s] > 0:
                touched[s] = 0
                for k in range(row[s], row[s + 1]):
                    if not plane[corner_of[k] >> 2][3] > parameters[first + 1]:
                        total += corner[corner_of[k]]
            out[first_out + s] = total
            before[s] = u[slot, surface[s]]

    @ti.func
    def product(kind: ti.template(), p, scale, scene: A, slot):
        stiffness, width = scene.parameters[first], scene.parameters[first + 1]
        y1, y2, y3 = corners(p, scene, slot)
        dy1, dy2, dy3 = changes(p, scene)
        h1, h2, h3, by_stiffness, by_width = f.gradient_jvp(
            kind, y1, y2, y3, dy1, dy2, dy3, scale, stiffness, width, scene.d_stiffness, scene.d_width
        )
        store(p, scene.corner, h1, h2, h3)
        # minus, as the force is minus the gradient; the pair's two numbers wait at its plane's place
        scene.numbers[p] = vec4(0 - by_stiffness, 0 - by_width, ti.cast(0, fp), ti.cast(0, fp))

    @ti.kernel
    def products(
        pairs: ints,
        scales: scalars,
        row: ints,
        corner_of: ints,
        rest: vectors,
        parameters: scalars,
        u: vectors2,
        w: vectors2,
        rest_dot: vectors,
        corner: vectors,
        numbers: vectors,
        out: vectors,
        slot: ti.i32,
        num_vt: ti.i32,
        num_ee: ti.i32,
        num_surface: ti.i32,
        first_out: ti.i32,
        by_rest: ti.i32,
        d_stiffness: fp,
        d_width: fp,
    ):
        """Change of the forces at u[slot] for changes w of the positions (and of rest shape, stiffness and width)."""
        scene = Bundle(
            pairs=pairs,
            rest=rest,
            parameters=parameters,
            u=u,
            w=w,
            rest_dot=rest_dot,
            corner=corner,
            numbers=numbers,
            by_rest=by_rest,
            d_stiffness=d_stiffness,
            d_width=d_width,
        )
        ti.loop_config(serialize=not parallel)
        for p in range(num_vt):
            product(VERTEX_TRIANGLE, p, ti.cast(0, fp), scene, slot)
        ti.loop_config(serialize=not parallel)
        for q in range(num_ee):
            product(EDGE_EDGE, num_vt + q, scales[q], scene, slot)
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            total = vec4(0)
            for k in range(row[s], row[s + 1]):
                total += corner[corner_of[k]]
            out[first_out + s] = total

    @ti.kernel
    def add_sums(
        row: ints,
        corner_of: ints,
        numbers: vectors,
        out: vectors,
        sums: vectors,
        rest_adj: vectors,
        num_surface: ti.i32,
        first_out: ti.i32,
    ):
        """Adjoints of stiffness and width, each pair at its corner 0, and of the rest shape, after `products`."""
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            total = vec4(0)
            for k in range(row[s], row[s + 1]):
                if corner_of[k] & 3 == 0:
                    total += numbers[corner_of[k] >> 2]
            sums[s] = sums[s] + total
            rest_adj[s] = rest_adj[s] + out[first_out + s]

    return SimpleNamespace(
        forces=forces,
        products=products,
        add_sums=add_sums,
        of=of,
        corners=corners,
        store=store,
        fp=fp,
        vector=vec4,
        vec3=vec3,
    )
