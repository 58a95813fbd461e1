"""n steps of a solver on the device: forward, in reverse from kept states, and in tangents."""

import math
from collections.abc import Callable, Iterable
from functools import cached_property

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.checked import as_numbers, listed, number, whole
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import Derived
from diffsim_ti.monitor.guard import Guard
from diffsim_ti.outputs.output import NOTED
from diffsim_ti.rollout.checkpoints import choose_checkpoints
from diffsim_ti.rollout.run import Run, Seed
from diffsim_ti.rollout.set_values import MOVED
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.substeps import RunSubsteps
from diffsim_ti.state.bending import FacesBend
from diffsim_ti.state.watch import ContactResolution
from diffsim_ti.terms import Robot

RECORD_BYTES = 200e6  # up to which the first run of implicit solvers is recorded


class Sweep:
    """Runs of a solver over `steps` steps: `run`, `pull_back` (adjoints) and `push_forward` (tangents).

    NumPy, `ti.ad.Tape` and torch read the same `Run`: its frames are in `workspace.frames` until the next one. A run that
    was overwritten is done again where its adjoint is asked for; one whose passes are all recorded still is not, however
    many seeds are pulled back. The arguments are those of `Rollout` (rollout.py).
    """

    def __init__(
        self,
        solver: Solver,
        steps: int,
        save_every: int | None = None,
        checkpoint_every: int | None = None,
        memory: float | None = None,
        gradients: str | Iterable[str] | None = None,
        clip: float | None = None,
        truncate: int | None = None,
        health: bool = False,
        contacts: frozenset = frozenset(),
        chambers: bool = False,
        law_states: bool = False,
        raise_errors: bool = True,
    ):
        if True in contacts:
            solver.check_contact_forces()
        self.raise_errors, self.last_error = raise_errors, None  # what stopped the last run
        self.contacts = (
            contacts  # what runs note of contact, of each vertex in each frame (`Output.reads_contact_forces`)
        )
        self.chambers = chambers and solver.scene.holds_volumes  # whether pressures in chambers are wanted of frames
        self.law_states = law_states and bool(solver.scene.law.state_names)  # whether what the law remembers is
        self.joints = bool(solver.scene.terms_of(Robot))
        self.solver, self.scene, self.steps = solver, solver.scene, steps
        self.save_every = max(steps, 1) if save_every is None else whole("save_every", save_every, 0)
        if self.save_every < 1 or steps % self.save_every:
            raise ValueError(f"save_every = {save_every} must be >= 1 and divide steps = {steps}")
        self.num_frames = self.steps // self.save_every + 1
        self.values = self.scene.inputs.at_times(solver.schedule.time(np.arange(self.steps + 1)))
        solver.check_run(self.values)
        self.inputs = tuple(self.values)
        self.wanted = self._check_names(gradients)
        self.clip = None if clip is None else number("clip", clip)
        self.truncate = None if truncate is None else whole("truncate", truncate)
        self.careful = health or clip is not None
        self._memory = None if memory is None else number("memory", memory, unit="MB")
        self._every = None if checkpoint_every is None else whole("checkpoint_every", checkpoint_every, 0)
        self.health: list[dict] = []
        self.first_step = 0  # steps that came before those of a run, for reports
        self.state_bytes = 4 * self.scene.mesh.num_vertices * runtime.NUMPY[self.scene.precision]().itemsize
        self.run_substeps = RunSubsteps(solver, self.values) if solver.automatic else None
        self._plan()
        self.workspace = None  # made by the first run
        self.bend = 0.0  # how far faces bend in the last run [m] (state/bending.py)
        self._name = object()  # that runs bear
        self._loaded, self._started = None, False  # the values that are on the device; whether the run began elsewhere
        self._current = None  # the run whose frames and snapshots the workspace holds
        self._adjoint = None  # the solver's, made by the first pull-back
        self.noted_changes: dict[str, np.ndarray] = {}  # of what runs note, by the last tangent
        self._recorded, self._warned = False, False  # whether the record holds all passes; whether of coarse contacts

    def _plan(self) -> None:
        """Choose the states that are kept, for the solver's substeps."""
        self.num_passes = self.solver.num_passes(self.steps)
        a_step = self.num_passes / max(self.steps, 1)
        every = None if self._every is None else max(1, round(max(1, self._every) * a_step))
        places = -(-self.scene.mesh.num_tetrahedra // runtime.LANES) * runtime.LANES
        law_state = places * len(self.scene.law.state_names) / (4 * self.scene.mesh.num_vertices)
        kept = int(self.state_bytes * self.held)
        self.checkpoints = choose_checkpoints(self.num_passes, kept, every, self._memory, law_state)

    held = 1  # states that one of the kept ones has room for

    def fit(self, each: list[dict]) -> None:
        """See to it that substeps which were left to the solver suit the values of a run, those of each scene of a batch."""
        if self.solver.automatic:
            solver = self.run_substeps.fit(each)
            if solver.substeps != self.solver.substeps:
                self.solver = solver
                self._plan()

    def _check_names(self, names) -> tuple[str, ...]:
        self.wants_shape = False  # the sum of these by initial and by rest positions (set_values.py)
        if names is None:
            return tuple(name for name in self.inputs if name != "rest_positions")
        if isinstance(names, str):
            names = self.inputs if names == "all" else (names,)
        names = tuple(listed("gradients", names, "names of inputs"))
        self.wants_shape = "shape" in names
        if self.wants_shape:
            names = tuple(dict.fromkeys((*(name for name in names if name != "shape"), *MOVED)))
        unknown = [name for name in names if name not in self.inputs]
        if unknown:
            raise ValueError(f"gradients: {self.scene.inputs.no_input(unknown[0], 'this rollout', self.inputs)}")
        return names

    @property
    def frame_time(self) -> np.ndarray:
        """Time of each frame since the one before [s], shape (frames, 1, 1, 1, 1); the first has that of the second."""
        times = [self.solver.schedule.frame_time(max(k, 1), self.save_every) for k in range(self.num_frames)]
        return np.reshape(times if self.steps else [1.0], (-1, 1, 1, 1, 1))

    @cached_property
    def noted(self) -> tuple[str, ...]:
        """What frames hold besides states, by name."""
        return tuple(
            n for n, asked in zip(NOTED, (self.contacts, self.chambers, self.law_states, self.joints)) if asked
        )

    def noted_values(self) -> dict[str, np.ndarray]:
        """The same of the last run."""
        ws = self.workspace
        return self._noted(ws, lambda: ws.chamber_pressures(self.num_frames, self.save_every))

    def _noted(self, of, chamber_pressures: Callable) -> dict[str, np.ndarray]:
        """What a workspace or a tangent has of what frames hold besides states."""
        contact_forces, law_state = lambda: of.contact_forces(self.frame_time), lambda: of.law_frames.values()
        joints = lambda: np.array([of.joint_frames[0] if x is None else x for x in of.joint_frames])  # noqa: E731
        make = dict(zip(NOTED, (contact_forces, chamber_pressures, law_state, joints)))
        return {name: make[name]() for name in self.noted}

    @property
    def truncates(self) -> bool:
        """Whether the reverse sweep stops before it comes to the start."""
        return self.truncate is not None and self.truncate < self.steps

    # ---- what a sweep of many scenes makes in another way (batch/sweep.py) --------------------------------------------

    def _derive(self, values: dict):
        return self.scene.inputs.derive(values)

    def make_workspace(self, derived):
        return self.solver.workspace(derived, self.bend)

    def take_bend(self, bend: float) -> None:
        """Faces bend so far from here on [m]."""
        self.bend, self.workspace, self._adjoint, self._loaded, self._current = bend, None, None, None, None

    def _make_guard(self):
        return Guard(self.workspace)

    def make_adjoint(self, density: bool, shape: bool):
        return self.solver.adjoint(self.workspace, density, shape)

    def _make_tangent(self, change):
        return self.solver.tangent(self.workspace, change)

    # ---- forward ----------------------------------------------------------------------------------------------------

    def run(self, values: dict, start: Callable | None = None, law_state=None) -> Run:
        """Run from the scene's inputs with some values replaced; see `Run` for the rest."""
        run, self.last_error = Run(self._checked(values), start, self.first_step, law_state), None
        if self.bend:  # of the run before
            self.take_bend(0.0)
        self.fit([run.values])
        try:
            self._forward(run)
        except FloatingPointError as error:
            if self.raise_errors:
                raise
            run.error = self.last_error = error
            last = self.last_good(run)
            for frames in self.workspace.frames:
                for k in range(last + 1, self.num_frames):
                    copy_slot(frames, last, frames, k)
        run.contacts = self.workspace.watch.seen_so_far()
        return run

    def last_good(self, run: Run) -> int:
        """The last frame of a run before what stopped it, if something did."""
        if run.error is None:
            return self.num_frames - 1
        return max(0, getattr(run.error, "step", 0) - run.first_step) // self.save_every

    def bring_back(self, run: Run) -> None:
        """See to it that frames and kept states are those of a run that came to its end."""
        if self._current is not run:
            again = run.seen_by is self._name
            run.values = self._checked(run.values)  # which may be another rollout's
            self._forward(run, again)

    def _checked(self, values: dict) -> dict:
        """All values of a run: copies of those given, for callers may change theirs, or what is loaded if it is the same."""
        unknown = [name for name in values if name not in self.inputs]
        if unknown:
            raise ValueError(self.scene.inputs.no_input(unknown[0], "this rollout", self.inputs))
        known, kept, given = self._loaded or self.values, {}, {}
        for name, value in values.items():
            self.scene.inputs.warn_if_coarse(name, value)
            value, before = as_numbers(name, value), known[name]
            if value is before or value.shape == before.shape and (value == before).all():
                kept[name] = before  # and was checked
            else:
                given[name] = value.copy()
        out = self.values | kept | self.scene.inputs.check(given)
        self.scene.inputs.check_steps(out, self.steps)
        return out

    def _load(self, run: Run) -> None:
        """Put a run's inputs and its start on the device."""
        if self.solver.num_passes(self.steps) != self.num_passes:
            raise RuntimeError("the solver's substeps changed since this Rollout was made: make a new one")
        self._current = None  # until the sweep is through
        values = run.values
        if run.bend not in (None, self.bend):
            self.take_bend(run.bend)
        if self._loaded is not None and all(value is self._loaded[name] for name, value in values.items()):
            self.workspace.restart()
            if self._started:
                self.workspace.check_apart()
        else:
            derived, self._loaded = self._derive(values), None
            if self.workspace is None:
                self.workspace = self.make_workspace(derived)
                self.workspace.make_frames(self.num_frames)
                if self.contacts:
                    self.workspace.record_contacts(self.contacts)
                if self.law_states:
                    self.workspace.record_law_states()
                self._snapshots = self.workspace.history(self.checkpoints.snapshots)
                self._guard = self._make_guard()
            else:
                self.workspace.load(derived)
            self._loaded = values
        if run.law_state is not None:
            run.law_state = self.workspace.checked_law_state(run.law_state).copy()
            self.workspace.set_law_state(run.law_state)
        self._started = run.start is not None  # elsewhere than the values say
        if self._started:
            run.start(self.workspace)
            self.workspace.forget()

    def _forward(self, run: Run, again: bool = False) -> None:
        """All passes; keeps the first snapshots on the way. again: the guard has seen this run come to its end."""
        while True:
            try:
                return self._forward_as_bent(run, again)
            except FacesBend as bent:
                self.take_bend(bent.bend)

    def _forward_as_bent(self, run: Run, again: bool) -> None:
        self._load(run)
        ws, checkpoints = self.workspace, self.checkpoints
        self._guard.restart()
        advance = self._guard.advance_again if again else self._guard.advance
        if self.contacts:
            ws.forget_contacts()
        self.workspace.first_step = run.first_step
        self._recorded = checkpoints.num_segments == 1 and self._expects_gradient()
        if self._recorded:
            ws.make_record(checkpoints.segment + 1)
        ws.report.clear()
        path = [0, *checkpoints.path(0, checkpoints.num_segments, checkpoints.snapshots - 1)]
        for k, segment in enumerate(path):
            ws.save(self._snapshots, k)
            first = checkpoints.bounds(segment)[0]
            last = checkpoints.bounds(path[k + 1])[0] if k + 1 < len(path) else self.num_passes
            with ws.report.of_passes(last - first):
                advance(first, last, self.num_passes, self.save_every, self._recorded)
        if self.solver.last_frame_is_state:
            ws.save_frame(self.num_frames - 1)
        run.seen_by, run.bend = self._name, self.bend
        self._kept, self._current = path, run  # segments whose starts are in the snapshots

    def _expects_gradient(self) -> bool:
        """Whether a run is worth its record: one was asked for before, or passes are solves, which cost more than that."""
        solves = not self.solver.explicit and bool(self.wanted)
        size = self.checkpoints.states() * self.state_bytes * self.held
        return self._adjoint is not None or solves and size <= RECORD_BYTES

    def _record(self, first: int, last: int) -> None:
        """Passes first .. last - 1 from the current state, recorded."""
        ws = self.workspace
        ws.make_record(self.checkpoints.segment + 1)
        ws.restore_to_record()
        ws.advance(first, last, self.num_passes, base=first)
        self._recorded = self.checkpoints.num_segments == 1

    # ---- tangents ---------------------------------------------------------------------------------------------------

    def push_forward(self, run: Run, change: Derived) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities, float64, for a change of what kernels read."""
        if run.error is not None:
            raise run.error
        current, recorded = self._current, self._recorded and self._current is run
        if not recorded:
            self._load(run)
        self._current = None  # until the sweep is through
        ws, checkpoints, tangent = self.workspace, self.checkpoints, self._make_tangent(change)
        for k in range(checkpoints.num_segments):
            first, last = checkpoints.bounds(k)
            if not recorded:
                self._record(first, last)
            tangent.advance(first, last, self.num_passes, self.save_every)
            ws.restore(ws.record, last - first)
        if self.solver.last_frame_is_state:
            tangent.save_frame(self.num_frames - 1)
        self._current = run if current is run else None  # its frames and snapshots are untouched
        self.noted_changes = self._noted(tangent, lambda: tangent.chamber_record.changes(self.num_frames))
        return tangent.collect()

    # ---- adjoints ---------------------------------------------------------------------------------------------------

    def pull_back(self, run: Run, seed: Seed) -> Derived:
        """Adjoints of what kernels read at the start of a run.

        Raises FloatingPointError, naming the step, where an adjoint is not finite. Warns of contacts that the steps
        hardly resolve, of an adjoint that grew out of use, and of a run that was stopped, whose adjoints are zero.
        """
        if run.error is not None:
            return self._no_adjoints(run, seed)
        self.bring_back(run)
        if not (run.contact_resolution.resolved or self._warned):
            self._warned = True
            _warn_of_coarse_steps(self.solver, run.contact_resolution)
        of_frames = self._reverse(seed, self.careful)
        derived, of_start = seed.collect(self._adjoint, self.truncates)
        if not math.isfinite(sum(of_start) + derived.coefficients.sum()):
            if not self.careful:
                self._reverse(seed, True)  # raises where it happens
            raise FloatingPointError("the adjoint is not finite at the start of the run")
        if all(seed.noted[name] is None for name in self.noted):  # whose seeds are no adjoints of places
            _warn_of_explosion(of_frames, of_start, float(self.solver.schedule.time(self.steps)) or self.solver.dt)
        return derived

    def _no_adjoints(self, run: Run, seed: Seed) -> Derived:
        warn(f"the gradient of a run that was stopped is zero: {run.error}")
        self._make_ready()
        seed.put(self._adjoint, self.solver.last_frame_is_state)
        derived, _ = seed.collect(self._adjoint, True)
        for part in derived.parts().values():
            if part is not None:
                part[...] = 0
        return derived

    def _make_ready(self) -> None:
        """The solver's adjoint."""
        if self._adjoint is None or not self._adjoint.fits(self.workspace):
            shape = "rest_positions" in self.wanted
            density = shape or "density" in self.wanted  # the rest shape makes masses
            self._adjoint = self.make_adjoint(density, shape)

    def _reverse(self, seed: Seed, careful: bool) -> tuple[float, float]:
        """The reverse sweep; the norms of its seed."""
        ws, checkpoints = self.workspace, self.checkpoints
        self._make_ready()
        norms, self.health = seed.put(self._adjoint, self.solver.last_frame_is_state), []
        if self.contacts:
            self._adjoint.seed_contacts(seed.noted["contact_forces"], self.frame_time)
        if self.chambers:
            self._adjoint.chamber_record.adjoints = seed.noted["chamber_pressures"]
        if self.law_states:
            self._adjoint.law_frames.put(seed.noted["law_state"])
            if self.solver.last_frame_is_state:
                self._adjoint.law_frames.add_to(self._adjoint.z, self.num_frames - 1)
        if self.joints:
            self._adjoint.joints.seed_frames(seed.noted["joint_states"])
        stop = 0 if self.truncate is None else self.solver.schedule.first(max(0, self.steps - self.truncate))
        kept, end = self._kept, checkpoints.num_segments
        self._kept = kept[:1]  # the sweep overwrites the others, also if it does not get to its end
        while end > 0 and checkpoints.bounds(end - 1)[1] > stop:
            at = kept[-1]
            if self._recorded:
                self._reverse_segment(0, self.num_passes, stop, stop, careful)
                break
            ws.restore(self._snapshots, len(kept) - 1)
            for segment in checkpoints.path(at, end, checkpoints.snapshots - len(kept)):
                ws.advance(checkpoints.bounds(at)[0], checkpoints.bounds(segment)[0], self.num_passes)
                kept.append(segment)
                ws.save(self._snapshots, len(kept) - 1)
                at = segment
            first, last = checkpoints.bounds(end - 1)
            if at < end - 1:  # no snapshot is left: come here anew
                ws.advance(checkpoints.bounds(at)[0], first, self.num_passes)
            self._record(first, last)
            self._reverse_segment(first, last, max(first, stop), stop, careful)
            end -= 1
            if kept[-1] == end:
                kept.pop()
        if self.num_passes > stop:
            self._adjoint.finish()
        if self.joints and self.truncates:
            self._adjoint.joints.clear()
        return norms

    def _reverse_segment(self, first: int, last: int, stop: int, end: int, careful: bool) -> None:
        """Passes last - 1 .. stop of a segment that begins with pass `first`; the whole sweep stops at pass `end`."""
        save, adjoint, schedule = self.save_every, self._adjoint, self.solver.schedule
        if not careful:
            adjoint.reverse(first, last, self.num_passes, save, stop, 0 < stop == end)
            return
        passes = int(schedule.first(self.steps))
        while last > stop:
            begin = max(stop, int(schedule.first(schedule.row(min(last, passes) - 1))))
            step = int(schedule.row(begin))
            at_step = begin == schedule.first(step) and begin < passes  # and not where a segment happens to begin
            adjoint.reverse(first, last, self.num_passes, save, begin, at_step and begin > 0)
            if at_step:
                self._check_adjoint(step)
                if begin > end:
                    adjoint.reverse_kick(begin, first, self.num_passes)
            last = begin

    def _check_adjoint(self, step: int) -> None:
        """Between steps: report the running adjoint, and scale it back to `clip`."""
        by_position, by_velocity = self._adjoint.norm()
        if not np.isfinite(by_position + by_velocity):
            now = self.workspace.first_step + step
            raise FloatingPointError(
                f"the adjoint became not finite in step {now} (t = {self.solver.schedule.time(now):g} s): "
                "check the loss and how long the rollout stays smooth; parameters are unchanged"
            )
        scaled, norm = 1.0, float(np.hypot(by_position, by_velocity))
        if self.clip is not None and norm > self.clip:
            scaled = self.clip / norm
            self._adjoint.scale(scaled)
        self.health.append({"step": step, "norm_position": by_position, "norm_velocity": by_velocity, "scaled": scaled})


def _warn_of_coarse_steps(solver: Solver, seen: ContactResolution) -> None:
    """Contacts that the steps hardly resolve."""
    damped = solver.stages_contact and solver.contact_damping > 0
    warn(
        f"gradients through contacts may be off by more than 10 %: {seen}; take substeps of at most "
        f"{seen.advised_substep:.3g} s instead of {seen.substep:.3g} s, or a softer or wider barrier"
        + (", or a smaller contact_damping" if damped else "")
    )


def _warn_of_explosion(of_frames: tuple, of_start: tuple, duration: float) -> None:
    """An adjoint that grew, by its norms (by displacements, by velocities) where the sweep began and where it ended;
    duration [s] of the run."""
    start, end = (by_u + by_v / duration for by_u, by_v in (of_frames, of_start))
    if end > 1e8 * start > 0:
        warn(
            f"the adjoint grew by {end / start:.1g} over the run: the motion is chaotic or unstable, and this "
            "gradient is of little use; shorten the rollout, pass truncate=, or see gradient_health"
        )
