"""States of a run on the device, in slots."""

import math

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.arrays import SceneArrays


class History:
    """States of a run: u, v (and forces f if recorded) in `slots` slots, and z, what the law remembers, if it does."""

    def __init__(self, arrays: SceneArrays, num_slots: int, record: bool, remembers: bool = True):
        n = arrays.num_vertices
        self.num_slots = num_slots
        self.beside: list = [None] * num_slots  # what solvers keep with each state
        self.joints: list = [None] * num_slots  # of robots: `Joints.start`
        self.u = runtime.array(arrays.vector, num_slots, n)
        self.v = runtime.array(arrays.vector, num_slots, n)
        self.f = runtime.array(arrays.vector, num_slots, n) if record else runtime.array(arrays.vector, 1, 1)
        self.z = arrays.law_states(num_slots) if remembers else None

        self._state = (self.u, self.v) if self.z is None else (self.u, self.v, self.z)
        self._views = [runtime.view(array) for array in self._state]

    def copy(self, slot: int, target: "History", to: int) -> None:
        """Copy the state in a slot to one of another history; on the CPU without the cost of launches."""
        runtime.check_alive(self.u.owner)
        target.beside[to], target.joints[to] = self.beside[slot], self.joints[slot]
        for k, view in enumerate(self._views):
            if view is None:
                copy_slot(self._state[k], slot, target._state[k], to)
            else:
                target._views[k][to] = view[slot]


@runtime.untaped
@runtime.kernel
def _find_bad(u: ti.types.ndarray(ndim=2), v: ti.types.ndarray(ndim=2), bad: ti.types.ndarray(ti.i32, 1)):
    for i in range(u.shape[1]):
        finite = True
        for d in ti.static(range(3)):
            for value in ti.static((u[0, i][d], v[0, i][d])):
                finite = finite and not (ti.math.isnan(value) or ti.math.isinf(value))
        if not finite:
            ti.atomic_min(bad[0], i)


def first_bad_vertex(history: History) -> int | None:
    """The first vertex of slot 0 whose displacement or velocity is not finite, or None."""
    u, v = runtime.view(history.u), runtime.view(history.v)
    if u is not None:
        with np.errstate(all="ignore"):
            if math.isfinite(np.add.reduce(u[0], None) + np.add.reduce(v[0], None)):
                return None
            bad = np.nonzero(~np.isfinite(u[0].sum(1) + v[0].sum(1)))[0]
        return int(bad[0]) if bad.size else None
    n = history.u.shape[1]
    out = runtime.array(ti.i32, 1)
    runtime.fill(out, n)
    _find_bad(history.u, history.v, out)
    bad = int(runtime.fetch(out)[0])
    return bad if bad < n else None
