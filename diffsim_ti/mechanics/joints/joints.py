"""The joints of a scene's robots in implicit passes: eliminated from Newton's equations, with tangent and adjoint.

For each displacement u of the body the joint positions q(u) minimise the incremental potential (terms/robots/robot.py) by
Newton's method, from where they are on a way that meets no vertex. So forces on the body are those of Phi(u, q(u)), and its
Hessian is the Schur complement K_uu - K_uq K_qq^-1 K_qu, of rank as many as there are joints less than K_uu.

Of a link, a vertex at x has the barrier's force f and -df/dx = H, and friction's f' and -df'/du = F. A joint a moves the
link's point there by J_a = v_a + w_a x x. Since turning link and vertex together turns f,

    K_uq = -w_a x f - H J_a - F J'_a,
    K_qq = sum f . dJ_a/dq_b + J_a . (w_b x f + H J_b) + J'_a . F J'_b,    dS_a/dq_b = [S_b, S_a] of a joint b below a,

J' being taken at the place where the step begins, from which friction takes its arm.
"""

import weakref
from contextlib import contextmanager
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common import rotations
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.obstacles.contact_record import Shares
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.state.numbers import Tangent
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, RATE
from diffsim_ti.terms.robots.model import bracket

STIFF = 1e6  # of a prescribed joint's drive, over inertia / h^2


def moved(S: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Velocities at points of twists S, shape (..., joints, 3), of points of shape (..., 3)."""
    return S[:, :3] + np.tensordot(x, rotations.skew(S[:, 3:]), (-1, 2))


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
    falls = 0.8  # how steeply Phi may rise along a step where it ends, against how it fell

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
        self.shares = Shares(workspace) if self.links and self.p else None
        self.eps = np.finfo(runtime.NUMPY[workspace.scene.precision]).eps
        self.loose = max(1e-6, 1e3 * self.eps)  # of their forces, what rounding of the vertices' places may leave
        self._known, self._zero, self._held, self._placed, self._anchor = None, None, None, None, None
        self.q, self.left, self.now = None, 0.0, self.start()

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """(positions, velocities) where a run begins."""
        q, v, *_ = self.robots.numbers(self.a.values.parameters)
        return q.copy(), v.copy()

    # ---- kinematics --------------------------------------------------------------------------------------------------

    def kinematics(self, q: np.ndarray) -> tuple[list, np.ndarray]:
        """(pose of each link's obstacle, twists of all joints)"""
        if self._known is None or not np.array_equal(q, self._known[0]):
            twists, poses = np.zeros((self.count, 6)), []
            for robot, own in zip(self.robots.terms, self.slices):
                frames, twists[own] = robot.model.kinematics(q[own])
                poses += robot.poses_of(frames)
            self._known = q.copy(), poses, twists
        return self._known[1:]

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
        self._put_rates(rows, v)

    def _put_rates(self, rows: np.ndarray, rate: np.ndarray) -> None:
        for (k, carried), (_, t) in zip(self.links, self.poses_n):
            J = moved(self.S_n, t)
            rows[3 * k + RATE] = (rate * carried) @ J
            rows[3 * self.a.poses.place_of[k] + RATE] = (rate * carried) @ self.S_n[:, 3:]

    # ---- a pass ------------------------------------------------------------------------------------------------------

    def begin(self, j: int, stage, rows: np.ndarray) -> None:
        """Pass j from `now`; rows: of obstacles, which links write into."""
        (self.q_n, self.v_n), self.h, self.rows, a = self.now, stage.gamma, rows, self.a
        self.poses_n, self.S_n = self.kinematics(self.q_n)
        _, _, self.k, self.c, self.masses = self.robots.numbers(a.values.parameters)
        at = a.features().gravity
        self.gravity = a.values.parameters[at : at + 3].copy() if at >= 0 else np.zeros(3)
        self.M, self.bias = np.zeros((self.count, self.count)), np.zeros(self.count)
        for robot, own in zip(self.robots.terms, self.slices):
            numbers = self.q_n[own], self.v_n[own], self.masses[own], self.gravity
            self.M[own, own], self.bias[own] = robot.model.dynamics(*numbers)
        schedule, self.j = self.ws.solver.schedule, j
        self.share = self.ws.share_at_stage(j, stage)
        given = a.rows["joints"]
        self.targets = schedule.pressure(given, j, self.share)
        self.torques = given[schedule.load_row(given, j)][:, 2]
        self.k = np.where(self.robots.prescribed, STIFF * self.robots.typical / self.h**2, self.k)
        self.c = self.c + self.robots.damping
        self.q, self._held, self._placed, self._anchor = self.q_n.copy(), None, None, None
        self.put(rows, self.q_n, (AT_STAGE, AT_BEGIN))
        self._put_rates(rows, np.zeros(self.count))

    def hold(self, q: np.ndarray) -> None:
        """Stand at q wherever the body is, as a recorded pass does."""
        self._held, self._placed = q, None

    @contextmanager
    def still(self):
        """Stand where they are while the body is placed elsewhere."""
        kept = self._held
        self.hold(self.q)
        try:
            yield
        finally:
            self._held, self._placed = kept, None

    def end(self) -> None:
        """The pass is over. Raises NotConverged where the joints are not in balance."""
        if not self.left <= max(self.ws.solver.tolerance, self.loose):
            raise NotConverged(
                f"the joints of robots are out of balance by {self.left:.2g} of their forces: take smaller steps",
                [self.left],
            )
        met = self.ws.collisions.detection.nearest(self.p.held_at, self.rows[::3]) if self.links else None
        if met and met.obstacle in dict(self.links):
            link = self.a.contacts[met.obstacle].name
            raise NotConverged(f"{link} has got {-met.value:.2g} m into {met}: take smaller steps", [self.left])
        turned = np.abs(self.q - self.q_n) * np.linalg.norm(self.S_n[:, 3:], axis=1)
        if any(turned @ carried >= np.pi for _, carried in self.links):
            raise NotConverged("a link of a robot turns by more than half a turn: take smaller steps", [self.left])
        self.now = self.q.copy(), (self.q - self.q_n) / self.h

    def forget(self) -> None:
        """Rows of obstacles were written by others."""
        self._placed = None

    @property
    def acceleration(self) -> np.ndarray:
        """Of the joints in the pass."""
        return (self.q - self.q_n - self.h * self.v_n) / self.h**2

    def _own_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """(-dPhi/dq but for contact, sizes of what it adds up)"""
        parts = -self.bias, self.torques, -self.k * (self.q - self.targets), -self.c * (self.q - self.q_n) / self.h
        size = np.abs(self.M) @ np.abs(self.acceleration) + sum(np.abs(part) for part in parts)
        return sum(parts) - self.M @ self.acceleration, size

    def _rounding(self) -> np.ndarray:
        """Of each joint's own forces, by the digits of their positions."""
        reach = np.abs(self.q) + np.abs(self.q_n) + self.h * np.abs(self.v_n)
        return 1e-15 * (np.abs(self.M) @ reach / self.h**2 + self.k * reach) + 1e-300

    def energies(self) -> np.ndarray:
        """What the joints add to Phi [J]."""
        if self.q is None:
            return np.zeros(1)
        a, d = self.acceleration, self.q - self.q_n
        inertia = 0.5 * self.h**2 * a @ self.M @ a
        drives = 0.5 * self.k * (self.q - self.targets) ** 2 + 0.5 * self.c * d**2 / self.h
        return np.array([inertia, self.bias @ d, drives.sum(), -self.torques @ d])

    def _stand(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Go to q; (-dPhi/dq, sizes of what it adds up)."""
        self.q, self._linear = q, None
        self.put(self.rows, q)
        self._put_rates(self.rows, (q - self.q_n) / self.h)
        if len(self.rows):
            runtime.fill(self.p.poses, self.rows)
        R, size = self._own_forces()
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
                R = R - np.einsum("iad,id->a", arm, force)
                size = size + np.einsum("iad,id->a", np.abs(arm), np.abs(force))
        return R, size

    def places(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions of vertices where forces are taken, and where the pass begins [m]."""
        rest = self.a.values.rest
        return rest + u, rest + self.u_n

    def settle(self, u: np.ndarray) -> None:
        """Find q(u). The potential is placed at u; before the first pass there is nothing to find."""
        if self.q is None or (self._placed is not None and np.array_equal(u, self._placed)):
            return
        self._placed = u.copy()
        if self._held is not None:
            self._stand(self._held, u)
            return
        R, size = self._stand(self._predicted(u), u)
        best, stalled = np.inf, 0
        scale = np.sqrt(np.diag(self.M) / self.h**2 + self.k + self.c / self.h)  # of joints, some stiff, some light
        for _ in range(self.most):
            noise = self._rounding()
            left = float(np.max(np.abs(R) / (max(1e-13, 4 * self.eps) * size + noise)))
            stalled = 0 if left < 0.5 * best else stalled + 1
            fair = np.all(np.abs(R) <= self.loose * size + noise)
            if not left > 1 or (stalled > 3 and fair) or stalled > 20:
                break
            best = min(best, left)
            _, K = self.linear
            values, vectors = np.linalg.eigh(K / np.outer(scale, scale))
            values = np.maximum(np.abs(values), 1e-12 * np.abs(values).max())
            step = vectors @ ((vectors.T @ (R / scale)) / values) / scale
            slope, q = float(R @ step), self.q
            t = self._free_share(u, q, step)
            while True:
                R, size = self._stand(q + t * step, u)
                if float(R @ step) >= -self.falls * slope or t < 1e-12:
                    break
                t *= 0.5
        self.left = float(np.max(np.abs(R) / (size + 1e6 * self._rounding())))

    def _free_share(self, u, q: np.ndarray, step: np.ndarray) -> float:
        """How far links may go along a step of the joints."""
        if not self.links:
            return 1.0
        before, after = self.rows[::3].copy(), self.rows.copy()
        self.put(after, q + step)
        return self.ws.collisions.detection.share(u, np.zeros_like(u), before, self.a.poses.drift(before, after[::3]))

    @property
    def linear(self) -> tuple[list, np.ndarray]:
        """(of each link: vertices and their part of K_uq, shape (k, 3, joints); K_qq) where q stands."""
        if self._linear is None:
            self._linear = self._linearise()
        return self._linear

    def _linearise(self) -> tuple[list, np.ndarray]:
        K, columns = self.M / self.h**2 + np.diag(self.k + self.c / self.h), []
        if any(len(part.at) for part in self.pushed):
            blocks = self._blocks()
            turns, x = self.turns(self.S), self.places(self.p.held_at)[0]
            for (k, carried), (at, f, _, J, J_n) in zip(self.links, self.pushed):
                H, F = blocks[:, k, 0, at], blocks[:, k, 1, at]  # (3, k, 3)
                w = carried[:, None] * self.S[:, 3:]
                turned = np.tensordot(f, rotations.skew(w), (1, 2))  # (k, joints, 3), of f as the link turns
                HJ, FJ = np.einsum("jid,iaj->iad", H, J), np.einsum("jid,iaj->iad", F, J_n)
                columns.append((at, -np.swapaxes(turned + HJ + FJ, 1, 2)))
                force, moment = f.sum(0), np.cross(x[at], f).sum(0)
                bent = turns[..., :3] @ force + turns[..., 3:] @ moment
                K = K + (bent * carried * carried[:, None]).T
                K = K + np.einsum("iad,ibd->ab", J, turned + HJ) + np.einsum("iad,ibd->ab", J_n, FJ)
        return columns, 0.5 * (K + K.T)

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
