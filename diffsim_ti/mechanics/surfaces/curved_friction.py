"""Friction of implicit passes between pairs whose vertices are sums over nodes, x = C X + g, g of corners of obstacles
(curved_pairs.py): a potential of the points, so that friction on nodes is C^T that on points."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE


class CurvedLaggedFriction:
    """As LaggedFriction, of nodes."""

    def __init__(self, pairs):
        self.pairs, self.inner, self.C, self.began = pairs, pairs.inner.friction, pairs.matrix, None

    def begin(self, u: np.ndarray, x: np.ndarray, per_gamma: float, presses: bool) -> None:
        """With obstacles where the pass begins; their corners have x = g - v / per_gamma, g where forces are taken."""
        self.began, self.x = (u, x, per_gamma, presses), self.C @ x
        self.given, obstacles = np.zeros_like(self.x), self.pairs.obstacles
        self.lost = obstacles.velocities() / per_gamma if obstacles else None
        self.inner.begin(self.pairs.spread(u), self.x, per_gamma, presses)
        self.follow()

    def follow(self) -> None:
        """Obstacles are elsewhere."""
        if self.pairs.obstacles:
            first = self.pairs.finer.mesh.first
            self.given[first:] = self.pairs.obstacles.displacements
            self.x[first:] = self.given[first:] - self.lost
            self.inner.lag(self.x)

    def without(self):
        return self.inner.without()

    def _fine(self, u: np.ndarray) -> np.ndarray:
        return self.C @ u + self.given

    def forces(self, u: np.ndarray, only: int | None = None) -> np.ndarray:
        return self.C.T @ self.inner.forces(self._fine(u), only)

    def jvp(self, u, du, dx, du_begin, numbers, poses_dot=None, only: int | None = None) -> np.ndarray:
        """poses_dot: changes of the rows of poses, None: zero."""
        C, obstacles = self.C, self.pairs.obstacles
        changes = [C @ du, C @ dx, C @ du_begin]
        if obstacles:
            change = runtime.fetch(numbers.parameters)[: len(obstacles.parameters)].astype(np.float64)
            given = obstacles.changes(change, poses_dot)
            for change, corners in zip(changes, (given[0], given[0] - given[2] / self.inner.per_gamma, given[1])):
                change[self.pairs.finer.mesh.first :] = corners
        return C.T @ self.inner.jvp(self._fine(u), *changes, self.pairs.fine_numbers(numbers), only=only)

    def vjp(self, u: np.ndarray, forces_adj: np.ndarray, only: int | None = None) -> tuple[np.ndarray, ...]:
        found, obstacles = self.inner.vjp(self._fine(u), self.C @ forces_adj, only), self.pairs.obstacles
        if obstacles:
            by_u, by_x, by_begin = (by[self.pairs.finer.mesh.first :] for by in found)
            obstacles.add_places(by_u + by_x, AT_STAGE)
            obstacles.add_places(by_begin, AT_BEGIN)
            obstacles.add_velocities(-by_x / self.inner.per_gamma)
        return tuple(self.C.T @ by for by in found)
