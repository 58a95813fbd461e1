"""What tangents and reverse sweeps of implicit passes do of the joints of robots (joints.py)."""

import numpy as np

from diffsim_ti.differentiation.arrays import add_transposed
from diffsim_ti.mechanics.joints.twists import by_turns, moved, moved_jvp, on_joints
from diffsim_ti.mechanics.obstacles.contact_record import SharesAdjoint
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, RATE


class JointSweep:
    """Derivatives of the rows of links, and of the joints' own equation, in the pass that the workspace stands in."""

    def __init__(self, workspace):
        self.ws, self.joints = workspace, workspace.joints

    def open(self, slot: int) -> None:
        """Stand in the pass whose states are in a slot of the record and in the next."""
        record = self.ws.record
        self.joints.now = record.joints[slot]
        self._end = record.joints[slot + 1][0]

    def hold(self) -> None:
        """Stand where the pass ended; it has begun."""
        self.joints.hold(self._end)

    # ---- rows of links -----------------------------------------------------------------------------------------------

    def _moments(self) -> list:
        """(rows of translation and of rotation, joints that move it, its points at the pass's end and beginning) of links"""
        J, place = self.joints, self.joints.a.poses.place_of
        now, before = J.kinematics(J.q)[0], J.poses_n
        return [(3 * k, 3 * place[k], carried, t[1], t_n[1]) for (k, carried), t, t_n in zip(J.links, now, before)]

    def _rate_by_place(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change of velocity of a link's own point t, and of its spin, by q_n at a constant rate, shape (joints, joints, 3)
        each: [b, a] of joint a by q_b."""
        J = self.joints
        turns = J.turns(J.S_n)
        here = moved(J.S_n, t)
        at = turns[..., :3] + np.cross(turns[..., 3:], t) + np.cross(J.S_n[None, :, 3:], here[:, None])
        return at, turns[..., 3:]

    def _slopes(self) -> np.ndarray:
        """Derivatives of the rows by the joints where the pass ends, where it begins, and where inertia starts from, shape
        (3, joints, rows, 3)."""
        J = self.joints
        out, per_h = np.zeros((3, J.count, J.a.poses.size, 3)), np.array([1.0, 0.0, -1.0])[:, None, None] / J.h
        for row, turn, carried, t, t_n in self._moments():
            end, begin = (
                carried[:, None, None] * np.stack([moved(S, x), S[:, 3:]], 1) for S, x in ((J.S, t), (J.S_n, t_n))
            )
            bent = np.einsum("sbad,b,a->bsd", self._rate_by_place(t_n), carried, J.rate * carried)
            both = np.array([row, turn])
            out[0][:, both + AT_STAGE] += end
            out[1][:, both + AT_BEGIN] += begin
            out[1][:, both + RATE] += bent
            for own, share in zip(out, per_h):
                own[:, both + RATE] += share * begin
        return out

    def rows_jvp(self, dq: np.ndarray, dq_n: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Change of the rows for changes of the joints where the pass ends and begins, and where inertia starts from."""
        return np.einsum("wj,wjrd->rd", np.stack([dq, dq_n, dx]), self._slopes())

    def rows_vjp(self, rows: np.ndarray) -> np.ndarray:
        """Adjoints of the joints there, shape (3, joints)."""
        return np.einsum("wjrd,rd->wj", self._slopes(), rows)

    def _each(self):
        """(robot, its joints)"""
        return zip(self.joints.robots.terms, self.joints.slices)

    def _of_friction(self) -> list:
        """(vertices, joints that move the link, f, f', sum over vertices of f' . change of J' by q_b, [b, a])"""
        J, out = self.joints, []
        turns, x_n = J.turns(J.S_n), J.places(J.p.held_at)[1]
        for (_, carried), part in zip(J.links, J.pushed):
            out.append((part.at, carried, part.f, part.drag, by_turns(turns, carried, x_n[part.at], part.drag)))
        return out


class JointTangent(JointSweep):
    """Changes of the joints along a run."""

    def __init__(self, workspace, tangent):
        super().__init__(workspace)
        self.tangent, J, self.frames = tangent, self.joints, []
        self.dq, self.dv, *_ = J.robots.numbers(tangent.parameters)
        self.deffort, (q, *_), self.before = np.zeros(J.count), J.start(), (self.dq, self.dv)
        at, x = J.at, (J.a.values.rest + J.a.values.displacement)[J.at]
        moved_on = (tangent.rest + tangent.displacement)[at] - np.einsum(
            "iad,a->id", J.ways(J.kinematics(q)[1], x), self.dq
        )
        self.dlocal = J.to_joints(q, moved_on)

    def begin(self) -> None:
        """The pass is open. dx, dy, dq_on, dv_on: changes of what `extrapolated` says."""
        self.dx, self.dy, self.dq_on, self.dv_on = self.joints.extrapolated(self.dq, self.dv, *self.before)

    def note(self) -> None:
        """A frame has the change of the present state."""
        self.frames.append(np.stack([self.dq, self.dv, self.deffort], 1))

    def led(self) -> np.ndarray:
        """Change of displacements of the vertices that links hold, joints staying where the pass ends."""
        return self.joints.from_joints(self.joints.q, self.dlocal) - self.tangent.rest[self.joints.at]

    def force(self, shares=None, held=None, du=None, dR=None) -> np.ndarray:
        """Change of -dPhi/dq, body and joints staying where the pass ends, but for its fixed vertices.

        shares: change of what obstacles do to vertices; held: change of places; du: of those where the pass begins; dR: of
        what acts on vertices. Without places: that without contact.
        """
        J, moved_numbers, out = self.joints, self.tangent, np.zeros(self.joints.count)
        _, _, dk, dc, dm = J.robots.numbers(moved_numbers.parameters)
        dk = np.where(J.robots.prescribed, 0.0, dk)
        dg = J.a.gravity_of(moved_numbers)
        for robot, own in self._each():
            by_q, by_v, by_m, by_g = J.derivatives(robot, own)
            out[own] -= by_q @ self.dq_on[own] + by_v @ self.dv_on[own] + by_m @ dm[own] + J.laid * by_g @ dg
        schedule, rows = self.ws.solver.schedule, moved_numbers.joints
        dtargets = schedule.pressure(rows, J.j, J.share)
        self._given = J.k * dtargets - dk * (J.q - J.targets) + J.c * self.dx / J.h
        self._given += J.laid * rows[schedule.load_row(rows, J.j)][:, 2] - J.moves * dc * J.rate
        out += J.moves * J.M @ (self.dx / J.h + self.dy) / J.h + self._given
        if held is None:
            return out
        x, x_n = J.places(J.p.held_at)
        dx, dx_n = held + moved_numbers.rest, du + moved_numbers.rest
        if len(J.at):
            out += on_joints(J.J_a, dR[J.at])
            out += on_joints(J.holding * moved_jvp(J.S, dx[J.at]), J.pull)
        for (k, *_), (vertices, carried, f, drag, bent) in zip(J.links, self._of_friction()):
            both = ((J.S, x, shares[k, 0], f, dx), (J.S_n, x_n, shares[k, 1], drag, dx_n))
            for S, y, change, force, dy in both:
                out -= carried * on_joints(moved(S, y[vertices]), change[vertices])
                out -= carried * on_joints(moved_jvp(S, dy[vertices]), force)
            out -= self.dq @ bent
        return out

    def step(self, dq: np.ndarray) -> None:
        """The pass has changed the joints so."""
        self.before, self.dq, self.dv = (self.dq, self.dv), dq, self.joints.moves * (dq - self.dx) / self.joints.h
        self.deffort = self._given - self.joints.yielding * dq


class JointAdjoint(JointSweep):
    """Adjoints of the joints in a reverse sweep. pending: of positions and velocities before, from the pass that comes
    next."""

    _to_x = 0.0

    def __init__(self, workspace, features, numbers):
        super().__init__(workspace)
        self._shares = SharesAdjoint(workspace, features, numbers) if self.joints.links else None

    def seed_frames(self, seeds: np.ndarray | None) -> None:
        """Begin with the adjoints of the frames, shape (frames, joints, 3)."""
        frames = len(self.ws.joint_frames)
        self.frames = np.zeros((frames, self.joints.count, 3)) if seeds is None else seeds
        self.by_q, self.by_v, self.by_effort = self.frames[-1].T.copy()
        self.pending = np.zeros((2, self.joints.count))
        self.numbers, self.by_local = np.zeros((5, self.joints.count)), np.zeros((len(self.joints.at), 3))

    def clear(self) -> None:
        """The joints where the sweep stands are no start of theirs."""
        self.by_q, self.by_v, self.by_effort, *self.pending = np.zeros((5, self.joints.count))

    def scale(self, factor: float) -> None:
        """Multiply the running adjoint."""
        self.by_q, self.by_v, self.pending = factor * self.by_q, factor * self.by_v, [factor * x for x in self.pending]

    def add_frame(self, frame: int) -> None:
        """Add the adjoints of a frame."""
        self.by_q, self.by_v = self.by_q + self.frames[frame, :, 0], self.by_v + self.frames[frame, :, 1]
        self.by_effort = self.frames[frame, :, 2]

    def begin(self, seed: np.ndarray, rows: np.ndarray | float, by_ends: np.ndarray) -> np.ndarray:
        """What the body's equation is to be solved for; rows: adjoint of the obstacles' rows by what is seen of contacts;
        by_ends: of the vertices' displacements where the pass ends."""
        J = self.joints
        by_q, self._to_q_n, self._to_x = self.rows_vjp(rows) if np.ndim(rows) else np.zeros((3, J.count))
        self.by_v = J.moves * self.by_v
        self._seed = self.by_q + self.by_v / J.h + by_q - J.yielding * self.by_effort
        if len(J.at):
            self._seed = self._seed + on_joints(J.J_a, by_ends[J.at])
        return seed - J.of_joints(J.follow(self._seed), seed.shape)

    def with_held(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """x with what y has at the vertices that links hold."""
        x = x.copy()
        x[self.joints.at] = y[self.joints.at]
        return x

    def follow(self, w: np.ndarray) -> np.ndarray:
        """The adjoint of the body's equation, with what the joints make of it at vertices that links hold."""
        J = self.joints
        self.w, out = J.follow(self._seed - J.of_body(w)), w.copy()
        if len(J.at):
            out[J.at] = np.einsum("iad,a->id", J.J_a, self.w)
        return out

    def pull_back(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(adjoint of all places, of the two rows of lag, of the obstacles' rows) by the joints' equation, the body's having
        the adjoint w; those of rest positions are added by the caller as those of places and of the first row."""
        J, n = self.joints, len(w)
        by_places, by_lag = np.zeros((n, 3)), np.zeros((2, n, 3))
        self.by_rest = np.zeros((n, 3))  # by the arms of forces
        if not J.links:
            return by_places, by_lag, np.zeros((J.a.poses.size, 3))
        seed = np.zeros((len(J.a.contacts), 2, n, 3))
        x, x_n = J.places(J.p.held_at)
        for (k, *_), (vertices, carried, f, drag, bent) in zip(J.links, self._of_friction()):
            own = self.w * carried
            for side, S, y in ((0, J.S, x), (1, J.S_n, x_n)):
                seed[k, side, vertices] = -np.einsum("a,iad->id", own, moved(S, y[vertices]))
            by_places[vertices] += np.cross(own @ J.S[:, 3:], f)
            by_lag[0, vertices] += np.cross(own @ J.S_n[:, 3:], drag)
            self._to_q_n = self._to_q_n - bent @ self.w
        self.by_rest = by_places + by_lag[0]
        by_u, lag, rows = self._shares.pull_back(seed)
        by_lag[: len(lag)] += lag if self.ws.potential.has_friction else 0.0
        return by_places + by_u, by_lag, rows

    def end(self, rows: np.ndarray, adj) -> np.ndarray:
        """Go to where the pass begins. rows: adjoint of the obstacles' rows by the equations of body and joints; adj: takes
        adjoints of numbers. Returns that of gravity."""
        J, w = self.joints, self.w
        _, by_q_n, by_x = self.rows_vjp(rows)
        e, by_y, by_gravity = w + self.by_effort, J.moves * J.M @ w / J.h, np.zeros(3)
        by_q_on, by_v_on = np.zeros((2, J.count))
        by_x = by_x + self._to_x + (by_y + J.c * e - self.by_v) / J.h
        for robot, own in self._each():
            by_q, by_v, by_m, by_g = J.derivatives(robot, own)
            by_q_on[own] -= w[own] @ by_q
            by_v_on[own] -= w[own] @ by_v
            self.numbers[4, own] -= w[own] @ by_m
            by_gravity -= J.laid * w[own] @ by_g
        self.numbers[2] -= np.where(J.robots.prescribed, 0.0, e * (J.q - J.targets))
        self.numbers[3] -= J.moves * e * J.rate
        schedule = self.ws.solver.schedule
        add_transposed(adj.joints, lambda rows: schedule.pressure(rows, J.j, J.share), J.k * e)
        adj.joints[schedule.load_row(adj.joints, J.j)][:, 2] += J.laid * e
        (a0, a1), (b0, b1) = J.weights
        by_first, by_second = np.stack([by_x, by_y]), np.stack([by_q_on, by_v_on])
        self.by_q, self.by_v = a0 * by_first + b0 * by_second + self.pending
        self.by_q, self.pending = self.by_q + self._to_q_n + by_q_n, a1 * by_first + b1 * by_second
        self.by_effort = np.zeros(J.count)
        return by_gravity

    def hand_on(self, by_places: np.ndarray) -> np.ndarray:
        """Add to the adjoints of where links hold vertices, for those of all places; returns the latter's."""
        J = self.joints
        omega = (J.holding * J.S[:, 3:] * self.w[:, None]).sum(1)
        by = by_places[J.at] + np.cross(J.pull, omega)
        self.by_local += J.to_joints(J.q, by)
        return by_places[J.at]

    def collect(self, out) -> None:
        """Add the adjoints of the robots' numbers, and of places where links hold vertices."""
        J = self.joints
        q, *_ = J.start()
        by, x = J.from_joints(q, self.by_local), (J.a.values.rest + J.a.values.displacement)[J.at]
        if out.rest is not None:
            out.rest[J.at] += by
        out.displacement[J.at] += by
        by_q = self.by_q - on_joints(J.ways(J.kinematics(q)[1], x), by)
        J.robots.add_numbers(out.parameters, np.concatenate([[by_q, self.by_v], self.numbers[2:]]))
