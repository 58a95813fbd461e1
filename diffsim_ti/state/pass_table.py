"""What each pass of an explicit run is, as tables on the device: its numbers by name (schedule.py says what they are)."""

from collections.abc import Callable

import numpy as np
import taichi as ti

from diffsim_ti import runtime

INTS = ("row", "next", "force0", "force1", "frame", "counted", "opens")
FLOATS = (
    *("begin", "end", "per_step", "h", "pre", "post", "share0", "share1"),
    *("alpha", "decay", "alpha_by_rate", "decay_by_rate"),
)


@runtime.traced
def reversed_pass(now, j, plan) -> runtime.Bundle:
    """Pass j on the way back, `pre_adj` being what the kick before the state counts: none if the sweep halts at the state
    (j = plan.halt); with plan.kick the pass is that kick alone."""
    own, alone = dict(vars(now)), runtime.let(plan.kick > 0)
    own["pre_adj"] = runtime.let(ti.select(j == plan.halt, 0 * now.pre, now.pre))
    for name in ("post", "alpha", "alpha_by_rate", "decay_by_rate"):
        own[name] = runtime.let(ti.select(alone, 0 * own[name], own[name]))
    own["decay"] = runtime.let(ti.select(alone, 0 * now.decay + 1, now.decay))
    own["frame"] = runtime.let(ti.select(alone, -1, now.frame))
    return runtime.Bundle(**own)


@runtime.traced
def between(begin, end, share):
    """What goes linearly from `begin` to `end` within a step, at a share of it: on the host and in kernels."""
    return begin + share * (end - begin)


@runtime.traced
def kicks(now, per_step: bool, fp) -> list:
    """(row of numbers given over time, share of its step at which they count, weight) of the two kicks of a pass. A step
    before its own has ended there. per_step: whether there is a row for each step; else one holds in all."""
    one = ti.cast(1, fp)
    return [
        (step if per_step else 0, runtime.let(ti.select(step == now.row, now.begin, one)), weight)
        for step, weight in ((now.force0, now.share0), (now.force1, now.share1))
    ]


class PassTable:
    """Tables of some passes on the device, row after row: `ints` and `floats`; the first row is that of pass `window`."""

    size = 1024  # passes

    def __init__(self, fp):
        self.ints = runtime.array(ti.i32, self.size * len(INTS))
        self.floats = runtime.array(fp, self.size * len(FLOATS))
        self.turns = runtime.array(ti.i32, 2)  # of the loops of a launch
        runtime.fill(self.turns, 0)
        self._made, self._shown = {}, None

    def windows(self, first: int, last: int) -> list[tuple[int, int, int]]:
        """(window, first pass, last pass) of the windows that passes first .. last - 1 lie in."""
        starts = range(first // self.size * self.size, last, self.size)
        return [(start, max(first, start), min(last, start + self.size)) for start in starts]

    def show(self, window: int, run: tuple, make: Callable) -> None:
        """Bring a window's tables, make(first, last), to the device; `run` is what they depend on besides."""
        if self._shown == (window, run):
            return
        if (window, run) not in self._made:
            if len(self._made) > 8:
                self._made.pop(next(iter(self._made)))
            self._made[window, run] = make(window, min(window + self.size, run[0]))
        self._shown = window, run
        for target, rows in zip((self.ints, self.floats), self._made[window, run]):
            whole = np.zeros(target.shape)
            whole[: rows.size] = rows.ravel()
            runtime.fill(target, whole)


@runtime.traced
def pass_at(table, k, row=None) -> runtime.Bundle:
    """Row k of the tables in a kernel: what a pass is, by name; row: that of the floats, if it is another one."""
    columns = {}
    for array, names, at in ((table.ints, INTS, k), (table.floats, FLOATS, k if row is None else row)):
        first = runtime.let(at * len(names))
        columns |= {name: runtime.let(runtime.at(array, first + c)) for c, name in enumerate(names)}
    return runtime.Bundle(**columns)
