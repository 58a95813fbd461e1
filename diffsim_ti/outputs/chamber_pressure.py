"""The pressure in a chamber."""

from copy import copy

import numpy as np

from diffsim_ti.mechanics.chambers.laws import law_of
from diffsim_ti.mechanics.chambers.pressures import rows_of
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Chamber


class ChamberPressure(Output):
    """Pressure [Pa] of a chamber on the body, shape (frames,): of a gas p - p_out, of an incompressible fluid the
    multiplier of its volume.

    chamber: its name, or the term as the scene lists it. name: how a loss calls it.

    That of a gas is at the frame's positions, its amount that of the step that ends there. That of a `FilledChamber` is of
    the last substep before the frame, and 0 in the first one.
    The gradient is exact by all inputs.

    Raises ValueError for a chamber that the scene has not.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 8.5.2,
    doi:10.1017/CBO9780511755446.
    """

    reads_chamber_pressures = True

    def __init__(self, chamber: Chamber | str, name: str = "chamber_pressure"):
        self.chamber, self.name = chamber, name

    def __repr__(self) -> str:
        return f"ChamberPressure({self.chamber!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "ChamberPressure":
        out = copy(self)
        chambers = scene.terms_of(Chamber)
        out.place, out.inputs = scene.place_among(chambers, self.chamber, "chamber"), scene.inputs
        chamber = chambers[out.place]
        out.law, out.enclosure, (out.rows,) = law_of(chamber), chamber.enclosure, rows_of(scene, [chamber])
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,)

    @staticmethod
    def _at(step: int, rows: np.ndarray) -> tuple[int, int]:
        """Of rows of numbers, which one and which end of its step a frame shows."""
        return min(max(step - 1, 0), len(rows) - 1), 1 if step else 0

    def _numbers(self, step: int, follower: np.ndarray) -> np.ndarray:
        row, end = self._at(step, follower)
        return follower[row, self.rows, end]

    def _volumes(self, frames) -> list[float]:
        return [self.enclosure.volume(x.astype(np.float64)) for x in frames.positions]

    def value(self, frames: Frames) -> np.ndarray:
        if self.law.holds:
            return frames.chamber_pressures[:, self.place].copy()
        follower, out = self.inputs.derive(frames.inputs).follower, []
        for step, V in zip(frames.steps, self._volumes(frames)):
            self.law.at(self._numbers(int(step), follower), 1.0)
            out.append(self.law.pressure(V))
        return np.array(out)

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        if self.law.holds:
            zero = np.zeros(len(frames.positions))
            return zero if change.chamber_pressures is None else change.chamber_pressures[:, self.place]
        follower = self.inputs.derive(frames.inputs).follower
        moved = self.inputs.derive_jvp(frames.inputs, change.inputs).follower
        out = []
        for k, (step, V) in enumerate(zip(frames.steps, self._volumes(frames))):
            self.law.at(self._numbers(int(step), follower), 1.0)
            out.append(self.law.by_numbers(V) @ self._numbers(int(step), moved))
            if change.positions is not None:
                G = self.enclosure.gradient(frames.positions[k].astype(np.float64))
                out[-1] += self.law.slope(V) * (G * change.positions[k]).sum()
        return np.array(out)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        if self.law.holds:
            out = np.zeros(frames.chamber_pressures.shape)
            out[:, self.place] = seed
            return Change(chamber_pressures=out)
        derived, positions = self.inputs.derive(frames.inputs), np.zeros(frames.positions.shape)
        adj = derived.zeros()
        for k, (step, V) in enumerate(zip(frames.steps, self._volumes(frames))):
            self.law.at(self._numbers(int(step), derived.follower), 1.0)
            row, end = self._at(int(step), adj.follower)
            adj.follower[row, self.rows, end] += seed[k] * self.law.by_numbers(V)
            G = self.enclosure.gradient(frames.positions[k].astype(np.float64))
            positions[k] = seed[k] * self.law.slope(V) * G
        return Change(positions=positions, inputs=self.inputs.derive_vjp(frames.inputs, adj, tuple(frames.inputs)))
