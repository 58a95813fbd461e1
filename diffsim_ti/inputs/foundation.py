"""Links of elastic foundations: from stiffness per area and the rest shape to the stiffness of each vertex."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh.face_points import face_points


class FoundationStiffness(Link):
    """K_i [N/m] of each of some vertices, shape (k, 3, 3): the sum over the triangles around of

        A / 3 [t I + (c - t) N N^T]

    A, N: area and unit normal at rest; c, t: normal and tangential stiffness per area [N/m^3], a number or one for each
    triangle. Over faces of six nodes the integral of N_i [t I + (c - t) N N^T].
    """

    def __init__(self, faces: np.ndarray, vertices: np.ndarray, normal: str, tangential: str, writes: str):
        self.reads, self.writes = ("rest", normal, tangential), (writes,)
        self.points, self.count = face_points(faces), len(vertices)
        self.nodes = np.searchsorted(vertices, faces)

    def _to_vertices(self, of_each):
        out, by_nodes = np.zeros((self.count, 3, 3)), self.points.to_nodes(of_each)
        for a in range(self.nodes.shape[1]):
            np.add.at(out, self.nodes[:, a], by_nodes[:, a])
        return out

    def _at_points(self, x):
        """Of each point what its face has."""
        return np.repeat(x, self.points.points) if x.ndim else x

    def _of_faces(self, by_points, x):
        """Adjoint of what faces have, or all of them."""
        return by_points.reshape(-1, self.points.points).sum(1) if x.ndim else by_points.sum()

    @staticmethod
    def _parts(n):
        """(A, n n^T / A) of normals as long as the area."""
        A = np.linalg.norm(n, axis=1)[:, None, None]
        return A, n[:, :, None] * n[:, None, :] / A

    def _filled(self, A, across, c, t):
        c, t = (self._at_points(x)[..., None, None] for x in (c, t))
        return self._to_vertices(t * A * np.eye(3) + (c - t) * across)

    def value(self, X, c, t):
        return (self._filled(*self._parts(self.points.normals(X)), c, t),)

    def jvp(self, x, dx):
        (X, c, t), (dX, dc, dt) = x, dx
        n, dn = self.points.normals(X), self.points.normals_jvp(X, dX)
        A, across = self._parts(n)
        dA = (n * dn).sum(1)[:, None, None] / A
        turned = (n[:, :, None] * dn[:, None] + dn[:, :, None] * n[:, None]) / A - across * dA / A
        return (self._filled(A, across, dc, dt) + self._filled(dA, turned, c, t),)

    def vjp(self, x, y_adj):
        X, c, t = x
        Y = self.points.from_nodes(y_adj[0][self.nodes])
        n = self.points.normals(X)
        A, across = self._parts(n)
        trace, along = np.trace(Y, axis1=1, axis2=2), (Y * across).sum((1, 2))
        by_c, by_t = along, A[:, 0, 0] * trace - along
        soft = self._at_points(t)
        by_across = self._at_points(c) - soft
        by_across = by_across[..., None] if by_across.ndim else by_across
        twice = np.einsum("tij,tj->ti", Y + np.swapaxes(Y, 1, 2), n)
        size = A[:, :, 0]
        n_adj = by_across * (twice / size - along[:, None] * n / size**2)
        n_adj += (soft[..., None] if soft.ndim else soft) * trace[:, None] * n / size
        return self.points.normals_vjp(X, n_adj), self._of_faces(by_c, c), self._of_faces(by_t, t)


class FoundationRows(Link):
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

    def jvp(self, x, dx):
        return self.value(*dx)

    def vjp(self, x, y_adj):
        whole = y_adj[0].reshape(-1, 3, 3)
        return [whole[place] for place in self.places]
