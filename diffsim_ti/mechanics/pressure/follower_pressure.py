"""Pressures that follow the surface, in float64 on the host: forces, their derivatives both ways, and their work.

The force of a triangle on each of its corners is -p n / 3, n = (x_1 - x_0) x (x_2 - x_0) / 2, that on each node of a face of
six nodes minus the integral of p N_a dx/ds x dx/dt. Over a closed surface that is -p dV/dx, V the volume inside. Over an
open one a part is left at its edge that no potential has.
"""

from functools import cached_property

import numpy as np

from diffsim_ti.differentiation.arrays import as_array, summed_at
from diffsim_ti.mechanics.host_force import HostForce, Instant
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


class FollowerPressure(HostForce):
    """Of faces (m, 3) or (m, 6), each of which belongs to a load; `at` says how large the pressures of loads are [Pa].

    Displacements are from `rest`, the origin until `take` says otherwise.
    symmetric: whether there is a potential: all edges of each load's faces are inner ones, or held so (`is_symmetric`).
    """

    rest, instant = 0.0, Instant()

    def __init__(self, faces: np.ndarray, load_of: np.ndarray, num_vertices: int, symmetric: bool = True):
        self.points, self.num_vertices, self.symmetric = face_points(faces), num_vertices, symmetric
        self.faces, self.load_of = faces, np.repeat(load_of, self.points.points)
        self.pressure = np.zeros(load_of.max(initial=-1) + 1)

    def restrict(self, free, rest):
        self.symmetric = is_symmetric(self.faces, self.load_of[:: self.points.points], free, rest)

    def at(self, pressures: np.ndarray) -> "FollowerPressure":
        """With pressures of the loads [Pa]."""
        self.pressure = as_array(pressures)
        return self

    def take(self, values, instant):
        super().take(values, instant)
        self.rest = values.rest
        return self.at(instant.load * pressures_at(values.follower, instant)[: len(self.pressure)])

    def pressures(self, x: np.ndarray) -> np.ndarray:
        """Of the loads at places x [Pa]."""
        return self.pressure

    def _to_vertices(self, by_points):
        """Sums at vertices of what the points have."""
        return summed_at(self.points.faces, self.points.to_nodes(by_points), self.num_vertices)

    def _pushed(self, pressures, x):
        """-p n of each point."""
        return -pressures[self.load_of, None] * self.points.normals(x)

    def forces(self, u):
        x = self.rest + u
        return self._to_vertices(self._pushed(self.pressures(x), x))

    def sizes(self, u):
        x = self.rest + u
        part = np.linalg.norm(self.points.to_nodes(self._pushed(self.pressures(x), x)), axis=2)
        return np.bincount(self.points.faces.ravel(), part.ravel(), self.num_vertices)

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

    def tangent(self, u, transposed=False):
        out = self._tangent(self.rest + u)
        return out.T if transposed else out

    def _tangent(self, x: np.ndarray) -> Tangent:
        from scipy.sparse import bsr_matrix

        points, (sums, columns, start) = self.points, self._blocks
        pushes = -self.pressures(x)[self.load_of].reshape(len(points.faces), -1)
        parts = np.einsum("qa,fq,fqbij->fabij", points.shares, pushes, points.normals_by_nodes(x), optimize=True)
        blocks = (sums @ parts.reshape(-1, 9)).reshape(-1, 3, 3)
        return Tangent(bsr_matrix((blocks, columns, start), (3 * self.num_vertices,) * 2), [])

    def matrix(self, u):
        """Of pressures as they are."""
        return -self.tangent(u).K


def pressures_at(rows: np.ndarray, instant: Instant) -> np.ndarray:
    """Pressures and numbers of chambers at an instant, of rows in time. In a part of a pass of static solves those of
    steps of which each has its own go over from the last one's."""
    schedule, j = instant.schedule, instant.j
    if instant.laid == 1 or j == 0:
        return schedule.pressure(rows, j, instant.share)
    now, before = (schedule.pressure(rows, k, schedule.end(k)) for k in (j, j - 1))
    return before + instant.laid * (now - before)


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
