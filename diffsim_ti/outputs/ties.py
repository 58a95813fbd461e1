"""Lengths and tensions of springs and cables."""

from abc import abstractmethod
from copy import copy
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.common.deprecated import renamed_arguments
from diffsim_ti.mechanics.ties.interaction import SpringsAndCables
from diffsim_ti.outputs.given_loads import at_end
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.terms.ties import Tie

if TYPE_CHECKING:
    from diffsim_ti.rollout.frames import Frames
    from diffsim_ti.scene import Scene


class _OfTies(Output):
    """One number for each spring or cable of a term, from the state in each frame and the loads at the end of the step that
    leads to it; shape (frames,) of a cable or a single spring, else (frames, k)."""

    def __init__(self, of: Tie | str, name: str):
        self.of, self.name = of, name

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.of!r}, name={self.name!r})"

    def settled(self, scene: "Scene") -> "_OfTies":
        out = copy(self)
        ties = scene.interaction(SpringsAndCables)
        number = scene.place_among(ties.terms if ties else (), self.of, "spring or cable")
        out.scene, out.own, out.ties = scene, ties.places(number), ties.host()
        out.count = out.own.stop - out.own.start
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.count == 1 else (num_frames, self.count)

    @abstractmethod
    def _value(self, ties, u: np.ndarray) -> np.ndarray:
        """Of all ties of the scene."""

    @abstractmethod
    def _jvp(self, ties, u, du, moved) -> np.ndarray:
        """Its change; moved: those of segments at rest and of (a, s, k)."""

    @abstractmethod
    def _vjp(self, ties, u, seed) -> tuple:
        """Adjoints of u, of segments at rest, of (a, s, k)."""

    def _frames(self, frames, derived):
        """(ties as they are in each frame, displacements)"""
        for step, x in zip(frames.steps, frames.positions.astype(np.float64)):
            instant = at_end(int(step))
            yield self.ties.take(derived, instant), x - derived.rest, instant

    def value(self, frames: "Frames") -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        found = [self._value(ties, u)[self.own] for ties, u, _ in self._frames(frames, derived)]
        return np.reshape(found, self.shape(len(found)))

    def jvp(self, frames: "Frames", change: Change) -> np.ndarray:
        derived = self.scene.inputs.derive(frames.inputs)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        dx, out = np.zeros(frames.positions.shape) if change.positions is None else change.positions, []
        for (ties, u, at), moving in zip(self._frames(frames, derived), dx):
            numbers = moved.tie_segments, *at.schedule.ties(moved.ties, at.j, at.share)
            out.append(self._jvp(ties, u, moving - moved.rest, numbers)[self.own])
        return np.reshape(out, self.shape(len(out)))

    def vjp(self, frames: "Frames", seed: np.ndarray) -> Change:
        derived, positions = self.scene.inputs.derive(frames.inputs), np.zeros(frames.positions.shape)
        adj, all_ties = derived.zeros(), np.zeros((len(positions), len(self.ties.paths)))
        all_ties[:, self.own] = seed.reshape(len(positions), -1)
        for k, (ties, u, at) in enumerate(self._frames(frames, derived)):
            positions[k], segments, numbers = self._vjp(ties, u, all_ties[k])
            adj.tie_segments += segments
            at.schedule.add_ties(adj.ties, at.j, at.share, numbers)
        adj.rest = adj.rest - positions.sum(0)
        return Change(
            positions=positions, inputs=self.scene.inputs.derive_vjp(frames.inputs, adj, tuple(frames.inputs))
        )


class Length(_OfTies):
    """Length L [m] of a cable along its points, or of springs between theirs, in each frame; shape (frames,), or
    (frames, k) of a `Spring` term with k springs.

    of: the name of the `Spring` or `Cable`, or the term as the scene lists it. name: what losses call the output.
    The gradient is exact with respect to all inputs; that of a spring of zero length is set to 0.
    Raises ValueError for a spring or cable that is not in the scene.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2.
    """

    unit = "m"

    @renamed_arguments(tie="of")
    def __init__(self, of: Tie | str, name: str = "length"):
        super().__init__(of, name)

    def _value(self, ties, u):
        return ties.lengths(u)

    def _jvp(self, ties, u, du, moved):
        return ties.lengths_jvp(u, du, moved[0])

    def _vjp(self, ties, u, seed):
        by_u, segments = ties.lengths_vjp(u, seed)
        none = np.zeros(len(seed))
        return by_u, segments, (none, none, none)


class Tension(_OfTies):
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
    def __init__(self, of: Tie | str, name: str = "tension"):
        super().__init__(of, name)

    def _value(self, ties, u):
        return ties.tensions(u)

    def _jvp(self, ties, u, du, moved):
        return ties.tensions_jvp(u, du, *moved)

    def _vjp(self, ties, u, seed):
        return ties.tensions_vjp(u, seed)
