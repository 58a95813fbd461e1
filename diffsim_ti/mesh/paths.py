"""Paths through points of a body and points fixed in space: what springs and cables run along."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths, each through two points or more; point p lies at sum of weights times its vertices, or is anchored in space.

    first_point (paths + 1,): where the points of each path begin; first_corner (points + 1,): where the vertices of each
    point begin among `vertices` and `weights`; anchored: the points without vertices.
    """

    first_point: np.ndarray
    first_corner: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray
    anchored: np.ndarray

    @classmethod
    def of(cls, points: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]]) -> "Paths":
        """From the (vertices, weights) of each point of each path; an anchor has none."""
        flat = [point for path in points for point in path]
        counts = np.array([len(vertices) for vertices, _ in flat], np.int64)
        firsts = [np.cumsum([0, *x], dtype=np.int64) for x in (map(len, points), counts)]
        vertices = np.concatenate([np.zeros(0, np.int64), *(own for own, _ in flat)]).astype(np.int64)
        weights = np.concatenate([np.zeros(0), *(own for _, own in flat)])
        return cls(*firsts, vertices, weights, np.nonzero(counts == 0)[0])

    @classmethod
    def joined(cls, parts: Sequence["Paths"]) -> "Paths":
        """Those of several, one after the other."""
        if len(parts) == 1:
            return parts[0]
        return cls.of([path for part in parts for path in part.points()])

    def points(self) -> list[list[tuple[np.ndarray, np.ndarray]]]:
        """(vertices, weights) of each point of each path."""
        corners = [slice(a, b) for a, b in zip(self.first_corner, self.first_corner[1:])]
        flat = [(self.vertices[own], self.weights[own]) for own in corners]
        return [flat[a:b] for a, b in zip(self.first_point, self.first_point[1:])]

    def __len__(self) -> int:
        return len(self.first_point) - 1

    @property
    def num_points(self) -> int:
        return len(self.first_corner) - 1

    @cached_property
    def starts(self) -> np.ndarray:
        """The points from which a segment leads to the next point: all but the last of each path."""
        return np.setdiff1d(np.arange(self.num_points), self.first_point[1:] - 1)

    @cached_property
    def path_of(self) -> np.ndarray:
        """The path of each segment."""
        return np.repeat(np.arange(len(self)), np.diff(self.first_point) - 1)

    def matrix(self, num_vertices: int):
        """SciPy CSR matrix (points, num_vertices): places of points from those of vertices; zero for anchors."""
        from scipy.sparse import csr_matrix

        parts = self.weights, self.vertices, self.first_corner
        out = csr_matrix(parts, shape=(self.num_points, num_vertices), copy=True)
        out.sum_duplicates()  # and sort, as some products of scipy do unasked: later sums would have another order
        return out
