"""Links of elastic foundations: from stiffness per area and the rest shape to the stiffness of each vertex."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh.geometry import triangle_normals, triangle_normals_jvp, triangle_normals_vjp


class FoundationStiffness(Link):
    """K_i [N/m] of each of some vertices, shape (k, 3, 3): the sum over the triangles around of

        A / 3 [t I + (c - t) N N^T]

    A, N: area and unit normal at rest; c, t: normal and tangential stiffness per area [N/m^3], a number or one for each
    triangle.
    """

    def __init__(self, triangles: np.ndarray, vertices: np.ndarray, normal: str, tangential: str, writes: str):
        self.reads, self.writes = ("rest", normal, tangential), (writes,)
        self.triangles, self.count = triangles, len(vertices)
        self.corners = np.searchsorted(vertices, triangles)

    def _to_vertices(self, of_each):
        out = np.zeros((self.count, 3, 3))
        for a in range(3):
            np.add.at(out, self.corners[:, a], of_each / 3)
        return out

    @staticmethod
    def _parts(n):
        """(A, n n^T / A) of normals as long as the area."""
        A = np.linalg.norm(n, axis=1)[:, None, None]
        return A, n[:, :, None] * n[:, None, :] / A

    def _filled(self, A, across, c, t):
        c, t = (x[..., None, None] for x in (c, t))
        return self._to_vertices(t * A * np.eye(3) + (c - t) * across)

    def value(self, X, c, t):
        return (self._filled(*self._parts(triangle_normals(X, self.triangles)), c, t),)

    def jvp(self, x, dx):
        (X, c, t), (dX, dc, dt) = x, dx
        n, dn = triangle_normals(X, self.triangles), triangle_normals_jvp(X, self.triangles, dX)
        A, across = self._parts(n)
        dA = (n * dn).sum(1)[:, None, None] / A
        turned = (n[:, :, None] * dn[:, None] + dn[:, :, None] * n[:, None]) / A - across * dA / A
        return (self._filled(A, across, dc, dt) + self._filled(dA, turned, c, t),)

    def vjp(self, x, y_adj):
        X, c, t = x
        Y = y_adj[0][self.corners].sum(1) / 3  # of each triangle
        n = triangle_normals(X, self.triangles)
        A, across = self._parts(n)
        trace, along = np.trace(Y, axis1=1, axis2=2), (Y * across).sum((1, 2))
        by_c, by_t = along, A[:, 0, 0] * trace - along
        by_across = (c - t)[..., None] if np.ndim(c - t) else c - t
        twice = np.einsum("tij,tj->ti", Y + np.swapaxes(Y, 1, 2), n)
        size = A[:, :, 0]
        n_adj = by_across * (twice / size - along[:, None] * n / size**2)
        n_adj += (t[..., None] if t.ndim else t) * trace[:, None] * n / size
        out = triangle_normals_vjp(X, self.triangles, n_adj)
        return out, by_c if c.ndim else by_c.sum(), by_t if t.ndim else by_t.sum()


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
