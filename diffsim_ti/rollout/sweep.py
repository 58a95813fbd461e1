"""What a rollout does with its solver: a forward sweep, and a reverse sweep from the states that a schedule keeps."""

import warnings

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.rollout.checkpoints import choose_schedule
from diffsim_ti.state.guard import Guard


class Sweeps:
    """n steps of a solver, forward and in reverse; the arguments are those of `Rollout` (rollout.py)."""

    wanted: tuple[str, ...] = ()
    clip: float | None = None
    truncate: int | None = None

    def __init__(self, solver, steps: int, save_every: int | None, checkpoint_every: int | None, memory: float | None):
        self.solver, self.scene, self.steps = solver, solver.scene, int(steps)
        if self.steps != steps or steps < 0:
            raise ValueError(f"steps must be a whole number >= 0, got {steps}")
        self.save_every = max(self.steps, 1) if save_every is None else int(save_every)
        if self.save_every < 1 or self.steps % self.save_every:
            raise ValueError(f"save_every = {save_every} must be >= 1 and divide steps = {steps}")
        self.num_frames = self.steps // self.save_every + 1
        self.values = self.scene.inputs.at_times(np.arange(self.steps + 1) * solver.dt)
        self.inputs = tuple(self.values)
        self.num_passes = solver.num_passes(self.steps)
        every = None if checkpoint_every is None else max(1, int(checkpoint_every)) * solver.substeps
        self.state_bytes = 4 * self.scene.mesh.num_vertices * runtime.NUMPY[self.scene.precision]().itemsize
        self.schedule = choose_schedule(self.num_passes, self.state_bytes, every, memory)
        self.health: list[dict] = []
        self._workspace, self._current, self._loaded, self._adjoint = None, None, None, None

    @property
    def times(self) -> np.ndarray:
        """Times of the frames [s]."""
        return np.arange(self.num_frames) * self.save_every * self.solver.dt

    @property
    def memory(self) -> float:
        """What the reverse sweep keeps [MB]: snapshots, recorded states."""
        return self.schedule.states() * self.state_bytes / 1e6

    def _start(self, values: dict) -> dict:
        unknown = [name for name in values if name not in self.inputs]
        if unknown:
            raise ValueError(f"no input named {unknown[0]!r}; this rollout has {', '.join(self.inputs)}")
        if self.solver.num_passes(self.steps) != self.num_passes:
            raise RuntimeError("the solver's substeps changed since this Rollout was made: make a new one")
        run = self.values | self.scene.inputs.check(values)
        self._current = None  # until the sweep is through
        if self._loaded is not None and all(run[name] is self._loaded[name] for name in run):
            self._workspace.restart()
            return run
        self.scene.inputs.check_steps(run, self.steps)
        derived = self.scene.inputs.derive(run)
        if self._workspace is None:
            self._workspace = self.solver.workspace(derived)
            self._workspace.make_frames(self.num_frames)
            self._snapshots = self._workspace.history(self.schedule.snapshots)
            self._guard = Guard(self._workspace)
        else:
            self._workspace.load(derived)
        self._loaded = run
        return run

    def _sweep_forward(self) -> None:
        """All passes; keeps the first snapshots of the schedule on the way."""
        ws, schedule = self._workspace, self.schedule
        self._guard.restart()
        self._recorded = schedule.num_segments == 1 and self._adjoint is not None  # a gradient was asked for before
        if self._recorded:
            ws.make_record(schedule.segment + 1)
        path = [0, *schedule.path(0, schedule.num_segments, schedule.snapshots - 1)]
        save = self.save_every * self.solver.substeps
        for k, segment in enumerate(path):
            ws.save(self._snapshots, k)
            first = schedule.bounds(segment)[0]
            last = schedule.bounds(path[k + 1])[0] if k + 1 < len(path) else self.num_passes
            self._guard.advance(first, last, self.num_passes, save, self._recorded)
        if self.solver.last_frame_is_state:
            ws.save_frame(self.num_frames - 1)
        self._kept = path

    def _record(self, first: int, last: int) -> None:
        """Passes first .. last - 1 from the current state, recorded."""
        ws = self._workspace
        ws.make_record(self.schedule.segment + 1)
        ws.restore_to_record()
        ws.advance(first, last, self.num_passes, base=first)

    @property
    def truncates(self) -> bool:
        """Whether the reverse sweep stops before it comes to the start."""
        return self.truncate is not None and self.truncate < self.steps

    def _mirror(self, begin, careful: bool):
        """The reverse sweep; begin(adjoint) sets the adjoints of the frames. Returns the adjoint at the start."""
        ws, schedule = self._workspace, self.schedule
        if self._adjoint is None or not self._adjoint.fits(ws):
            shape = "rest_positions" in self.wanted
            self._adjoint = self.solver.adjoint(
                ws, shape or "density" in self.wanted, shape
            )  # the rest shape makes masses
        adjoint = self._adjoint
        begin(adjoint)
        self.health = []
        stop = 0 if self.truncate is None else max(0, self.steps - self.truncate) * self.solver.substeps
        kept, end = self._kept, schedule.num_segments
        self._kept = kept[:1]  # the sweep overwrites the others, also if it does not get to its end
        while end > 0 and schedule.bounds(end - 1)[1] > stop:
            at = kept[-1]
            if self._recorded:
                self._reverse_segment(0, self.num_passes, stop, stop, careful)
                break
            ws.restore(self._snapshots, len(kept) - 1)
            for segment in schedule.path(at, end, schedule.snapshots - len(kept)):
                ws.advance(schedule.bounds(at)[0], schedule.bounds(segment)[0], self.num_passes)
                kept.append(segment)
                ws.save(self._snapshots, len(kept) - 1)
                at = segment
            first, last = schedule.bounds(end - 1)
            if at < end - 1:  # no snapshot is left: come here anew
                ws.advance(schedule.bounds(at)[0], first, self.num_passes)
            self._record(first, last)
            self._reverse_segment(first, last, max(first, stop), stop, careful)
            end -= 1
            if kept[-1] == end:
                kept.pop()
        if self.num_passes > stop:
            adjoint.finish()
        return adjoint

    def _sweep_reverse(self, positions_adj, velocities_adj, careful: bool) -> dict[str, np.ndarray]:
        last = self.solver.last_frame_is_state
        derived = self._mirror(lambda adjoint: adjoint.start(positions_adj, velocities_adj, last), careful).collect()
        if self.truncates:
            derived.displacement[:], derived.velocity[:] = 0, 0
        if not np.isfinite(derived.displacement.sum() + derived.velocity.sum() + derived.coefficients.sum()):
            if careful:
                raise FloatingPointError("the adjoint is not finite at the start of the run")
            return self._sweep_reverse(positions_adj, velocities_adj, careful=True)
        norms = [np.linalg.norm(np.asarray(x, np.float64)) for x in (positions_adj, velocities_adj)]
        self._warn_if_exploded(norms, [np.linalg.norm(x) for x in (derived.displacement, derived.velocity)])
        return self.scene.inputs.derive_vjp(self._current, derived, self.wanted)

    def _warn_if_exploded(self, of_frames, of_start) -> None:
        """Norms of the adjoints of displacements and velocities, where the sweep began and where it ended."""
        duration = max(self.steps, 1) * self.solver.dt
        start, end = (by_u + by_v / duration for by_u, by_v in (of_frames, of_start))
        if end > 1e8 * start > 0:
            warnings.warn(
                f"the adjoint grew by {end / start:.1g} over the run: the motion is chaotic or unstable, and this "
                "gradient is of little use; shorten the rollout, pass truncate=, or see gradient_health",
                stacklevel=4,
            )

    def _reverse_segment(self, first: int, last: int, stop: int, end: int, careful: bool) -> None:
        """Passes last - 1 .. stop of a segment that begins with pass `first`; the whole sweep stops at pass `end`."""
        save, adjoint = self.save_every * self.solver.substeps, self._adjoint
        if not careful:
            adjoint.reverse(first, last, self.num_passes, save, stop, to_state=0 < stop == end)
            return
        substeps, passes = self.solver.substeps, self.steps * self.solver.substeps
        while last > stop:
            begin = max(stop, (min(last, passes) - 1) // substeps * substeps)
            at_step = begin % substeps == 0 and begin < passes  # and not where a segment happens to begin
            adjoint.reverse(first, last, self.num_passes, save, begin, to_state=at_step and begin > 0)
            if at_step:
                self._look_at_adjoint(begin // substeps)
                if begin > end:
                    adjoint.reverse_kick(begin, first, self.num_passes)
            last = begin

    def _look_at_adjoint(self, step: int) -> None:
        """Between steps: report the running adjoint, and scale it back to `clip`."""
        by_position, by_velocity = self._adjoint.norm()
        if not np.isfinite(by_position + by_velocity):
            raise FloatingPointError(
                f"the adjoint became not finite in step {step} (t = {step * self.solver.dt:g} s): "
                "look at the loss and at how long the rollout stays smooth; parameters are unchanged"
            )
        scaled = 1.0
        norm = float(np.hypot(by_position, by_velocity))
        if self.clip is not None and norm > self.clip:
            scaled = self.clip / norm
            self._adjoint.scale(scaled)
        self.health.append({"step": step, "norm_position": by_position, "norm_velocity": by_velocity, "scaled": scaled})
