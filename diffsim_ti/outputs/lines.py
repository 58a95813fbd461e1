"""Lengths and tensions of springs and cables."""

from copy import copy

import numpy as np

from diffsim_ti.common.deprecated import renamed_arguments
from diffsim_ti.mechanics.lines.interaction import SpringsAndCables
from diffsim_ti.outputs.forces_at_frames import at_end
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms.lines import LineTerm


class _OfLines(Output):
    """One number for each spring or cable of a term, from the state in each frame and the loads at the end of the step that
    leads to it; shape (frames,) of a cable or a single spring, else (frames, k).

    quantity: whose value and derivatives the host form of lines has under this name; numbers: how many of the changes of
    (segments at rest, a, s, k) it depends on.
    """

    quantity: str
    numbers: int
    _shown = ("of",)

    def __init__(self, of: LineTerm | str, name: str):
        self.of, self.name = of, name

    def settled(self, scene: Scene) -> "_OfLines":
        out = copy(self)
        lines = scene.interaction(SpringsAndCables)
        number = scene.place_among(lines.terms if lines else (), self.of, "spring or cable")
        out.scene, out.own, out.lines = scene, lines.places(number), lines.host()
        out.count = out.own.stop - out.own.start
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.count == 1 else (num_frames, self.count)

    def _frames(self, frames, derived):
        """(line elements as they are in each frame, displacements, when that is)"""
        for step, x in zip(frames.steps, frames.positions.astype(np.float64)):
            instant = at_end(int(step))
            yield self.lines.take(derived, instant), x - derived.rest, instant

    def value(self, frames: Frames) -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        found = [getattr(lines, self.quantity)(u)[self.own] for lines, u, _ in self._frames(frames, derived)]
        return np.reshape(found, self.shape(len(found)))

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        dx, out = np.zeros(frames.positions.shape) if change.positions is None else change.positions, []
        for (lines, u, at), moving in zip(self._frames(frames, derived), dx):
            numbers = (moved.line_segments, *at.schedule.lines(moved.lines, at.j, at.share))[: self.numbers]
            out.append(getattr(lines, f"{self.quantity}_jvp")(u, moving - moved.rest, *numbers)[self.own])
        return np.reshape(out, self.shape(len(out)))

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        derived, positions = self.scene.inputs.derive(frames.inputs), np.zeros(frames.positions.shape)
        adj, all_lines = derived.zeros(), np.zeros((len(positions), len(self.lines.paths)))
        all_lines[:, self.own] = seed.reshape(len(positions), -1)
        for k, (lines, u, at) in enumerate(self._frames(frames, derived)):
            positions[k], segments, *numbers = getattr(lines, f"{self.quantity}_vjp")(u, all_lines[k])
            adj.line_segments += segments
            for by_numbers in numbers:
                at.schedule.add_lines(adj.lines, at.j, at.share, by_numbers)
        adj.rest = adj.rest - positions.sum(0)
        return Change(
            positions=positions, inputs=self.scene.inputs.derive_vjp(frames.inputs, adj, tuple(frames.inputs))
        )


class Length(_OfLines):
    """Length L [m] of a cable along its points, or of springs between theirs, in each frame; shape (frames,), or
    (frames, k) of a `Spring` term with k springs.

    of: the name of the `Spring` or `Cable`, or the term as the scene lists it. name: what losses call the output.
    The gradient is exact with respect to all inputs; that of a spring of zero length is set to 0.
    Raises ValueError for a spring or cable that is not in the scene.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2.
    """

    unit, quantity, numbers = "m", "lengths", 1

    @renamed_arguments(tie="of")
    def __init__(self, of: LineTerm | str, name: str = "length"):
        super().__init__(of, name)


class Tension(_OfLines):
    """Tension T [N] of a cable or of springs (negative in compression), in each frame; shape (frames,), or (frames, k) of a
    `Spring` term with k springs. A prescribed tension is that at the end of the step that leads to the frame.

    of: the name of the `Spring` or `Cable`, or the term as the scene lists it. name: what losses call the output.
    The gradient is exact with respect to all inputs; it is 0 for a slack cable. In single precision the tension has
    the error of the positions, about 1e-7 of them, times the stiffness.
    Raises ValueError for a spring or cable that is not in the scene.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2.
    """

    unit, quantity, numbers = "N", "tensions", 4

    @renamed_arguments(tie="of")
    def __init__(self, of: LineTerm | str, name: str = "tension"):
        super().__init__(of, name)
