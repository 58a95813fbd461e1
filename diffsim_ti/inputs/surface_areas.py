"""How much of a body's surface each of its vertices stands for, where it lies on something."""

import numpy as np

from diffsim_ti.differentiation.arrays import ratio, summed_at
from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.mesh.face_points import curved_faces
from diffsim_ti.mesh.geometry import triangle_normals


class SurfaceAreas(Recording, Link):
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
        x = X[self.triangles]
        e, f = np.roll(x, -1, 1) - x, np.roll(x, -2, 1) - x
        angles = np.arctan2(np.linalg.norm(np.cross(e, f), axis=2), (e * f).sum(2))
        n = triangle_normals(X, self.triangles)
        outer = n[:, :, None] * n[:, None, :] / np.linalg.norm(n, axis=1)[:, None, None]
        dealt = self._dealt(angles)[:, :, None, None] / np.pi * outer[:, None]
        M = summed_at(self.triangles, dealt, self.num_vertices)
        return (ratio((M**2).sum((1, 2)), (M * np.eye(3)).sum((1, 2))),)

    def _dealt(self, angles):
        """What corners of triangles count for: their angles, but for what those of six-node faces hand on, which stand in
        the first three triangles of four."""
        if self.at_corner is None:
            return angles
        handed_on = (1 - self.kept) * self.at_corner * angles
        middles = np.arange(len(angles)) % 4 == 3
        return angles - handed_on + middles[:, None] * np.repeat(handed_on.reshape(-1, 12).sum(1) / 3, 4)[:, None]
