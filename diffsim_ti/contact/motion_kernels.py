"""Kernels that follow the motion of a surface: whether a list of pairs still holds, and whether a pair may have crossed."""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.contact.pair_kernels import BLOCK, MARGIN, OPPOSITE, SAFE, pair_kernels
from diffsim_ti.contact.proximity import EDGE_EDGE, VERTEX_TRIANGLE
from diffsim_ti.runtime import Bundle

A = ti.template()


@lru_cache(maxsize=None)
def motion_kernels(precision: str, first: int, parallel: bool) -> SimpleNamespace:
    """Kernels beside those of `pair_kernels`."""
    pairs_of = pair_kernels(precision, first, parallel)
    fp, vec3, vec4, of = pairs_of.fp, pairs_of.vec3, pairs_of.vector, pairs_of.of
    ints, scalars = ti.types.ndarray(ti.i32, 1), ti.types.ndarray(fp, 1)
    vectors, vectors2 = ti.types.ndarray(vec4, 1), ti.types.ndarray(vec4, 2)

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

    return SimpleNamespace(check=check, begin=begin)
