"""How much of a body's surface each of its vertices stands for, where it lies on something."""

import numpy as np

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh.face_points import curved_faces
from diffsim_ti.mesh.geometry import triangle_normals


class SurfaceAreas(Link):
    """Of rest positions the area [m^2] of each vertex, 0 within the body.

        a = tr(M^2) / tr(M),    M = sum over the triangles around of (theta / pi) A N (x) N

    A, N: a triangle's area and unit normal; theta: its angle at the vertex, so that it is dealt out among its corners, by
    the same shares however a square is cut in two. Where the surface is flat or bends little, a is the sum of these shares.
    What counts at an edge is what faces one way: where a cube lies on its bottom, its sides carry nothing, and sides of
    any height do not count. a is the mean, over the surface around, of what faces the same way, by the square of the cosine.

    Of ten-node tetrahedra, whose faces are four triangles each, a face's corners hand on nearly all of their shares to its
    three middles: under an even pressure a quadratic face pushes its middles alone (A / 3 each, corners 0), and what its
    corners have beyond that makes stresses below uneven. They keep a twentieth, so that they are stopped too. Where a face
    of the mesh is curved, its corners keep their shares: pressure is uneven there, and any node may be the lowest.
    """

    reads, writes = ("rest",), ("surface",)

    kept = 0.05  # of the share of a face's corner, where its middles are vertices too

    def __init__(self, mesh):
        self.triangles, self.num_vertices = mesh.surface_triangles, mesh.num_vertices
        self.at_corner = None
        if mesh.order == 2:
            self.at_corner = np.isin(self.triangles, mesh.tetrahedra) & ~np.repeat(curved_faces(mesh), 4)[:, None]

    def value(self, X):
        return (self._areas(self._moments(*self._shapes(X)[:2])),)

    def _shapes(self, X):
        """(area times normal, angles, edges to the next corner, to the one after) of the triangles, by corners."""
        x = X[self.triangles]
        e, f = np.roll(x, -1, 1) - x, np.roll(x, -2, 1) - x
        angles = np.arctan2(np.linalg.norm(np.cross(e, f), axis=2), (e * f).sum(2))
        return triangle_normals(X, self.triangles), angles, e, f

    def _dealt(self, angles):
        """What corners of triangles count for: their angles, but for what those of six-node faces hand on, which stand in
        the first three triangles of four."""
        if self.at_corner is None:
            return angles
        handed_on = (1 - self.kept) * self.at_corner * angles
        out = angles - handed_on
        out[3::4] += handed_on.reshape(-1, 12).sum(1)[:, None] / 3
        return out

    def _dealt_vjp(self, out_adj):
        if self.at_corner is None:
            return out_adj
        to_middles = np.repeat(out_adj[3::4].sum(1) / 3, 4)[:, None]
        return out_adj + (1 - self.kept) * self.at_corner * (to_middles - out_adj)

    def _moments(self, n, angles):
        """M of each vertex."""
        outer = n[:, :, None] * n[:, None, :] / np.linalg.norm(n, axis=1)[:, None, None]
        return self._to_vertices(self._dealt(angles)[:, :, None, None] / np.pi * outer[:, None])

    def _areas(self, M):
        total = np.trace(M, axis1=1, axis2=2)
        return np.divide((M**2).sum((1, 2)), total, out=np.zeros_like(total), where=total > 0)

    def _slopes(self, M):
        """da/dM of each vertex."""
        total = np.trace(M, axis1=1, axis2=2)[:, None, None]
        rise = 2 * M - self._areas(M)[:, None, None] * np.eye(3)
        return np.divide(rise, total, out=np.zeros_like(M), where=total > 0)

    def _parts(self, X):
        """What of da/dx comes by the corners of triangles: (da/d angle, da/d n, unit normals, edges e, f)."""
        n, angles, e, f = self._shapes(X)
        size = np.linalg.norm(n, axis=1)[:, None]
        N, slopes = n / size, self._slopes(self._moments(n, angles))[self.triangles]
        turned = np.einsum("tcij,tj->tci", slopes, N)
        along = np.einsum("tci,ti->tc", turned, N)
        by_n = self._dealt(angles)[:, :, None] / np.pi * (2 * turned - along[:, :, None] * N[:, None])
        return along * size / np.pi, by_n, N, e, f

    def jvp(self, x, dx):
        by_angle, by_n, N, e, f = self._parts(*x)
        moved = dx[0][self.triangles]
        de, df = np.roll(moved, -1, 1) - moved, np.roll(moved, -2, 1) - moved
        by_e, by_f = _turn(N, e, f)
        change = by_angle * self._dealt((by_e * de).sum(2) + (by_f * df).sum(2))
        dn = (np.cross(de[:, 0], f[:, 0]) + np.cross(e[:, 0], df[:, 0])) / 2
        return (self._to_vertices(change + np.einsum("tci,ti->tc", by_n, dn)),)

    def vjp(self, x, y_adj):
        by_angle, by_n, N, e, f = self._parts(*x)
        own = y_adj[0][self.triangles]
        by_own = self._dealt_vjp(own * by_angle)
        by_e, by_f = (by_own[:, :, None] * by for by in _turn(N, e, f))
        by_corner = np.roll(by_e, 1, 1) + np.roll(by_f, 2, 1) - by_e - by_f
        n_adj = np.einsum("tc,tci->ti", own, by_n)
        by_corner += np.cross(np.roll(e, -1, 1) / -2, n_adj[:, None])
        return (self._to_vertices(by_corner),)

    def _to_vertices(self, by_corner: np.ndarray) -> np.ndarray:
        out = np.zeros((self.num_vertices, *by_corner.shape[2:]))
        np.add.at(out, self.triangles, by_corner)
        return out


def _turn(N, e, f):
    """Derivatives of the angles between e and f by these."""
    normal = N[:, None]
    return -np.cross(normal, e) / (e**2).sum(2, keepdims=True), np.cross(normal, f) / (f**2).sum(2, keepdims=True)
