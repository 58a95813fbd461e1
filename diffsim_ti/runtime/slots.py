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


@runtime.untaped
@runtime.kernel
def _take(source: ti.types.ndarray(ndim=2), s: ti.i32, nodes: ti.types.ndarray(ndim=1), to: ti.types.ndarray(ndim=2)):
    for k in range(nodes.shape[0]):
        to[0, k] = source[s, nodes[k]]


@runtime.untaped
@runtime.kernel
def _put(target: ti.types.ndarray(ndim=2), t: ti.i32, nodes: ti.types.ndarray(ndim=1), of: ti.types.ndarray(ndim=2)):
    for k in range(nodes.shape[0]):
        target[t, nodes[k]] = of[0, k]


class VertexRows:
    """Of the vertices `nodes`, in arrays of shape (slots, num_vertices)."""

    def __init__(self, arrays, nodes: np.ndarray):
        self.nodes, self._at = nodes, runtime.upload(nodes, ti.i32)
        self._part = runtime.array(arrays.vector, 1, len(nodes))

    def get(self, source, slot: int) -> np.ndarray:
        """Theirs in a slot, float64."""
        host = runtime.view(source)
        if host is not None:
            return host[slot][self.nodes, :3].astype(np.float64)
        _take(source, slot, self._at, self._part)
        return runtime.fetch_row(self._part, 0)[: len(self.nodes)]

    def put(self, target, slot: int, data: np.ndarray) -> None:
        """Others in their place."""
        host = runtime.view(target)
        if host is not None:
            host[slot, self.nodes, :3] = data
        elif len(self.nodes):
            runtime.fill(self._part, data)
            _put(target, slot, self._at, self._part)

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
