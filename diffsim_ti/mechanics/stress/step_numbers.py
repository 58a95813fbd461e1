"""What elements share that read numbers given over time, as an explicit pass takes them."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import PRECISIONS

A = ti.template()


@dataclass(frozen=True)
class StepNumbers:
    """per_step: whether there is a row of numbers for each step; else one holds in all."""

    precision: str
    per_step: bool

    @property
    def fp(self):
        return PRECISIONS[self.precision]

    @property
    def vector(self):
        return ti.types.vector(4, self.fp)

    @ti.func
    def row(self, force):
        """The row that a kick of a step takes."""
        r = 0
        if ti.static(self.per_step):
            r = force
        return r

    @ti.func
    def share(self, force, now: A):
        """How far in that step the pass lies: it ends a step before its own."""
        return ti.select(force == now.row, now.begin, ti.cast(1, self.fp))

    @ti.func
    def cross(self, a, b):
        zero = ti.cast(0, self.fp)
        return self.vector(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0], zero)
