"""Kernels that write a list of pairs: corners of each, and which corners meet at each surface vertex."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.broad_phase_kernels import sort
from diffsim_ti.runtime import Kernel, as_kernel

A = ti.template()


@dataclass(frozen=True)
class ListKernels:
    """Partners in rows of `room` places for each vertex and edge become a list; then its corners are put in rows."""

    precision: str
    parallel: bool
    has_areas: bool  # whether pairs take the area of the triangle, or of the first edge

    @ti.func
    def write_all(self, list: A, found: A, vertices: A, triangles: A, edges: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_vertices):
            for p in range(found.row_t[s], found.row_t[s + 1]):
                other = found.partner_t[plan.room_t * s + p - found.row_t[s]]
                list.pairs[4 * p] = vertices.corners[s]
                for k in ti.static(range(3)):
                    list.pairs[4 * p + 1 + k] = triangles.corners[3 * other + k]
                if ti.static(self.has_areas):
                    list.area[p] = found.area_t[other]
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_edges):
            for q in range(found.row_e[e], found.row_e[e + 1]):
                p, other = plan.num_vt + q, found.partner_e[plan.room_e * e + q - found.row_e[e]]
                for k in ti.static(range(2)):
                    list.pairs[4 * p + k] = edges.corners[2 * e + k]
                    list.pairs[4 * p + 2 + k] = edges.corners[2 * other + k]
                list.scale[q] = plan.factor / (found.lengths[e] * found.lengths[other])
                if ti.static(self.has_areas):
                    list.area[p] = found.area_e[e]

    @cached_property
    def write(self) -> Kernel:
        """Corners of each pair, four indices of vertices; and, of edges, 1 / sqrt(threshold of |a x b|^2)."""
        found = dict.fromkeys(("row_t", "row_e", "partner_t", "partner_e"), "ints") | dict(lengths="scalars")
        trees = dict.fromkeys(("vertices", "triangles", "edges"), dict(corners="ints"))
        numbers = dict.fromkeys(("num_vertices", "num_edges", "num_vt", "room_t", "room_e"), "int")
        areas = dict.fromkeys(("area_t", "area_e"), "scalars") if self.has_areas else {}
        written = dict(pairs="ints", scale="scalars") | (dict(area="scalars") if self.has_areas else {})
        arrays = dict(list=written, found=found | areas) | trees
        return Kernel("write", self.write_all, self.precision, arrays, numbers | dict(factor="float"))

    @as_kernel("count")
    def count(self, list: A, plan: A):
        """How many of the first `count` corners meet at each surface vertex."""
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface + 1):
            list.row[s] = 0
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.count):
            list.row[list.place[list.pairs[c]]] += 1  # whole numbers: their order does not matter

    @as_kernel("fill")
    def fill(self, list: A, plan: A):
        """The corners that meet at each surface vertex, in order."""
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            list.cursor[s] = list.row[s]
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.count):
            k = ti.atomic_add(list.cursor[list.place[list.pairs[c]]], 1)
            list.corner_of[k] = c
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            sort(list.corner_of, list.row[s], list.row[s + 1])

    def _kernel(self, name: str, body) -> Kernel:
        arrays = dict(list=dict.fromkeys(("pairs", "place", "row", "cursor", "corner_of"), "ints"))
        return Kernel(name, body, self.precision, arrays, dict(count="int", num_surface="int"))
