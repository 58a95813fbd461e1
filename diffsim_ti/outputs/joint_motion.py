"""Positions and velocities of a robot's joints."""

from copy import copy

import numpy as np

from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Robot


class JointPositions(Output):
    """Joint positions [rad or m] of a robot, shape (frames, joints), in the order of `robot.joints`.

    robot: its name, or the term as the scene lists it. name: how a loss calls it. The gradient is exact by all inputs.
    Raises ValueError, when a Rollout is made, for a robot that the scene has not.
    """

    reads_joint_states, column = True, 0

    def __init__(self, robot: Robot | str = "robot", name: str = "joint_positions"):
        self.robot, self.name = robot, name

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.robot!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "JointPositions":
        out, robots = copy(self), scene.terms_of(Robot)
        place, sizes = scene.place_among(robots, self.robot, "robot"), [robot.model.size for robot in robots]
        out.own = slice(sum(sizes[:place]), sum(sizes[: place + 1]))
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, self.own.stop - self.own.start

    def value(self, frames: Frames) -> np.ndarray:
        return frames.joint_states[:, self.own, self.column].copy()

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        states = change.joint_states
        return np.zeros(self.shape(len(frames.times))) if states is None else states[:, self.own, self.column]

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        out = np.zeros(frames.joint_states.shape)
        out[:, self.own, self.column] = seed
        return Change(joint_states=out)


class JointVelocities(JointPositions):
    """Joint velocities [rad/s or m/s], as `JointPositions`: of the step that ends in the frame, (q_n+1 - q_n) / h."""

    column = 1

    def __init__(self, robot: Robot | str = "robot", name: str = "joint_velocities"):
        super().__init__(robot, name)
