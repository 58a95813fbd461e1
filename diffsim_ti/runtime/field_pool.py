"""Taichi fields for the boundary of a `ti.ad.Tape`, lent and returned."""

import weakref
from collections import defaultdict

import numpy as np
import taichi as ti
from taichi.lang import impl

from diffsim_ti.runtime.arrays import to_numpy_dtype
from diffsim_ti.runtime.start import program
from diffsim_ti.runtime.threads import LOCK, materialize, untaped


class FieldPool:
    """Taichi fields with gradients, lent and returned: plain fields are never freed and 512 field trees end a process."""

    def __init__(self):
        self._free = defaultdict(list)

    def take(self, owner, dtype, shape: tuple, components: int = 0):
        """A field of that kind, zeroed; it comes back to the pool when `owner` is collected."""
        key = (program(), dtype, tuple(shape), components)
        with LOCK:
            field = self._free[key].pop() if self._free[key] else self._make(dtype, tuple(shape), components)
            materialize()
        weakref.finalize(owner, self._free[key].append, field)
        for part in (field, field.grad):
            untaped(part.from_numpy)(
                np.zeros(tuple(shape) + ((components,) if components else ()), to_numpy_dtype(dtype))
            )
        return field

    @staticmethod
    def _make(dtype, shape, components):
        if components:
            return ti.Vector.field(components, dtype, shape=shape, needs_grad=True)
        return ti.field(dtype, shape=shape, needs_grad=True)


fields = FieldPool()


def current_tape():
    """The `ti.ad.Tape` that is open now, or None."""
    program()
    return impl.get_runtime().target_tape
