"""Kernels over the pairs of a surface for Newton's method: products of the Hessian, its diagonal, and safe shares of a step.

They read the planes that `forces` (pair_kernels.py) left at the same displacement: a pair that its plane keeps beyond the
width has no part in the Hessian.
"""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.contact.pair_kernels import OPPOSITE, pair_kernels
from diffsim_ti.contact.proximity import EDGE_EDGE, VERTEX_TRIANGLE, pair_functions
from diffsim_ti.runtime import Bundle

A = ti.template()


@lru_cache(maxsize=None)
def hessian_kernels(precision: str, first: int, parallel: bool) -> SimpleNamespace:
    """Kernels for the numbers (stiffness, width) at `first` in the parameter array."""
    f, pair = pair_functions(precision), pair_kernels(precision, first, parallel)
    fp, vec3, vec4 = f.fp, f.vec3, ti.types.vector(4, f.fp)
    ints, scalars = ti.types.ndarray(ti.i32, 1), ti.types.ndarray(fp, 1)
    vectors, vectors2 = ti.types.ndarray(vec4, 1), ti.types.ndarray(vec4, 2)

    @ti.func
    def changes(p, scene: A):
        """Vectors w of corners 1 to 3 of pair p relative to corner 0's."""
        c0 = scene.pairs[4 * p]
        return (
            pair.of(scene.w, c0, scene.pairs[4 * p + 1], 0),
            pair.of(scene.w, c0, scene.pairs[4 * p + 2], 0),
            pair.of(scene.w, c0, scene.pairs[4 * p + 3], 0),
        )

    @ti.func
    def stiffness_along(kind: ti.template(), y1, y2, y3, scale, scene: A):
        """(weights of the corners, n, m phi''): the convex part of a pair's Hessian is m phi'' (w n)(w n)^T."""
        number, width = scene.parameters[first], scene.parameters[first + 1]
        w, r, _ = f.nearest(kind, y1, y2, y3)
        d = ti.sqrt(r.norm_sqr())
        k = ti.cast(0, fp)
        if d < width:
            k = number * f.curvature(d / width)
            if ti.static(kind == EDGE_EDGE):
                m, _, _ = f.mollifier((scale * y1.cross(y3 - y2)).norm_sqr())
                k *= m
        return w, r / ti.max(d, ti.cast(1e-30, fp)), k

    @ti.func
    def is_felt(p, scene: A):
        return not scene.plane[p][3] > scene.parameters[first + 1]

    @ti.func
    def product(kind: ti.template(), p, scale, scene: A):
        h1, h2, h3 = vec3(0), vec3(0), vec3(0)
        if is_felt(p, scene):
            y1, y2, y3 = pair.corners(p, scene, 0)
            dy1, dy2, dy3 = changes(p, scene)
            if scene.convex > 0:
                w, n, k = stiffness_along(kind, y1, y2, y3, scale, scene)
                pull = k * (w[1] * n.dot(dy1) + w[2] * n.dot(dy2) + w[3] * n.dot(dy3)) * n
                h1, h2, h3 = w[1] * pull, w[2] * pull, w[3] * pull
            else:
                zero = ti.cast(0, fp)
                h1, h2, h3, _, _ = f.gradient_jvp(
                    kind,
                    y1,
                    y2,
                    y3,
                    dy1,
                    dy2,
                    dy3,
                    scale,
                    scene.parameters[first],
                    scene.parameters[first + 1],
                    zero,
                    zero,
                )
        pair.store(p, scene.corner, h1, h2, h3)

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
        corner: vectors,
        plane: vectors,
        out: vectors,
        num_vt: ti.i32,
        num_ee: ti.i32,
        num_surface: ti.i32,
        first_out: ti.i32,
        convex: ti.i32,
    ):
        """Change of the forces for changes w of the positions; `convex`: of the convex part of the energy alone."""
        scene = Bundle(
            pairs=pairs, rest=rest, parameters=parameters, u=u, w=w, corner=corner, plane=plane, convex=convex
        )
        ti.loop_config(serialize=not parallel)
        for p in range(num_vt):
            product(VERTEX_TRIANGLE, p, ti.cast(0, fp), scene)
        ti.loop_config(serialize=not parallel)
        for q in range(num_ee):
            product(EDGE_EDGE, num_vt + q, scales[q], scene)
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            total = vec4(0)
            for k in range(row[s], row[s + 1]):
                total += corner[corner_of[k]]
            out[first_out + s] = total

    @ti.func
    def root(kind: ti.template(), p, scale, scene: A):
        """Of each corner, the vector c with c c^T its diagonal block of the convex part."""
        c = (vec4(0), vec4(0), vec4(0), vec4(0))
        if is_felt(p, scene):
            y1, y2, y3 = pair.corners(p, scene, 0)
            w, n, k = stiffness_along(kind, y1, y2, y3, scale, scene)
            for a in ti.static(range(4)):
                v = w[a] * ti.sqrt(k) * n
                c[a] += vec4(v[0], v[1], v[2], ti.cast(0, fp))
        for a in ti.static(range(4)):
            scene.corner[4 * p + a] = c[a]

    @ti.kernel
    def blocks(
        pairs: ints,
        scales: scalars,
        row: ints,
        corner_of: ints,
        surface: ints,
        rest: vectors,
        parameters: scalars,
        u: vectors2,
        corner: vectors,
        plane: vectors,
        out: vectors2,
        num_vt: ti.i32,
        num_ee: ti.i32,
        num_surface: ti.i32,
    ):
        """Adds the 3x3 diagonal blocks of the convex part to rows 0..2 of `out`, one column of each vertex."""
        scene = Bundle(pairs=pairs, rest=rest, parameters=parameters, u=u, corner=corner, plane=plane)
        ti.loop_config(serialize=not parallel)
        for p in range(num_vt):
            root(VERTEX_TRIANGLE, p, ti.cast(0, fp), scene)
        ti.loop_config(serialize=not parallel)
        for q in range(num_ee):
            root(EDGE_EDGE, num_vt + q, scales[q], scene)
        ti.loop_config(serialize=not parallel)
        for s in range(num_surface):
            for d in ti.static(range(3)):
                column = vec4(0)
                for k in range(row[s], row[s + 1]):
                    c = corner[corner_of[k]]
                    column += c[d] * c
                out[d, surface[s]] += column

    @ti.func
    def share(kind: ti.template(), p, scene: A, most):
        """The share of the step w after which the pair has closed along its plane's normal by the share `most` of its gap;
        above 1 it may take the step whole."""
        plane, closing = scene.plane[p], ti.cast(0, fp)
        n = vec3(plane[0], plane[1], plane[2])
        for a, b in ti.static(OPPOSITE[kind]):
            closing = ti.max(closing, n.dot(pair.of(scene.w, scene.pairs[4 * p + a], scene.pairs[4 * p + b], 0)))
        return most * plane[3] / ti.max(closing, ti.cast(1e-30, fp))

    @ti.kernel
    def shares(pairs: ints, w: vectors2, plane: vectors, out: scalars, num_vt: ti.i32, num_ee: ti.i32, most: fp):
        scene = Bundle(pairs=pairs, w=w, plane=plane)
        ti.loop_config(serialize=not parallel)
        for p in range(num_vt):
            out[p] = share(VERTEX_TRIANGLE, p, scene, most)
        ti.loop_config(serialize=not parallel)
        for q in range(num_ee):
            out[num_vt + q] = share(EDGE_EDGE, num_vt + q, scene, most)

    return SimpleNamespace(products=products, blocks=blocks, shares=shares)
