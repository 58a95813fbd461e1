"""Links of springs, cables and elastic foundations: from stiffness, lengths, tensions and anchors to what kernels read.

A line element pulls along its path with the tension T = a + k e, e = L - L0 + s, where L is its length, L0 that at
rest, and s the slack at rest: L0 less the length without force. Numbers of line elements lie as rows of steps, two
vectors for each: (a when the step begins, a when it ends, k) and (s, s, 0). Segments are X_next - X of the points of a path
at rest [m], zero for the last point of each.
"""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.differentiation.arrays import summed_at, times
from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.mesh.face_points import face_points
from diffsim_ti.mesh.paths import Paths


class Segments(Recording, Link):
    """Of rest positions, and of the places of anchors [m], shape (k, 3) or (3,) for one, the segments of paths."""

    def __init__(self, paths: Paths, num_vertices: int, anchors: str | None, writes: str):
        self.reads, self.writes = ("rest",) if anchors is None else ("rest", anchors), (writes,)
        self.paths, self.places = paths, paths.matrix(num_vertices)

    def value(self, rest, anchors=None):
        points, starts, anchored = times(self.places, rest), self.paths.starts, self.paths.anchored
        if anchors is not None:  # one may hold many
            places = np.broadcast_to(anchors.reshape(-1, 3), (len(anchored), 3))
            points = points + summed_at(anchored, places, len(points))
        return (summed_at(starts, points[starts + 1] - points[starts], len(points)),)


class LineRows(Recording, Link):
    """Rows of a term's line elements. stiffness [N/m]: a number, or one for each; tension [N] and length [m] without
    force in time, as `InTime` has them, of all line elements together or of each; what is None is none, of a length:
    that at rest."""

    def __init__(
        self,
        paths: Paths,
        segments: str,
        writes: str,
        stiffness: str | None = None,
        tension: str | None = None,
        length: str | None = None,
    ):
        self.given = [name is not None for name in (stiffness, tension, length)]
        self.reads = (segments, *(name for name in (stiffness, tension, length) if name is not None))
        self.writes, self.paths = (writes,), paths

    def value(self, segments, *given):
        rest = iter(given)
        stiffness, tension, length = (next(rest) if there else None for there in self.given)
        rows = max((part.shape[1] for part in (tension, length) if part is not None), default=1)
        lengths = np.linalg.norm(segments, axis=1)[self.paths.starts]
        zero, at_rest = np.zeros((rows, len(self.paths))), summed_at(self.paths.path_of, lengths, len(self.paths))

        def columns(part):  # as each step begins and ends, of each line element
            return list(part.reshape(*part.shape[:2], -1) + zero)

        pulls = [zero, zero] if tension is None else columns(tension)
        slacks = [zero, zero] if length is None else [at_rest - part for part in columns(length)]
        stiff = zero if stiffness is None else stiffness + zero
        out = np.stack([np.stack([*pulls, stiff], -1), np.stack([*slacks, zero], -1)], 2)
        return (out.reshape(rows, -1, 3),)


class JoinedRows(Recording, Link):
    """Rows of line elements of several terms, of which those of one row hold in all steps, side by side."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    def value(self, *x):
        rows = min((len(part) for part in x if len(part) > 1), default=1)
        return (np.concatenate([np.broadcast_to(part[:rows], (rows, *part.shape[1:])) for part in x], 1),)


def directions(segments: np.ndarray) -> np.ndarray:
    """Unit vectors along segments, zero where they have no length."""
    lengths = np.linalg.norm(segments, axis=1, keepdims=True)
    return np.divide(segments, lengths, out=np.zeros_like(segments), where=lengths > 0)


class FoundationStiffness(Recording, Link):
    """K_i [N/m] of each of some vertices, shape (k, 3, 3): the sum over the triangles around of

        A / 3 [t I + (c - t) N N^T]

    A, N: area and unit normal at rest; c, t: normal and tangential stiffness per area [N/m^3], a number or one for each
    triangle. Over faces of six nodes the integral of N_i [t I + (c - t) N N^T].
    """

    def __init__(self, faces: np.ndarray, vertices: np.ndarray, normal: str, tangential: str, writes: str):
        self.reads, self.writes = ("rest", normal, tangential), (writes,)
        self.points, self.count = face_points(faces), len(vertices)
        self.nodes = np.searchsorted(vertices, faces)

    def value(self, X, c, t):
        c, t = (np.repeat(x, self.points.points)[:, None, None] if x.ndim else x for x in (c, t))
        n = self.points.normals(X)
        A = np.sqrt((n * n).sum(1))[:, None, None]
        of_each = self.points.to_nodes(t * A * np.eye(3) + (c - t) * (n[:, :, None] * n[:, None, :] / A))
        return (summed_at(self.nodes.T, np.moveaxis(of_each, 1, 0), self.count),)


class FoundationRows(Recording, Link):
    """Rows of K_i of all foundations, shape (3 k, 3) for the k vertices that any of them holds."""

    def __init__(self, reads: Sequence[str], vertices: Sequence[np.ndarray], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)
        self.vertices = np.unique(np.concatenate(vertices))
        self.places = np.concatenate([np.searchsorted(self.vertices, own) for own in vertices])

    def value(self, *x):
        return (summed_at(self.places, np.concatenate(x), len(self.vertices)).reshape(-1, 3),)
