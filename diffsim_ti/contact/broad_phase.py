"""Which pairs of surface primitives lie within reach of each other: cells in a hash table, linear in their number.

Boxes of triangles and of edges, widened by the reach, are put into the cells of a uniform grid that they overlap; cells live
in a hash table, so that it does not matter how far bodies fly apart. A vertex looks into its own cell for triangles; two
edges meet in the cell of the lowest common corner of their boxes, once. Pairs are kept if they are within reach and share
no vertex, sorted by (vertex, triangle) and (edge, edge), so that the list depends on positions alone and not on threads.
Teschner et al. 2003, Optimized Spatial Hashing for Collision Detection of Deformable Objects, VMV 2003, 47-54.
"""

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.contact.proximity import EDGE_EDGE, VERTEX_TRIANGLE, pair_functions
from diffsim_ti.runtime import Bundle

A = ti.template()
BLOCK = 256  # numbers that one thread sums
LARGEST_SPAN = 64  # cells that the largest box covers along an axis


@lru_cache(maxsize=None)
def broad_phase_kernels(precision: str) -> SimpleNamespace:
    """Kernels of the search; `slot` of u holds the displacements."""
    f = pair_functions(precision)
    fp, vec3 = f.fp, f.vec3
    ints, vectors = ti.types.ndarray(ti.i32, 1), ti.types.ndarray(ti.types.vector(4, fp), 1)
    vectors2, scalars = ti.types.ndarray(ti.types.vector(4, fp), 2), ti.types.ndarray(fp, 1)

    @ti.func
    def place(i, scene: A, slot):
        x = scene.rest[i] + scene.u[slot, i]
        return vec3(x[0], x[1], x[2])

    @ti.func
    def between(i, k, scene: A, slot):
        """x_k - x_i, without the rounding of the positions."""
        y = (scene.rest[k] - scene.rest[i]) + (scene.u[slot, k] - scene.u[slot, i])
        return vec3(y[0], y[1], y[2])

    @ti.func
    def cell_of(x, inverse_size):
        """Cell of a coordinate."""
        limit = ti.cast(1e9, fp)
        return ti.cast(ti.floor(ti.min(ti.max(x * inverse_size, 0 - limit), limit)), ti.i32)

    @ti.func
    def key_of(cx, cy, cz):
        """A name of a cell that cells within 1000 of each other along an axis do not share."""
        return (cx & 1023) | ((cy & 1023) << 10) | ((cz & 1023) << 20)

    @ti.func
    def bucket_of(key, mask):
        h = key * 73856093
        return (h ^ (h >> 15)) & mask

    @ti.kernel
    def find_extent(rest: vectors, u: vectors2, corners: ints, extent: scalars, slot: ti.i32, count: ti.i32, size: ti.i32):
        """Largest side of the box of each primitive of `size` corners."""
        scene = Bundle(rest=rest, u=u)
        for p in range(count):
            lo = place(corners[size * p], scene, slot)
            hi = lo
            for k in range(1, size):
                x = place(corners[size * p + k], scene, slot)
                lo, hi = ti.min(lo, x), ti.max(hi, x)
            extent[p] = (hi - lo).max()

    @ti.kernel
    def find_boxes(rest: vectors, u: vectors2, corners: ints, box: ints, slot: ti.i32, count: ti.i32, size: ti.i32,
                   margin: fp, inverse_size: fp):  # fmt: skip
        """Lowest and highest cell of the widened box of each primitive."""
        scene = Bundle(rest=rest, u=u)
        for p in range(count):
            lo = place(corners[size * p], scene, slot)
            hi = lo
            for k in range(1, size):
                x = place(corners[size * p + k], scene, slot)
                lo, hi = ti.min(lo, x), ti.max(hi, x)
            for d in ti.static(range(3)):
                box[6 * p + d] = cell_of(lo[d] - margin, inverse_size)
                box[6 * p + 3 + d] = cell_of(hi[d] + margin, inverse_size)

    @ti.kernel
    def fill_cells(box: ints, start: ints, cursor: ints, entries: ints, keys: ints, count: ti.i32, mask: ti.i32,
                   counting: ti.i32):  # fmt: skip
        """Count the entries of each bucket of cells, or write them."""
        for p in range(count):
            for cx in range(box[6 * p], box[6 * p + 3] + 1):
                for cy in range(box[6 * p + 1], box[6 * p + 4] + 1):
                    for cz in range(box[6 * p + 2], box[6 * p + 5] + 1):
                        key = key_of(cx, cy, cz)
                        b = bucket_of(key, mask)
                        k = ti.atomic_add(cursor[b], 1)  # the order in a bucket does not matter: pairs are sorted
                        if counting == 0:
                            entries[start[b] + k] = p
                            keys[start[b] + k] = key

    @ti.func
    def sort(row: A, first, last):
        for k in range(first + 1, last):
            value, at = row[k], k
            while at > first and row[at - 1] > value:
                row[at] = row[at - 1]
                at -= 1
            row[at] = value

    @ti.kernel
    def find_vertex_triangle(rest: vectors, u: vectors2, surface: ints, triangles: ints, start: ints, entries: ints,
                             keys: ints, row: ints, partner: ints, slot: ti.i32, count: ti.i32, mask: ti.i32, reach: fp,
                             inverse_size: fp, room: ti.i32):  # fmt: skip
        """Triangles within reach of each surface vertex, in order, at most `room`, and their number."""
        scene = Bundle(rest=rest, u=u)
        for s in range(count):
            i = surface[s]
            x = place(i, scene, slot)
            key = key_of(cell_of(x[0], inverse_size), cell_of(x[1], inverse_size), cell_of(x[2], inverse_size))
            b, found = bucket_of(key, mask), 0
            for k in range(start[b], start[b + 1]):
                p = entries[k]
                c1, c2, c3 = triangles[3 * p], triangles[3 * p + 1], triangles[3 * p + 2]
                if keys[k] == key and c1 != i and c2 != i and c3 != i:
                    y1, y2, y3 = between(i, c1, scene, slot), between(i, c2, scene, slot), between(i, c3, scene, slot)
                    gap = ti.max(ti.max(ti.min(ti.min(y1, y2), y3), 0 - ti.max(ti.max(y1, y2), y3)), ti.cast(0, fp))
                    if gap.norm_sqr() < reach * reach:
                        w, r, g = f.nearest(VERTEX_TRIANGLE, y1, y2, y3)
                        if r.norm_sqr() < reach * reach:
                            if found < room:
                                partner[room * s + found] = p
                            found += 1
            row[s] = found
            sort(partner, room * s, room * s + ti.min(found, room))

    @ti.kernel
    def find_edge_edge(rest: vectors, u: vectors2, edges: ints, box: ints, start: ints, entries: ints, keys: ints, row: ints,
                       partner: ints, slot: ti.i32, count: ti.i32, mask: ti.i32, reach: fp, room: ti.i32):  # fmt: skip
        """Edges of larger number within reach of each edge, in order, at most `room`, and their number."""
        scene = Bundle(rest=rest, u=u)
        for e in range(count):
            i, j, found = edges[2 * e], edges[2 * e + 1], 0
            y1 = between(i, j, scene, slot)
            for cx in range(box[6 * e], box[6 * e + 3] + 1):
                for cy in range(box[6 * e + 1], box[6 * e + 4] + 1):
                    for cz in range(box[6 * e + 2], box[6 * e + 5] + 1):
                        key = key_of(cx, cy, cz)
                        b = bucket_of(key, mask)
                        for k in range(start[b], start[b + 1]):
                            p = entries[k]
                            if p > e and keys[k] == key:
                                i2, j2 = edges[2 * p], edges[2 * p + 1]
                                here = (
                                    ti.max(box[6 * e], box[6 * p]) == cx
                                    and ti.max(box[6 * e + 1], box[6 * p + 1]) == cy
                                    and ti.max(box[6 * e + 2], box[6 * p + 2]) == cz
                                )
                                if here and i2 != i and i2 != j and j2 != i and j2 != j:
                                    y2, y3 = between(i, i2, scene, slot), between(i, j2, scene, slot)
                                    lo, hi = ti.min(y2, y3) - ti.max(y1, vec3(0)), ti.min(y1, vec3(0)) - ti.max(y2, y3)
                                    gap = ti.max(ti.max(lo, hi), ti.cast(0, fp))
                                    if gap.norm_sqr() < reach * reach:
                                        w, r, g = f.nearest(EDGE_EDGE, y1, y2, y3)
                                        if r.norm_sqr() < reach * reach:
                                            if found < room:
                                                partner[room * e + found] = p
                                            found += 1
            row[e] = found
            sort(partner, room * e, room * e + ti.min(found, room))

    @ti.kernel
    def write_pairs(surface: ints, triangles: ints, edges: ints, row_t: ints, row_e: ints, partner_t: ints, partner_e: ints,
                    lengths: scalars, pairs: ints, scale: scalars, num_surface: ti.i32, num_edges: ti.i32, num_vt: ti.i32,
                    room_t: ti.i32, room_e: ti.i32, factor: fp):  # fmt: skip
        """Corners of each pair, four indices of vertices; and, of edges, 1 / sqrt(threshold of |a x b|^2)."""
        for s in range(num_surface):
            for p in range(row_t[s], row_t[s + 1]):
                pairs[4 * p] = surface[s]
                for k in ti.static(range(3)):
                    pairs[4 * p + 1 + k] = triangles[3 * partner_t[room_t * s + p - row_t[s]] + k]
        for e in range(num_edges):
            for q in range(row_e[e], row_e[e + 1]):
                p, other = num_vt + q, partner_e[room_e * e + q - row_e[e]]
                for k in ti.static(range(2)):
                    pairs[4 * p + k] = edges[2 * e + k]
                    pairs[4 * p + 2 + k] = edges[2 * other + k]
                scale[q] = factor / (lengths[e] * lengths[other])

    @ti.kernel
    def fill_rows(pairs: ints, place_of: ints, row: ints, cursor: ints, corner: ints, count: ti.i32, counting: ti.i32):
        """Corners of pairs that meet at each surface vertex: their number, or themselves."""
        for c in range(count):
            s = place_of[pairs[c]]
            k = ti.atomic_add(cursor[s], 1)
            if counting == 0:
                corner[row[s] + k] = c

    @ti.kernel
    def sort_rows(row: ints, corner: ints, count: ti.i32):
        for s in range(count):
            sort(corner, row[s], row[s + 1])

    @ti.kernel
    def find_piercing(rest: vectors, u: vectors2, edges: ints, triangles: ints, box: ints, start: ints, entries: ints,
                      keys: ints, pierced: ints, slot: ti.i32, count: ti.i32, mask: ti.i32):  # fmt: skip
        """pierced[e]: the first triangle that edge e passes through, or -1."""
        scene = Bundle(rest=rest, u=u)
        for e in range(count):
            pierced[e] = -1
            i, j = edges[2 * e], edges[2 * e + 1]
            for cx in range(box[6 * e], box[6 * e + 3] + 1):
                for cy in range(box[6 * e + 1], box[6 * e + 4] + 1):
                    for cz in range(box[6 * e + 2], box[6 * e + 5] + 1):
                        key = key_of(cx, cy, cz)
                        b = bucket_of(key, mask)
                        for k in range(start[b], start[b + 1]):
                            p = entries[k]
                            c1, c2, c3 = triangles[3 * p], triangles[3 * p + 1], triangles[3 * p + 2]
                            apart = c1 != i and c2 != i and c3 != i and c1 != j and c2 != j and c3 != j
                            if keys[k] == key and apart:
                                y1, a = between(i, c1, scene, slot), between(i, j, scene, slot)
                                e1, e2 = between(c1, c2, scene, slot), between(c1, c3, scene, slot)
                                normal = e1.cross(e2)
                                before, after = 0 - y1.dot(normal), (a - y1).dot(normal)
                                if before * after <= 0 and before != after:
                                    x = (before / (before - after)) * a - y1
                                    s, t = x.cross(e2).dot(normal), e1.cross(x).dot(normal)
                                    if s >= 0 and t >= 0 and s + t <= normal.norm_sqr():
                                        pierced[e] = ti.max(pierced[e], p)

    return SimpleNamespace(
        find_extent=find_extent, find_boxes=find_boxes, fill_cells=fill_cells, find_vertex_triangle=find_vertex_triangle,
        find_edge_edge=find_edge_edge, write_pairs=write_pairs, fill_rows=fill_rows, sort_rows=sort_rows,
        find_piercing=find_piercing, fp=fp,
    )  # fmt: skip


@ti.kernel
def _scan(values: ti.types.ndarray(ti.i32, 1), sums: ti.types.ndarray(ti.i32, 1), count: ti.i32, blocks: ti.i32):
    """values[k] becomes the sum of those before k; values[count], which must be there, the sum of all."""
    for b in range(blocks):
        total = 0
        for k in range(b * BLOCK, ti.min((b + 1) * BLOCK, count)):
            total += values[k]
        sums[b] = total
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for b in range(blocks):
            part = sums[b]
            sums[b] = total
            total += part
        values[count] = total
    for b in range(blocks):
        total = sums[b]
        for k in range(b * BLOCK, ti.min((b + 1) * BLOCK, count)):
            part = values[k]
            values[k] = total
            total += part


@ti.kernel
def _clear(values: ti.types.ndarray(ti.i32, 1), count: ti.i32):
    for k in range(count):
        values[k] = 0


@ti.kernel
def _copy_number(values: ti.types.ndarray(ti.i32, 1), at: ti.i32, out: ti.types.ndarray(ti.i32, 1)):
    for _ in range(1):
        out[0] = values[at]


class Buffers:
    """Arrays that grow: `take` hands out one of at least the length asked for, by name."""

    def __init__(self):
        self._arrays, self._total = {}, runtime.array(ti.i32, 1)
        self.version = 0  # how often some array was replaced

    def take(self, name: str, dtype, count: int):
        """The array of that name, made anew, half as long again, if it is too short."""
        have = self._arrays.get(name)
        if have is None or have.shape[0] < count:
            self._arrays[name] = have = runtime.array(dtype, max(16, count + count // 2 if have is not None else count))
            self.version += 1
        return have

    def scan(self, values, count: int) -> int:
        """Exclusive sums in place, over count + 1 numbers; returns the last, the sum of all."""
        blocks = -(-count // BLOCK)
        _scan(values, self.take("sums", ti.i32, max(blocks, 1)), count, blocks)
        _copy_number(values, count, self._total)
        return int(runtime.fetch(self._total)[0])


class Cells:
    """The hash table of the boxes of one kind of primitives (corners: flat indices, `size` each)."""

    def __init__(self, corners: np.ndarray, buffers: Buffers, name: str, precision: str):
        self.count, self.size = corners.shape
        self.corners = runtime.upload(corners.ravel(), ti.i32)
        self.kernels, self.buffers, self.name = broad_phase_kernels(precision), buffers, name
        self.box = runtime.array(ti.i32, 6 * self.count)
        self.num_buckets = 1 << max(4, self.count.bit_length())
        self.start, self.cursor = (runtime.array(ti.i32, self.num_buckets + 1) for _ in range(2))

    def fill(self, rest, u, slot: int, margin: float, cell: float) -> None:
        """Put boxes widened by `margin` [m] into cells of side `cell` [m]."""
        k, mask = self.kernels, self.num_buckets - 1
        k.find_boxes(rest, u, self.corners, self.box, slot, self.count, self.size, margin, 1 / cell)
        none = self.start  # not touched while counting
        _clear(self.start, self.num_buckets + 1)
        k.fill_cells(self.box, self.cursor, self.start, none, none, self.count, mask, 1)
        total = self.buffers.scan(self.start, self.num_buckets)
        self.entries, self.keys = (self.buffers.take(f"{self.name} {part}", ti.i32, total) for part in ("entries", "keys"))
        _clear(self.cursor, self.num_buckets + 1)
        k.fill_cells(self.box, self.start, self.cursor, self.entries, self.keys, self.count, mask, 0)


class CandidatePairs:
    """Pairs of a surface within reach: `pairs`, four vertices each, first vertex-triangle, then edge-edge.

    scale: of each edge pair, 1 / sqrt(10^-3 A^2 B^2) with the lengths A, B given. row, corner: the corners 4 p + k that
    meet at surface vertex s are corner[row[s] : row[s + 1]], in order.
    """

    def __init__(self, num_vertices: int, surface: np.ndarray, triangles: np.ndarray, edges: np.ndarray,
                 lengths: np.ndarray, precision: str):  # fmt: skip
        self.precision, self.kernels, self.buffers = precision, broad_phase_kernels(precision), Buffers()
        self.surface, self.num_surface = runtime.upload(surface, ti.i32), len(surface)
        self.triangles = Cells(triangles, self.buffers, "triangle", precision)
        self.edges = Cells(edges, self.buffers, "edge", precision)
        self.lengths, self.typical = runtime.upload(lengths, self.kernels.fp), float(lengths.mean())
        place = np.full(num_vertices, -1)
        place[surface] = np.arange(len(surface))
        self.place = runtime.upload(place, ti.i32)
        self.row_t, self.row_e = runtime.array(ti.i32, len(surface) + 1), runtime.array(ti.i32, len(edges) + 1)
        self.row, self.cursor = (runtime.array(ti.i32, len(surface) + 1) for _ in range(2))
        self.extent = runtime.array(self.kernels.fp, self.triangles.count)
        self.num_vt = self.num_ee = 0
        self.room = {"vt": 16, "ee": 32}  # partners kept of each vertex and edge; grows
        self._take()

    def _take(self) -> None:
        count, b = self.num_vt + self.num_ee, self.buffers
        self.pairs, self.corner = b.take("pairs", ti.i32, 4 * count), b.take("corner", ti.i32, 4 * count)
        self.scale = b.take("scale", self.kernels.fp, self.num_ee)

    @property
    def count(self) -> int:
        return self.num_vt + self.num_ee

    def _find(self, name: str, kernel, arrays: tuple, row, slot: int, count: int, *numbers):
        """Partners of each of `count` primitives, `room` places for each, and their numbers in `row`."""
        while True:
            partner = self.buffers.take(name, ti.i32, self.room[name] * count)
            kernel(*arrays, partner, slot, count, *numbers, self.room[name])
            most = int(runtime.fetch(row)[:count].max(initial=0))
            if most <= self.room[name]:
                return partner
            self.room[name] = most + most // 2

    def build(self, rest, u, slot: int, reach: float) -> None:
        """Find all pairs nearer than `reach` [m] at rest + u[slot]."""
        k, b, ns, ne = self.kernels, self.buffers, self.num_surface, self.edges.count
        t, e = self.triangles, self.edges
        k.find_extent(rest, u, t.corners, self.extent, slot, t.count, 3)
        largest = float(runtime.fetch(self.extent).max(initial=0))
        cell, reach = max(self.typical + reach, largest / LARGEST_SPAN), float(reach)
        t.fill(rest, u, slot, 1.01 * reach, cell)  # a hundredth more than rounding can take
        e.fill(rest, u, slot, 0.505 * reach, cell)
        vt = (rest, u, self.surface, t.corners, t.start, t.entries, t.keys, self.row_t)
        ee = (rest, u, e.corners, e.box, e.start, e.entries, e.keys, self.row_e)
        partner_t = self._find("vt", k.find_vertex_triangle, vt, self.row_t, slot, ns, t.num_buckets - 1, reach, 1 / cell)
        partner_e = self._find("ee", k.find_edge_edge, ee, self.row_e, slot, ne, e.num_buckets - 1, reach)
        self.num_vt, self.num_ee = b.scan(self.row_t, ns), b.scan(self.row_e, ne)
        self._take()
        k.write_pairs(self.surface, t.corners, e.corners, self.row_t, self.row_e, partner_t, partner_e, self.lengths,
                      self.pairs, self.scale, ns, ne, self.num_vt, self.room["vt"], self.room["ee"], 1000**0.5)  # fmt: skip
        _clear(self.row, ns + 1)
        k.fill_rows(self.pairs, self.place, self.cursor, self.row, self.corner, 4 * self.count, 1)
        b.scan(self.row, ns)
        _clear(self.cursor, ns + 1)
        k.fill_rows(self.pairs, self.place, self.row, self.cursor, self.corner, 4 * self.count, 0)
        k.sort_rows(self.row, self.corner, ns)

    def first_piercing(self, rest, u, slot: int) -> tuple[int, int] | None:
        """(edge, triangle) of the surface that pass through each other, after a `build` at the same place; or None."""
        t, e = self.triangles, self.edges
        pierced = runtime.array(ti.i32, e.count)
        self.kernels.find_piercing(rest, u, e.corners, t.corners, e.box, t.start, t.entries, t.keys, pierced, slot, e.count,
                                   t.num_buckets - 1)  # fmt: skip
        found = runtime.fetch(pierced)[: e.count]
        worst = int(np.argmax(found >= 0))
        return (worst, int(found[worst])) if found[worst] >= 0 else None
