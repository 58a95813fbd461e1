"""What holds a body by springs, cables and elastic foundations, in float64 on the host."""

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.ties.interaction import Foundations, SpringsAndCables
from diffsim_ti.mechanics.ties.ties import Ties
from diffsim_ti.state.schedule import EqualSteps, Schedule

START = EqualSteps(1.0, 1)


class Foundation:
    """f = -K u of vertices; `at` says K, shape (k, 3, 3)."""

    def __init__(self, vertices: np.ndarray):
        self.vertices = vertices

    def at(self, rows: np.ndarray) -> "Foundation":
        """With rows of K, shape (3 k, 3)."""
        self.K = rows.reshape(-1, 3, 3)
        return self

    def forces(self, u: np.ndarray) -> np.ndarray:
        """On its vertices [N], shape (k, 3)."""
        return -np.einsum("kij,kj->ki", self.K, u[self.vertices])

    def energies(self, u: np.ndarray) -> np.ndarray:
        """Of each of its vertices [J]."""
        return -0.5 * (self.forces(u) * u[self.vertices]).sum(1)


class Attached:
    """Energy, forces and derivatives of a scene's springs, cables and foundations; shapes (num_vertices, 3)."""

    def __init__(self, scene):
        n, self.num_springs = scene.mesh.num_vertices, 0
        self.ties = self.foundation = None
        if ties := scene.interaction(SpringsAndCables):
            self.ties = Ties(ties.paths, ties.one_sided, ties.cables, n)
        if founded := scene.interaction(Foundations):
            self.foundation = Foundation(founded.acts_at)

    @classmethod
    def of(cls, scene) -> "Attached | None":
        """None where a scene has none."""
        return cls(scene) if scene.interaction(SpringsAndCables) or scene.interaction(Foundations) else None

    def at(self, values: Derived, rows: np.ndarray | None, schedule: Schedule, j: int, share: float, laid: float = 1.0):
        """At a share of the step of pass j; rows: of ties, in time; laid: share of given tensions that is laid on."""
        if self.ties:
            a, s, k = schedule.ties(rows, j, share)
            self.ties.at(values.tie_segments, a * self._laid(laid), s, k)
        if self.foundation:
            self.foundation.at(values.foundation)
        return self

    def at_start(self, values: Derived) -> "Attached":
        """As a run begins."""
        return self.at(values, values.ties, START, 0, 0.0)

    def vjp_at_start(self, u, w, adj: Derived) -> np.ndarray:
        """`vjp` there."""
        return self.vjp(u, w, adj, START, 0, 0.0)

    def stiffest(self, values: Derived, rows: np.ndarray | None, schedule: Schedule) -> "Attached":
        """With the largest tension and stiffness of each tie in `rows` and its least length: what a step has to follow."""
        if self.ties:
            ends = rows.reshape(len(rows), -1, 2, 3)
            a, s = ends[:, :, 0, :2].max((0, 2)), ends[:, :, 1, :2].max((0, 2))
            self.ties.at(values.tie_segments, a, s, ends[:, :, 0, 2].max(0))
        if self.foundation:
            self.foundation.at(values.foundation)
        return self

    def _laid(self, share: float) -> np.ndarray:
        """Of each tie: those of springs are there from the start."""
        return np.where(self.ties.cables, share, 1.0)

    def energies(self, u: np.ndarray) -> np.ndarray:
        """[J] of ties and of vertices on foundations."""
        parts = [part.energies(u) for part in (self.ties, self.foundation) if part]
        return np.concatenate(parts)

    def stored(self, u: np.ndarray) -> dict[str, float]:
        """Energies [J] by name, without that of cables, which are loads."""
        out = {}
        if self.ties and not self.ties.cables.all():
            out["springs"] = float(self.ties.energies(u)[~self.ties.cables].sum())
        if self.foundation:
            out["foundations"] = float(self.foundation.energies(u).sum())
        return out

    def forces(self, u: np.ndarray) -> np.ndarray:
        """[N]"""
        out = self.ties.forces(u) if self.ties else np.zeros_like(u)
        if self.foundation:
            out[self.foundation.vertices] += self.foundation.forces(u)
        return out

    def sizes(self, u: np.ndarray) -> np.ndarray:
        """Sum of the sizes of the forces that meet at each vertex [N]."""
        out = self.ties.sizes(u) if self.ties else np.zeros(len(u))
        if self.foundation:
            out[self.foundation.vertices] += np.linalg.norm(self.foundation.forces(u), axis=1)
        return out

    def product(self, u: np.ndarray, w: np.ndarray, convex: bool = False) -> np.ndarray:
        """d2E/du2 w [N]; convex: without what has negative curvature."""
        out = self.ties.product(u, w, convex) if self.ties else np.zeros_like(w)
        if self.foundation:
            out[self.foundation.vertices] -= self.foundation.forces(w)
        return out

    def matrix(self, u: np.ndarray):
        """d2E/du2 [N/m] as a SciPy sparse matrix of all unknowns, rows 3 i + d."""
        from scipy.sparse import coo_matrix

        shape = (u.size, u.size)
        out = self.ties.matrix(u) if self.ties else coo_matrix(shape)
        if self.foundation:
            vertices, axes = self.foundation.vertices, np.arange(3)
            rows = np.broadcast_to(3 * vertices[:, None, None] + axes[:, None], self.foundation.K.shape)
            columns = np.broadcast_to(3 * vertices[:, None, None] + axes, self.foundation.K.shape)
            out = out + coo_matrix((self.foundation.K.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
        return out.tocsr()

    def turning(self, u: np.ndarray, w: np.ndarray) -> float:
        """How much a segment of springs and cables is changed by w at most, against its length; of foundations 1."""
        return max(self.ties.turning(u, w), 1e-300) if self.ties else 1.0

    def blocks(self, u: np.ndarray) -> np.ndarray:
        """3x3 diagonal blocks of d2E/du2 [N/m]."""
        out = self.ties.blocks(u) if self.ties else np.zeros((len(u), 3, 3))
        if self.foundation:
            out[self.foundation.vertices] += self.foundation.K
        return out

    def jvp(self, u, du, moved: Derived, schedule: Schedule, j: int, share: float, laid: float = 1.0) -> np.ndarray:
        """Change of the forces for changes of displacements and numbers, at the time that `at` was told."""
        out = np.zeros_like(du)
        if self.ties:
            a, s, k = schedule.ties(moved.ties, j, share)
            out += self.ties.jvp(u, du, moved.tie_segments, a * self._laid(laid), s, k)
        if self.foundation:
            own, f = self.foundation.vertices, self.foundation
            out[own] += f.forces(du) - np.einsum("kij,kj->ki", moved.foundation.reshape(-1, 3, 3), u[own])
        return out

    def vjp(self, u, w, adj: Derived, schedule: Schedule, j: int, share: float, laid: float = 1.0) -> np.ndarray:
        """Adjoint of displacements for that of the forces; adds those of numbers to `adj`."""
        out = np.zeros_like(w)
        if self.ties:
            by_u, segments, (a, s, k) = self.ties.vjp(u, w)
            out += by_u
            adj.tie_segments += segments
            schedule.add_ties(adj.ties, j, share, (a * self._laid(laid), s, k))
        if self.foundation:
            own = self.foundation.vertices
            out[own] += self.foundation.forces(w)
            adj.foundation -= (w[own][:, :, None] * u[own][:, None]).reshape(-1, 3)
        return out
