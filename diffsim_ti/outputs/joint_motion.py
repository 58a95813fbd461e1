"""How joints and links of a robot move, what pulls joints, and energies of links."""

from copy import copy

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.mechanics.joints.joints import moved
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Gravity, Robot
from diffsim_ti.terms.robots.model import bracket
from diffsim_ti.terms.robots.robot import joined


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
        out.own, out.model = slice(sum(sizes[:place]), sum(sizes[: place + 1])), robots[place].model
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
    """Joint velocities [rad/s or m/s], as `JointPositions`: of the last substep that ends in the frame,
    (q_n+1 - q_n) / h there; explicit steps add what a contact that keeps its energy gives back."""

    column = 1

    def __init__(self, robot: Robot | str = "robot", name: str = "joint_velocities"):
        super().__init__(robot, name)


class JointEfforts(JointPositions):
    """Joint efforts [N m or N], as `JointPositions`: what torques, drives, damping and limits did in the last substep that
    ends in the frame, zero in the first,

        tau + k (q_target - q) - c (q - q_n) / h - dE_limit/dq,

    so of a prescribed joint what it takes to move it. With save_every=1 and one substep in each step, effort times (q - q_n)
    is the work on the joints.
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

    def _stand(self, states: np.ndarray) -> tuple[np.ndarray, ...]:
        """(quaternion, position of the origin, velocities of origin and spin by joints, joint velocities, changes of these
        velocities by joint positions)"""
        q, v = states[self.own, :2].T
        frames, S = self.model.kinematics(q)
        joint, place = self.model.links[self.link]
        turn, t = joined(frames[joint], place) if joint >= 0 else place
        S = S * self.model.carries(joint)[:, None]
        J = np.concatenate([moved(S, t), S[:, 3:]], 1)
        turns = bracket(S[:, None], S[None]) * self.model.above[..., None]
        way = turns[..., :3] + np.cross(turns[..., 3:], t) + np.cross(S[None, :, 3:], J[:, None, :3])
        bent = np.einsum("bad,a->bd", np.concatenate([way, turns[..., 3:]], 2), v)
        return turn if turn[0] >= 0 else -turn, t, J, v, bent

    def value(self, frames: Frames) -> np.ndarray:
        stands = map(self._stand, frames.joint_states)
        return np.stack([np.concatenate([t, turn, v @ J]) for turn, t, J, v, _ in stands])

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        out = np.zeros(self.shape(len(frames.times)))
        for row, states, d in zip(out, frames.joint_states, () if change.joint_states is None else change.joint_states):
            (turn, _, J, _, bent), (dq, dv) = self._stand(states), d[self.own, :2].T
            row[:3], row[3:7] = dq @ J[:, :3], 0.5 * rotations.product(np.append(0.0, dq @ J[:, 3:]), turn)
            row[7:] = dv @ J + dq @ bent
        return out

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        out = np.zeros(frames.joint_states.shape)
        for row, states, w in zip(out, frames.joint_states, seed):
            turn, _, J, _, bent = self._stand(states)
            by_turn = 0.5 * rotations.product(w[3:7], rotations.conjugate(turn))[1:]
            row[self.own, 0], row[self.own, 1] = J @ np.append(w[:3], by_turn) + bent @ w[7:], J @ w[7:]
        return Change(joint_states=out)


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

    def _numbers(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(masses, gravity)"""
        g = parameters[self.gravity][:3]
        return self.all.numbers(parameters)[4, self.own], g if len(g) else np.zeros(3)

    def _of(self, q, v, masses, g) -> tuple[np.ndarray, tuple]:
        """(energies of a frame; its derivatives by q, v, masses and g, two rows or columns each)"""
        model, none = self.model, np.zeros(3)
        M, _ = model.dynamics(q, 0 * v, masses, none)
        _, weight = model.dynamics(q, 0 * v, masses, g)
        by_q, _, by_masses, _ = model.derivatives(q, 0 * v, v, masses, none)
        c = model.centres(q)
        energies = np.array([0.5 * v @ M @ v, -masses @ c @ g])
        own = [0.5 * v @ by_q, weight], [M @ v, 0 * v], [0.5 * v @ by_masses, -c @ g], [none, -masses @ c]
        return energies, tuple(np.stack(rows) for rows in own)

    def _each(self, frames: Frames) -> tuple:
        derived = self.scene.inputs.derive(frames.inputs)
        numbers = self._numbers(derived.parameters)
        return derived, [self._of(rows[self.own, 0], rows[self.own, 1], *numbers) for rows in frames.joint_states]

    def value(self, frames: Frames) -> np.ndarray:
        return np.stack([energies for energies, _ in self._each(frames)[1]])

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        moved_so = self._numbers(self.scene.inputs.derive_jvp(frames.inputs, change.inputs).parameters)
        states = np.zeros(frames.joint_states.shape) if change.joint_states is None else change.joint_states
        out = []
        for rows, (_, by) in zip(states, self._each(frames)[1]):
            changes = rows[self.own, 0], rows[self.own, 1], *moved_so
            out.append(sum(derivative @ x for derivative, x in zip(by, changes)))
        return np.stack(out)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        out, (derived, found) = np.zeros(frames.joint_states.shape), self._each(frames)
        adjoint, by_numbers = derived.zeros(), np.zeros((5, self.all.count))
        for row, w, (_, by) in zip(out, seed, found):
            row[self.own, 0], row[self.own, 1], by_masses, by_g = (w @ derivative for derivative in by)
            by_numbers[4, self.own] += by_masses
            adjoint.parameters[self.gravity][:3] += by_g[: len(adjoint.parameters[self.gravity][:3])]
        self.all.add_numbers(adjoint.parameters, by_numbers)
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(joint_states=out, inputs=inputs)
