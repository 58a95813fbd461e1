"""What obstacles, and surfaces to each other, do in each frame of an implicit run, per vertex, with tangent and adjoint; on
the host, in float64.

Forces are those where passes take them, averaged over the passes since the frame before; of static solves those of the
last pass.
"""

from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.obstacle_shares import share_kernels


class Shares:
    """Forces of each obstacle on each vertex in the pass that a potential is told of, shape (obstacles, 2, n, 3)."""

    def __init__(self, workspace, features=None):
        self.p, self.a = workspace.potential, workspace.arrays
        a, features = self.a, workspace.arrays.features() if features is None else features
        self.kernels = share_kernels(workspace.shares_kind, features, a.precision, workspace.parallel)
        self.num_obstacles = len(a.obstacles)
        self.force = runtime.array(a.vector, 2 * self.num_obstacles, a.num_vertices)
        self.y = runtime.array(a.vector, 1, a.num_vertices)
        self._launches = {}

    def run(self, name: str, **records) -> None:
        if name not in self._launches:
            own = dict(scene=self.a, pass_=self.p, at=(self.p, self), out=self) | records
            self._launches[name] = getattr(self.kernels, name).bind(**own)
        self._launches[name](num_vertices=self.a.num_vertices, per_gamma=self.p.per_gamma)

    def forces(self, name: str = "forces", **records) -> np.ndarray:
        """Forces, or "jvp": their change for w of the potential and `tangent`."""
        self.run(name, **records)
        n = self.a.num_vertices
        return runtime.fetch(self.force).astype(np.float64).reshape(self.num_obstacles, 2, n, 3)


class ContactRecord:
    """Forces of all frames, shape (frames, obstacles, 2, num_vertices, 3); one row more is of surfaces on each other."""

    def __init__(self, workspace):
        frames, a, self.schedule = workspace.frames.frames_u.shape[0], workspace.arrays, workspace.solver.schedule
        self.forces = np.zeros((frames, a.num_contact_rows, 2, a.num_vertices, 3))

    def _weight(self, j: int, save_every: int, static: bool) -> tuple[int, float]:
        """(the frame that pass j leads to, how much it counts there)."""
        frame = int(self.schedule.counted(j, save_every))
        if frame < 0 or static:
            return frame, float(frame >= 0 and self.schedule.ends_frame(j, save_every))
        return frame, float(self.schedule.length(j) / self.schedule.frame_time(frame, save_every))

    def add(self, j: int, save_every: int, static: bool, *made) -> None:
        """Add what `made` give, forces in pass j of the first rows, or of all, to the frame that the pass leads to."""
        frame, weight = self._weight(j, save_every, static)
        for make in made if weight else ():
            forces = make()
            self.forces[frame, : len(forces)] += weight * forces

    def seed(self, j: int, save_every: int, static: bool) -> np.ndarray | None:
        """Adjoints of the forces in pass j, `forces` being those of the frames; None where they are zero."""
        frame, weight = self._weight(j, save_every, static)
        own = weight * self.forces[frame] if weight else np.zeros(0)
        return own if own.any() else None


class SharesAdjoint(Shares):
    """Adjoints by those of the forces."""

    def __init__(self, workspace, features, numbers):
        super().__init__(workspace, features)
        p, a = self.p, self.a
        self.seed = runtime.array(a.vector, 2 * self.num_obstacles, a.num_vertices)
        self.lag = runtime.array(a.vector, *p.lag.shape)
        self.poses = runtime.array(a.vector, a.poses.size, a.num_vertices)
        self.numbers = SimpleNamespace(lag=self.lag, poses=self.poses), numbers

    def pull_back(self, seed: np.ndarray, summed=lambda rows: rows.sum(1)) -> tuple[np.ndarray, ...]:
        """(adjoint of u*, of the two rows of lag, of the rows of obstacle poses) in float64; adds those
        of the scene's numbers. summed: what adds up the last over vertices."""
        runtime.fill(self.seed, seed.reshape(-1, *seed.shape[2:]))
        for target in (self.lag, self.poses):
            runtime.fill(target, 0)
        self.run("vjp", adjoint=self.numbers)
        by_u = runtime.fetch_row(self.y, 0)
        by_lag, by_poses = (runtime.fetch(x).astype(np.float64) for x in (self.lag, self.poses))
        return by_u, by_lag, summed(by_poses)
