"""What errors of trial runs are of: the motion of all vertices, or a number of the run."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.accuracy.estimate import Accuracy, Number
from diffsim_ti.outputs import Output
from diffsim_ti.rollout import Rollout
from diffsim_ti.solvers import Solver


@dataclass(frozen=True)
class Quantity:
    """output, weights: the number, as of `Rollout.accuracy`; None: displacements from the start."""

    output: Output | None = None
    weights: ArrayLike | Callable | None = None

    @property
    def scale(self) -> str:
        """What relative errors are relative to."""
        return "the largest displacement" if self.output is None else f"the change of {self.output.name}"

    def rollout(self, solver: Solver, steps, **options) -> Rollout:
        """A run that has it, with a frame after each step."""
        return Rollout(solver, steps, save_every=1, outputs=[] if self.output is None else self.output, **options)

    def _number(self, rollout: Rollout) -> Number:
        return Number(rollout, next(iter(rollout.computed)), self.weights)

    def of(self, rollout: Rollout, frames) -> np.ndarray:
        """Displacements [m], shape (frames, num_vertices, 3), or how far the number changed, shape (1, 1, 1)."""
        if self.output is None:
            moved = frames.displacements.astype(np.float64)
            return moved - moved[0]
        number = self._number(rollout)
        return np.full((1, 1, 1), number.of(frames)[0] - number.start(frames))

    def time(self, rollout: Rollout, gradients: bool) -> float:
        """Wall time of a run [s], with the gradient of the number, or of the square of displacements, if one is wanted."""
        start = time.perf_counter()
        frames = rollout.forward()
        if gradients and self.output is None:
            rollout.vjp(frames, frames.displacements)
        elif gradients:
            number = self._number(rollout)
            rollout.vjp(frames, **{number.output: number.of(frames)[1]})
        return time.perf_counter() - start

    def accuracy(self, rollout: Rollout) -> Accuracy:
        """The error bar of the number."""
        return rollout.accuracy(next(iter(rollout.computed)), self.weights)


MOTION = Quantity()
