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

    @ti.func
    def closing(kind: ti.template(), p, scene: A):
        """How far the corners of pair p have come towards each other along n since `forces`."""
        n, most = vec3(scene.plane[p][0], scene.plane[p][1], scene.plane[p][2]), ti.cast(-1e30, fp)
        for a, b in ti.static(OPPOSITE[kind]):
            i, k = scene.pairs[4 * p + a], scene.pairs[4 * p + b]
            y = scene.before[scene.place[i]] - scene.before[scene.place[k]]
            most = ti.max(most, n.dot(of(scene.u, i, k, scene.slot) + vec3(y[0], y[1], y[2])))
        return most

    @ti.kernel
    def check(
        pairs: ints,
        surface: ints,
        place: ints,
        body: ints,
        slack: vectors,
        marked: ints,
        u: vectors2,
        before: vectors,
        built: vectors,
        frame: vectors,
        farthest: scalars,
        plane: vectors,
        flags: ints,
        slot: ti.i32,
        num_vt: ti.i32,
        num_ee: ti.i32,
        num_surface: ti.i32,
        num_bodies: ti.i32,
        markers: ti.i32,
        lost: fp,
    ):
        """flags: a vertex has used up its slack (0), or that and `lost` (1); a pair may have crossed (2).

        frame: mean motion of each body's markers since the list was made, and their mean, which motion is relative to.
        Two convex sets that a plane parts cannot meet while their corners move in straight lines and stay parted. No pair
        closes by more than twice the farthest that a vertex has moved relative to the mean since `forces`, which spares
        most pairs the look at their corners. farthest: that of each BLOCK vertices, squared, then of all.
        """
        scene = Bundle(pairs=pairs, place=place, u=u, before=before, plane=plane, slot=slot)
        ti.loop_config(serialize=True)
        for k in range(3):
            flags[k] = 0
        ti.loop_config(serialize=not parallel)
        for b in range(num_bodies):
            total = vec4(0)
            for k in range(b * markers, (b + 1) * markers):
                total += u[slot, surface[marked[k]]] - built[marked[k]]
            frame[b] = (ti.cast(1, fp) / ti.cast(markers, fp)) * total
        ti.loop_config(serialize=True)
        for _ in range(1):
            total, latest = vec4(0), vec4(0)
            for b in range(num_bodies):
                total += frame[b]
                latest += u[slot, surface[marked[b * markers]]] - before[marked[b * markers]]
            frame[num_bodies] = (ti.cast(1, fp) / ti.cast(num_bodies, fp)) * total
            frame[num_bodies + 1] = (ti.cast(1, fp) / ti.cast(num_bodies, fp)) * latest
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            move = u[slot, surface[s]] - built[s]
            for k in range(1 + ti.cast(num_bodies > 1, ti.i32)):
                origin, limit = frame[body[s]], slack[s][0]
                if k == 1:
                    origin, limit = frame[num_bodies], slack[s][1]
                square = (move - origin).norm_sqr()
                if not square <= limit * limit:
                    flags[0] = 1
                if not square <= (limit + lost) * (limit + lost):
                    flags[1] = 1
        blocks = (num_surface + BLOCK - 1) // BLOCK
        ti.loop_config(serialize=not parallel)
        for b in range(blocks):
            most = ti.cast(0, fp)
            for s in range(b * BLOCK, ti.min((b + 1) * BLOCK, num_surface)):
                most = ti.max(most, (u[slot, surface[s]] - before[s] - frame[num_bodies + 1]).norm_sqr())
            farthest[b] = most
        ti.loop_config(serialize=True)
        for _ in range(1):
            most = ti.cast(0, fp)
            for b in range(blocks):
                most = ti.max(most, farthest[b])
            farthest[blocks] = ti.cast(2 * MARGIN, fp) * ti.sqrt(most)
        ti.loop_config(serialize=not parallel)
        for p in range(num_vt):
            room = ti.cast(SAFE, fp) * plane[p][3]
            if not farthest[blocks] <= room:
                if not closing(VERTEX_TRIANGLE, p, scene) <= room:
                    flags[2] = 1
        ti.loop_config(serialize=not parallel)
        for q in range(num_ee):
            room = ti.cast(SAFE, fp) * plane[num_vt + q][3]
            if not farthest[blocks] <= room:
                if not closing(EDGE_EDGE, num_vt + q, scene) <= room:
                    flags[2] = 1

    @ti.kernel
    def begin(
        surface: ints, u: vectors2, built: vectors, plane: vectors, slot: ti.i32, num_surface: ti.i32, count: ti.i32
    ):
        """A new list: where the surface is, and no planes yet."""
        for p in range(count):
            plane[p] = vec4(0)
        for s in range(num_surface):
            built[s] = u[slot, surface[s]]

    return SimpleNamespace(
        forces=forces,
        products=products,
        add_sums=add_sums,
        check=check,
        begin=begin,
        of=of,
        corners=corners,
        store=store,
        fp=fp,
        vector=vec4,
    )
