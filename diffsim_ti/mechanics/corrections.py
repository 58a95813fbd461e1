"""Corrections: stages that change on the host where a pass has led vertices, and their tangent and adjoint, which are found
from what they do (differentiation/arrays.py).

A pass begins with displacements u and leads to u* and v*, of which a correction makes u' and v'; of a velocity between two
kicks, v + pre a, it makes what a frame shows.
"""

import weakref
from contextlib import contextmanager, nullcontext
from functools import cached_property
from types import SimpleNamespace
from typing import ClassVar

import numpy as np

from diffsim_ti.differentiation.arrays import Recorded, forward_of_all, reverse_of_all, value_of
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.runtime.slots import VertexRows


class Correction:
    """A stage (mechanics/stage.py) of the vertices `nodes`, whose vectors have the shape (n, 3).

    `of` has the numbers that it reads: masses and rest positions of the vertices, and the arrays of `Derived` in `reads`. It
    is made anew for each pass, and may keep what is found of them once.
    kept: of recorded passes, by the slot they led to: (u*, v*, what the correction found), None where it did nothing.
    work [J] that the stage adds to what passes note of loads.
    """

    reads: ClassVar[tuple[str, ...]] = ()
    in_kicks = False

    def __init__(self, workspace, nodes: np.ndarray):
        self.ws, self.nodes = weakref.proxy(workspace), nodes
        self.free = workspace.scene.supports.freedom(workspace.scene.mesh.num_vertices)[nodes]
        self._own = VertexRows(workspace.arrays, nodes)
        self.rows, self.put = self._own.get, self._own.put
        self.kept, self.work = {}, 0.0

    # ---- what a correction writes, of arrays that record too --------------------------------------------------------------

    def ends(self, of, at: Passes, u: np.ndarray, y: np.ndarray, v: np.ndarray, found=None) -> tuple:
        """(u', v', what is found) of y = u* and v = v*; found: what it was, where derivatives follow."""
        raise NotImplementedError(
            f"{type(self).__name__} corrects displacements: it writes ends(of, at, u, y, v, found)"
        )

    def shown(self, of, at: Passes, u: np.ndarray, v: np.ndarray, found=None) -> tuple:
        """(what a frame shows of v, what is found); found: constant forces of constraint."""
        raise NotImplementedError(f"{type(self).__name__} corrects velocities: it writes shown(of, at, u, v, found)")

    def note(self, at: Passes, found) -> None:
        """A pass has found this."""

    def record_of(self, run):
        """What keeps changes and adjoints of `seen` in frames, if there is any."""

    def seen(self, of, at: Passes, found) -> np.ndarray:
        """What frames say of what was found."""

    def with_buffers(self, way: str, run) -> Stage:
        return CorrectionTangent(self, run) if way == "tangent" else CorrectionAdjoint(self, run)

    # ---- a pass ----------------------------------------------------------------------------------------------------------

    def numbers_of(self, values: Derived) -> dict[str, np.ndarray]:
        """What `of` has, of numbers or their changes."""
        own = dict(mass=values.mass[self.nodes], rest=values.rest[self.nodes])
        return own | {name: getattr(values, name) for name in self.reads}

    def frame(self, at: Passes) -> int:
        """The frame whose velocity a pass shows between its kicks, or -1."""
        return int(self.ws.solver.schedule.shown(at.j, at.save_every)) if at.now.pre > 0 else -1

    def freed(self, x: np.ndarray) -> np.ndarray:
        """What vertices may do of vectors."""
        return np.einsum("nij,nj->ni", self.free, x)

    @contextmanager
    def do(self, at: Passes):
        history, slot, end, now = at.history, at.slot, at.end, at.now
        u, before = self.rows(history.u, slot), self.rows(history.v, slot)
        yield
        of, self.kept[end] = SimpleNamespace(**self.numbers_of(self.ws.arrays.now)), None
        y, v = self.rows(history.u, end), self.rows(history.v, end)
        if not np.all(np.isfinite(y)):  # the guard of the run will say so
            return
        u_next, v_next, found = self.ends(of, at, u, y, v)
        self.put(history.u, end, u_next)
        self.put(history.v, end, v_next)
        self.note(at, found)
        if at.stride:
            self.kept[end] = y, v, found
        # as `work_of_pass` (outside_work.py) has it of loads; (pre^2 - post^2) times the body's own acceleration
        change, after, whole = (v_next - v) / now.decay, v / now.decay, now.pre + now.post
        uneven = (now.pre - now.post) * (after - before) / whole
        self.work += 0.5 * float((of.mass[:, None] * change * (before + after + change + uneven)).sum())
        frame = self.frame(at)
        if frame >= 0:
            frames = self.ws.frames.frames_v
            self.put(frames, frame, self.shown(of, at, u, self.rows(frames, frame))[0])

    def alone(self, at: Passes):
        """A recorded pass without the stage; then the record is what it was."""
        kept = self.kept.get(at.end)
        return nullcontext() if kept is None else self._own.replaced(at.history, at.end, *kept[:2])


class RecordedPass:
    """A pass of the record: leaves of what its correction depends on, and what that makes of them."""

    def __init__(self, stage: Correction, at: Passes):
        self.stage, self.at, self.kept = stage, at, stage.kept.get(at.end)
        self.leaves = {name: Recorded(x) for name, x in stage.numbers_of(stage.ws.arrays.now).items()}
        self.of, self.u = SimpleNamespace(**self.leaves), Recorded(stage.rows(at.history.u, at.slot))
        self.y, self.v = map(Recorded, (self.kept or (None, None))[:2])

    @cached_property
    def between(self) -> Recorded:
        """v + pre a."""
        stage, at, arrays = self.stage, self.at, self.stage.ws.arrays
        a = stage.rows(at.history.f, at.slot) / self.of.mass.value[:, None] + arrays.gravity_of(arrays.values)
        return Recorded(stage.rows(at.history.v, at.slot) + at.now.pre * stage.freed(a))

    @cached_property
    def ends(self) -> tuple:
        return self.stage.ends(self.of, self.at, self.u, self.y, self.v, self.kept[2])

    @cached_property
    def shown(self) -> tuple:
        return self.stage.shown(self.of, self.at, self.u, self.between)

    def tangent(self, values: list, changes: dict, *states: tuple) -> list[np.ndarray]:
        """Changes of values for those of numbers, and of states, (leaf, change) each."""
        return forward_of_all(values, [*((self.leaves[name], change) for name, change in changes.items()), *states])

    def adjoint(self, sums: dict, seeds: list[tuple], *states: Recorded) -> list[np.ndarray]:
        """Adjoints of states; adds those of numbers to `sums`."""
        for name, leaf in self.leaves.items():
            leaf.zeros = lambda name=name: sums[name]
        found = reverse_of_all(seeds, [*states, *self.leaves.values()])
        for name, x in zip(self.leaves, found[len(states) :]):
            if x is not None and x is not sums[name]:
                sums[name] += x
        return [0.0 if x is None else x for x in found[: len(states)]]


class CorrectionTangent(Stage):
    """Of a run, which holds the changes of the state and of frames, and those of all else."""

    def __init__(self, stage: Correction, run):
        self.stage, self.changes, self.record = stage, stage.numbers_of(run.tangent), stage.record_of(run)

    @contextmanager
    def tangent(self, at: Passes):
        stage, run = self.stage, at.run
        du = stage.rows(run.u, 0)
        with stage.alone(at):
            yield
        one, frame = RecordedPass(stage, at), stage.frame(at)
        if one.kept:
            states = (one.u, du), (one.y, stage.rows(run.u, 0)), (one.v, stage.rows(run.v, 0))
            *values, found = one.ends
            seen = self.record and found is not None
            values += [stage.seen(one.of, at, found)] if seen else []
            u, v, *more = one.tangent(values, self.changes, *states)
            stage.put(run.u, 0, u)
            stage.put(run.v, 0, v)
            if seen:
                self.record.note(at.j, at.save_every, more[0])
        if frame >= 0:
            states = (one.u, du), (one.between, stage.rows(run.frames.frames_v, frame))
            stage.put(run.frames.frames_v, frame, one.tangent(one.shown[:1], self.changes, *states)[0])


class CorrectionAdjoint(Stage):
    """Of a run, which holds the adjoints of the state and of frames: sums over passes.

    Where a sweep stops at the state that a pass shows, between its kicks, that state is what the correction shows, of which
    all later ones are functions likewise: v + pre a is it less constant forces of constraint. The kick before it is gone
    back through by itself.
    """

    in_kicks = True

    def __init__(self, stage: Correction, run):
        self.stage, self.record = stage, stage.record_of(run)

    def clear(self) -> None:
        self.sums = {name: np.zeros_like(x) for name, x in self.stage.numbers_of(self.stage.ws.arrays.now).items()}

    def _show(self, one: RecordedPass, array, slot: int) -> np.ndarray:
        """From the adjoint of what is shown to that of the velocity; returns that of u."""
        by_u, by_v = one.adjoint(self.sums, [(one.shown[0], self.stage.rows(array, slot))], one.u, one.between)
        self.stage.put(array, slot, by_v)
        return by_u

    @contextmanager
    def adjoint(self, at: Passes):
        stage, run, one = self.stage, at.run, RecordedPass(self.stage, at)
        if at.kick:
            self._add(run, self._show(one, run.v, 0))
            yield
            return
        run.complete()
        by_u, frame, halts = 0.0, stage.frame(at), at.j == at.halt
        if one.kept:
            *ends, found = one.ends
            seeds = [(end, stage.rows(array, 0)) for array, end in zip((run.u, run.v), ends)]
            if self.record and found is not None:
                seeds.append((stage.seen(one.of, at, found), self.record.adjoint(at.j, at.save_every)))
            by_u, by_y, by_v = one.adjoint(self.sums, seeds, one.u, one.y, one.v)
            stage.put(run.u, 0, by_y)
            stage.put(run.v, 0, by_v)
        if frame >= 0 and not halts:
            by_u = by_u + self._show(one, run.frames.frames_v, frame)
        with stage.alone(at):
            yield
        if halts and at.now.pre > 0:
            of_frame = stage.rows(run.frames.frames_v, frame) if frame >= 0 else 0.0
            held = stage.shown(one.of, at, one.u, one.between.value, value_of(one.shown[1]))[0]
            by_u = by_u + one.adjoint(self.sums, [(held, of_frame - stage.rows(run.v, 0))], one.u)[0]
        self._add(run, by_u)

    def _add(self, run, by_u: np.ndarray) -> None:
        """Add what the beginning of the pass was to the stage."""
        self.stage.put(run.u, 0, self.stage.rows(run.u, 0) + by_u)

    def collect(self, out: Derived) -> None:
        for name, x in self.sums.items():
            if name in ("mass", "rest"):
                of_all = np.zeros_like(getattr(out, name))
                of_all[self.stage.nodes] = x
                x = of_all
            setattr(out, name, getattr(out, name) + x)
