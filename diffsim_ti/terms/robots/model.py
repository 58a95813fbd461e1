"""Kinematics and dynamics of a tree of joints, by Pinocchio (`pip install "diffsim-ti[robots]"`)."""

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.terms.pose import as_pose


def pinocchio():
    """The module. Raises ImportError that says how to get it."""
    try:
        import pinocchio as pin
    except ImportError as error:
        raise ImportError('robots need Pinocchio: pip install "diffsim-ti[robots]"') from error
    return pin


def bracket(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """How twists B [v, w], shape (..., 6), change as what carries them moves by twists A: (w_A x v_B + v_A x w_B,
    w_A x w_B)."""
    w = np.cross(A[..., 3:], B[..., 3:])
    return np.concatenate([np.cross(A[..., 3:], B[..., :3]) + np.cross(A[..., :3], B[..., 3:]), w], -1)


class RobotModel:
    """A robot on a base of pose `base`, 7 numbers. Joints have one degree of freedom each, in the order of `joints`.

    masses [kg]: of what each joint carries rigidly, fixed links included. above[b, a]: whether joint b carries joint a, a
    itself not included. limits: (lower, upper) of joints, infinite without. links: {name of a link: (joint that carries it,
    -1 for the base, its pose in the frame of that)}, a pose being (unit quaternion, t [m]).
    Featherstone, Rigid Body Dynamics Algorithms, 2008; Carpentier, Mansard 2018, Analytical Derivatives of Rigid Body
    Dynamics Algorithms, doi:10.15607/RSS.2018.XIV.038.
    """

    def __init__(self, text: str, base: np.ndarray):
        self.pin = pin = pinocchio()
        try:
            self.model = model = pin.buildModelFromXML(text)
        except ValueError as error:
            raise ValueError(f"Robot.from_urdf: Pinocchio, which has written why, does not read it: {error}") from error
        placed = pin.SE3(rotations.turned(as_pose(base)[1], np.eye(3)).T, np.array(as_pose(base)[0]))
        for j in range(1, model.njoints):
            if model.parents[j] == 0:
                model.jointPlacements[j] = placed * model.jointPlacements[j]
        self.data, self.size = model.createData(), model.nv
        self.joints = tuple(model.names)[1:]
        bounds = [
            (model.lowerPositionLimit[j.idx_q], model.upperPositionLimit[j.idx_q], j.nq) for j in model.joints[1:]
        ]
        bounded = np.array([(low, high) if nq == 1 else (-np.inf, np.inf) for low, high, nq in bounds]).reshape(-1, 2)
        self.limits = bounded[:, 0], bounded[:, 1]
        self.inertias = [model.inertias[j].copy() for j in range(1, model.njoints)]
        self.masses = np.array([inertia.mass for inertia in self.inertias])
        parents = np.array([model.parents[j] for j in range(model.njoints)])
        self.above = np.zeros((self.size, self.size), bool)
        for a in range(self.size):
            b = parents[a + 1]
            while b > 0:
                self.above[b - 1, a] = True
                b = parents[b]
        self.links = {}
        for frame in model.frames:
            if frame.type == pin.FrameType.BODY:
                at = frame.placement if frame.parentJoint else placed * frame.placement
                self.links[frame.name] = frame.parentJoint - 1, self._pose(at)

    def _pose(self, placement) -> tuple[np.ndarray, np.ndarray]:
        x, y, z, w = self.pin.Quaternion(placement.rotation).coeffs()
        return np.array([w, x, y, z]) * (1 if w >= 0 else -1), placement.translation.copy()

    def __deepcopy__(self, memo):
        return self

    def __getstate__(self):
        return {name: x for name, x in vars(self).items() if name not in ("pin", "data")}

    def __setstate__(self, state):
        vars(self).update(state)
        self.pin, self.data = pinocchio(), self.model.createData()

    def _place(self, q: np.ndarray) -> np.ndarray:
        """Of Pinocchio, whose joints without limits take cosine and sine of the angle."""
        out = np.zeros(self.model.nq)
        for j, angle in enumerate(q, 1):
            joint = self.model.joints[j]
            out[joint.idx_q : joint.idx_q + joint.nq] = angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
        return out

    def carries(self, joint: int) -> np.ndarray:
        """Which joints move what a joint carries; -1: the base, which none moves."""
        own = np.arange(self.size) == joint
        return own | self.above[:, joint] if joint >= 0 else own

    def kinematics(self, q: np.ndarray) -> tuple[list, np.ndarray]:
        """(pose of each joint's frame, twists of the joints about the world's origin, (v, w) each, shape (joints, 6))"""
        S = self.pin.computeJointJacobians(self.model, self.data, self._place(q)).reshape(6, -1).T.copy()
        return [self._pose(x) for x in list(self.data.oMi)[1:]], S

    def centres(self, q: np.ndarray) -> np.ndarray:
        """Centres of mass of what each joint carries rigidly, shape (joints, 3) [m]."""
        places = zip(self.kinematics(q)[0], self.inertias)
        return np.array([t + rotations.turned(turn, inertia.lever) for (turn, t), inertia in places])

    def _load(self, masses: np.ndarray, gravity: np.ndarray) -> None:
        for j, (mass, inertia) in enumerate(zip(masses, self.inertias), 1):
            share = mass / inertia.mass
            self.model.inertias[j] = self.pin.Inertia(float(mass), inertia.lever, share * inertia.inertia)
        self.model.gravity.linear = gravity

    def dynamics(self, q, v, masses, gravity) -> tuple[np.ndarray, np.ndarray]:
        """(M(q), C(q, v) v + g(q)) [kg m^2 or kg, N m or N]"""
        self._load(masses, gravity)
        place = self._place(q)
        M = self.pin.crba(self.model, self.data, place).reshape(self.size, -1)
        M = np.triu(M) + np.triu(M, 1).T
        return M, self.pin.rnea(self.model, self.data, place, v, np.zeros(self.size)).copy()

    def derivatives(self, q, v, a, masses, gravity) -> tuple[np.ndarray, ...]:
        """Derivatives of M(q) a + C(q, v) v + g(q) by q, v, masses and gravity, a column each."""
        self._load(masses, gravity)
        place = self._place(q)
        found = self.pin.computeRNEADerivatives(self.model, self.data, place, v, a)[:2]  # of one joint: rows
        by_q, by_v = (x.reshape(self.size, -1).copy() for x in found)
        Y = self.pin.computeJointTorqueRegressor(self.model, self.data, place, v, a).reshape(self.size, -1)
        each = [x.toDynamicParameters() / x.mass for x in self.inertias]
        by_masses = np.stack([Y[:, 10 * j : 10 * j + 10] @ x for j, x in enumerate(each)], 1)
        at = lambda g: self._weight(place, g)  # noqa: E731
        by_gravity = np.stack([at(unit) for unit in np.eye(3)], 1)
        self.model.gravity.linear = gravity
        return by_q, by_v, by_masses, by_gravity

    def _weight(self, place: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        self.model.gravity.linear = gravity
        return self.pin.computeGeneralizedGravity(self.model, self.data, place).copy()
