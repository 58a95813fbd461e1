"""Articulated robots, whose joints are unknowns of steps together with the body."""

from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common import rotations
from diffsim_ti.common.checked import instance, listed
from diffsim_ti.inputs import NOT_NEGATIVE, POSITIVE, Input
from diffsim_ti.inputs.description import Range
from diffsim_ti.inputs.links import Joined
from diffsim_ti.inputs.loads import InTime
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.obstacles.obstacle import Obstacle
from diffsim_ti.terms.over_time import GivenOverTime, OverTime, amount
from diffsim_ti.terms.robots.model import RobotModel
from diffsim_ti.terms.robots.urdf import Urdf
from diffsim_ti.terms.term import Term, nonempty

OfJoints = ArrayLike | Mapping[str, ArrayLike]
AT_LEAST_0 = Range(">= 0", NOT_NEGATIVE.holds, in_runs=False)


class LinkContact(TypedDict, total=False):
    """What links take of `ObstacleOptions`."""

    stiffness_per_area: float | None
    width: float | None
    friction: float
    friction_speed: float


class Robot(GivenOverTime, Term):
    """A tree of rigid links and joints, on a base that stands, with the joint positions q as unknowns of steps.

    `Robot.from_urdf(path)` makes one of the model, inputs, targets and name that it finds. A backward Euler step of length h
    from (x_n, q_n, v_n) is a stationary point, found by descent, of one incremental potential of body and joints,

        Phi(x) + E_contact(x, links(q)) + 1/2 (q - p)^T M (q - p) / h^2 + b . q
          + 1/2 k (q - q_target)^2 + 1/2 c (q - q_n)^2 / h + E_limit(q) - tau . q,    p = q_n + h v_n,

    with friction by the velocities of body and links in the same step. So no wrench of normal contact lags. The inertia
    M(q_n), the bias b = C(q_n, v_n) v_n + g(q_n) of Coriolis forces and weight, and arms and normal forces of friction, as
    of every obstacle, are those where the step begins: they change by O(h) within it, which keeps the first order of
    backward Euler. BDF2 takes M and b where the two states before lead linearly, which keeps its second order. In an
    equilibrium joints have no inertia and no damping, and their weight is that where they are; what nothing holds is named.
    Action is reaction to round-off. Weight is that of the scene's `Gravity`; `Drag` acts on the body alone.
    In explicit steps joints take substeps of backward Euler, whose length stiff drives do not limit, and links are obstacles
    of the contact stage: what vertices do to them turns joints in the same substep, by J M^-1 J^T. Fixed vertices do not
    stop links there.
    Links touch the body alone: not one another, the ground, or other obstacles. `Simulator.set_state` leaves the joints
    where they are. `compute_energy` is that of the body, `LinkEnergy` that of links; no guard watches the energy.
    Vertices that are `attached` move exactly as their links do, from where they and the joints are as a run starts: they are
    no unknowns of their own, and what acts on them acts on the joints, inertia included. `Reaction` of their set is the
    force of the link on them, or its moment. Give the body `initial_velocities` that go with those of the joints. In
    explicit steps they meet obstacles with their own mass before they go where links have them, without rebound.
    Limits of joints hold by the one-sided potential E_limit = k d^3 / (6 w) of what is beyond them by d < w, 1e-4 of the
    range, and of constant stiffness k = 10^6 M / h^2 beyond (in equilibria with h = 0.01 s): joints stop there without
    rebound. Limits of effort and velocity in the file have no effect; nor have limits of prescribed joints, but where they
    start.

    All inputs have a gradient, by names that begin with the robot's: "positions", "velocities", shape (joints,), where a
    run starts [rad or m, per s]; "torques", (joints,) or (steps, joints) [N m or N]; "targets", of shape (joints,),
    (steps, joints), or (steps + 1, joints) of a function or keyframes; "drive_stiffness" k, "drive_damping" c;
    "masses" [kg], of what each joint carries rigidly, whose inertia goes along. Links are obstacles <robot>_<link> of the
    scene, with _1, _2 behind it where a link has several shapes, and _ for what is no letter or digit.
    Results: `JointPositions`, `JointVelocities`, `JointEfforts`, `LinkMotion`, `LinkEnergy`, and
    `ContactForce("<robot>_<link>")`. A link turns by less than half a turn in a step.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425; Featherstone 2008, Rigid Body Dynamics
    Algorithms.
    """

    def __init__(self, model: RobotModel, inputs: Sequence[Input] = (), targets: OverTime = 0.0, name: str = "robot"):
        if not isinstance(model, RobotModel):
            raise TypeError("Robot is made by Robot.from_urdf(path)")
        self.model, self.shape = model, (model.size,)
        self.prescribed, self.damping = np.zeros(model.size, bool), np.zeros(model.size)
        self.limits = np.full(model.size, -np.inf), np.full(model.size, np.inf)
        self.attached: dict[str, SetOrIndices] = {}
        self.holds: list[
            tuple[int, np.ndarray]
        ] = []  # (joint that carries a link, -1 for the base, vertices that it holds)
        self.companions: tuple[Obstacle, ...] = ()
        self.places: tuple[
            tuple[str, int, tuple], ...
        ] = ()  # (name of an obstacle, joint that carries it, its pose there)
        super().__init__(amount("targets", targets, self.shape, "rad, m", "joint_targets"), *inputs, name=name)
        self._give(targets)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        name: str = "robot",
        base: ArrayLike = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        positions: OfJoints = 0.0,
        velocities: OfJoints = 0.0,
        torques: OfJoints = 0.0,
        targets: OverTime | Mapping[str, ArrayLike] | None = None,
        drive_stiffness: OfJoints = 0.0,
        drive_damping: OfJoints = 0.0,
        prescribed: Sequence[str] = (),
        links: Sequence[str] | None = None,
        attached: Mapping[str, SetOrIndices] | None = None,
        limits: bool = True,
        **contact: Unpack[LinkContact],
    ) -> "Robot":
        """The robot of a URDF file, or of its text; joints in the order of `robot.joints`, which need not be the file's.

        What is given of joints is a value for all, a list in that order, or a dictionary {joint: value} that names all.
        base: pose of its root, a displacement [m] and a rotation vector or quaternion (w, x, y, z). positions, velocities:
        of the joints at the start. torques: constant, or of each step. targets: what drives pull to, in the form of any
        amount over time, default `positions`. drive_stiffness [N m/rad or N/m], drive_damping: of each joint or of all; the
        file's damping comes on top. prescribed: joints that follow their targets, within F h^2 / (10^6 M) where F pulls, M
        being the inertia by the file's masses where the joints start.
        links: whose collision geometry acts on the body; None: all. contact: of all links, as of an `Obstacle`; they act on
        vertices by their distance. Meshes are taken from beside the file.
        attached: {link: vertices that it holds}, by a vertex set's name, indices, a mask or a list of names, free ones of
        the scene that are outside of the links' own geometry; not in `VelocityVerletSolver`, nor beside `SelfContact`,
        `FilledChamber` or obstacles that act by pairs. limits: whether those of joints in the file hold.

        Raises ValueError for joints of other kinds, mimic joints, closed loops, dry friction, joints that carry no mass or
        start beyond their limits, and files that cannot be read; ImportError without Pinocchio.
        """
        prescribed = tuple(listed("Robot.from_urdf: prescribed", prescribed, "joints by name"))
        links = None if links is None else tuple(listed("Robot.from_urdf: links", links, "links by name"))
        instance("Robot.from_urdf", "limits", limits, bool, "True or False, their numbers being the file's <limit>")
        instance("Robot.from_urdf", "attached", attached, (Mapping, type(None)), "{link: vertices}")
        urdf, pose, known = Urdf(path), np.asarray(base, np.float64), LinkContact.__annotations__
        if pose.shape not in ((3,), (6,), (7,)) or not np.isfinite(pose).all():
            raise ValueError(f"Robot.from_urdf: base must be 3, 6 or 7 finite numbers, got {base}")
        if unknown := contact.keys() - known:
            raise TypeError(f"Robot.from_urdf: no option {min(unknown)!r}; contact of links takes {', '.join(known)}")
        model = RobotModel(urdf.text, pose)
        m = model.size
        for joint, mass in zip(model.joints, model.masses):
            if not mass > 0:
                raise ValueError(
                    f"Robot.from_urdf: joint {joint!r} carries no mass: give its link an <inertial> element"
                )
        if m == 0:
            raise ValueError("Robot.from_urdf: the robot has no joint that moves; take obstacles such as MeshObstacle")
        own, start = (m,), each(model.joints, "positions", positions)
        if targets is None or isinstance(targets, Mapping):
            targets = start if targets is None else each(model.joints, "targets", targets)
        named = dict(
            velocities=velocities, drive_stiffness=drive_stiffness, drive_damping=drive_damping, torques=torques
        )
        speed, stiffness, damping, torques = (each(model.joints, name, x) for name, x in named.items())
        inputs = [
            Input("positions", start, (own,), "rad, m", plain="joint_positions"),
            Input("velocities", speed, (own,), "rad/s, m/s", plain="joint_velocities"),
            Input("drive_stiffness", stiffness, (own,), "N m/rad, N/m", AT_LEAST_0),
            Input("drive_damping", damping, (own,), "N m s/rad, N s/m", AT_LEAST_0),
            Input("masses", model.masses, (own,), "kg", POSITIVE, plain="link_masses"),
            Input("torques", torques, (own, ("steps", m)), "N m, N", plain="joint_torques"),
        ]
        for given in inputs:
            given.check_value("Robot")  # before the targets, which may be the positions
        out = cls(model, inputs, targets, name)
        for joint in prescribed:
            if joint not in model.joints:
                raise ValueError(
                    f"Robot.from_urdf: no joint {joint!r} to prescribe; there are {', '.join(model.joints)}"
                )
            out.prescribed[model.joints.index(joint)] = True
        out.damping = urdf.dampings(model.joints)
        M, _ = model.dynamics(out.values["joint_positions"], np.zeros(m), model.masses, np.zeros(3))
        if not np.linalg.eigvalsh(M)[0] > 0:
            raise ValueError(
                "Robot.from_urdf: the robot has no positive definite inertia where it starts: check the <inertial> elements"
            )
        out.typical, out.attached = np.diag(M).copy(), dict(attached or {})
        for link in out.attached.keys() - model.links.keys():
            raise ValueError(f"Robot.from_urdf: attached: no link {link!r}; the file has {', '.join(model.links)}")
        if limits:
            out.limits = model.limits
            for joint, low, high in zip(model.joints, *model.limits):
                if not low < high:
                    raise ValueError(
                        f"Robot.from_urdf: joint {joint!r} has the limits {low:g} and {high:g}: give a lower below the "
                        "upper one in its <limit>, or pass limits=False"
                    )
            out.check_limits(out.values["joint_positions"])
        out._take_links(urdf.obstacles(name, links, dict(contact)))
        return out

    def _take_links(self, found: list) -> None:
        parts, places = [], []
        for link, (turn, shift), obstacle in found:
            joint, (q, t) = self.model.links[link]
            pose = rotations.product(q, turn), t + rotations.turned(q, shift)
            obstacle.described = tuple(i for i in obstacle.described if i.name != "path")
            obstacle.path = None
            parts.append(obstacle)
            places.append((obstacle.name, joint, pose))
        self.companions, self.places = tuple(parts), tuple(places)
        for obstacle, pose in zip(parts, self.poses(self.values["joint_positions"]).values()):
            obstacle.led = pose

    def settled(self, scene, density, initial_positions, initial_velocities):
        out = copy(self)
        out.holds = [
            (self.model.links[link][0], nonempty(self, scene.mesh.vertex_indices(chosen)))
            for link, chosen in self.attached.items()
        ]
        return out

    def check_limits(self, q: np.ndarray) -> None:
        """Raise ValueError for joints that start beyond their limits."""
        for joint, at, low, high in zip(self.joints, q, *self.limits):
            if not low <= at <= high:
                raise ValueError(
                    f"Robot: joint {joint!r} starts at {at:g}, beyond its limits {low:g} and {high:g}: give other "
                    "positions, or pass limits=False to from_urdf"
                )

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.model.joints

    def poses(self, q: ArrayLike) -> dict[str, np.ndarray]:
        """{name of the obstacle: its pose, 7 numbers as of `base`} of links at joint positions."""
        found = self.poses_of(self.model.kinematics(np.asarray(q, np.float64))[0])
        return {part.name: np.concatenate([t, turn]) for part, (turn, t) in zip(self.companions, found)}

    def poses_of(self, frames: list) -> list[tuple[np.ndarray, np.ndarray]]:
        """(unit quaternion, position [m]) of each of `companions` for the joints' frames."""
        base = np.array([1.0, 0, 0, 0]), np.zeros(3)
        return [joined(base if joint < 0 else frames[joint], pose) for _, joint, pose in self.places]

    @property
    def num_numbers(self) -> int:
        return 5 * self.model.size

    def links(self, names, own):
        constant = ("joint_positions", "joint_velocities", "drive_stiffness", "drive_damping", "link_masses")
        return [
            Joined([names[plain] for plain in constant], own),
            InTime(names["joint_targets"], f"{own} targets", 2, self.keyed),
            InTime(names["joint_torques"], f"{own} torques", 2, False),
        ]

    def __repr__(self) -> str:
        return f"Robot(name={self.name!r}, joints={', '.join(self.joints)})"


def each(joints: tuple[str, ...], name: str, given: OfJoints) -> ArrayLike:
    """What is given of joints, in their order."""
    if any(map(callable, given.values() if isinstance(given, Mapping) else [given])):
        remedy = ": give a value for each step" if name in ("torques", "targets") else ""
        raise ValueError(f"Robot.from_urdf: {name} of joints are numbers, not functions{remedy}")
    if isinstance(given, Mapping):
        if given.keys() != set(joints):
            raise ValueError(f"Robot.from_urdf: {name} must name {', '.join(joints)}, got {', '.join(given)}")
        try:
            return np.stack(np.broadcast_arrays(*(given[joint] for joint in joints)), -1)
        except ValueError:
            shapes = ", ".join(f"{joint} {np.shape(given[joint])}" for joint in joints)
            raise ValueError(
                f"Robot.from_urdf: {name} must have as many steps for each joint, got shapes {shapes}"
            ) from None
    return np.full(len(joints), given, np.float64) if np.ndim(given) == 0 else given


def joined(a: tuple, b: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Pose b in the frame of pose a, as seen where a is."""
    return rotations.product(a[0], b[0]), a[1] + rotations.turned(a[0], b[1])
