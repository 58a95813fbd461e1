"""n steps of many scenes side by side: forward, in reverse from kept states, and in tangents."""

from collections.abc import Callable

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.adjoint import BatchAdjoint, BatchTangent
from diffsim_ti.batch.workspace import BatchWorkspace
from diffsim_ti.inputs import Derived
from diffsim_ti.rollout.run import HostSeed, Run
from diffsim_ti.rollout.sweep import Sweep
from diffsim_ti.state.watch import ContactResolution, ContactWatch, limits, worst


class Own(tuple):
    """The values of an input, one array for each scene."""


class BatchValues(dict):
    """Values of all inputs, those of scenes as `Own`; `derived` is what kernels read of each scene, once it is known."""

    derived: list[Derived] | None = None


def value_of(value, b: int) -> np.ndarray:
    """What scene b has of it."""
    return value[b] if isinstance(value, Own) else value


class FrameByFrame:
    """Takes scenes from frame to frame and notes when one of them gets onto or behind an obstacle."""

    def __init__(self, workspace: BatchWorkspace):
        self.ws = workspace
        self.restart()

    def restart(self) -> None:
        self.crossed: dict[int, int] = {}  # {scene: pass before which it was seen}

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, recording: bool = False) -> None:
        schedule = self.ws.solver.schedule
        for begin, end in schedule.stretches(first, last):
            self.ws.substep = float(schedule.length(begin))
            self._advance(begin, end, num_passes, save_every, recording)
            if schedule.varies:
                self.ws.close(self.ws.substep)

    advance_again = advance

    def _advance(self, first: int, last: int, num_passes: int, save_every: int, recording: bool) -> None:
        """The same where all passes have one length."""
        ws, contacts = self.ws, bool(self.ws.arrays.contacts)
        if recording:
            ws.save(ws.record, first)
        while first < last:
            stop = last
            if contacts:
                schedule = ws.solver.schedule
                every = max(save_every, 1)
                frame = (int(schedule.row(first)) // every + 1) * every
                if frame <= int(schedule.row(num_passes - 1)):
                    stop = min(last, int(schedule.first(frame)))
                stop = max(stop, first + 1)
            ws.advance(first, stop, num_passes, save_every, 0 if recording else None)
            if contacts:
                for b in np.flatnonzero(ws.smallest_gaps() <= 0):
                    self.crossed.setdefault(int(b), first)
            first = stop
        if recording:
            ws.restore(ws.record, last)


class BatchSweep(Sweep):
    """Runs of many scenes; values are arrays that all share, or `Own`."""

    def __init__(self, solver, steps: int, num_scenes: int, memory: float | None = None, **options):
        self.num_scenes = num_scenes
        super().__init__(solver, steps, memory=memory, **options)

    @property
    def held(self) -> float:
        whole = -(-self.num_scenes // runtime.LANES) * runtime.LANES  # in blocks, of vectors of three; else of four
        return whole / 4 * 3 if runtime.runs_on_cpu() else self.num_scenes

    def values_of(self, values: dict, b: int) -> dict:
        """The values of scene b."""
        return {name: value_of(value, b) for name, value in values.items()}

    def _checked(self, values: dict) -> dict:
        return values

    def _derive(self, values: BatchValues) -> list[Derived]:
        if values.derived is None:
            own = {name: x for name, x in values.items() if isinstance(x, Own)}
            changed = [{name: x[b] for name, x in own.items()} for b in range(self.num_scenes)]
            try:
                values.derived = self.scene.inputs.derive_each(self.values_of(values, 0), changed)
            except ValueError:
                self._name_scene(values)
                raise
        return values.derived

    def _name_scene(self, values: BatchValues) -> None:
        """Raise what the first scene says whose values are refused."""
        for b in range(self.num_scenes):
            try:
                self.scene.inputs.derive(self.values_of(values, b))
            except ValueError as error:
                error.args = (f"scene {b}: {error}",)
                raise

    def make_workspace(self, derived):
        return BatchWorkspace(self.solver, derived)

    def _make_guard(self):
        return FrameByFrame(self.workspace)

    def make_adjoint(self, density: bool, shape: bool):
        return BatchAdjoint(self.workspace, density, shape)

    def _make_tangent(self, change):
        return BatchTangent(self.workspace, change)

    def run(self, values: dict, start=None) -> Run:
        """Run from values that are complete and checked."""
        run = Run(values, start, self.first_step)
        self._forward(run)
        return run

    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """Displacements and velocities of the frames of the last run, (scenes, frames, n, 3)."""
        ws = self.workspace
        return ws.layout.unpack_vectors(ws.frames.frames_u), ws.layout.unpack_vectors(ws.frames.frames_v)

    def crossed(self) -> dict[int, int]:
        """{scene: the step in which it got behind an obstacle}"""
        return {b: int(self.solver.schedule.row(j)) for b, j in self._guard.crossed.items()}

    left: tuple | list = ()  # scenes that are to be run alone

    def resolutions(self) -> Callable[[int], ContactResolution]:
        """What contacts of scene b did in the last run, worked out when it is asked for."""
        ws, derived = self.workspace, self.workspace.derived
        watch, largest, parts = ContactWatch(ws), limits(self.solver), [*ws.parts, (ws.seen(), ws.substep)]

        def of(b: int) -> ContactResolution:
            seen = [watch.resolution_of(rows[b], derived[b], h, largest) for rows, h in parts]
            return worst(seen) if watch.contacts else seen[-1]

        return of

    def pull_back(self, run: Run, seed: HostSeed) -> Derived:
        """Adjoints, from those of the frames, of what kernels read at the start; the scenes are their first axis."""
        self.bring_back(run)
        self._reverse(seed, False)
        out = self._adjoint.collect()
        if self.truncates:
            out.displacement[:], out.velocity[:] = 0, 0
        return out

    def push_forward(self, run: Run, change: list[Derived]) -> tuple[np.ndarray, np.ndarray]:
        du, dv = super().push_forward(run, change)
        return du + np.stack([d.rest for d in change])[:, None], dv
