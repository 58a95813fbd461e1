"""Pressures that follow the surface, in float64 on the host: forces, their derivatives both ways, and their work.

The force of a triangle on each of its corners is -p n / 3, n = (x_1 - x_0) x (x_2 - x_0) / 2, that on each node of a face of
six nodes minus the integral of p N_a dx/ds x dx/dt. Over a closed surface that is -p dV/dx, V the volume inside. Over an
open one a part is left at its edge that no potential has.
"""

from functools import cached_property

import numpy as np

from diffsim_ti.mesh.enclosure import open_edges, spanned_by_edges
from diffsim_ti.mesh.face_points import face_points


class Tangent:
    """dx -> K dx + sum of u (g . dx) over pairs (u, g), which are few; K a sparse matrix, all of them (num_vertices, 3)."""

    def __init__(self, K, pairs: list[tuple[np.ndarray, np.ndarray]]):
        self.K, self.pairs = K, pairs

    def __call__(self, dx: np.ndarray) -> np.ndarray:
        out = (self.K @ dx.ravel()).reshape(-1, 3)
        for u, g in self.pairs:
            out += float(np.vdot(g, dx)) * u
        return out

    @property
    def T(self) -> "Tangent":
        return Tangent(self.K.T, [(g, u) for u, g in self.pairs])


class FollowerPressure:
    """Of faces (m, 3) or (m, 6), each of which belongs to a load; `at` says how large the pressures of loads are [Pa].

    symmetric: whether there is a potential: all edges of each load's faces are inner ones, or held so (`is_symmetric`).
    """

    def __init__(self, faces: np.ndarray, load_of: np.ndarray, num_vertices: int, symmetric: bool = True):
        self.points, self.num_vertices, self.symmetric = face_points(faces), num_vertices, symmetric
        self.load_of = np.repeat(load_of, self.points.points)
        self.pressure = np.zeros(0)

    def at(self, pressures: np.ndarray, share: float = 1.0) -> "FollowerPressure":
        """With a share of pressures of the loads [Pa]."""
        self.share, self.pressure = share, share * np.asarray(pressures, np.float64)
        return self

    def _to_vertices(self, by_points):
        """Sums at vertices of what the points have."""
        at, by_nodes = self.points.faces.ravel(), self.points.to_nodes(by_points).reshape(-1, 3)
        return np.stack([np.bincount(at, by_nodes[:, d], self.num_vertices) for d in range(3)], 1)

    def _pushes(self, pressures):
        """-p of each point."""
        return -pressures[self.load_of, None]

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Forces on vertices at x [N], shape (num_vertices, 3)."""
        return self._to_vertices(self._pushes(self.pressure) * self.points.normals(x))

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """Sum of the sizes of the forces that meet at each vertex [N]."""
        by_nodes = self.points.to_nodes(self._pushes(self.pressure) * self.points.normals(x))
        part = np.linalg.norm(by_nodes, axis=2)
        return np.bincount(self.points.faces.ravel(), part.ravel(), self.num_vertices)

    def jvp(self, x: np.ndarray, dx: np.ndarray, pressures_dot: np.ndarray | None = None) -> np.ndarray:
        """Change of the forces for changes of x and of pressures."""
        part = self._pushes(self.pressure) * self.points.normals_jvp(x, dx)
        if pressures_dot is not None:
            part += self._pushes(self.share * pressures_dot) * self.points.normals(x)
        return self._to_vertices(part)

    @cached_property
    def _blocks(self):
        """(what adds up the blocks of all pairs of nodes of each face, columns of the sums, where rows begin)."""
        from scipy.sparse import csr_matrix

        n, faces = self.num_vertices, self.points.faces
        pairs, place = np.unique(n * faces[:, :, None] + faces[:, None], return_inverse=True)
        rows, columns = np.divmod(pairs, n)
        each = np.arange(place.size + 1)
        sums = csr_matrix((np.ones(place.size), place.ravel(), each), (place.size, len(pairs))).T.tocsr()
        return sums, columns, np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])

    def tangent(self, x: np.ndarray) -> Tangent:
        """Change of the forces for many changes of x."""
        from scipy.sparse import bsr_matrix

        points, (sums, columns, start) = self.points, self._blocks
        pushes = self._pushes(self.pressure).reshape(len(points.faces), -1)
        parts = np.einsum("qa,fq,fqbij->fabij", points.shares, pushes, points.normals_by_nodes(x), optimize=True)
        blocks = (sums @ parts.reshape(-1, 9)).reshape(-1, 3, 3)
        return Tangent(bsr_matrix((blocks, columns, start), (3 * self.num_vertices,) * 2), [])

    def vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of x for the adjoint w of the forces."""
        return self.points.normals_vjp(x, self._pushes(self.pressure) * self._at_points(w))

    def _at_points(self, w):
        return self.points.from_nodes(w[self.points.faces])

    def pressures_vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of the pressures of loads for the adjoint w of the forces."""
        by_point = -(self.points.normals(x) * self._at_points(w)).sum(1)
        return self.share * np.bincount(self.load_of, by_point, len(self.pressure))

    def work(self, x: np.ndarray, step: np.ndarray) -> float:
        """Work done along a straight step [J]: the forces are quadratic in it, so that Simpson's rule is exact."""
        middle = 4 * self.forces(x + 0.5 * step)
        return float(((self.forces(x) + middle + self.forces(x + step)) * step).sum()) / 6


def is_symmetric(faces: np.ndarray, load_of: np.ndarray, free: np.ndarray, x: np.ndarray) -> bool:
    """Whether pressures have a potential in what may move, and so a symmetric tangent.

    Each load's faces must be closed, or their edge be held: what an edge's vertices may do, with the edge itself, must span
    a plane at most, as on a symmetry plane. free: projectors on what each vertex may do, (num_vertices, 3, 3).
    """
    for load in np.unique(load_of):
        rim = open_edges(faces[load_of == load], len(x))
        spanned = spanned_by_edges(rim, free, x)
        if np.any(np.linalg.matrix_rank(spanned, tol=1e-9) > 2):
            return False
    return True
