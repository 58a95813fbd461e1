"""Two pads that take hold of a soft cube, and lift it by friction alone."""

import numpy as np

from diffsim_ti.envs.soft_bodies import SoftBodies, SoftBody
from diffsim_ti.materials import StableNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Drag, Gravity, Ground, HalfSpace
from diffsim_ti.terms.obstacles import barrier

SIZE, WIDTH = 0.1, 0.01  # [m]
STIFFNESS = 300.0  # of a pad's barrier, of each vertex [N/m]
CLOSING, LIFTING = 0.05, 0.3  # [m/s] of an action of 1
HEIGHT = 0.05  # [m] that the cube is to be lifted by
TOO_MUCH = 6.0  # [N] of each pad, from which on the cube is pressed harder than need be


class SoftGrasps(SoftBodies):
    """Cubes of 0.1 m (3 N) on a floor between two pads with friction 0.5.

    Two actions: how fast the pads close, and how fast they rise. The reward of a step is the share of 0.05 m by which the
    cube is lifted, less how fast it slips past the pads [m/s], less by how much each presses beyond 6 N, in parts of that.
    Seen are, besides what all tasks show, how far pads have closed and risen [m], and the force of each [N]. Starts differ
    in where the cube stands between them.
    """

    gradients = ("initial_positions", "initial_velocities", "half_space_path", "half_space_path_2")
    num_actions = 2
    substeps = 40

    @staticmethod
    def make_scene() -> Scene:
        cube = TetrahedralMesh.create_box(3, size=SIZE, origin=(-SIZE / 2, 0.006, -SIZE / 2))
        pad = dict(stiffness=STIFFNESS, width=WIDTH, friction=0.5, friction_speed=5e-3)
        still = ([0.0, 1.0], np.zeros((2, 3)))  # the paths are inputs
        left = HalfSpace((-SIZE / 2 - WIDTH, 0, 0), (1, 0, 0), path=still, **pad)
        right = HalfSpace((SIZE / 2 + WIDTH, 0, 0), (-1, 0, 0), path=still, **pad)
        floor = Ground(stiffness=500.0, width=WIDTH)
        return Scene(cube, StableNeoHookean(1e5, 0.3), 300.0, [Gravity(), Drag(2.0), left, right, floor])

    def __init__(self, num_envs: int = 32):
        self.pads = np.zeros((num_envs, 2))  # closed, risen [m]
        super().__init__(num_envs)

    def start(self, rows):
        self.pads[rows] = 0.0
        self.positions[rows, :, 0] += self.np_random.uniform(-0.3, 0.3, len(rows))[:, None] * WIDTH

    def inputs(self, actions):
        moved = self.pads + self.step_time * actions * [CLOSING, LIFTING]
        moved = np.clip(moved, [-WIDTH, 0.0], [0.25 * SIZE, 2 * HEIGHT])
        rows = np.stack([self.pads, moved], 1)
        self.rising = (moved - self.pads)[:, 1] / self.step_time  # [m/s]
        self.pads = moved
        return {
            name: np.stack([sign * rows[..., 0], rows[..., 1], np.zeros(rows.shape[:2])], -1)
            for name, sign in (("half_space_path", 1), ("half_space_path_2", -1))
        }

    def forces(self, positions: np.ndarray, pads: np.ndarray) -> np.ndarray:
        """What each pad presses with [N], by its barrier, shape (scenes, 2)."""
        out = np.zeros((len(positions), 2))
        for k, sign in enumerate((1, -1)):
            gap = sign * positions[..., 0] + (SIZE / 2 + WIDTH - pads[:, :1])
            s = np.clip(gap / WIDTH, barrier.CROSSOVER, 1.0)
            out[:, k] = -STIFFNESS * WIDTH * barrier.slope_within(s, np.log(s)).sum(1)
        return out

    def seen(self, positions, velocities, left) -> list:
        return [*super().seen(positions, velocities, left), self.pads, self.forces(positions, self.pads)]

    def rewards(self, actions):
        lifted = self.positions[..., 1].mean(1) - self.scene.mesh.vertices[:, 1].mean()
        force = self.forces(self.positions, self.pads)
        slip = np.abs(self.rising - self.velocities[..., 1].mean(1)) * (force.min(1) > 0)
        return np.clip(lifted / HEIGHT, 0, 1) - slip - np.maximum(force / TOO_MUCH - 1, 0).sum(1)


class SoftGrasp(SoftBody):
    """One cube between two pads."""

    many = SoftGrasps
