"""How joints and links of a robot move, what pulls joints, and energies of links."""

from copy import copy
from functools import cache

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.differentiation.arrays import value_of, with_slopes
from diffsim_ti.mechanics.joints.twists import moved
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.outputs.output import Frames, Output, derived
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Gravity, Robot
from diffsim_ti.terms.robots.model import bracket
from diffsim_ti.terms.robots.robot import joined


class JointPositions(Output):
    """Joint positions [rad or m] of a robot, shape (frames, joints), in the order of `robot.joints`.

    robot: its name, or the term as the scene lists it. name: how a loss calls it. The gradient is exact by all inputs.
    Raises ValueError, when a Rollout is made, for a robot that the scene has not.
    """

    reads_joint_states, _shown, column = True, ("robot",), 0

    def __init__(self, robot: Robot | str = "robot", name: str = "joint_positions"):
        self.robot, self.name = robot, name

    def settled(self, scene: Scene) -> "JointPositions":
        out, robots = copy(self), scene.terms_of(Robot)
        place, sizes = scene.place_among(robots, self.robot, "robot"), [robot.model.size for robot in robots]
        out.own, out.model = slice(sum(sizes[:place]), sum(sizes[: place + 1])), robots[place].model
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, self.own.stop - self.own.start

    def value(self, frames: Frames) -> np.ndarray:
        return frames.joint_states[:, self.own, self.column].copy()


class JointVelocities(JointPositions):
    """Joint velocities [rad/s or m/s], as `JointPositions`: of the last substep that ends in the frame,
    (q_n+1 - q_n) / h there; explicit steps add what a contact that keeps its energy gives back."""

    column = 1

    def __init__(self, robot: Robot | str = "robot", name: str = "joint_velocities"):
        super().__init__(robot, name)


class JointEfforts(JointPositions):
    """Joint efforts [N m or N], as `JointPositions`: what torques, drives, damping and limits did in the last substep that
    ends in the frame, zero in the first,

        tau + k (q_target - q) - c (q - q_n) / h - dE_limit/dq,

    so of a prescribed joint what it takes to move it; in explicit steps with -(c + h k) times the velocity that a contact
    gives back, so that efforts, weight and contact change momentum to round-off there, too. With save_every=1 and one
    substep in each step, effort times (q - q_n) is the work on the joints.
    Featherstone 2008, Rigid Body Dynamics Algorithms, sec. 3.
    """

    column = 2

    def __init__(self, robot: Robot | str = "robot", name: str = "joint_efforts"):
        super().__init__(robot, name)


class LinkMotion(JointPositions):
    """Where a link of a robot is and how it moves, shape (frames, 13): position of its origin [m], unit quaternion
    (w, x, y, z) with w >= 0, velocity of the origin [m/s] and angular velocity [rad/s], in space.

    Velocities are those of the substep that ends in the frame, by `JointVelocities`, at the joint positions there.
    link: its name in the file. robot, name: as of `JointPositions`. The gradient is exact by all inputs.
    Raises ValueError, when a Rollout is made, for a robot or a link that is not there.
    Featherstone 2008, Rigid Body Dynamics Algorithms, sec. 4.
    """

    def __init__(self, link: str, robot: Robot | str = "robot", name: str = "link_motion"):
        super().__init__(robot, name)
        self.link = link

    def settled(self, scene: Scene) -> "LinkMotion":
        out = super().settled(scene)
        if self.link not in out.model.links:
            raise ValueError(f"LinkMotion: no link {self.link!r}; there are {', '.join(out.model.links)}")
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 13

    def _stand(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """(quaternion, position of the origin, velocities of origin and spin by joints, how these change by joint
        positions)"""
        frames, S = self.model.kinematics(q)
        joint, place = self.model.links[self.link]
        turn, t = joined(frames[joint], place) if joint >= 0 else place
        S = S * self.model.carries(joint)[:, None]
        J = np.concatenate([moved(S, t), S[:, 3:]], 1)
        turns = bracket(S[:, None], S[None]) * self.model.above[..., None]
        way = turns[..., :3] + np.cross(turns[..., 3:], t) + np.cross(S[None, :, 3:], J[:, None, :3])
        bent = np.einsum("bad,a->bd", np.concatenate([way, turns[..., 3:]], 2), v)
        return turn if turn[0] >= 0 else -turn, t, J, bent

    def value(self, frames: Frames) -> np.ndarray:
        return np.stack([self._motion(states[self.own, :2]) for states in frames.joint_states])

    def _motion(self, states: np.ndarray) -> np.ndarray:
        turn, t, J, bent = self._stand(*value_of(states).T)
        q, v = states[:, 0], states[:, 1]
        dq = q - value_of(q)  # zero, whose change is that of q
        spin = np.concatenate([np.zeros(1), dq @ J[:, 3:]])
        return np.concatenate([t + dq @ J[:, :3], turn + 0.5 * rotations.product(spin, turn), v @ J + dq @ bent])


class LinkEnergy(JointPositions):
    """Energies [J] of all links of a robot, shape (frames, 2): of motion, v . M(q) v / 2, and of weight, -sum m g . c(q) of
    centres of mass c.

    With `KineticEnergy` and `ElasticEnergy` of the body, work of `JointEfforts` and `WorkOfLoads(weight=True)` it makes the
    balance of energy, but for what backward Euler dissipates. robot, name: as of `JointPositions`. The gradient is exact.
    Featherstone 2008, Rigid Body Dynamics Algorithms, sec. 2.
    """

    unit = "J"

    def __init__(self, robot: Robot | str = "robot", name: str = "link_energy"):
        super().__init__(robot, name)

    def settled(self, scene: Scene) -> "LinkEnergy":
        out, gravity = super().settled(scene), scene.term(Gravity)
        out.scene, out.all = scene, scene.interaction(Robots)
        out.gravity = slice(0) if gravity is None else slice(scene.inputs.parameters.first(gravity), None)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 2

    def value(self, frames: Frames) -> np.ndarray:
        parameters = derived(self.scene, frames).parameters
        masses, g = self.all.numbers(parameters)[4, self.own], parameters[self.gravity][:3]
        g = g if len(g) else np.zeros(3)
        return np.stack([self._of(*(states[self.own, k] for k in (0, 1)), masses, g) for states in frames.joint_states])

    def _of(self, *numbers) -> np.ndarray:
        """Energies of a frame, of joint positions and velocities, masses and gravity."""
        (q, v, masses, g), model, none = map(value_of, numbers), self.model, np.zeros(3)
        M, _ = model.dynamics(q, 0 * v, masses, none)
        c = model.centres(q)

        @cache
        def slopes():
            _, weight = model.dynamics(q, 0 * v, masses, g)
            by_q, _, by_masses, _ = model.derivatives(q, 0 * v, v, masses, none)
            return (0.5 * v @ by_q, M @ v, 0.5 * v @ by_masses, none), (weight, 0 * v, -c @ g, -masses @ c)

        def of(k, x):
            return with_slopes(x, *((number, lambda i=i: slopes()[k][i]) for i, number in enumerate(numbers)))

        return np.stack([of(0, 0.5 * v @ M @ v), of(1, -masses @ c @ g)])
