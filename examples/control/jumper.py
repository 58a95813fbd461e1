"""Soft cubes that jump, as environments of Gymnasium: many at once in a `diffsim_ti.Batch`, or one.

A cube of 0.2 m on a rough floor squeezes itself: two actions, the forces that press its left and its right half together
along y, equal and opposite at top and bottom, so that it cannot lift itself but by letting go. The reward is by how much
its centre rises above where it has been. Observed are the centre's height [m], its velocity [m/s], eight corners relative
to it [m], and the share of the episode that is left. Starts differ in height.

`train` finds actions by the simulator's gradient: one run of sixteen starts at once, forward and in reverse, for each of
thirty iterations.

    python examples/control/jumper.py
"""

import time

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

import diffsim_ti as ds

SIZE, STEP, HORIZON = 0.2, 0.01, 50  # [m], [s], steps of an episode
SQUEEZE = 20.0  # [N] that an action of 1 presses each half with
OBSERVED = 29


def cube_scene() -> ds.Scene:
    """The cube just above a rough floor."""
    mesh = ds.TetrahedralMesh.create_box((3, 4, 3), SIZE, origin=(-SIZE / 2, 0.021, -SIZE / 2))
    floor, forces = ds.Ground(width=0.02, friction=0.5), ds.ExternalForce(np.zeros((1, mesh.num_vertices, 3)))
    return ds.Scene(mesh, ds.StableNeoHookean(3e4, 0.3), 300.0, [ds.Gravity(), ds.Drag(0.5), floor, forces])


def pressing(mesh: ds.TetrahedralMesh) -> np.ndarray:
    """Forces [N] of the two actions, shape (2, n, 3): each sums to zero."""
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    out = np.zeros((2, mesh.num_vertices, 3))
    for half, side in zip(out, (x < -1e-9, x > 1e-9)):
        for end, sign in ((y.max(), -1), (y.min(), 1)):
            pressed = side & (np.abs(y - end) < 1e-9)
            half[pressed, 1] = sign * SQUEEZE / pressed.sum()
    return out


class SoftJumpers(gym.vector.VectorEnv):
    """`num_envs` cubes. One that ends starts anew in the same step; its last observation is in info["final_obs"].

    Other bodies and tasks: their scene, actions and progress (examples/control/crawler.py).
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    gradients = ("initial_positions", "initial_velocities", "external_forces")

    def __init__(self, num_envs: int = 32):
        self.scene, self.num_envs = self.make_scene(), num_envs
        solver = ds.SemiImplicitSolver(self.scene, dt=STEP, substeps=20)
        self.batch = ds.Batch(solver, 1, num_envs, gradients=self.gradients)
        self.pressing, self.corners = self.forces(self.scene.mesh), self._corners()
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (OBSERVED,), np.float64)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (len(self.pressing),), np.float64)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

    make_scene = staticmethod(cube_scene)
    forces = staticmethod(pressing)

    @staticmethod
    def progress(positions):
        """What counts, of positions (scenes, n, 3), NumPy's or torch's: the centre's height [m]."""
        return positions[:, :, 1].mean(1)

    def reward(self, progress: np.ndarray, before: np.ndarray) -> np.ndarray:
        return np.maximum(progress - self.highest, 0)

    @staticmethod
    def goal(progress):
        """What an episode is worth, of progress (steps, scenes) in torch: a smooth maximum in its second half."""
        late = progress[len(progress) // 2 :]
        return (late * (200.0 * late).softmax(0)).sum(0)

    def _start(self, rows: np.ndarray) -> None:
        """Put the cubes of some rows where an episode begins."""
        lifts = self.np_random.uniform(0.0, 0.02, len(rows))
        self.positions[rows] = self.scene.mesh.vertices + lifts[:, None, None] * np.array([0.0, 1.0, 0.0])
        self.velocities[rows], self.steps[rows] = 0.0, 0
        self.highest[rows] = self.progress(self.positions[rows])

    def seen(self, positions, velocities, left) -> list:
        """Parts of what is observed, (scenes, ...), NumPy's or torch's, from states and shares that are left."""
        centre = positions.mean(1)
        corners = positions[:, self.corners] - centre[:, None]
        return [centre[:, 1:2], velocities.mean(1), corners.reshape(len(centre), -1), left[:, None]]

    def _observe(self) -> np.ndarray:
        return np.concatenate(self.seen(self.positions, self.velocities, 1 - self.steps / HORIZON), 1)

    def _corners(self) -> np.ndarray:
        X = self.scene.mesh.vertices
        return np.flatnonzero(((X == X.min(0)) | (X == X.max(0))).all(1))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        shape = (self.num_envs, self.scene.mesh.num_vertices, 3)
        self.positions, self.velocities = np.zeros(shape), np.zeros(shape)
        self.steps, self.highest = np.zeros(self.num_envs, int), np.zeros(self.num_envs)
        self._start(np.arange(self.num_envs))
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple:
        before = self.progress(self.positions)
        forces = np.einsum("bk,kni->bni", np.clip(actions, -1, 1), self.pressing)[:, None]
        frames = self.batch.forward(
            initial_positions=self.positions, initial_velocities=self.velocities, external_forces=forces
        )
        self.positions, self.velocities = frames.end["initial_positions"], frames.end["initial_velocities"]
        self.steps += 1
        after = self.progress(self.positions)
        rewards = self.reward(after, before)
        self.highest = np.maximum(after, self.highest)
        observed, terminated, truncated = self._observe(), ~frames.alive, self.steps >= HORIZON
        ended, info = terminated | truncated, {}
        if ended.any():
            info = {"final_obs": observed.copy(), "_final_obs": ended}
            self._start(np.flatnonzero(ended))
            observed = self._observe()
        return observed, rewards, terminated, truncated, info


class SoftJumper(gym.Env):
    """One cube."""

    metadata, many = {"render_modes": []}, SoftJumpers

    def __init__(self):
        self.all = self.many(1)
        self.observation_space, self.action_space = self.all.single_observation_space, self.all.single_action_space

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        observed, info = self.all.reset(seed=seed)
        return observed[0], info

    def step(self, action: np.ndarray) -> tuple:
        observed, rewards, terminated, truncated, info = self.all.step(np.asarray(action)[None])
        last = info["final_obs"][0] if info else observed[0]
        return last, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), {}


def train(iterations: int = 30, starts: int = 16) -> tuple[np.ndarray, list[float]]:
    """Actions (steps, 2) that lift cubes from many starts, and the mean rise [m] in each iteration.

    Adam on the mean over starts of a smooth maximum, log sum exp, of the heights after half of the episode.
    """
    scene = cube_scene()
    mesh, rng = scene.mesh, np.random.default_rng(0)
    batch = ds.Batch(ds.SemiImplicitSolver(scene, dt=STEP, substeps=20), HORIZON, starts, save_every=1)
    press, late, sharp = pressing(mesh), HORIZON // 2, 200.0
    lifts = rng.uniform(0, 0.02, starts)[:, None, None] * np.array([0.0, 1.0, 0.0])
    actions, rises = np.zeros((HORIZON, 2)), []
    mean, square = np.zeros_like(actions), np.zeros_like(actions)
    for k in range(1, iterations + 1):
        forces = np.einsum("tk,kni->tni", np.clip(actions, -1, 1), press)
        frames = batch.forward(initial_positions=mesh.vertices + lifts, external_forces=forces)
        heights = frames.positions[:, late:, :, 1].mean(2)
        weights = np.exp(sharp * (heights - heights.max(1, keepdims=True)))
        weights /= weights.sum(1, keepdims=True) * starts * mesh.num_vertices
        seed = np.zeros_like(frames.positions)
        seed[:, late:, :, 1] = weights[:, :, None]
        by_forces = batch.vjp(frames, seed)["external_forces"]
        gradient = np.einsum("tni,kni->tk", by_forces, press)
        rises.append(float((heights.max(1) - mesh.vertices[:, 1].mean()).mean()))
        mean, square = 0.9 * mean + 0.1 * gradient, 0.99 * square + 0.01 * gradient**2
        step = mean / (1 - 0.9**k) / (np.sqrt(square / (1 - 0.99**k)) + 1e-12)
        actions = np.clip(actions + 0.1 * step, -1, 1)
    return actions, rises


def main(num_envs: int = 32, steps: int = HORIZON, iterations: int = 30) -> dict:
    """Steps per second, all at once and one by one; heights [m] that letting go after a squeeze reaches, and training."""
    out = {}
    for name, count in (("together", num_envs), ("alone", 1)):
        envs = SoftJumpers(count)
        envs.reset(seed=0)
        envs.action_space.seed(0)
        envs.step(envs.action_space.sample())  # compiles
        start = time.perf_counter()
        for _ in range(steps):
            envs.step(envs.action_space.sample())
        out[name] = count * steps / (time.perf_counter() - start)
    envs = SoftJumpers(1)
    envs.reset(seed=0)
    heights = []
    for k in range(HORIZON - 1):
        observed, *_ = envs.step(np.full((1, 2), 1.0 if k < 15 else -1.0 if k < 20 else 0.0))
        heights.append(observed[0, 0])
    out |= {"rest": float(np.mean(heights[10:15])), "jumped": float(max(heights[15:]))}
    print(f"{num_envs} at once: {out['together']:.0f} steps per second; one by one: {out['alone']:.0f}")
    print(f"squeezed, the centre is at {out['rest']:.3f} m; let go, it jumps to {out['jumped']:.3f} m")
    start = time.perf_counter()
    _, rises = train(iterations)
    out |= {"first": rises[0], "best": max(rises)}
    print(
        f"{iterations} iterations in {time.perf_counter() - start:.1f} s: rises of {rises[0]:.3f} to {max(rises):.3f} m"
    )
    return out


if __name__ == "__main__":
    main()
