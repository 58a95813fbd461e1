"""What elements share that read numbers given over time, as an explicit pass takes them."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import A, number_type, traced, vector_type
from diffsim_ti.state.pass_table import between, kicks


@dataclass(frozen=True)
class StepNumbers:
    """per_step: whether there is a row of numbers for each step; else one holds in all."""

    precision: str
    per_step: bool

    fp, vector = number_type, vector_type

    @traced
    def kicks(self, now) -> list:
        """(row, how far in its step the pass lies, weight) of the two kicks that a pass is made of."""
        return kicks(now, self.per_step, self.fp)

    @ti.func
    def mean(self, place, now: A, rows: A):
        """The mean over both kicks of a number that goes from [0] to [1] of rows[step, place] within each step."""
        out = ti.cast(0, self.fp)
        for row, share, weight in ti.static(self.kicks(now)):
            ends = rows[row, place]
            out += weight * between(ends[0], ends[1], share)
        return out

    @ti.func
    def add_mean(self, place, by, now: A, adjoint: A):
        """Adds the adjoint of such a number to adjoint[step, place], `by` being that of its mean."""
        for row, share, weight in ti.static(self.kicks(now)):
            ends = self.vector(0)
            ends[0], ends[1] = weight * by * (1 - share), weight * by * share
            adjoint[row, place] = adjoint[row, place] + ends
