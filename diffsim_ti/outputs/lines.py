"""Lengths and tensions of springs and cables."""

from abc import abstractmethod
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
    leads to it; shape (frames,) of a cable or a single spring, else (frames, k)."""

    def __init__(self, of: LineTerm | str, name: str):
        self.of, self.name = of, name

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.of!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "_OfLines":
        out = copy(self)
        lines = scene.interaction(SpringsAndCables)
        number = scene.place_among(lines.terms if lines else (), self.of, "spring or cable")
        out.scene, out.own, out.lines = scene, lines.places(number), lines.host()
        out.count = out.own.stop - out.own.start
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.count == 1 else (num_frames, self.count)

    @abstractmethod
    def _value(self, lines, u: np.ndarray) -> np.ndarray:
        """Of all line elements of the scene."""

    @abstractmethod
    def _jvp(self, lines, u, du, moved) -> np.ndarray:
        """Its change; moved: those of segments at rest and of (a, s, k)."""

    @abstractmethod
    def _vjp(self, lines, u, seed) -> tuple:
        """Adjoints of u, of segments at rest, of (a, s, k)."""

    def _frames(self, frames, derived):
        """(line elements as they are in each frame, displacements, when that is)"""
        for step, x in zip(frames.steps, frames.positions.astype(np.float64)):
            instant = at_end(int(step))
            yield self.lines.take(derived, instant), x - derived.rest, instant

    def value(self, frames: Frames) -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        found = [self._value(lines, u)[self.own] for lines, u, _ in self._frames(frames, derived)]
        return np.reshape(found, self.shape(len(found)))

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        dx, out = np.zeros(frames.positions.shape) if change.positions is None else change.positions, []
        for (lines, u, at), moving in zip(self._frames(frames, derived), dx):
            numbers = moved.line_segments, *at.schedule.lines(moved.lines, at.j, at.share)
            out.append(self._jvp(lines, u, moving - moved.rest, numbers)[self.own])
        return np.reshape(out, self.shape(len(out)))

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        derived, positions = self.scene.inputs.derive(frames.inputs), np.zeros(frames.positions.shape)
        adj, all_lines = derived.zeros(), np.zeros((len(positions), len(self.lines.paths)))
        all_lines[:, self.own] = seed.reshape(len(positions), -1)
        for k, (lines, u, at) in enumerate(self._frames(frames, derived)):
            positions[k], segments, numbers = self._vjp(lines, u, all_lines[k])
            adj.line_segments += segments
            at.schedule.add_lines(adj.lines, at.j, at.share, numbers)
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

    unit = "m"

    @renamed_arguments(tie="of")
    def __init__(self, of: LineTerm | str, name: str = "length"):
        super().__init__(of, name)

    def _value(self, lines, u):
        return lines.lengths(u)

    def _jvp(self, lines, u, du, moved):
        return lines.lengths_jvp(u, du, moved[0])

    def _vjp(self, lines, u, seed):
        by_u, segments = lines.lengths_vjp(u, seed)
        none = np.zeros(len(seed))
        return by_u, segments, (none, none, none)


class Tension(_OfLines):
    """Tension T [N] of a cable or of springs (negative in compression), in each frame; shape (frames,), or (frames, k) of a
    `Spring` term with k springs. A prescribed tension is that at the end of the step that leads to the frame.

    of: the name of the `Spring` or `Cable`, or the term as the scene lists it. name: what losses call the output.
    The gradient is exact with respect to all inputs; it is 0 for a slack cable. In single precision the tension has
    the error of the positions, about 1e-7 of them, times the stiffness.
    Raises ValueError for a spring or cable that is not in the scene.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2.
    """

    unit = "N"

    @renamed_arguments(tie="of")
    def __init__(self, of: LineTerm | str, name: str = "tension"):
        super().__init__(of, name)

    def _value(self, lines, u):
        return lines.tensions(u)

    def _jvp(self, lines, u, du, moved):
        return lines.tensions_jvp(u, du, *moved)

    def _vjp(self, lines, u, seed):
        return lines.tensions_vjp(u, seed)
