"""Work of loads on a body, frame after frame."""

from copy import copy

import numpy as np

from diffsim_ti.outputs.forces_at_frames import AppliedLoads
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene


class WorkOfLoads(Output):
    """Work [J] that loads have done on the body since the first frame, shape (frames,): the sum over the frames before of

        W_k - W_(k-1) = 1/6 [F_b(a) + 2 F_b(m) + 2 F_e(m) + F_e(b)] . (b - a),        m = (a + b) / 2

    a, b: positions in the two frames; F_b(x), F_e(x): forces of all tractions, body forces, external forces, pressures,
    chambers, springs, cables and foundations at x, as the first step between the frames begins and as the last one ends;
    with weight=True also those of gravity. A `FilledChamber` pushes with what `ChamberPressure` says of the two frames,
    before the first step with that of the second: its work is the mean of both times the change of volume, 0 where V stays.
    It is Simpson's rule along straight lines from frame to frame under loads that go linearly in time: exact, to round-off,
    for such motions; for loads that are constant and dead (and weight), and for a constant pressure on a closed surface
    (minus p times the change of volume), whatever the motion. Else its error falls as the square of the time between
    frames; with save_every=1 loads for each step are those of their step. Loads that change between frames further apart are
    not seen there. What moves fixed vertices, obstacles, drag and a rotating frame do no work of loads.

    weight: whether gravity counts. name: how a loss calls it. The gradient is exact by all inputs.
    Raises ValueError for a scene without such loads.
    Belytschko, Liu, Moran, Nonlinear Finite Elements for Continua and Structures, 2000, sec. 6.2.3 (energy balance).
    """

    unit, cumulative, reads_chamber_pressures = "J", True, True

    def __init__(self, weight: bool = False, name: str = "work"):
        self.weight, self.name = bool(weight), name

    def __repr__(self) -> str:
        return f"WorkOfLoads(weight={self.weight}, name={self.name!r})"

    def settled(self, scene: Scene) -> "WorkOfLoads":
        out = copy(self)
        out.scene, out.loads = scene, AppliedLoads(scene, weight=self.weight)
        if not out.loads.any:
            raise ValueError(
                "WorkOfLoads: the scene has no load: add a Traction, BodyForce, ExternalForce or Pressure, or count gravity "
                "by weight=True"
            )
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,)

    def _points(self, frames, k: int):
        """(weight, place, share of a, step, whether as that step begins, frame of held pressures) of each force between
        frames k - 1 and k."""
        a, b = frames.positions[k - 1].astype(np.float64), frames.positions[k].astype(np.float64)
        first, last = int(frames.steps[k - 1]) + 1, int(frames.steps[k])
        middle = 0.5 * (a + b)
        before = max(k - 1, 1)
        return [
            (1 / 6, a, 1.0, first, True, before),
            (1 / 3, middle, 0.5, first, True, before),
            (1 / 3, middle, 0.5, last, False, k),
            (1 / 6, b, 0.0, last, False, k),
        ]

    def _held(self, frames, k: int) -> np.ndarray | None:
        """Of chambers that hold a volume in frame k."""
        return frames.chamber_pressures[k] if self.scene.holds_volumes else None

    def _gone(self, frames, k: int) -> np.ndarray:
        return frames.positions[k].astype(np.float64) - frames.positions[k - 1].astype(np.float64)

    def value(self, frames: Frames) -> np.ndarray:
        derived, parts = self.scene.inputs.derive(frames.inputs), [0.0]
        for k in range(1, len(frames.positions)):
            mean = 0.0
            for w, x, _, s, begins, shown in self._points(frames, k):
                mean = mean + w * self.loads.forces(derived, x, s, begins, self._held(frames, shown))
            parts.append(float((mean * self._gone(frames, k)).sum()))
        return np.cumsum(parts)

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        dx = np.zeros(frames.positions.shape) if change.positions is None else change.positions
        parts = [0.0]
        for k in range(1, len(dx)):
            mean, dmean = np.zeros((2, *dx.shape[1:]))
            for w, x, share, s, begins, shown in self._points(frames, k):
                own, held = share * dx[k - 1] + (1 - share) * dx[k], self._held(frames, shown)
                mean += w * self.loads.forces(derived, x, s, begins, held)
                dmean += w * self.loads.jvp(derived, moved, x, own, s, begins, held)
                if held is not None and change.chamber_pressures is not None:
                    dmean += w * self.loads.held_jvp(x, change.chamber_pressures[shown])
            parts.append(float((dmean * self._gone(frames, k) + mean * (dx[k] - dx[k - 1])).sum()))
        return np.cumsum(parts)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        derived = self.scene.inputs.derive(frames.inputs)
        positions, adjoint = np.zeros(frames.positions.shape), derived.zeros()
        by_held = np.zeros_like(frames.chamber_pressures) if self.scene.holds_volumes else None
        later = np.cumsum(seed[::-1])[::-1]  # a part counts in all frames after it
        for k in range(1, len(positions)):
            gone, mean = later[k] * self._gone(frames, k), np.zeros(positions.shape[1:])
            for w, x, share, s, begins, shown in self._points(frames, k):
                held = self._held(frames, shown)
                mean += w * self.loads.forces(derived, x, s, begins, held)
                by_x, _ = self.loads.vjp(derived, x, w * gone, s, adjoint, begins, held)
                if held is not None:
                    by_held[shown] += self.loads.held_vjp(x, w * gone)
                positions[k - 1] += share * by_x
                positions[k] += (1 - share) * by_x
            positions[k] += later[k] * mean
            positions[k - 1] -= later[k] * mean
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(positions=positions, inputs=inputs, chamber_pressures=by_held)
