"""What tasks of soft bodies share: scenes in a batch, episodes, starts, and what is observed."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from diffsim_ti.batch import Batch
from diffsim_ti.batch.frames import check_goes_on
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import SemiImplicitSolver


class SoftBodies(gymnasium.vector.VectorEnv):
    """`num_envs` scenes of a task. One that ends starts anew in the same step; its last observation is in
    info["final_obs"].

    A task says its scene, how many actions there are (each from -1 to 1), what they do (`inputs`), what is observed (`seen`)
    and rewarded. What a step does is `batch.forward(initial_positions=..., initial_velocities=..., **inputs(actions))`, so
    that gradients go through `batch.vjp`, or in torch through `diffsim_ti.rollout_frames(batch, ...)`.
    step_time [s]; horizon: steps of an episode; substeps of a step.
    Raises ValueError for a scene with a robot, or a law that remembers, whose states no input of a run has.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    gradients: ClassVar[tuple[str, ...]] = ("initial_positions", "initial_velocities")
    num_actions = 0
    step_time, horizon, substeps = 0.01, 50, 20

    def __init__(self, num_envs: int = 32):
        self.scene, self.num_envs = self.make_scene(), num_envs
        check_goes_on(self.scene)
        solver = SemiImplicitSolver(self.scene, dt=self.step_time, substeps=self.substeps)
        self.batch = Batch(solver, 1, num_envs, gradients=self.gradients)
        X = self.scene.mesh.vertices
        self.corners = np.flatnonzero(((X == X.min(0)) | (X == X.max(0))).all(1))
        self._clear()
        box, observed = gymnasium.spaces.Box, self._observe().shape[1]
        self.single_observation_space = box(-np.inf, np.inf, (observed,), np.float64)
        self.single_action_space = box(-1.0, 1.0, (self.num_actions,), np.float64)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)

    # ---- what a task says ------------------------------------------------------------------------------------------------

    @staticmethod
    @abstractmethod
    def make_scene() -> Scene:
        """The scene, at the start of an episode."""

    @abstractmethod
    def inputs(self, actions: np.ndarray) -> Mapping[str, np.ndarray]:
        """What actions, shape (scenes, num_actions), give the batch in a step, {input: value}."""

    @abstractmethod
    def rewards(self, actions: np.ndarray) -> np.ndarray:
        """Of the step that led to the present state, shape (scenes,)."""

    def start(self, rows: np.ndarray) -> None:
        """Put scenes where an episode begins: `positions` and `velocities` of these rows, from `np_random`."""

    def seen(self, positions, velocities, left) -> list:
        """Parts of what is observed, (scenes, ...), NumPy's or torch's: centre's height [m], its velocity [m/s], corners
        relative to the centre [m], share of the episode that is left."""
        centre = positions.mean(1)
        corners = positions[:, self.corners] - centre[:, None]
        return [centre[:, 1:2], velocities.mean(1), corners.reshape(len(centre), -1), left[:, None]]

    # ---- Gymnasium -------------------------------------------------------------------------------------------------------

    def _observe(self) -> np.ndarray:
        return np.concatenate(self.seen(self.positions, self.velocities, 1 - self.steps / self.horizon), 1)

    def _clear(self) -> None:
        shape = (self.num_envs, self.scene.mesh.num_vertices, 3)
        self.positions, self.velocities = np.zeros(shape), np.zeros(shape)
        self.steps = np.zeros(self.num_envs, int)

    def _begin(self, rows: np.ndarray) -> None:
        self.positions[rows], self.velocities[rows], self.steps[rows] = self.scene.mesh.vertices, 0.0, 0
        self.start(rows)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._clear()
        self._begin(np.arange(self.num_envs))
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple:
        actions = np.clip(np.asarray(actions, np.float64), -1, 1)
        given = self.inputs(actions)
        frames = self.batch.forward(initial_positions=self.positions, initial_velocities=self.velocities, **given)
        self.positions, self.velocities = frames.end["initial_positions"], frames.end["initial_velocities"]
        self.steps += 1
        rewards, observed = self.rewards(actions), self._observe()
        terminated, truncated = ~frames.alive, self.steps >= self.horizon
        ended, info = terminated | truncated, {}
        if ended.any():
            info = {"final_obs": observed.copy(), "_final_obs": ended}
            self._begin(np.flatnonzero(ended))
            observed = self._observe()
        return observed, rewards, terminated, truncated, info


class SoftBody(gymnasium.Env):
    """One scene of a task."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}
    many: ClassVar[type[SoftBodies]] = SoftBodies

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
