"""Which pairs of surface primitives lie within reach of each other: walks through trees of boxes (contact/box_tree.py).

Reach of a pair is a base reach plus the slack of both primitives, the largest of their corners'; the slack for primitives of
one body and that for different bodies are two numbers of each surface vertex. Pairs are kept if they are within reach and
share no vertex, sorted by (vertex, triangle) and (edge, edge), so that the list depends on positions alone and not on
threads.
"""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.contact.box_tree import BoxTree
from diffsim_ti.contact.broad_phase_kernels import broad_phase_kernels
from diffsim_ti.contact.buffers import Buffers, Launches
from diffsim_ti.contact.proximity import EDGE_EDGE, VERTEX_TRIANGLE


class CandidatePairs:
    """Pairs of a surface within reach: `pairs`, four vertices each, first vertex-triangle, then edge-edge.

    scale: of each edge pair, 1 / sqrt(10^-3 A^2 B^2) with the lengths A, B given. row, corner: the corners 4 p + k that
    meet at surface vertex s are corner[row[s] : row[s + 1]], in order. slack [m], of each surface vertex: what its
    primitives' reach is larger by, towards those of the same body and of others; zero unless set. body: of each vertex.
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
    ):
        self.kernels, self.launch = broad_phase_kernels(precision, parallel), Launches()
        self.buffers = Buffers(self.launch, parallel)
        self.trees = tuple(BoxTree(c, precision, parallel, self.launch) for c in (surface[:, None], triangles, edges))
        self.surface, self.num_surface = self.trees[0].corners, len(surface)
        self.lengths, self.typical = runtime.upload(lengths, self.kernels.fp), float(lengths.mean())
        place = np.full(len(body), -1)
        place[surface] = np.arange(len(surface))
        self.place, self.body = runtime.upload(place, ti.i32), runtime.upload(body[surface], ti.i32)
        self.slack = runtime.upload(np.zeros((len(surface), 4)), self.trees[0].kernels.vector)
        self.row_t, self.row_e = runtime.array(ti.i32, len(surface) + 1), runtime.array(ti.i32, len(edges) + 1)
        self.row, self.cursor = (runtime.array(ti.i32, len(surface) + 1) for _ in range(2))
        self.most = runtime.array(ti.i32, 1)
        self.num_vt = self.num_ee = 0
        self.room = [16, 32]  # partners kept of each vertex and edge; grows
        self._take()

    def _take(self) -> None:
        count, b = self.num_vt + self.num_ee, self.buffers
        self.pairs, self.corner = b.take("pairs", ti.i32, 4 * count), b.take("corner", ti.i32, 4 * count)
        self.scale = b.take("scale", self.kernels.fp, self.num_ee)

    @property
    def count(self) -> int:
        return self.num_vt + self.num_ee

    def _find(self, kind: int, of: BoxTree, among: BoxTree, row, rest, u, slot: int, reach: float):
        """Partners of each primitive of a tree, `room` places for each; their numbers, summed, in `row`."""
        while True:
            partner = self.buffers.take(f"partners {kind}", ti.i32, self.room[kind] * of.count)
            runtime.fill(self.most, 0)
            find = self.launch(
                self.kernels.find[kind],
                rest,
                u,
                *of.arrays,
                *among.arrays,
                row,
                partner,
                self.most,
                vectorized=runtime.runs_on_cpu(),
            )
            find(slot, of.count, of.leaves, of.groups, among.leaves, reach, self.room[kind])
            most = int(runtime.fetch(self.most)[0])
            if most == 0:
                self.buffers.scan(row, of.count)
                return partner
            self.room[kind] = most + most // 2

    def build(self, rest, u, slot: int, reach: float) -> None:
        """Find all pairs nearer than `reach` [m] and their slacks at rest + u[slot]."""
        k, ns, ne, reach = self.kernels, self.num_surface, self.trees[2].count, float(reach)
        for tree in self.trees:
            tree.refit(rest, u, self.place, self.body, self.slack, slot, reach)
        v, t, e = self.trees
        partner_t = self._find(VERTEX_TRIANGLE, v, t, self.row_t, rest, u, slot, reach)
        partner_e = self._find(EDGE_EDGE, e, e, self.row_e, rest, u, slot, reach)
        self.num_vt, self.num_ee = _last(self.row_t), _last(self.row_e)
        self._take()
        self.launch(
            k.write_pairs,
            self.surface,
            t.corners,
            e.corners,
            self.row_t,
            self.row_e,
            partner_t,
            partner_e,
            self.lengths,
            self.pairs,
            self.scale,
        )(ns, ne, self.num_vt, *self.room, 1000**0.5)
        self.launch(k.count_corners, self.pairs, self.place, self.row)(4 * self.count, ns)
        self.buffers.scan(self.row, ns)
        self.launch(k.fill_rows, self.pairs, self.place, self.row, self.cursor, self.corner)(4 * self.count, ns)

    def first_piercing(self, rest, u, slot: int) -> tuple[int, int] | None:
        """(edge, triangle) of the surface that pass through each other, after a `build` at the same place; or None."""
        _, t, e = self.trees
        pierced = runtime.array(ti.i32, e.count)
        self.kernels.find_piercing(
            rest,
            u,
            e.corners,
            e.order,
            e.items,
            t.corners,
            t.order,
            t.items,
            t.boxes,
            pierced,
            slot,
            e.count,
            t.count,
            t.leaves,
        )
        found = runtime.fetch(pierced)[: e.count]
        worst = int(np.argmax(found >= 0))
        return (worst, int(found[worst])) if found[worst] >= 0 else None


def _last(row) -> int:
    """The last number of an array."""
    host = runtime.view(row)
    return int((runtime.fetch(row) if host is None else host)[-1])
