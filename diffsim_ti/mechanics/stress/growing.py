"""Tetrahedra that grow over time, as an explicit pass and an implicit one take it."""

import taichi as ti

from diffsim_ti.runtime import let, traced
from diffsim_ti.state.pass_table import kicks


class Growing:
    """A part of Tetrahedron, whose `growth` says whether there are rows for each step and whether all grow alike.

    Growth has its value at the beginning and at the end of each step; a pass takes the mean over its kicks. Where no pass
    is told (`scene.now`), the first row holds, as at the end of its step.
    """

    @property
    def growth_at(self) -> int:
        """Place of growth among the law's coefficients."""
        return self.law.coefficient_names.index("growth")

    @traced
    def _growth_weights(self, of) -> list:
        """(row, weight of its beginning, of its end) for each part."""
        one = ti.cast(1, self.fp)
        if not hasattr(of, "now"):
            return [(0, let(one - one), let(one))]
        parts = kicks(of.now, self.growth[0], self.fp)
        return [(row, let(weight * (one - share)), let(weight * share)) for row, share, weight in parts]

    @traced
    def grown(self, item, p: list, of) -> list:
        """Coefficients p with the growths of a Bundle, at its pass; one of scenes in lanes has none."""
        if self.growth is None:
            return p
        total = p[self.growth_at]
        for row, begin, end in self._growth_weights(of):
            first, last = self.items.row(of.growths, row, 0, 2, 2, 0 if self.growth[1] else item)
            total = total + first * begin + last * end
        return [let(total) if k == self.growth_at else x for k, x in enumerate(p)]

    @traced
    def add_growth(self, item, adjoint, by_p: list, of) -> None:
        """Add the adjoint of growth, that of its coefficient."""
        if self.growth is None:
            return
        by = by_p[self.growth_at]
        for row, *weights in self._growth_weights(of):
            known = self.items.row(adjoint.growths, row, 0, 2, 2, item)
            self.items.put_row(adjoint.growths, row, 0, 2, item, [a + by * w for a, w in zip(known, weights)])
