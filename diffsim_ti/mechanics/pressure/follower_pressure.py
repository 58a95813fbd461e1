"""Pressures that follow the surface, in float64 on the host: forces, their derivatives both ways, and their work.

The force of a triangle on each of its corners is -p n / 3, n = (x_1 - x_0) x (x_2 - x_0) / 2, that on each node of a face of
six nodes minus the integral of p N_a dx/ds x dx/dt. Over a closed surface that is -p dV/dx, V the volume inside. Over an
open one a part is left at its edge that no potential has.
"""

from functools import cached_property

import numpy as np

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
        self.pressure = np.asarray(pressures, np.float64)
        return self

    def take(self, values, instant):
        super().take(values, instant)
        self.rest = values.rest
        return self.at(instant.load * pressures_at(values.follower, instant)[: len(self.pressure)])

    def _to_vertices(self, by_points):
        """Sums at vertices of what the points have."""
        at, by_nodes = self.points.faces.ravel(), self.points.to_nodes(by_points).reshape(-1, 3)
        return np.stack([np.bincount(at, by_nodes[:, d], self.num_vertices) for d in range(3)], 1)

    def _pushes(self, pressures):
        """-p of each point."""
        return -pressures[self.load_of, None]

    def forces(self, u):
        return self._to_vertices(self._pushes(self.pressure) * self.points.normals(self.rest + u))

    def sizes(self, u):
        by_nodes = self.points.to_nodes(self._pushes(self.pressure) * self.points.normals(self.rest + u))
        part = np.linalg.norm(by_nodes, axis=2)
        return np.bincount(self.points.faces.ravel(), part.ravel(), self.num_vertices)

    def jvp(self, u, du, dv=None, moved=None):
        x, dx = self.rest + u, du if moved is None else du + moved.rest
        part, dp = self._pushes(self.pressure) * self.points.normals_jvp(x, dx), self._pressures_jvp(x, dx, moved)
        if dp is not None:
            part += self._pushes(dp) * self.points.normals(x)
        return self._to_vertices(part)

    def _pressures_jvp(self, x: np.ndarray, dx: np.ndarray, moved) -> np.ndarray | None:
        """Change of the pressures of loads; None where there is none."""
        if moved is None:
            return None
        instant = self.instant
        change = instant.schedule.pressure(moved.follower, instant.j, instant.share)
        return instant.load * change[: len(self.pressure)]

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
        pushes = self._pushes(self.pressure).reshape(len(points.faces), -1)
        parts = np.einsum("qa,fq,fqbij->fabij", points.shares, pushes, points.normals_by_nodes(x), optimize=True)
        blocks = (sums @ parts.reshape(-1, 9)).reshape(-1, 3, 3)
        return Tangent(bsr_matrix((blocks, columns, start), (3 * self.num_vertices,) * 2), [])

    def matrix(self, u):
        """Of pressures as they are."""
        return -self.tangent(u).K

    def vjp(self, u, w, adj=None):
        x, at_points = self.rest + u, self.points.from_nodes(w[self.points.faces])
        by_points = -(self.points.normals(x) * at_points).sum(1)
        by_x = self.points.normals_vjp(x, self._pushes(self.pressure) * at_points)
        by_x = by_x + self._pressures_vjp(x, np.bincount(self.load_of, by_points, len(self.pressure)), adj)
        if adj is not None:
            adj.rest += by_x
        return by_x, 0.0

    def _pressures_vjp(self, x: np.ndarray, p_adj: np.ndarray, adj):
        """Adjoint of x for that of the pressures of loads; adds those of their numbers."""
        if adj is not None:
            self.add_numbers(adj, slice(len(p_adj)), self.instant.load * p_adj)
        return 0.0

    def add_numbers(self, adj, rows, by_numbers: np.ndarray) -> None:
        """Add to the adjoints of `Derived.follower`, in some rows."""
        whole, instant = np.zeros(adj.follower.shape[1]), self.instant
        whole[rows] = by_numbers
        instant.schedule.add_pressure(adj.follower, instant.j, instant.share, whole)


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
