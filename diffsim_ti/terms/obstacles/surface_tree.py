"""Triangles, segments and points in a binary tree of boxes, built once, and what is nearest to given places.

All of them are triangles: corners of a segment are (i, j, j), of a point (i, i, i). They follow a space-filling curve, and
each leaf holds the next GROUP of them. Node k has children 2 k and 2 k + 1, so that links need no memory. A walk goes down
to the child whose middle is nearer, then to the other, and leaves out what is farther away than what it has found; it needs
no stack, for where it comes from says what is left. What a place has nearest is, by `feature`, the inside of a triangle
(0), its side ab, bc or ca (1, 2, 3), or its corner a, b or c (4, 5, 6).
Hapala, Davidovic, Wald, Havran, Slusallek 2011, Efficient stack-less BVH traversal, doi:10.1145/2461217.2461219.
Ericson, Real-Time Collision Detection, 2005, 5.1 and 6; Morton 1966.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from diffsim_ti.differentiation.arrays import cross
from diffsim_ti.mesh.geometry import curve_order
from diffsim_ti.terms.obstacles.surface_mesh import SurfaceMesh

GROUP, NODE = (
    4,
    10,
)  # primitives of a leaf; numbers of a node: lowest and highest corner, where its right child is nearer
HEADER = 5  # of the table: number of leaves, of primitives, where primitives begin, where vertices do, numbers of these
FLAT = 1e-14  # sin^2 of an angle below which a triangle is its sides
CHUNK, MOST_PAIRS = 20_000, 1_000_000  # places that are looked for together, and pairs of them and nodes


class SurfaceTree:
    """Of a surface's primitives, in float64 on the host and as a `table` of numbers for kernels; origin [m]: what places in
    the table are measured from."""

    def __init__(self, surface: SurfaceMesh, origin: np.ndarray):
        self.surface, self.x = surface, surface.vertices - origin
        s, p = surface.segments, surface.points
        corners = np.concatenate([surface.triangles, s[:, [0, 1, 1]], p[:, None][:, [0, 0, 0]]])
        places = self.x[corners]
        self.order = curve_order(places.mean(1))
        self.corners, self.count = corners[self.order], len(corners)
        self.leaves = 1 << max(-(-self.count // GROUP) - 1, 0).bit_length()
        low, high = places[self.order].min(1), places[self.order].max(1)
        self.boxes = np.empty((2 * self.leaves, 6))
        for part, bound, reduce in ((slice(3), low, np.minimum), (slice(3, 6), high, np.maximum)):
            far = 1e15 if reduce is np.minimum else -1e15
            row = np.full((self.leaves * GROUP, 3), far)
            row[: self.count] = bound
            row = reduce.reduce(row.reshape(self.leaves, GROUP, 3), 1)
            self.boxes[0, part] = 0
            first = self.leaves
            while True:
                self.boxes[first : 2 * first, part] = row
                if first == 1:
                    break
                first, row = first // 2, reduce(row[::2], row[1::2])

    def moved(self, x: np.ndarray) -> "SurfaceTree":
        """That of vertices elsewhere, with the same edges and sides."""
        surface = replace(self.surface, vertices=x)
        topology = ("one", "is_sided", "shares", "_edges_of_triangles")
        vars(surface).update({name: getattr(self.surface, name) for name in topology})
        return SurfaceTree(surface, np.zeros(3))

    @cached_property
    def pseudonormals(self) -> np.ndarray:
        """Of each primitive whether it has an inside, and the outward directions of its sides, shape (count, 10)."""
        t = len(self.surface.triangles)
        out = np.zeros((self.count, 10))
        out[:t, 0], out[:t, 1:] = self.surface.is_sided, self.surface.pseudonormals[0].reshape(t, 9)
        return out[self.order]

    @property
    def is_sided(self) -> bool:
        return bool(self.surface.is_sided.any())

    def table(self) -> np.ndarray:
        """What kernels read (surface_distance.py): HEADER, boxes of nodes from 0 on, primitives, vertices, and where some
        have an inside outward directions there."""
        sided = self.is_sided
        shares = self.surface.shares[self.order]
        primitives = np.column_stack([self.corners, shares, *([self.pseudonormals] if sided else [])])
        vertices = [self.x.ravel(), *([self.surface.pseudonormals[1].ravel()] if sided else [])]
        nodes = np.zeros((len(self.boxes), NODE))
        nodes[:, :6], middles = self.boxes, 0.5 * (self.boxes[:, :3] + self.boxes[:, 3:])
        left, right = middles[2 : 2 * self.leaves : 2], middles[3 : 2 * self.leaves : 2]  # of inner nodes from 1 on
        nodes[1 : self.leaves, 6:9] = right - left
        nodes[1 : self.leaves, 9] = 0.5 * np.einsum("ij,ij->i", right - left, right + left)
        begin = HEADER + nodes.size
        header = [self.leaves, self.count, begin, begin + primitives.size, self.x.size]
        return np.concatenate([header, nodes.ravel(), primitives.ravel(), *vertices])

    # ---- on the host -------------------------------------------------------------------------------------------------

    def distance(self, places: np.ndarray) -> np.ndarray:
        """Signed distances [m] of places, shape (k, 3), measured from the origin, to what has no radius."""
        places = np.asarray(places, np.float64)
        return np.concatenate([np.zeros(0), *map(self._distance, np.split(places, range(CHUNK, len(places), CHUNK)))])

    def _distance(self, places: np.ndarray) -> np.ndarray:
        m, feature, w, square = self._nearest(places)
        out = np.sqrt(square)
        if not self.is_sided:
            return out
        corners, normals = self.corners[m], self.pseudonormals[m]
        a, b, c = (self.x[corners[:, k]] for k in range(3))
        r = places - np.einsum("ij,ijk->ik", w, self.x[corners])
        of_corner = self.surface.pseudonormals[1][corners[np.arange(len(m)), np.maximum(feature - 4, 0)]]
        of_side = normals[:, 1:].reshape(-1, 3, 3)[np.arange(len(m)), np.clip(feature - 1, 0, 2)]
        outward = np.where((feature > 3)[:, None], of_corner, of_side)
        outward = np.where((feature == 0)[:, None], cross(b - a, c - a), outward)
        behind = (normals[:, 0] > 0) & (np.einsum("ij,ij->i", r, outward) < 0)
        return np.where(behind, -out, out)

    def _nearest(self, places: np.ndarray) -> tuple[np.ndarray, ...]:
        """(primitive, feature, shares of its corners, squared distance) of what is nearest to each place."""
        m = self._middles.query(places)[1]
        return self._improved(places, (m, *nearest_of_triangles(places, self.x[self.corners[m]])))

    @cached_property
    def _middles(self):
        from scipy.spatial import cKDTree

        return cKDTree(self.x[self.corners].mean(1))

    def _improved(self, places: np.ndarray, best: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
        """By all leaves that are nearer than what was found."""
        who, at = np.arange(len(places)), np.ones(len(places), np.int64)
        while True:
            square = self._squares(places, who, at)
            near = square < best[3][who]
            who, at, square = who[near], at[near], square[near]
            if not at.size or at[0] >= self.leaves:
                break
            if len(at) > MOST_PAIRS and len(places) > 1:
                halves = slice(len(places) // 2), slice(len(places) // 2, None)
                parts = [self._improved(places[half], tuple(x[half] for x in best)) for half in halves]
                return tuple(map(np.concatenate, zip(*parts)))
            who, at = np.repeat(who, 2), (2 * at[:, None] + [0, 1]).ravel()
        for first_alone in (True, False):  # the nearest box of each place, and what is still nearer then
            order = np.lexsort((square, who))
            who, at, square = who[order], at[order], square[order]
            begin = np.flatnonzero(np.diff(who, prepend=-1))
            rows = begin if first_alone else slice(None)
            found, own = self._of_leaves(places, who[rows], at[rows]), who[rows]
            order = np.lexsort((found[3], own))
            order = order[np.flatnonzero(np.diff(own[order], prepend=-1))]
            order = order[found[3][order] < best[3][own[order]]]
            for target, new in zip(best, found):
                target[own[order]] = new[order]
            near = square < best[3][who]
            who, at, square = who[near], at[near], square[near]
        return best

    def first_through(self, ways: np.ndarray) -> int | None:
        """Number of the first of straight ways, shape (k, 2, 3), that leads through a triangle; None where none does."""
        low, high, who, at = ways.min(1), ways.max(1), np.arange(len(ways)), np.ones(len(ways), np.int64)
        while True:
            box = self.boxes[at]
            meets = ((box[:, :3] <= high[who]) & (box[:, 3:] >= low[who])).all(1)
            who, at = who[meets], at[meets]
            if not at.size or at[0] >= self.leaves:
                break
            who, at = np.repeat(who, 2), (2 * at[:, None] + [0, 1]).ravel()
        m = np.minimum((at - self.leaves)[:, None] * GROUP + np.arange(GROUP), self.count - 1).ravel()
        who, dot = np.repeat(who, GROUP), lambda a, b: np.einsum("ij,ij->i", a, b)
        (p, q), (a, b, c) = np.moveaxis(ways[who], 1, 0), np.moveaxis(self.x[self.corners[m]], 1, 0)
        normal = cross(b - a, c - a)
        before, after = dot(p - a, normal), dot(q - a, normal)
        y = (
            p
            - a
            + np.divide(before, before - after, out=np.zeros_like(before), where=before != after)[:, None] * (q - p)
        )
        s, t = dot(cross(y, c - a), normal), dot(cross(b - a, y), normal)
        through = (before * after < 0) & (s >= 0) & (t >= 0) & (s + t <= dot(normal, normal))
        return int(who[through].min()) if through.any() else None

    def _squares(self, places, who, nodes) -> np.ndarray:
        box, x = self.boxes[nodes], places[who]
        gap = np.maximum(np.maximum(box[:, :3] - x, x - box[:, 3:]), 0)
        return np.einsum("ij,ij->i", gap, gap)

    def _of_leaves(self, places, who, nodes) -> tuple[np.ndarray, ...]:
        """The nearest in each leaf."""
        m = (nodes - self.leaves)[:, None] * GROUP + np.arange(GROUP)
        m = np.minimum(m, self.count - 1)  # the last stands for what a leaf lacks
        feature, w, square = nearest_of_triangles(np.repeat(places[who], GROUP, 0), self.x[self.corners[m.ravel()]])
        k = square.reshape(-1, GROUP).argmin(1) + GROUP * np.arange(len(m))
        return m.ravel()[k], feature[k], w[k], square[k]


def nearest_of_triangles(x: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(feature, shares of the corners, squared distance) of places and triangles, shapes (k, 3) and (k, 3, 3)."""
    dot = lambda a, b: np.einsum("ij,ij->i", a, b)  # noqa: E731
    a = corners[:, 0]
    e1, e2, q = corners[:, 1] - a, corners[:, 2] - a, x - a
    normal = cross(e1, e2)
    det = dot(normal, normal)
    inverse = 1 / np.maximum(det, 1e-200)
    s, t = dot(cross(q, e2), normal) * inverse, dot(cross(e1, q), normal) * inverse
    within = (det > FLAT * dot(e1, e1) * dot(e2, e2)) & (s > 0) & (t > 0) & (s + t < 1)
    w, square = np.stack([1 - s - t, s, t], 1), dot(q, normal) ** 2 * inverse
    feature, square = np.zeros(len(x), np.int64), np.where(within, square, np.inf)
    for k in range(3):
        begin, end = corners[:, k], corners[:, (k + 1) % 3]
        side, r = end - begin, x - begin
        share = np.clip(dot(r, side) / np.maximum(dot(side, side), 1e-200), 0, 1)
        r = r - share[:, None] * side
        new = dot(r, r)
        better = ~within & (new < square)
        square = np.where(better, new, square)
        own = np.where(share <= 0, 4 + k, np.where(share >= 1, 4 + (k + 1) % 3, 1 + k))
        feature = np.where(better, own, feature)
        along = np.zeros((len(x), 3))
        along[:, k], along[:, (k + 1) % 3] = 1 - share, share
        w = np.where(better[:, None], along, w)
    return feature, w, square
