"""Slots of arrays of vectors on the device, (slots, num_vertices): copied, and read and written in part from the host."""

from contextlib import contextmanager

import numpy as np
import taichi as ti

from diffsim_ti import runtime


@runtime.untaped
@runtime.kernel
def _copy_slot(source: ti.types.ndarray(ndim=2), s: ti.i32, target: ti.types.ndarray(ndim=2), t: ti.i32):
    for i in range(source.shape[1]):
        target[t, i] = source[s, i]


def copy_slot(source, s: int, target, t: int) -> None:
    """target[t] = source[s]; on the CPU without the cost of a launch."""
    host = runtime.view(target)
    if host is None:
        _copy_slot(source, s, target, t)
    else:
        host[t] = runtime.view(source)[s]


@runtime.untaped
@runtime.kernel
def _add_slot(source: ti.types.ndarray(ndim=2), s: ti.i32, target: ti.types.ndarray(ndim=2), t: ti.i32):
    for i in range(source.shape[1]):
        target[t, i] += source[s, i]


def add_slot(source, s: int, target, t: int) -> None:
    """target[t] += source[s], likewise."""
    host = runtime.view(target)
    if host is None:
        _add_slot(source, s, target, t)
    else:
        host[t] += runtime.view(source)[s]


class VertexRows:
    """Of the vertices `nodes`, in arrays of shape (slots, num_vertices)."""

    def __init__(self, arrays, nodes: np.ndarray):
        self.nodes, self._row = nodes, runtime.array(arrays.vector, 1, arrays.num_vertices)

    def get(self, source, slot: int) -> np.ndarray:
        """Theirs in a slot, float64."""
        host = runtime.view(source)
        return (runtime.fetch(source, slot) if host is None else host[slot])[self.nodes, :3].astype(np.float64)

    def put(self, target, slot: int, data: np.ndarray) -> None:
        """Others in their place."""
        host = runtime.view(target)
        if host is not None:
            host[slot, self.nodes, :3] = data
            return
        whole = runtime.fetch(target, slot)
        whole[self.nodes] = data
        runtime.fill(self._row, whole[None])
        copy_slot(self._row, 0, target, slot)

    @contextmanager
    def replaced(self, history, slot: int, u: np.ndarray, v: np.ndarray):
        """Other displacements and velocities in a slot of a record, for a while."""
        before = self.get(history.u, slot), self.get(history.v, slot)
        self._set(history, slot, u, v)
        yield
        self._set(history, slot, *before)

    def _set(self, history, slot: int, u: np.ndarray, v: np.ndarray) -> None:
        self.put(history.u, slot, u)
        self.put(history.v, slot, v)
