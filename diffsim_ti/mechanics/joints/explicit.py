"""Joints of robots in explicit passes: a stage around the kick and drift, to which links are obstacles that move.

In a pass of length h joints go from (q, v) to q + h w, and links with the velocities J w, J = J(q). The contact stage
(mechanics/obstacles/contact_stage.py) has vertices meet them, which gets them the impulses P by push and F by friction, for
each w anew: vertices are eliminated. With Phi of the joints alone (terms/robots/robot.py) and b = (1 + c) / 2 as there

    h dPhi/dq(q + h w) + J^T (b P(w) + F(w)) = 0,    v' = w - (1 - b) A^-1 J^T P,    A = M + h c + h^2 k,

is solved for w by Newton's method: links move by J A^-1 J^T times what vertices do to them in the same pass. What one gets
the other loses, to round-off, whatever is left of this equation. Fixed vertices do not stop links.

Vertices that links hold are kicked like all, to velocities v*, and then go where links have them, y(q), at d = (y(q + h w) -
y(q)) / h: J^T m (d - v*) acts on joints, which joins the equation. All of P counts in it, b = 1, so that v' = w and d stays.
"""

import weakref
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.joints.joints import Joints, balanced
from diffsim_ti.mechanics.joints.sweeps import JointAdjoint, JointSweep, JointTangent
from diffsim_ti.mechanics.joints.twists import by_turns, moved, moved_jvp, on_joints
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.runtime.slots import VertexRows, copy_slot
from diffsim_ti.state.history import History
from diffsim_ti.state.numbers import Tangent
from diffsim_ti.state.stage import Stage as Pass

ROUNDS = 100


class ExplicitJoints(Joints):
    """Joints that stand at q + h w."""

    @property
    def acceleration(self):
        return (self.w - self.v_n) / self.h

    def go(self, w: np.ndarray, rows: np.ndarray) -> None:
        """Stand there, with the velocities of links in rows of obstacles."""
        self.w, self.q = w, self.q_n + self.h * w
        self.put_rates(rows, w)


class JointStage(Stage):
    """The stage. `met`: (w, whether links touched) of each recorded pass, by its slot."""

    def __init__(self, ws):
        self.ws, a = weakref.proxy(ws), ws.arrays
        self.joints = ExplicitJoints(ws)
        self.rows, self.met = np.zeros((a.poses.size, 3)), {}
        self.blend = 1.0 if len(self.joints.at) else 0.5 + 0.5 * ws.solver.contact_damping
        links = [k for k, _ in self.joints.links]
        self.own = np.ravel([[2 * k, 2 * k + 1] for k in links]).astype(int)  # their rows of impulses
        self.carried = np.array([carried for _, carried in self.joints.links], float).reshape(-1, self.joints.count)
        ws.state.f = runtime.array(a.vector, 1, a.num_vertices)
        self.held = VertexRows(a, self.joints.at)
        self.pair = History(a, 2, record=True)  # the states that a pass leads from and to
        self.change, self.none = History(a, 1, record=False), None
        self.change.offsets = runtime.array(a.vector, a.poses.size)
        self.change.impulse = runtime.array(a.vector, 2 * len(a.obstacles), a.num_vertices)

    def with_buffers(self, way: str, run) -> Stage:
        return JointStageTangent(self, run) if way == "tangent" else JointStageAdjoint(self, run)

    # ---- a pass --------------------------------------------------------------------------------------------------------

    def begin(self, at: Passes) -> None:
        """Joints stand where the pass begins."""
        J, self.at = self.joints, at
        J.now = at.history.joints[at.slot]
        J.begin(at.j, Pass(at.now.h), self.rows)
        self.inertia = J.M + np.diag(J.h * J.c + J.h**2 * J.k)
        self.m, self.y_n, self.v_star = self.ws.mass[J.at], J.carried(J.q_n), np.zeros((len(J.at), 3))
        self.J_n = J.ways(J.S_n, self.y_n)  # of vertices that links hold
        self._note(np.zeros(0, int), np.zeros((2 * len(self.ws.arrays.obstacles), 0, 3)))

    def go(self, w: np.ndarray) -> None:
        """Links move with w in the pass; nothing is noted of it."""
        self.joints.go(w, self.rows)
        if self.own.size:
            runtime.fill(self.ws.arrays.offsets, self.rows)
            runtime.clear([self.ws.impulses.impulse])

    @contextmanager
    def do(self, at: Passes):
        ws, history, J = self.ws, at.history, self.joints
        ws.note_joints(int(ws.solver.schedule.shown(at.j, at.save_every)), history, at.slot)
        if not at.now.alpha > 0:
            yield
            history.joints[at.end] = history.joints[at.slot]
            return
        self.begin(at)
        self.go(J.v_n)
        if not len(J.at):
            self.find()
        history.copy(at.slot, self.pair, 0)
        yield
        touches = bool(self.own.size) and (self.look() or len(J.at) > 0)
        if touches or len(J.at):
            copy_slot(history.f, at.slot, self.pair.f, 0)
            states = (self.pair.u, history.u), (self.pair.v, history.v)
            for source, target in states:
                copy_slot(target, at.end, source, 1)
            self.find(meets=touches)
            for (source, target), row in zip(states, (J.carried(J.q) - ws.arrays.values.rest[J.at], self.chord)):
                copy_slot(source, 1, target, at.end)
                self.held.put(target, at.end, row)
        if self.own.size:
            ws.impulses.note_pass(at.numbers["counted"])
        z = self.rebound()
        history.joints[at.end] = J.q, J.w - z, sum(J.efforts()) + self.resistance * z, J.q_n, J.v_n
        self.met[at.end] = J.w, touches, self.v_star

    @property
    def chord(self) -> np.ndarray:
        """Velocities in the pass of vertices that links hold [m/s]."""
        return (self.joints.carried(self.joints.q) - self.y_n) / self.joints.h

    @property
    def pull(self) -> np.ndarray:
        """What links give these vertices [N s]."""
        return self.m * (self.chord - self.v_star)

    def look(self) -> bool:
        """Note what links have done to vertices, and say whether that is anything."""
        impulses = runtime.look(self.ws.impulses.impulse)
        near = np.flatnonzero(impulses[self.own].any((0, 2)))
        self._note(near, impulses[:, near].astype(np.float64))
        return bool(near.size)

    def _note(self, near: np.ndarray, given: np.ndarray) -> None:
        """near: vertices that links touch, at x where the pass begins; given: what all obstacles give them."""
        self.near, self.given, values = near, given, self.joints.a.values
        self.x = values.rest[near] + (runtime.fetch_row(self.pair.u, 0)[near] if near.size else 0.0)
        self.wrenches = self.wrenches_of(given)

    def launch(self, name: str, **numbers) -> None:
        """A kernel on the vertices, from the first state of the pair to the second."""
        ws, a = self.ws, self.ws.arrays
        own = {}
        if name == "press_jvp":
            self.none = self.none or Tangent(a, a.values.zeros())
            own = dict(tangent=(self.change, self.none, ws.frames))
        kernel = getattr(ws.kernels(a.features()), name)
        launch = ws.bound(kernel, state=(self.pair, ws.frames, ws.watch, ws.contact), **own, table=ws.table)
        launch(**self.at.numbers | dict(base=self.at.j, stride=1) | numbers)

    def wrenches_of(self, impulses: np.ndarray) -> np.ndarray:
        """Sums of impulses of each link, and of their moments about the origin, shape (links, 2, 6)."""
        own = impulses[self.own]
        return np.concatenate([own.sum(1), np.cross(self.x, own).sum(1)], 1).reshape(-1, 2, 6)

    def on_joints(self, wrenches: np.ndarray) -> np.ndarray:
        """What they do to joints, by push and by friction, shape (2, joints): J^T."""
        return np.einsum("la,ad,lkd->ka", self.carried, self.joints.S_n, wrenches)

    def bent(self) -> np.ndarray:
        """How that changes as joint b turns where the pass begins, shape (2, joints b, joints)."""
        turns = self.joints.turns(self.joints.S_n)
        return np.einsum("la,lb,bad,lkd->kba", self.carried, self.carried, turns, self.wrenches)

    def bent_by_held(self) -> np.ndarray:
        """How what vertices that links hold do to joints changes as joint b turns where the pass begins, [b, a]."""
        J, pull = self.joints, self.pull
        turns = J.turns(J.S_n)
        parts = (by_turns(turns, carried, self.y_n[rows], pull[rows]) for rows, _, carried in J.grips)
        return sum(parts, np.zeros((J.count, J.count)))

    def weighed(self, acting: np.ndarray) -> np.ndarray:
        """What counts of it in the equation of w."""
        return self.blend * acting[0] + acting[1]

    def left(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(what is left of that equation, by its sign a force, sizes of what it adds up, what digits of places leave)"""
        J = self.joints
        own, size = J.own_forces()
        given = np.abs(self.given[self.own])
        sizes = np.concatenate([given.sum(1), np.abs(np.cross(np.abs(self.x), given)).sum(1)], 1).reshape(-1, 2, 6)
        met = np.einsum("la,ad,lkd->a", self.carried, np.abs(J.S_n), sizes)
        pull, J_n = self.pull, self.J_n
        R = J.h * own - self.weighed(self.on_joints(self.wrenches)) - on_joints(J_n, pull)
        speeds = np.abs(self.chord) + np.abs(self.v_star), J.digits / J.h
        held, rounding = (on_joints(np.abs(J_n), self.m * x) for x in speeds)
        return R, J.h * size + met + held, J.h * J.rounding() + rounding

    def find(self, meets: bool = False) -> None:
        """Find w; meets: with vertices, else without contact. Raises NotConverged where it is not found."""
        J = self.joints

        def kicked():
            if len(J.at):
                self.v_star = self.held.get(self.pair.v, 1)

        def stand(w):
            self.go(w)
            if meets:
                self.launch("press")
                self.look()
                kicked()
            return self.left()

        def direction(R):
            step, w = np.linalg.solve(self.slope(meets), R), J.w
            if not step @ R > 0:  # which friction alone can do
                step = np.linalg.solve(self.slope(), R)
            return step, 1.0, lambda t: stand(w + t * step)

        kicked()
        R, size, noise = balanced(self.left(), direction, max(1e-14, 4 * J.eps), J.loose, ROUNDS)
        share = float(np.max(np.abs(R) / (size + noise / J.loose)))
        if not share <= J.loose:
            remedy = "take smaller steps" + (", or begin with links outside of the body" if self.own.size else "")
            error = NotConverged(f"joints of robots are out of balance by {share:.2g}: {remedy}", [share])
            raise self.ws.dated(error, self.at.j, self.at.num_passes)
        J.w = J.w + np.linalg.solve(self.slope(), R)  # so that momentum is kept to round-off
        J.q = J.q_n + J.h * J.w

    def slope(self, meets: bool = False) -> np.ndarray:
        """Derivative of the equation by w, or of its part without contact."""
        J = self.joints
        own = J.M + J.h**2 * np.diag(J.yielding)
        if len(J.at):
            own = own + np.einsum("iad,ibd->ab", self.m[..., None] * self.J_n, self.J_end)
        return own + self.weighed(self.answers()) - self.follows if meets else own

    @property
    def J_end(self) -> np.ndarray:
        """How joints move vertices that links hold where the pass ends."""
        J = self.joints
        return J.ways(J.kinematics(J.q)[1], J.carried(J.q))

    def rebound(self) -> np.ndarray:
        """(1 - b) A^-1 J^T P"""
        return (1 - self.blend) * np.linalg.solve(self.inertia, self.on_joints(self.wrenches)[0])

    @property
    def resistance(self) -> np.ndarray:
        """Effort by which drives and damping resist a change of velocity in a pass: (A - M) / h."""
        return self.joints.c + self.joints.h * self.joints.k

    def answers(self) -> np.ndarray:
        """Changes of what acts on joints, by w, shape (2, joints, joints of w). `moves`: of each joint of w those of
        displacements, velocities and impulses of the vertices that are near; `follows`: those of J^T m v* of vertices that
        links hold."""
        J, change = self.joints, self.change
        out, self.follows = np.zeros((2, J.count, J.count)), np.zeros((J.count, J.count))
        near, held = np.nonzero(self.near[:, None] == J.at)
        touched = self.wrenches.any((1, 2))
        self.moves = []
        for b in np.flatnonzero(self.carried[touched].any(0)):
            rows = np.zeros_like(self.rows)
            J.put_rates(rows, np.eye(J.count)[b])
            runtime.fill(change.offsets, rows)
            runtime.clear([change.u, change.v, change.impulse])
            self.launch("press_jvp", rate_dot=0.0)
            du, dv = (runtime.fetch_row(x, 0)[self.near] for x in (change.u, change.v))
            given = runtime.look(change.impulse)[:, self.near].astype(np.float64)
            out[:, :, b] = self.on_joints(self.wrenches_of(given))
            self.moves.append((b, du, dv, given))
            self.follows[:, b] = on_joints(self.J_n[held], self.m[held] * dv[near])
        return out

    # ---- what derivatives need -----------------------------------------------------------------------------------------

    def reopen(self, at: Passes) -> bool:
        """Stand in a recorded pass; whether links touched in it, of which all is noted then."""
        self.begin(at)
        J, (w, touches, self.v_star) = self.joints, self.met[at.end]
        self.go(w)
        J.S = J.kinematics(J.q)[1]
        if not touches:
            return False
        for slot, to in ((at.slot, 0), (at.end, 1)):
            at.history.copy(slot, self.pair, to)
        copy_slot(at.history.f, at.slot, self.pair.f, 0)
        self.launch("press")
        return self.look()

    def mass_derivatives(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of M y by joint positions and by masses, a column each."""
        J, m = self.joints, len(y)
        by_q, by_m = np.zeros((2, m, m))
        for robot, own in zip(J.robots.terms, J.slices):
            found = robot.model.derivatives(
                J.q_n[own], np.zeros(own.stop - own.start), y[own], J.masses[own], np.zeros(3)
            )
            by_q[own, own], by_m[own, own] = found[0], found[2]
        return by_q, by_m


class JointStageTangent(Stage):
    """Its tangent along a run; `joints`: changes of them."""

    def __init__(self, stage: JointStage, run):
        self.stage, self.joints = stage, JointTangent(run.ws, run.tangent)

    @contextmanager
    def tangent(self, at: Passes):
        stage, own, run = self.stage, self.joints, at.run
        J, ws = own.joints, own.ws
        if ws.solver.schedule.shown(at.j, at.save_every) >= 0:
            own.note()
        if not at.now.alpha > 0:
            yield
            return
        touches, h = stage.reopen(at), at.now.h
        own.begin()
        du_n = runtime.fetch_row(run.u, 0)
        if stage.own.size:
            runtime.fill(run.offsets, own.rows_jvp(own.dq, own.dq, own.dq))
            runtime.clear([run.impulses.impulse])
        yield
        dF = stage.slope() @ own.dq / h - h * own.force()  # for w as it is
        u, v, at_held = runtime.fetch(run.u), runtime.fetch(run.v), J.at
        led_n, led = (J.from_joints(q, own.dlocal) for q in (J.q_n, J.q))
        dy_n, dm = np.einsum("iad,a->id", stage.J_n, own.dq) + led_n, ws.mass_of(own.tangent)[at_held]
        dpull = dm * (stage.chord - stage.v_star) + stage.m * ((led - dy_n) / h - v[0, at_held])
        turned = J.holding * moved_jvp(J.S_n, dy_n)
        dF = dF + on_joints(stage.J_n, dpull) + on_joints(turned, stage.pull) + own.dq @ stage.bent_by_held()
        if touches:
            near, answers, z = stage.near, stage.answers(), stage.rebound()
            given = runtime.fetch(run.impulses.impulse).astype(np.float64)
            wrenches = stage.wrenches_of(given[:, near])
            dx = (du_n + own.tangent.rest)[near]
            wrenches[..., 3:] += np.cross(dx, stage.given[stage.own]).sum(1).reshape(-1, 2, 3)
            acting = stage.on_joints(wrenches) + np.einsum("kba,b->ka", stage.bent(), own.dq)
            dw = -np.linalg.solve(stage.slope() + stage.weighed(answers) - stage.follows, dF + stage.weighed(acting))
            acting = acting[0] + answers[0] @ dw
            _, _, dk, dc, dm = J.robots.numbers(own.tangent.parameters)
            by_q, by_m = stage.mass_derivatives(z)
            dresistance = dc + h * np.where(J.robots.prescribed, 0.0, dk)
            dA = by_q @ own.dq + by_m @ dm + h * dresistance * z
            dv = dw - np.linalg.solve(stage.inertia, (1 - stage.blend) * acting - dA)
            for b, du_b, dv_b, given_b in stage.moves:
                u[0, near] += du_b * dw[b]
                v[0, near] += dv_b * dw[b]
                given[:, near] += given_b * dw[b]
            runtime.fill(run.impulses.impulse, given)
        else:
            dw = dv = -np.linalg.solve(stage.slope(), dF)
        if touches or len(at_held):
            dy = np.einsum("iad,a->id", stage.J_end, own.dq + h * dw) + led
            u[0, at_held], v[0, at_held] = dy - own.tangent.rest[at_held], (dy - dy_n) / h
            runtime.fill(run.u, u)
            runtime.fill(run.v, v)
        if stage.own.size:
            run.impulses.note_pass(at.numbers["counted"])
        own.step(own.dq + h * dw)
        own.dv = dv
        if touches:
            own.deffort = own.deffort + stage.resistance * (dw - dv) + dresistance * z


class JointStageAdjoint(JointAdjoint):
    """Its adjoint."""

    in_kicks = False

    def __init__(self, stage: JointStage, run):
        JointSweep.__init__(self, run.ws)
        self.stage = stage

    def seed_frames(self, seeds):
        super().seed_frames(seeds)
        if not self.ws.solver.last_frame_is_state:  # its last pass shows the last frame
            self.clear()
        a, n = self.ws.arrays, self.ws.arrays.num_vertices
        self.by_rest, self.by_mass, self.by_gravity = np.zeros((n, 3)), np.zeros(n), np.zeros(3)
        self.by_steps = SimpleNamespace(joints=np.zeros_like(a.rows["joints"]))

    @contextmanager
    def adjoint(self, at: Passes):
        stage, J, ws, run = self.stage, self.joints, self.ws, at.run
        frame = int(ws.solver.schedule.shown(at.j, at.save_every))
        if not at.now.alpha > 0:
            yield
            if frame >= 0:
                self.add_frame(frame)
            return
        touches, h, rows = stage.reopen(at), at.now.h, np.zeros_like(stage.rows)
        seeds = run.impulses.of_frame(at.numbers["counted"]) if stage.own.size else 0.0
        by_w, K = h * (self.by_q - J.yielding * self.by_effort) + self.by_v, stage.slope()
        self._to_q_n, by_x = np.zeros(J.count), np.zeros_like(self.by_rest)
        if touches or len(J.at):
            run.complete()
            p, q = runtime.fetch_row(run.u, 0), runtime.fetch_row(run.v, 0)
            by_end, by_begin = p[J.at] + q[J.at] / h, -q[J.at] / h  # of where links have the vertices that they hold
            self.by_rest[J.at] -= p[J.at]
            p[J.at], q[J.at] = 0.0, 0.0
            by_w = by_w + h * on_joints(stage.J_end, by_end)
        if touches:
            near, answers, z = stage.near, stage.answers(), stage.rebound()
            K = K + stage.weighed(answers) - stage.follows
            eased = np.linalg.solve(stage.inertia, self.by_v - stage.resistance * self.by_effort)
            by_push = (stage.blend - 1) * eased
            by_w = by_w + by_push @ answers[0]
            seeded = seeds[:, near] if np.ndim(seeds) else 0.0
            for b, du_b, dv_b, given_b in stage.moves:
                by_w[b] += (p[near] * du_b).sum() + (q[near] * dv_b).sum() + (seeded * given_b).sum()
        w = np.linalg.solve(K.T, by_w)
        self.w = h * w
        if len(J.at):
            moved_by, turn = np.einsum("iad,a->id", stage.J_n, w), (J.holding * J.S_n[:, 3:] * w[:, None]).sum(1)
            q[J.at] = stage.m * moved_by
            by_end, by_begin = by_end - q[J.at] / h, by_begin + q[J.at] / h - np.cross(stage.pull, turn)
            self.by_mass[J.at] -= (moved_by * (stage.chord - stage.v_star)).sum(1)
            self._to_q_n += on_joints(stage.J_n, by_begin) - stage.bent_by_held() @ w
            self.by_local += J.to_joints(J.q, by_end) + J.to_joints(J.q_n, by_begin)
            runtime.fill(run.u, p[None])
            runtime.fill(run.v, q[None])
        if touches:
            by = np.stack([by_push - stage.blend * w, -w])  # adjoints of what acts on joints
            seeds = self._with(seeds, by)
            own = stage.carried[:, None] * by  # (links, 2, joints)
            turn = np.repeat((own @ J.S_n[:, 3:]).reshape(-1, 1, 3), len(near), 1)
            by_x[near] = np.cross(stage.given[stage.own], turn).sum(0)
            by_q, by_m = stage.mass_derivatives(z)
            self._to_q_n += np.einsum("kba,ka->b", stage.bent(), by) + eased @ by_q
            self.numbers[4] += eased @ by_m
            by_resistance = (h * eased + self.by_effort) * z
            self.numbers[3] += by_resistance
            self.numbers[2] += np.where(J.robots.prescribed, 0.0, h * by_resistance)
        if stage.own.size:
            runtime.fill(run.impulses.impulse, seeds)
            runtime.clear([run.offsets])
        yield
        if stage.own.size:
            rows = runtime.look(run.offsets).sum(1, dtype=np.float64)
            runtime.fill(run.u, runtime.fetch(run.u) + by_x)
            self.by_rest += by_x
        self.by_gravity += self.end(rows, self.by_steps)
        if frame >= 0:
            self.add_frame(frame)

    def _with(self, seeds, by: np.ndarray) -> np.ndarray:
        """Adjoints of all impulses, with those by what acts on joints."""
        stage, J = self.stage, self.joints
        out = np.zeros((2 * len(stage.ws.arrays.obstacles), *self.by_rest.shape)) + seeds
        arms = moved(J.S_n, stage.x)  # (near, joints, 3)
        for link, k in enumerate(stage.own[::2] // 2):
            for side in range(2):
                out[2 * k + side, stage.near] += np.einsum("a,iad->id", stage.carried[link] * by[side], arms)
        return out

    def collect(self, out) -> None:
        """Add what was summed up."""
        super().collect(out)
        if (first := self.ws.arrays.features().gravity) >= 0:
            out.parameters[first:][:3] += self.by_gravity
        out.joints += self.by_steps.joints
        if out.mass is not None:
            out.mass = out.mass + self.by_mass
        if out.rest is not None:
            out.rest = out.rest + self.by_rest
