"""Soft cubes that jump."""

import numpy as np

from diffsim_ti.envs.soft_bodies import SoftBodies, SoftBody
from diffsim_ti.materials import StableNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Drag, ExternalForce, Gravity, Ground

SIZE = 0.2  # [m]
SQUEEZE = 20.0  # [N] that an action of 1 presses each half with


class SoftJumpers(SoftBodies):
    """Cubes of 0.2 m on a rough floor, which squeeze themselves.

    Two actions: the forces that press the left and the right half together along y, equal and opposite at top and bottom,
    so that a cube cannot lift itself but by letting go. The reward is by how much its centre rises above where it has been
    [m]. Starts differ in height.
    """

    gradients = ("initial_positions", "initial_velocities", "external_forces")
    num_actions = 2

    def __init__(self, num_envs: int = 32):
        self.best = np.zeros(num_envs)  # progress so far
        super().__init__(num_envs)
        self.pressing = self.forces(self.scene.mesh)

    @staticmethod
    def make_scene() -> Scene:
        mesh = TetrahedralMesh.create_box((3, 4, 3), SIZE, origin=(-SIZE / 2, 0.021, -SIZE / 2))
        floor, forces = Ground(width=0.02, friction=0.5), ExternalForce(np.zeros((1, mesh.num_vertices, 3)))
        return Scene(mesh, StableNeoHookean(3e4, 0.3), 300.0, [Gravity(), Drag(0.5), floor, forces])

    @staticmethod
    def forces(mesh: TetrahedralMesh) -> np.ndarray:
        """Forces [N] of each action, shape (num_actions, n, 3): each sums to zero."""
        x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
        out = np.zeros((2, mesh.num_vertices, 3))
        for half, side in zip(out, (x < -1e-9, x > 1e-9)):
            for end, sign in ((y.max(), -1), (y.min(), 1)):
                pressed = side & (np.abs(y - end) < 1e-9)
                half[pressed, 1] = sign * SQUEEZE / pressed.sum()
        return out

    @staticmethod
    def progress(positions):
        """What counts, of positions (scenes, n, 3), NumPy's or torch's: the centre's height [m]."""
        return positions[:, :, 1].mean(1)

    @staticmethod
    def goal(progress):
        """What an episode is worth, of progress (steps, scenes) in torch: a smooth maximum in its second half."""
        late = progress[len(progress) // 2 :]
        return (late * (200.0 * late).softmax(0)).sum(0)

    def inputs(self, actions):
        return {"external_forces": np.einsum("bk,kni->bni", actions, self.pressing)[:, None]}

    def start(self, rows):
        lifts = self.np_random.uniform(0.0, 0.02, len(rows))
        self.positions[rows] += lifts[:, None, None] * np.array([0.0, 1.0, 0.0])
        self.best[rows] = self.progress(self.positions[rows])

    def rewards(self, actions):
        now = self.progress(self.positions)
        gained = np.maximum(now - self.best, 0)
        self.best = np.maximum(now, self.best)
        return gained


class SoftJumper(SoftBody):
    """One cube that jumps."""

    many = SoftJumpers
