"""The tangent and the adjoint of the stage that holds volumes (volume_constraints.py), along recorded passes; how the
pressures of frames change, and adjoints that a loss gives."""

from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.volume_constraints import ChamberWalls, VolumeConstraints, along, slopes
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.terms import Chamber


class ChamberRecord:
    """The pressure of a frame is that of the pass that leads to it."""

    def __init__(self, solver, held: list[int]):
        self.solver, self.held = solver, held  # places of these chambers among the scene's
        self.adjoints: np.ndarray | None = None  # by the frames' chamber pressures, None: zero
        self._changes: dict[int, np.ndarray] = {}

    def _frame(self, j: int, save_every: int) -> int:
        """The frame that the state after pass j is, or -1."""
        return int(self.solver.schedule.shown(j + 1, save_every))

    def adjoint(self, j: int, save_every: int) -> np.ndarray:
        """By the pressures of constrained volumes after pass j."""
        frame = self._frame(j, save_every)
        return np.zeros(len(self.held)) if self.adjoints is None or frame < 0 else self.adjoints[frame, self.held]

    def note(self, j: int, save_every: int, change: np.ndarray) -> None:
        """Change of those after pass j."""
        frame = self._frame(j, save_every)
        if frame >= 0:
            self._changes[frame] = change

    def changes(self, num_frames: int) -> np.ndarray:
        """Of the frames, shape (frames, chambers)."""
        out = np.zeros((num_frames, len(self.solver.scene.terms_of(Chamber))))
        for frame, change in self._changes.items():
            out[frame, self.held] = change
        return out


@dataclass
class VolumeConstraintPass:
    """A recorded pass j, between its slots."""

    j: int
    now: object  # its numbers
    walls: ChamberWalls
    ends: np.ndarray  # places of the walls after it
    s: np.ndarray | None  # None where there was no stage
    frame: int  # whose velocity it shows between kicks, or -1
    q: np.ndarray | None = None  # of that, and
    shown: np.ndarray | None = None  # the velocity

    @property
    def ratio(self) -> float:
        """r."""
        return self.now.decay / self.now.alpha

    @property
    def ratio_by_rate(self) -> float:
        now = self.now
        return (now.decay_by_rate * now.alpha - now.decay * now.alpha_by_rate) / now.alpha**2

    @property
    def per_pressure(self) -> float:
        """s of 1 Pa."""
        return self.now.alpha * (self.now.pre + self.now.post)


def recorded(held: VolumeConstraints, at: Passes, shows: bool = False) -> VolumeConstraintPass:
    """A pass of the record; shows: its velocity between kicks is looked at also where it is no frame's."""
    ws, kept, now, history, slot, j = held.ws, held.kept.get(at.end), at.now, at.history, at.slot, at.j
    u, v = held.rows(history.u, slot), held.rows(history.v, slot)
    walls, ends = held.walls(u), held.rest + held.rows(history.u, at.end)
    one = VolumeConstraintPass(
        j, now, walls, ends, None if kept is None else kept[2], held.frame(j, at.save_every, now)
    )
    if one.frame >= 0 or (shows and now.pre > 0):
        weight = ws.arrays.gravity_of(ws.arrays.values)
        v = v + now.pre * walls.freed(walls.inverse * held.rows(history.f, slot) + weight)
        change, one.q = held.tangent_part(walls, v, held.rates(ws.arrays.rows[held.numbers], j))
        one.shown = v + change
    return one


def _record_of(held: VolumeConstraints, run) -> ChamberRecord:
    """What a run knows of the frames' pressures, where these are shown."""
    record = ChamberRecord(held.ws.solver, held.places)
    if held.is_shown:
        run.chamber_record = record
    return record


class VolumeConstraintTangent(Stage):
    """Of a run, which holds the changes of the state and of frames, and those of all else."""

    def __init__(self, held: VolumeConstraints, run):
        self.held, self.change = held, run.tangent
        self.chambers = _record_of(held, run)
        held.take_change(self.change)
        self.rest, mass = held.of_rest(self.change.rest), held.ws.arrays.values.mass[held.nodes, None]
        self.inverse = -self.change.mass[held.nodes, None] / mass**2

    @contextmanager
    def tangent(self, at: Passes):
        dx = self.rest + self.held.rows(at.run.u, 0)
        with self.held.alone(at.history, at.end):
            yield
        self._after(at, dx)

    def _after(self, at: Passes, dx: np.ndarray) -> None:
        """The rest of a pass is done, whose beginning changed by dx."""
        held, run, j, one = self.held, at.run, at.j, recorded(self.held, at)
        walls, rows = one.walls, getattr(self.change, held.numbers)
        if one.s is not None:
            du, dv = held.rows(run.u, 0), held.rows(run.v, 0)
            G, pushed = walls.gradients(one.ends), walls.pushed_jvp(one.s, dx, self.inverse)
            left = held.targets(rows, j) - along(G, self.rest + du + pushed) - walls.moved(one.ends)
            ds = np.linalg.solve(slopes(G, walls.d), left)
            way = np.tensordot(ds, walls.d, 1) + pushed
            held.put(run.u, 0, du + way)
            by_ratio = run.rate_dot * one.ratio_by_rate * np.tensordot(one.s, walls.d, 1)
            held.put(run.v, 0, dv + one.ratio * way + by_ratio)
            by_rate = one.now.alpha_by_rate / one.now.alpha * run.rate_dot
            self.chambers.note(j, at.save_every, (ds - by_rate * one.s) / one.per_pressure)
        if one.frame >= 0:
            dv, pushed = held.rows(run.frames.frames_v, one.frame), walls.pushed_jvp(one.q, dx, self.inverse)
            left = held.rates(rows, j) - along(walls.turned(dx), one.shown) - along(walls.g, dv + pushed)
            dq = np.linalg.solve(slopes(walls.g, walls.d), left)
            held.put(run.frames.frames_v, one.frame, dv + np.tensordot(dq, walls.d, 1) + pushed)


class VolumeConstraintAdjoint(Stage):
    """Of a run, which holds the adjoints of the state and of frames: sums over passes."""

    in_kicks = True  # where the velocity that a state shows is not yet tangent

    def __init__(self, held: VolumeConstraints, run):
        self.held, self.drag = held, run.features.drag
        self.chambers = _record_of(held, run)

    def clear(self) -> None:
        n, values = len(self.held.nodes), self.held.ws.arrays.values
        self.rest, self.inverse, self.by_rate = np.zeros((n, 3)), np.zeros((n, 1)), 0.0
        self.follower, self.halted = np.zeros_like(getattr(values, self.held.numbers)), None
        self.held.clear_adjoint()

    @contextmanager
    def adjoint(self, at: Passes):
        if at.kick:
            self._go_before_state(at.run)
            yield
            return
        at.run.complete()
        self._start(at)
        with self.held.alone(at.history, at.end):
            yield
        if self.halted is not None:
            self._halt(self.halted, at.run)
        self.end(at.run)

    def _start(self, at: Passes) -> None:
        """Go back through the stage, which is the last thing that a pass does. Where the sweep stops at the state that the
        pass shows, its velocity is tangent."""
        held, run, j, save_every, schedule = self.held, at.run, at.j, at.save_every, self.held.ws.solver.schedule
        halts = j == at.halt
        one = recorded(held, at, halts)
        walls, self.by_x, rows = one.walls, np.zeros_like(self.rest), self.follower
        if one.s is not None:
            u_adj, v_adj = held.rows(run.u, 0), held.rows(run.v, 0)
            by_pressure = self.chambers.adjoint(j, save_every) / one.per_pressure
            G, displacement_adj = walls.gradients(one.ends), u_adj + one.ratio * v_adj
            mu = np.linalg.solve(slopes(G, walls.d).T, along(walls.d, displacement_adj) + by_pressure)
            z = -np.tensordot(mu, G, 1)
            walls.moved_vjp(-mu, one.ends)
            self._push(walls, one.s, displacement_adj + z)
            self.rest += z
            held.put(run.u, 0, u_adj + z)
            schedule.add_pressure(rows, j, schedule.end(j), self._of_all(mu))
            self.by_rate += one.ratio_by_rate * float(one.s @ along(walls.d, v_adj))
            self.by_rate -= one.now.alpha_by_rate / one.now.alpha * float(by_pressure @ one.s)
        self.halted = one if halts and one.q is not None else None
        if one.frame >= 0 and not halts:
            frame_adj = held.rows(run.frames.frames_v, one.frame)
            held.put(run.frames.frames_v, one.frame, frame_adj + self._show(one, frame_adj))

    def _halt(self, one: VolumeConstraintPass, run) -> None:
        """From the state between the kicks of a pass to that with a tangent velocity, of which all later ones are functions
        likewise."""
        held = self.held
        of_frame = held.rows(run.frames.frames_v, one.frame) if one.frame >= 0 else 0.0
        self._push(one.walls, one.q, of_frame - held.rows(run.v, 0))

    def _go_before_state(self, run) -> None:
        """Back from there."""
        if self.halted is not None:
            held, self.by_x = self.held, np.zeros_like(self.rest)
            v_adj = held.rows(run.v, 0)
            held.put(run.v, 0, v_adj + self._show(self.halted, v_adj))
            self.end(run)
        self.halted = None

    def _show(self, one: VolumeConstraintPass, frame_adj: np.ndarray) -> np.ndarray:
        """What comes to the adjoint of a velocity that is shown, before it is made tangent; adds those of all else."""
        walls, rows, schedule = one.walls, self.follower, self.held.ws.solver.schedule
        mu = np.linalg.solve(slopes(walls.g, walls.d).T, along(walls.d, frame_adj))
        z = -np.tensordot(mu, walls.g, 1)
        self._push(walls, one.q, frame_adj + z)
        self.by_x = self.by_x + walls.turned_vjp(-mu, one.shown)
        rate = self._of_all(mu) / schedule.step_length(one.j - 1)
        row = rows[schedule.load_row(rows, one.j - 1)]
        row[:, 0] -= rate
        row[:, 1] += rate
        return z

    def _push(self, walls: ChamberWalls, s: np.ndarray, adjoint: np.ndarray) -> None:
        by_x, by_inverse = walls.pushed_vjp(s, adjoint)
        self.by_x, self.inverse = self.by_x + by_x, self.inverse + by_inverse

    def _of_all(self, by_target: np.ndarray) -> np.ndarray:
        """Among the numbers of all loads."""
        out = np.zeros(self.follower.shape[1])
        out[self.held.columns] = by_target
        return out

    def end(self, run) -> None:
        """Add what the beginning of the pass was to the stage."""
        self.rest += self.by_x
        self.held.put(run.u, 0, self.held.rows(run.u, 0) + self.by_x)

    def collect(self, out: Derived) -> None:
        nodes = self.held.nodes
        targets = getattr(out, self.held.numbers)
        targets += self.follower
        by_mass = np.zeros(len(out.displacement))
        by_mass[nodes] = -self.inverse[:, 0] / self.held.ws.arrays.values.mass[nodes] ** 2
        out.mass = out.mass + by_mass
        self.held.collect(out, self.rest)
        if self.drag >= 0:
            out.parameters[self.drag] += self.by_rate
