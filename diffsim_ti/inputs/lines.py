"""Links of springs, cables and elastic foundations: from stiffness, lengths, tensions and anchors to what kernels read.

A line element pulls along its path with the tension T = a + k e, e = L - L0 + s, where L is its length, L0 that at
rest, and s the slack at rest: L0 less the length without force. Numbers of line elements lie as rows of steps, two
vectors for each: (a when the step begins, a when it ends, k) and (s, s, 0). Segments are X_next - X of the points of a path
at rest [m], zero for the last point of each.
"""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.differentiation.arrays import summed_at
from diffsim_ti.inputs.chain import Linear, Link, Recording
from diffsim_ti.inputs.loads import _Together
from diffsim_ti.mesh.face_points import face_points
from diffsim_ti.mesh.paths import Paths


class Segments(Linear, Link):
    """Of rest positions, and of the places of anchors [m], shape (k, 3) or (3,) for one, the segments of paths."""

    def __init__(self, paths: Paths, num_vertices: int, anchors: str | None, writes: str):
        self.reads, self.writes = ("rest",) if anchors is None else ("rest", anchors), (writes,)
        self.paths, self.places = paths, paths.matrix(num_vertices)

    def value(self, rest, anchors=None):
        points, starts = self.places @ rest, self.paths.starts
        if anchors is not None:
            points[self.paths.anchored] = anchors.reshape(-1, 3)
        out = np.zeros_like(points)
        out[starts] = points[starts + 1] - points[starts]
        return (out,)

    def vjp(self, x, y_adj):
        by_points, starts = np.zeros((self.paths.num_points, 3)), self.paths.starts
        by_points[starts] -= y_adj[0][starts]
        by_points[starts + 1] += y_adj[0][starts]
        rest = self.places.T @ by_points
        if len(x) == 1:
            return (rest,)
        by_anchors = by_points[self.paths.anchored]
        if x[1].size == 3:  # one may hold many
            by_anchors = by_anchors.sum(0)
        return rest, by_anchors.reshape(x[1].shape)


class LineRows(Link):
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

    def _named(self, x) -> list:
        """(stiffness, tension, length), None where it is not given."""
        rest = iter(x[1:])
        return [next(rest) if given else None for given in self.given]

    def _whole(self, part: np.ndarray) -> np.ndarray:
        """Of what is given in time, shape (2, rows) or (2, rows, line elements): that of each line element."""
        return np.broadcast_to(part.reshape(*part.shape[:2], -1), (*part.shape[:2], len(self.paths)))

    def _filled(self, x, at_rest) -> np.ndarray:
        stiffness, tension, length = self._named(x)
        rows = max((part.shape[1] for part in (tension, length) if part is not None), default=1)
        out = np.zeros((rows, len(self.paths), 2, 3))
        if tension is not None:
            out[:, :, 0, :2] = np.moveaxis(self._whole(tension), 0, 2)
        if stiffness is not None:
            out[:, :, 0, 2] = stiffness
        if length is not None:
            out[:, :, 1, :2] = at_rest[:, None] - np.moveaxis(self._whole(length), 0, 2)
        return out.reshape(rows, -1, 3)

    def _at_rest(self, of_each: np.ndarray) -> np.ndarray:
        """Sums over the segments of each path."""
        return np.bincount(self.paths.path_of, of_each[self.paths.starts], len(self.paths))

    def value(self, *x):
        return (self._filled(x, self._at_rest(np.linalg.norm(x[0], axis=1))),)

    def jvp(self, x, dx):
        along = (directions(x[0]) * dx[0]).sum(1)
        return (self._filled(dx, self._at_rest(along)),)

    def vjp(self, x, y_adj):
        stiffness, tension, length = self._named(x)
        adjoint = y_adj[0].reshape(len(y_adj[0]), len(self.paths), 2, 3)
        out = [np.zeros_like(x[0])]
        if stiffness is not None:
            by = adjoint[:, :, 0, 2].sum(0)
            out.append(by if stiffness.ndim else by.sum())
        for part, k in ((tension, 0), (length, 1)):
            if part is not None:
                by = np.moveaxis(adjoint[:, :, k, :2], 2, 0) * (1 if k == 0 else -1)
                if by.shape[1] > part.shape[1]:
                    by = by.sum(1, keepdims=True)
                out.append(by if part.ndim == 3 and part.shape[2] > 1 else by.sum(2).reshape(part.shape))
        if length is not None:
            of_path = adjoint[:, :, 1, :2].sum((0, 2))
            starts = self.paths.starts
            out[0][starts] = directions(x[0])[starts] * of_path[self.paths.path_of][:, None]
        return out


class JoinedRows(_Together):
    """Rows of line elements of several terms, of which those of one row hold in all steps, side by side."""

    @staticmethod
    def rows(x) -> int:
        return min((len(part) for part in x if len(part) > 1), default=1)

    def value(self, *x):
        rows = self.rows(x)
        return (np.concatenate([np.broadcast_to(part[:rows], (rows, *part.shape[1:])) for part in x], 1),)

    def vjp(self, x, y_adj):
        parts = np.split(y_adj[0], np.cumsum([part.shape[1] for part in x])[:-1], 1)
        return [self._pulled(part[None], adjoint[None])[0] for part, adjoint in zip(x, parts)]


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


class FoundationRows(Linear, Link):
    """Rows of K_i of all foundations, shape (3 k, 3) for the k vertices that any of them holds."""

    def __init__(self, reads: Sequence[str], vertices: Sequence[np.ndarray], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)
        self.vertices = np.unique(np.concatenate(vertices))
        self.places = [np.searchsorted(self.vertices, own) for own in vertices]

    def value(self, *x):
        out = np.zeros((len(self.vertices), 3, 3))
        for place, part in zip(self.places, x):
            out[place] += part
        return (out.reshape(-1, 3),)

    def vjp(self, x, y_adj):
        whole = y_adj[0].reshape(-1, 3, 3)
        return [whole[place] for place in self.places]
