"""Tables of the passes of many scenes, where scenes have drag of their own."""

from collections.abc import Callable

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.layouts import Innermost, Lanes
from diffsim_ti.state.pass_table import FLOATS, INTS, PassTable


class ScenesTable(PassTable):
    """Tables of passes; where scenes have drag of their own, `floats` are numbers of scenes."""

    def __init__(self, fp, own: bool, layout: Lanes | Innermost):
        super().__init__(fp)
        self.own, self._layout, self._numbers = own, layout, None
        if own:
            self.floats = layout.numbers(self.size * len(FLOATS))

    def show_scenes(self, window: int, run: tuple, rates: tuple, make: Callable) -> None:
        """As `show`, for the drag rates of all scenes [1/s]."""
        if not self.own:
            self.show(window, (*run, rates[0]), lambda first, last: make(first, last, rates[0]))
        elif self._numbers != (window, run, rates):
            self._numbers = window, run, rates
            tables = [make(window, min(window + self.size, run[0]), rate) for rate in rates]
            ints = np.zeros(self.size * len(INTS))
            ints[: tables[0][0].size] = tables[0][0].ravel()
            floats = np.zeros((len(rates), self.size * len(FLOATS)))
            for row, (_, numbers) in zip(floats, tables):
                row[: numbers.size] = numbers.ravel()
            runtime.fill(self.ints, ints)
            runtime.fill(self.floats, self._layout.pack(floats))
