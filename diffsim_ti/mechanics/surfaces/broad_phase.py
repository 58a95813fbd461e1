"""Which pairs of surface primitives lie within reach of each other: walks through trees of boxes (box_tree.py).

Reach of a pair is a base reach plus the slack of both primitives, the largest of their corners'; the slack for primitives of
one body and that for different bodies are two numbers of each surface vertex. Pairs are kept if they are within reach and
share no vertex, sorted by (vertex, triangle) and (edge, edge), so that the list depends on positions alone and not on
threads.
"""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.box_tree import BoxTree
from diffsim_ti.mechanics.surfaces.broad_phase_kernels import Piercing, Search, sort
from diffsim_ti.mechanics.surfaces.buffers import Buffers, Launches
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, PARALLEL, VERTEX_TRIANGLE
from diffsim_ti.runtime import A, Kernel, as_kernel, kernels_of


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


class CandidatePairs:
    """Pairs of a surface within reach: `pairs`, four vertices each, first vertex-triangle, then edge-edge.

    scale: of each edge pair, 1 / sqrt(10^-3 A^2 B^2) with the lengths A, B given. row, corner_of: the corners 4 p + k
    that meet at surface vertex s are corner_of[row[s] : row[s + 1]], in order. slack [m], of each surface vertex: what its
    primitives' reach is larger by, towards those of the same body and of others, and then in any case; zero unless set.
    body: of each vertex. kinematic: what obstacles bring (obstacle_corners.py), None without; the last edges and vertices
    of the surface are theirs, and its area is what each pair has of the body's surface.
    """

    def __init__(
        self,
        surface: np.ndarray,
        triangles: np.ndarray,
        edges: np.ndarray,
        lengths: np.ndarray,
        body: np.ndarray,
        precision: str,
        parallel: bool = True,
        kinematic=None,
    ):
        self.kinematic, has = kinematic, kinematic is not None
        self.own, self.meet = (kinematic.own_edges, kinematic.meeting_edges) if has else (len(edges), len(edges))
        self.searches = [kernels_of(Search, precision, parallel, kind) for kind in (VERTEX_TRIANGLE, EDGE_EDGE)]
        self.piercing, self.lists = (
            kernels_of(Piercing, precision, parallel),
            kernels_of(ListKernels, precision, parallel, has),
        )
        self.launch, self.fp = Launches(), runtime.PRECISIONS[precision]
        self.buffers = Buffers(self.launch, parallel)
        acting = kinematic.acting if has else surface  # on triangles
        self.trees = tuple(BoxTree(c, precision, parallel, self.launch) for c in (acting[:, None], triangles, edges))
        self.surface = runtime.upload(surface, ti.i32) if has else self.trees[0].corners
        if has:
            self.area_t, self.area_e = (runtime.upload(x, self.fp) for x in kinematic.areas)
        self.num_surface = len(surface)
        self.lengths, self.typical = runtime.upload(lengths, self.fp), float(lengths[: self.own].mean())
        place = np.full(len(body), -1)
        place[surface] = np.arange(len(surface))
        self.place, self.body = runtime.upload(place, ti.i32), runtime.upload(body[surface], ti.i32)
        self.slack = runtime.upload(np.zeros((len(surface), 4)), ti.types.vector(4, self.fp))
        self.row_t, self.row_e = runtime.array(ti.i32, len(acting) + 1), runtime.array(ti.i32, len(edges) + 1)
        self.row, self.cursor = (runtime.array(ti.i32, len(surface) + 1) for _ in range(2))
        self.most = runtime.array(ti.i32, 1)
        self.num_vt = self.num_ee = 0
        self.room = [16, 32]  # partners kept of each vertex and edge; grows
        self._take()

    def _take(self) -> None:
        count, b = self.num_vt + self.num_ee, self.buffers
        self.pairs, self.corner_of = b.take("pairs", ti.i32, 4 * count), b.take("corners", ti.i32, 4 * count)
        self.scale = b.take("scale", self.fp, self.num_ee)
        if self.kinematic is not None:
            self.area = b.take("area", self.fp, count)

    @property
    def count(self) -> int:
        return self.num_vt + self.num_ee

    def _find(self, kind: int, of: BoxTree, among: BoxTree, row, scene, slot: int, reach: float):
        """Partners of each primitive of a tree, `room` places for each; their numbers, summed, in `row`."""
        counts = dict(slot=slot, count=of.count, leaves=of.leaves, groups=of.groups, their_leaves=among.leaves)
        counts |= dict(own=self.own, meet=self.meet)
        while True:
            partner = self.buffers.take(f"partners {kind}", ti.i32, self.room[kind] * of.count)
            runtime.fill(self.most, 0)
            out = SimpleNamespace(row=row, partner=partner, most=self.most)
            records = dict(scene=scene, mine=of, theirs=among, out=out)
            find = self.launch(self.searches[kind].find, vectorized=runtime.runs_on_cpu(), **records)
            find(reach=reach, room=self.room[kind], **counts)
            most = int(runtime.fetch(self.most)[0])
            if most == 0:
                self.buffers.scan(row, of.count)
                return partner
            self.room[kind] = most + most // 2

    def build(self, rest, u, slot: int, reach: float) -> None:
        """Find all pairs nearer than `reach` [m] and their slacks at rest + u[slot]."""
        reach, scene, (v, t, e) = float(reach), SimpleNamespace(rest=rest, u=u), self.trees
        for tree in self.trees:
            tree.refit((scene, self), slot, reach)
        partner_t = self._find(VERTEX_TRIANGLE, v, t, self.row_t, scene, slot, reach)
        partner_e = self._find(EDGE_EDGE, e, e, self.row_e, scene, slot, reach)
        self.num_vt, self.num_ee = (int(runtime.fetch(row, -1)) for row in (self.row_t, self.row_e))
        self._take()
        found = SimpleNamespace(partner_t=partner_t, partner_e=partner_e), self
        write = self.launch(self.lists.write, list=self, found=found, vertices=v, triangles=t, edges=e)
        sizes = dict(num_vertices=v.count, num_edges=e.count, num_vt=self.num_vt)
        write(room_t=self.room[0], room_e=self.room[1], factor=PARALLEL**-0.5, **sizes)
        corners = dict(count=4 * self.count, num_surface=self.num_surface)
        self.launch(self.lists.count, list=self)(**corners)
        self.buffers.scan(self.row, self.num_surface)
        self.launch(self.lists.fill, list=self)(**corners)

    def first_piercing(self, rest, u, slot: int) -> tuple[int, int] | None:
        """(edge, triangle) of the surface that pass through each other, after a `build` at the same place; or None."""
        _, t, e = self.trees
        pierced = runtime.array(ti.i32, e.count)
        runtime.fill(pierced, -1)
        records = dict(scene=SimpleNamespace(rest=rest, u=u), mine=e, theirs=t, out=SimpleNamespace(pierced=pierced))
        first = 0 if self.meet else self.own
        self.piercing.find.bind(**records)(slot=slot, count=e.count, their_count=t.count, leaves=t.leaves, first=first)
        found = runtime.fetch(pierced)[: e.count]
        worst = int(np.argmax(found >= 0))
        return (worst, int(found[worst])) if found[worst] >= 0 else None
