"""What rough obstacles push vertices with where a pass begins, points within faces included: friction's normal forces.

Friction of a pass takes its normal force from where the pass begins (obstacles.py). An obstacle that reaches into
faces pushes a vertex by its barrier and by the points around; their sum, a vector, is found here, with its derivatives.
"""

from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.contact_record import Shares, SharesAdjoint


def _at_begin(workspace) -> SimpleNamespace:
    """What a potential says of a pass, as if it took its forces where it begins."""
    a, p = workspace.arrays, workspace.potential
    u, w = (runtime.array(a.vector, 1, a.num_vertices) for _ in range(2))
    poses = runtime.array(a.vector, *p.poses.shape)
    return SimpleNamespace(u=u, w=w, poses=poses, lag=p.lag, pressed=p.pressed, faces=p.faces, per_gamma=1.0)


def _begin_rows(poses: np.ndarray) -> np.ndarray:
    """Of the three rows of each obstacle, those where the pass begins in the place of those where it takes forces."""
    out = poses.copy()
    out[::3] = poses[1::3]
    return out


class Pressed:
    """Fills `pressed` of a workspace's potential."""

    def __init__(self, workspace):
        self.potential, self.here = workspace.potential, _at_begin(workspace)
        self.shares = Shares(workspace, at=self.here)

    def begin(self, u: np.ndarray, poses: np.ndarray) -> None:
        """For a pass from displacement u [m], obstacles being as `poses` says."""
        runtime.fill(self.here.u, u[None])
        runtime.fill(self.here.poses, _begin_rows(poses))
        runtime.fill(self.potential.pressed, self.shares.forces()[:, 0])


class PressedTangent:
    """Their change, into `pressed` of a tangent."""

    def __init__(self, workspace, tangent):
        self.tangent, self.here = tangent, workspace.pressed.here
        self.shares = Shares(workspace, at=self.here)
        poses, lag = runtime.array(workspace.arrays.vector, *self.here.poses.shape), tangent.lag
        self.change = SimpleNamespace(
            poses=poses, lag=lag, pressed=runtime.array(workspace.arrays.vector, *tangent.pressed.shape)
        )

    def begin(self, du: np.ndarray, poses_dot: np.ndarray | None) -> None:
        """For a change du of the displacement where the pass begins, and of the rows of obstacles."""
        runtime.fill(self.here.w, du[None])
        if poses_dot is not None:
            runtime.fill(self.change.poses, _begin_rows(poses_dot))
        df = self.shares.forces("jvp", tangent=(self.change, self.tangent.numbers))
        runtime.fill(self.tangent.pressed, df[:, 0])


class PressedAdjoint:
    """Adjoints of what they depend on."""

    def __init__(self, workspace, features, numbers, face_areas):
        self.shares = SharesAdjoint(workspace, features, numbers, face_areas, at=workspace.pressed.here)

    def pull_back(self, pressed_adj: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of the displacement where the pass begins, of the rows of obstacle poses); adds those of the scene's
        numbers."""
        seed = np.stack([pressed_adj, np.zeros_like(pressed_adj)], 1)
        by_u, _, _, by_poses = self.shares.pull_back(seed)
        out = np.zeros_like(by_poses)
        out[1::3] = by_poses[::3]
        return by_u, out
