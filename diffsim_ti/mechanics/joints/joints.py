"""The joints of a scene's robots in implicit passes: eliminated from Newton's equations, with tangent and adjoint.

For each displacement u of the body the joint positions q(u) minimise the incremental potential (terms/robots/robot.py) by
Newton's method, from where they are on a way that meets no vertex. Numbers of a pass are those of its solver
(solvers/implicit/solver.py); at rest there is no inertia, and weight is that at q. So forces on the body are those of
Phi(u, q(u)), and its Hessian is the Schur complement K_uu - K_uq K_qq^-1 K_qu, of rank as many as there are joints less than
K_uu.

Of a link, a vertex at x has the barrier's force f and -df/dx = H, and friction's f' and -df'/du = F. A joint a moves the
link's point there by J_a = v_a + w_a x x. Since turning link and vertex together turns f,

    K_uq = -w_a x f - H J_a - F J'_a,
    K_qq = sum f . dJ_a/dq_b + J_a . (w_b x f + H J_b) + J'_a . F J'_b,    dS_a/dq_b = [S_b, S_a] of a joint b below a,

J' being taken at the place where the step begins, from which friction takes its arm.

Vertices that a link holds move with it, u_a = y(q) - X, and are no unknowns of their own. With R_a what acts on them, less
their inertia, and J = dy/dq, J^T R_a acts on the joints, and to K come, u being the other vertices,

    K_uq += K_ua J,    K_qq += J^T K_aq + K_qa J + J^T K_aa J - R_a . dJ/dq.
"""

import weakref
from contextlib import contextmanager
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common import rotations
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.joints.twists import by_turns, moved, on_joints
from diffsim_ti.mechanics.obstacles.contact_record import Shares
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.mesh.sets import pieces
from diffsim_ti.state.numbers import Tangent
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, RATE
from diffsim_ti.state.stage import Stage
from diffsim_ti.terms.robots.model import bracket

STIFF = 1e6  # of a prescribed joint's drive, and of a limit, over inertia / h^2
AT_REST = 0.01  # [s], h of these in equilibria
# least stiffness of what is held in an equilibrium, over the largest that a joint meets, or inertia / s^2
STABLE = 1e-9
HELD = "hold the joint by drive_stiffness, prescribe it, or take a solver with inertia"
FALLS = 0.8  # how steeply Phi may rise along a step where it ends, against how it fell


def balanced(at: tuple, direction, eps: float, loose: float, most: int, by_places=lambda: 0.0) -> tuple:
    """(R, sizes of what it adds up, what digits leave) where Newton's method, from `at`, finds that R is zero to `eps` of
    these, or, once it gains no more, to `loose`.

    by_places(): what rounding of places may leave of R, below which neither a share nor a round gains anything.
    direction(R): (step, share of it that is tried first, t -> (R, ...) at that share). A share is good where R along the
    step has not turned round to more than FALLS of what it was.
    """
    (R, size, noise), best, stalled = at, np.inf, 0
    for _ in range(most):
        left = float(np.max(np.abs(R) / (eps * size + noise)))
        stalled = 0 if left < 0.5 * best else stalled + 1
        if not left > 1 or (stalled > 3 and np.all(np.abs(R) <= loose * size + noise + by_places())) or stalled > 20:
            break
        best = min(best, left)
        step, t, go = direction(R)
        slope = float(R @ step)
        while True:
            R, size, noise = go(t)
            if float(R @ step) >= -FALLS * slope or t < 1e-12 or np.all(np.abs(R) <= noise + by_places()):
                break
            t *= 0.5
    return R, size, noise


class Pushed(NamedTuple):
    """What a link does to the vertices that it touches, by its barrier and by friction, shape (k, 3) [N], and how the
    joints move its points there, where the pass ends and where it begins, shape (k, joints, 3)."""

    at: np.ndarray
    f: np.ndarray
    drag: np.ndarray
    J: np.ndarray
    J_n: np.ndarray


class Joints:
    """Of a workspace, made when its arrays are loaded. q: joint positions [rad or m] that belong to the body's place."""

    most = 200  # rounds

    def __init__(self, workspace):
        self.ws, self.a, self.p = weakref.proxy(workspace), workspace.arrays, workspace.potential
        self.robots = robots = workspace.scene.interaction(Robots)
        self.slices, self.count = robots.slices(), robots.count
        self.above = np.zeros((self.count, self.count), bool)
        names, self.links = [term.name for term in self.a.contacts], []  # (obstacle, joints that move it)
        for robot, own in zip(robots.terms, self.slices):
            self.above[own, own] = robot.model.above
            for name, joint, _ in robot.places:
                carried = np.zeros(self.count, bool)
                carried[own] = robot.model.carries(joint)
                self.links.append((names.index(name), carried))
        self._take_held()
        self.shares = Shares(workspace) if self.links and self.p else None
        self.eps = np.finfo(runtime.NUMPY[workspace.scene.precision]).eps
        self.loose = max(1e-6, 1e3 * self.eps)  # of their forces, what rounding of the vertices' places may leave
        self._known, self._zero, self._held, self._placed, self._back, self._anchor, self.problem = [None] * 7
        self.q, self.left, self.now = None, 0.0, self.start()

    def _take_held(self) -> None:
        """at: vertices that links hold; grips: of each link the places among them, the joint that carries it, -1 of the
        base, and the joints that move it; holding: the last of each vertex, shape (k, joints, 1)."""
        self.at, self.grips, self.holding = np.zeros(0, np.int64), [], np.zeros((0, self.count, 1))
        self.pull, self.J_a = np.zeros((0, 3)), np.zeros((0, self.count, 3))  # R_a and J
        for robot, own in zip(self.robots.terms, self.slices):
            for joint, vertices in robot.holds:
                carried, first = np.zeros(self.count, bool), len(self.at)
                carried[own] = robot.model.carries(joint)
                self.at = np.concatenate([self.at, vertices])
                self.grips.append((slice(first, len(self.at)), joint if joint < 0 else own.start + joint, carried))
                moving = np.tile(carried[:, None], (len(vertices), 1, 1))
                self.holding = np.concatenate([self.holding, moving])

    def start(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(positions, velocities, efforts, positions and velocities before) where a run begins."""
        values = self.a.values
        q, v, *_ = self.robots.numbers(values.parameters)
        for robot, own in zip(self.robots.terms, self.slices):
            robot.check_limits(q[own])
        x = (values.rest + values.displacement)[self.at]
        self.local = self._each_held(q, lambda turn, t, rows: rotations.turned(rotations.conjugate(turn), x[rows] - t))
        # what rounding leaves of their places [m], shape (k, 1)
        self.digits = 1e-15 * np.linalg.norm([x, self.local], axis=2).sum(0)[:, None]
        return q.copy(), v.copy(), np.zeros(self.count), q.copy(), v.copy()

    # ---- kinematics --------------------------------------------------------------------------------------------------

    def kinematics(self, q: np.ndarray) -> tuple[list, np.ndarray]:
        """(pose of each link's obstacle, twists of all joints)"""
        if self._known is None or not np.array_equal(q, self._known[0]):
            twists, poses, self._frames = np.zeros((self.count, 6)), [], []
            for robot, own in zip(self.robots.terms, self.slices):
                frames, twists[own] = robot.model.kinematics(q[own])
                poses += robot.poses_of(frames)
                self._frames += frames
            self._known = q.copy(), poses, twists
        return self._known[1:]

    def _each_held(self, q: np.ndarray, of) -> np.ndarray:
        """of(quaternion, position, rows) of the joint that carries each link at q, for rows of vertices that it holds."""
        if self.grips:
            self.kinematics(q)
        out, base = np.zeros((len(self.at), 3)), (np.eye(1, 4)[0], np.zeros(3))
        for rows, joint, _ in self.grips:
            out[rows] = of(*(base if joint < 0 else self._frames[joint]), rows)
        return out

    def carried(self, q: np.ndarray) -> np.ndarray:
        """Where links at q have the vertices that they hold [m]."""
        return self._each_held(q, lambda turn, t, rows: t + rotations.turned(turn, self.local[rows]))

    def from_joints(self, q: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Vectors of the vertices that links hold, from the frames of the joints to space."""
        return self._each_held(q, lambda turn, t, rows: rotations.turned(turn, x[rows]))

    def to_joints(self, q: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The way back."""
        return self._each_held(q, lambda turn, t, rows: rotations.turned(rotations.conjugate(turn), x[rows]))

    def ways(self, S: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How joints move vertices that links hold at y, shape (k, joints, 3)."""
        return self.holding * moved(S, y)

    def turns(self, S: np.ndarray) -> np.ndarray:
        """How twist S_a changes as joint b turns, [b, a]."""
        return bracket(S[:, None], S[None]) * self.above[..., None]

    def put(self, rows: np.ndarray, q: np.ndarray, moments=(AT_STAGE,)) -> None:
        """Write the poses of links at q to rows of obstacles."""
        for (k, _), (turn, t) in zip(self.links, self.kinematics(q)[0]):
            for m in moments:
                rows[3 * k + m] = t
                rows[3 * self.a.poses.place_of[k] + m] = rotations.rodrigues(turn)

    def put_moving(self, rows: np.ndarray, q: np.ndarray, v: np.ndarray) -> None:
        """The same with velocities."""
        self.put(rows, q)
        self.poses_n, self.S_n = self.kinematics(q)
        self.put_rates(rows, v)

    def put_rates(self, rows: np.ndarray, rate: np.ndarray) -> None:
        for (k, carried), (_, t) in zip(self.links, self.poses_n):
            J = moved(self.S_n, t)
            rows[3 * k + RATE] = (rate * carried) @ J
            rows[3 * self.a.poses.place_of[k] + RATE] = (rate * carried) @ self.S_n[:, 3:]

    # ---- a pass ------------------------------------------------------------------------------------------------------

    def extrapolated(self, q, v, q_before, v_before) -> tuple[np.ndarray, ...]:
        """(x, y) where inertia starts from, as of vertices, and positions and velocities where the pass ends, extrapolated
        from the states now and before; linear in these."""
        (a0, a1), (b0, b1) = self.weights
        return tuple(
            m * one + n * other for m, n in ((a0, a1), (b0, b1)) for one, other in ((q, q_before), (v, v_before))
        )

    def begin(self, j: int, stage: Stage, rows: np.ndarray) -> None:
        """Pass j from `now`; rows: of obstacles, which links write into."""
        (self.q_n, self.v_n, _, *before), self.h, self.rows, a = self.now, stage.gamma, rows, self.a
        self.moves = 0.0 if stage.static else 1.0  # without which there is neither inertia nor damping
        r = np.sqrt(-stage.a1 / stage.a0)  # w / (1 + w) of a step that is w times as long as the one before
        self.weights = (stage.a0, stage.a1), (self.moves / (1 - r), -self.moves * r / (1 - r))
        self.x, self.y, self.q_on, self.v_on = self.extrapolated(self.q_n, self.v_n, *before)
        self.poses_n, self.S_n = self.kinematics(self.q_n)
        _, _, self.k, self.c, self.masses = self.robots.numbers(a.values.parameters)
        self.load(j, stage)
        self.stiff = STIFF * self.robots.typical / (self.h if self.moves else AT_REST) ** 2
        self.k = np.where(self.robots.prescribed, self.stiff, self.k)
        self.c = self.moves * (self.c + self.robots.damping)
        self.q, self._held, self._placed, self._anchor, self.held_sizes = self.q_n.copy(), None, None, None, 0.0
        self._back, self.by_places = None, 0.0
        self.put(rows, self.q_n, (AT_STAGE, AT_BEGIN))
        self.put_rates(rows, np.zeros(self.count))

    def load(self, j: int, stage: Stage) -> None:
        """Take targets, torques and weight of pass j; statics lay on a share of these."""
        schedule, given, self.j = self.ws.solver.schedule, self.a.rows["joints"], j
        self.share, self.laid = self.ws.share_at_stage(j, stage), 1.0 if self.moves else self.ws.load_share(j, stage)
        self.targets = schedule.pressure(given, j, self.share)
        self.torques = self.laid * given[schedule.load_row(given, j)][:, 2]
        self.gravity = self.laid * self.a.gravity_of(self.a.values)
        self._weigh()
        self.forget()

    def _weigh(self) -> None:
        """Inertia M, and bias b of Coriolis forces and weight, where they are taken."""
        self.M, self.bias = np.zeros((self.count, self.count)), np.zeros(self.count)
        for robot, own in zip(self.robots.terms, self.slices):
            numbers = self.q_on[own], self.v_on[own], self.masses[own], self.gravity
            self.M[own, own], self.bias[own] = robot.model.dynamics(*numbers)

    def take(self, problem: tuple) -> None:
        """What is solved: mass, inertial and loads of `Newton.solve`."""
        if problem is not self.problem:
            self.problem = problem
            self.forget()

    def hold(self, q: np.ndarray) -> None:
        """Stand at q wherever the body is, as a recorded pass does."""
        self._held, self._placed = q, None

    @contextmanager
    def still(self):
        """Stand where they are while the body is placed elsewhere."""
        kept, found = self._held, self._placed
        self.hold(self.q)
        try:
            yield
        finally:
            self._held, self._placed, self._back = kept, None, np.zeros(0) if found is None else found

    def check_forces(self, others) -> None:
        """Raise ValueError for forces on the body that are not symmetric, beside vertices that links hold."""
        if len(self.at) and not others.symmetric:
            names = ", ".join(type(part).__name__ for part in others if not part.symmetric)
            raise ValueError(
                f"attached= of a robot needs forces with symmetric derivatives, which {names} has not: leave out "
                "SurfaceDrag, and Pressure on open surfaces, or hold the body by contact of links"
            )

    def end(self) -> None:
        """The pass is over. Raises NotConverged where the joints are not in balance, or nothing holds them at rest."""
        if not self.moves:
            self.check_stable()
        smaller = "take smaller steps" if self.moves else "give positions of joints nearer to the equilibrium"
        if not self.left <= max(self.ws.solver.tolerance, self.loose):
            raise NotConverged(
                f"the joints of robots are out of balance by {self.left:.2g} of their forces: {smaller}", [self.left]
            )
        meets = self.links or len(self.at) and len(self.rows)
        met = self.ws.collisions.detection.nearest(self.p.held_at, self.rows[::3]) if meets else None
        if met and (met.obstacle in dict(self.links) or np.isin(met.vertices, self.at).any()):
            obstacle = self.a.contacts[met.obstacle].name
            raise NotConverged(f"{obstacle} has got {-met.value:.2g} m into {met}: {smaller}", [self.left])
        turned = np.abs(self.q - self.q_n) * np.linalg.norm(self.S_n[:, 3:], axis=1)
        if any(turned @ carried >= np.pi for _, carried in self.links):
            raise NotConverged(f"a link of a robot turns by more than half a turn: {smaller}", [self.left])
        self.now = self.q.copy(), self.moves * self.rate, sum(self.efforts()), *self.now[:2]

    def forget(self) -> None:
        """Rows of obstacles were written by others."""
        self._placed = None

    @property
    def rate(self) -> np.ndarray:
        """Velocities of the joints as the pass ends."""
        return (self.q - self.x) / self.h

    @property
    def acceleration(self) -> np.ndarray:
        """Of the joints in the pass."""
        return self.moves * (self.rate - self.y) / self.h

    def derivatives(self, robot, own: slice) -> tuple[np.ndarray, ...]:
        """Of inertia and bias of a robot (RobotModel.derivatives), where they are taken."""
        return robot.model.derivatives(
            self.q_on[own], self.v_on[own], self.acceleration[own], self.masses[own], self.gravity
        )

    def check_stable(self, R: np.ndarray | None = None) -> None:
        """Raise NotConverged where an equilibrium resists no motion of joints, which pieces of the body on links follow.

        R: what acts on vertices where one is looked for [N]: what that pulls may come to be held."""
        columns, K = self.linear
        scale = np.sqrt(np.abs(np.diag(K)) + self.robots.typical)
        pull = np.zeros(self.count)
        if len(self.at):
            x, piece = self.places(self.p.held_at)[0], pieces(self.ws.scene.mesh)
            led = np.zeros((len(x), self.count, 1))
            for rows, _, carried in self.grips:
                led[np.isin(piece, piece[self.at[rows]])] = carried[:, None]
            ways = np.array([w * self.ws.linear for w in np.swapaxes(led * moved(self.S, x), 0, 1)])
            crossed = np.einsum("bid,ida->ab", ways, columns[-1][1])
            K = K + crossed + crossed.T + np.einsum("aid,bid->ab", ways, [self.of_places(w) for w in ways])
            if R is not None:
                pull = np.einsum("aid,id->a", ways, R)
        values, vectors = np.linalg.eigh(K / np.outer(scale, scale))
        least, away = max(STABLE, 2 * self.eps), abs(vectors[:, 0] @ (pull / scale)) / (np.abs(vectors[:, 0]) @ scale)
        sought = R is not None and (values[0] < -least or away > 1e-3 * least)
        if not (values[0] > least or sought):
            name = np.concatenate([robot.joints for robot in self.robots.terms])[np.argmax(np.abs(vectors[:, 0]))]
            how = "nothing holds" if values[0] > -least else "the equilibrium is unstable along"
            raise NotConverged(f"static solve: {how} joint {str(name)!r} of a robot: {HELD}", [self.left])

    def own_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """(-dPhi/dq but for contact, sizes of what it adds up)"""
        parts = -self.bias, *self.efforts()
        size = np.abs(self.M) @ np.abs(self.acceleration) + sum(np.abs(part) for part in parts)
        return sum(parts) - self.M @ self.acceleration, size

    def efforts(self) -> tuple[np.ndarray, ...]:
        """Of torques, drives, damping and limits [N m or N]."""
        drive, damping = -self.k * (self.q - self.targets), -self.c * self.rate
        return self.torques, drive, damping, -self._limits()[1]

    def _limits(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energies of the limits of joints, and their first two derivatives: k d^3 / (6 w) of what is beyond by d < w, and
        beyond w with the constant stiffness k; prescribed joints have none."""
        k, w = np.where(self.robots.prescribed, 0.0, self.stiff), self.robots.soft
        past = np.maximum(self.q - self.robots.upper, 0) - np.maximum(self.robots.lower - self.q, 0)
        s = np.abs(past) / w
        c = np.minimum(s, 1.0)
        energies = k * w**2 * c * (s**2 / 2 - c * s / 2 + c**2 / 6)
        return energies, k * w * c * (s - c / 2) * np.sign(past), k * c

    @property
    def yielding(self) -> np.ndarray:
        """How efforts fall as joints move: stiffness of drives, damping and limits."""
        return self.k + self.c / self.h + self._limits()[2]

    def rounding(self) -> np.ndarray:
        """Of each joint's own forces, by the digits of their positions."""
        reach = np.abs(self.q) + np.abs(self.q_n) + self.h * np.abs(self.v_n)
        own = 1e-15 * (np.abs(self.M) @ reach / self.h**2 + self.yielding * reach) + 1e-300
        return own + self.eps * self.held_sizes

    def energies(self) -> np.ndarray:
        """What the joints add to Phi [J]."""
        if self.q is None:
            return np.zeros(1)
        a, d = self.acceleration, self.q - self.q_n
        inertia, weight = 0.5 * self.h**2 * a @ self.M @ a, self.bias @ d if self.moves else 0.0
        for robot, own in zip(self.robots.terms, [] if self.moves else self.slices):
            weight -= self.masses[own] @ robot.model.centres(self.q[own]) @ self.gravity
        drives = 0.5 * self.k * (self.q - self.targets) ** 2 + 0.5 * self.c * self.h * self.rate**2
        return np.array([inertia, weight, drives.sum(), -self.torques @ d, self._limits()[0].sum()])

    def _stand(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Go to q; (-dPhi/dq, sizes of what it adds up, what digits of places leave)."""
        self.q, self._linear = q, None
        if not self.moves:  # the weight is that at rest
            self.q_on = q
            self._weigh()
        u = self._carry(u)
        self.put(self.rows, q)
        self.put_rates(self.rows, self.rate)
        if len(self.rows):
            runtime.fill(self.p.poses, self.rows)
        R, size = self.own_forces()
        x, x_n = self.places(u)
        _, self.S = self.kinematics(q)
        self.pushed = []
        forces = self.shares.forces() if self.links else np.zeros((0, 2, *u.shape))
        for k, carried in self.links:
            f, drag = forces[k]
            at = np.flatnonzero(f.any(1) | drag.any(1))
            J, J_n = (carried[:, None] * moved(S, y[at]) for S, y in ((self.S, x), (self.S_n, x_n)))
            self.pushed.append(Pushed(at, f[at], drag[at], J, J_n))
            for arm, force in ((J, f[at]), (J_n, drag[at])):
                R = R - on_joints(arm, force)
                size = size + on_joints(np.abs(arm), np.abs(force))
        if len(self.at):
            self.pull, sizes = (x[self.at] for x in self.ws.newton.balance(u, *self.problem))
            self.J_a = self.ways(self.S, x[self.at])
            R = R + on_joints(self.J_a, self.pull)
            size = size + np.linalg.norm(self.J_a, axis=2).T @ sizes
        return R, size, self.rounding()

    def _carry(self, u: np.ndarray) -> np.ndarray:
        """u with the vertices that links hold where they are at q; the potential goes there."""
        if self._held is not None or not len(self.at):
            return u
        u = u.copy()
        u[self.at] = self.carried(self.q) - self.a.values.rest[self.at]
        runtime.fill(self.p.u, u[None])
        self.p.held_at = runtime.fetch_row(self.p.u, 0)
        return self.p.held_at

    def places(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions of vertices where forces are taken, and where the pass begins [m]."""
        rest = self.a.values.rest
        return rest + u, rest + self.u_n

    def settle(self, u: np.ndarray) -> None:
        """Find q(u). The potential is placed at u; before the first pass there is nothing to find."""
        if self.q is None:
            return
        own = u.copy()
        own[self.at if self._held is None else []] = 0.0
        if self._placed is not None and np.array_equal(own, self._placed):
            self._carry(u)
            return
        self._placed, back, self._back = own, self._back, None
        if self._held is not None:
            self._stand(self._held, u)
            return
        if back is not None:  # `still` is over
            self._placed = own if np.array_equal(own, back) else None
            self._stand(self.q, u)
            return
        at = self._stand(self._predicted(u), u)
        scale = np.sqrt(np.diag(self.M) / self.h**2 + self.yielding)  # of joints, some stiff, some light

        def direction(R):
            _, K = self.linear
            values, vectors = np.linalg.eigh(K / np.outer(scale, scale))
            values = np.maximum(np.abs(values), 1e-12 * max(np.abs(values).max(), 1.0))
            step, q = vectors @ ((vectors.T @ (R / scale)) / values) / scale, self.q
            if not self.moves:  # no farther than half a radian, or the size of the body
                most = np.where(self.S_n[:, 3:].any(1), 0.5, np.ptp(self.a.values.rest, 0).max())
                step = step * min(1.0, 1 / np.max(np.abs(step) / most))
            return step, self._free_share(u, q, step), lambda t: self._stand(q + t * step, u)

        R, size, noise = balanced(
            at, direction, max(1e-13, 4 * self.eps), self.loose, self.most, lambda: self.by_places
        )
        self.left = float(np.max(np.abs(R) / (size + 1e6 * (noise + self.by_places))))

    def _free_share(self, u, q: np.ndarray, step: np.ndarray) -> float:
        """How far links may go along a step of the joints."""
        if not (self.links or len(self.at) and len(self.rows)):
            return 1.0
        before, after, way = self.rows[::3].copy(), self.rows.copy(), np.zeros_like(u)
        if len(self.at):
            way[self.at] = self.carried(q + step) - self.carried(q)
        self.put(after, q + step)
        there = self.a.poses.drift(before, after[::3])
        return self.ws.collisions.detection.share(self.p.held_at, way, before, there)

    @property
    def linear(self) -> tuple[list, np.ndarray]:
        """(of each link: vertices and their part of K_uq, shape (k, 3, joints); K_qq) where q stands."""
        if self._linear is None:
            self._linear = self._linearise()
        return self._linear

    def _linearise(self) -> tuple[list, np.ndarray]:
        K, columns = self.moves * self.M / self.h**2 + np.diag(self.yielding), []
        for robot, own in zip(self.robots.terms, [] if self.moves else self.slices):
            K[own, own] += self.derivatives(robot, own)[0] + 1e-14 * np.diag(robot.typical)
        if any(len(part.at) for part in self.pushed):
            blocks = self._blocks()
            turns, x = self.turns(self.S), self.places(self.p.held_at)[0]
            for (k, carried), (at, f, _, J, J_n) in zip(self.links, self.pushed):
                H, F = blocks[:, k, 0, at], blocks[:, k, 1, at]  # (3, k, 3)
                w = carried[:, None] * self.S[:, 3:]
                turned = np.tensordot(f, rotations.skew(w), (1, 2))  # (k, joints, 3), of f as the link turns
                HJ, FJ = np.einsum("jid,iaj->iad", H, J), np.einsum("jid,iaj->iad", F, J_n)
                columns.append((at, -np.swapaxes(turned + HJ + FJ, 1, 2)))
                K = K + by_turns(turns, carried, x[at], f).T
                K = K + np.einsum("iad,ibd->ab", J, turned + HJ) + np.einsum("iad,ibd->ab", J_n, FJ)
        if len(self.at):
            columns, K = self._with_held(columns, K)
        return columns, 0.5 * (K + K.T)

    def _with_held(self, columns: list, K: np.ndarray) -> tuple[list, np.ndarray]:
        """The same with the vertices that links hold going along."""
        J, n = self.J_a, self.a.num_vertices
        of_links, own = np.zeros((2, n, 3, self.count))
        for at, part in columns:
            of_links[at] += part
        for a in np.flatnonzero(J.any((0, 2))):
            w = np.zeros((n, 3))
            w[self.at] = J[:, a]
            own[..., a] = self.of_places(w)
        self.held_sizes = np.einsum("ida,id->a", np.abs(own), np.abs(self.p.held_at))
        self.by_places = np.einsum("ida,id->a", np.abs(own[self.at]), self.digits)
        turns, y = self.turns(self.S), self.places(self.p.held_at)[0][self.at]
        for rows, _, carried in self.grips:
            K = K - by_turns(turns, carried, y[rows], self.pull[rows]).T
        pulled = np.cross(self.holding * self.S[:, 3:], self.pull[:, None])
        crossed = np.einsum("iad,idb->ab", J, of_links[self.at])
        K = K + np.einsum("iad,ibd->ab", pulled, J) + crossed + crossed.T + np.einsum("iad,idb->ab", J, own[self.at])
        own += of_links
        own[self.at] = 0.0
        return [(np.arange(n), own)], K

    def of_places(self, w: np.ndarray) -> np.ndarray:
        """d2Phi/du2 w of all vertices, joints staying where they are."""
        others = self.ws.newton.others
        y = self.problem[0] * w + self.p.product_of_body(w)
        return y - others.tangent(self.p.held_at)(w) if others else y

    def _blocks(self) -> np.ndarray:
        """-df/du of barriers and of friction, a column each, shape (3, obstacles, 2, n, 3)."""
        if self._zero is None:
            numbers = Tangent(self.a, self.a.values.zeros())
            arrays = {name: runtime.array(self.a.vector, *getattr(self.p, name).shape) for name in ("lag", "poses")}
            still = SimpleNamespace(**arrays)
            for array in vars(still).values():
                runtime.fill(array, 0)
            self._zero = still, numbers
        out = []
        for unit in np.eye(3):
            runtime.fill(self.p.w, np.tile(unit, (1, self.a.num_vertices, 1)))
            out.append(-self.shares.forces("jvp", tangent=self._zero))
        return np.stack(out)

    # ---- what Newton's method takes ----------------------------------------------------------------------------------

    def of_joints(self, dq: np.ndarray, shape) -> np.ndarray:
        """K_uq dq."""
        out = np.zeros(shape)
        for at, part in self.linear[0]:
            out[at] += part @ dq
        return out

    def of_body(self, w: np.ndarray) -> np.ndarray:
        """K_qu w."""
        return sum((np.einsum("ida,id->a", part, w[at]) for at, part in self.linear[0]), np.zeros(self.count))

    def follow(self, w: np.ndarray) -> np.ndarray:
        """K_qq^-1 w"""
        return np.linalg.solve(self.linear[1], w)

    def product(self, w: np.ndarray) -> np.ndarray:
        """What the joints that give way take from d2E/du2 w."""
        if self.q is None or not self.linear[0]:
            return np.zeros(w.shape)
        return self.of_joints(self.follow(self.of_body(w)), w.shape)

    def extended(self, w: np.ndarray) -> np.ndarray:
        """A direction of the body with what the vertices do that links hold."""
        if len(self.at):
            w = w.copy()
            w[self.at] = np.einsum("iad,a->id", self.J_a, -self.follow(self.of_body(w)))
        return w

    def anchor(self, u: np.ndarray) -> None:
        """From here on predict q from where it is at u."""
        if self._placed is None or not np.array_equal(u, self._placed):
            self.p.place(u)
        self._anchor = self.p.held_at.copy(), self.q.copy(), self.linear

    def _predicted(self, u: np.ndarray) -> np.ndarray:
        if self._anchor is None:
            return self.q
        u0, q0, (columns, K) = self._anchor
        pull = sum((np.einsum("ida,id->a", part, (u - u0)[at]) for at, part in columns), np.zeros(self.count))
        return q0 - np.linalg.solve(K, pull)

    def drift(self, u: np.ndarray, step: np.ndarray) -> np.ndarray | float:
        """How obstacles go along a step of the body from u."""
        self.anchor(u)
        after = self.rows.copy()
        self.put(after, self._predicted(u + step))
        return self.a.poses.drift(self.rows[::3], after[::3])
