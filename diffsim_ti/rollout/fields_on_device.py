"""Copies between device arrays and Taichi fields, sums into fields, gradients by fields: without the host between them."""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.outputs import Change
from diffsim_ti.rollout.run import HostSeed, check_finite, norm
from diffsim_ti.runtime.slots import copy_slot

# Fields of frames have shape (frames, vertices), or (runs, frames, vertices) in a rollout of several runs.

STATES = ("positions", "velocities", "displacements")


@ti.func
def _row(field: ti.template(), k, f, i):
    if ti.static(len(field.shape) == 3):
        return field[k, f, i]
    else:
        return field[f, i]


@ti.func
def _put(field: ti.template(), k, f, i, value):
    if ti.static(len(field.shape) == 3):
        field[k, f, i] = value
    else:
        field[f, i] = value


@runtime.kernel
def show_frames(
    u: ti.types.ndarray(ndim=2),
    v: ti.types.ndarray(ndim=2),
    rest: ti.types.ndarray(ndim=1),
    k: ti.i32,
    positions: ti.template(),
    velocities: ti.template(),
    displacements: ti.template(),
):
    """Row k of the fields from frames; positions are added in float64, in which `rest` is, as on the host."""
    for f, i in ti.ndrange(u.shape[0], u.shape[1]):
        x = ti.Vector([rest[i][d] + ti.cast(u[f, i][d], ti.f64) for d in ti.static(range(3))])
        _put(positions, k, f, i, ti.cast(x, positions.dtype))
        _put(velocities, k, f, i, ti.Vector([v[f, i][0], v[f, i][1], v[f, i][2]]))
        _put(displacements, k, f, i, ti.Vector([u[f, i][0], u[f, i][1], u[f, i][2]]))


@runtime.kernel
def take_seeds(
    positions: ti.template(),
    velocities: ti.template(),
    displacements: ti.template(),
    k: ti.i32,
    u_adj: ti.types.ndarray(ndim=2),
    v_adj: ti.types.ndarray(ndim=2),
):
    """Adjoints of the frames from row k of the fields' gradients."""
    for f, i in ti.ndrange(u_adj.shape[0], u_adj.shape[1]):
        x, v = _row(positions, k, f, i) + _row(displacements, k, f, i), _row(velocities, k, f, i)
        for d in ti.static(range(3)):
            u_adj[f, i][d] = x[d]
            v_adj[f, i][d] = v[d]


@runtime.kernel
def add_squares(x: ti.types.ndarray(ndim=2), total: ti.types.ndarray(ndim=1)):
    """total[0] += |x|^2."""
    for f, i in ti.ndrange(x.shape[0], x.shape[1]):
        total[0] += x[f, i][0] * x[f, i][0] + x[f, i][1] * x[f, i][1] + x[f, i][2] * x[f, i][2]


@runtime.kernel
def take_positions(field: ti.template(), known: ti.types.ndarray(ndim=2), u: ti.types.ndarray(ndim=2)):
    """u[0] += field - known[0]: u belongs to the positions `known`, which cost it no digits where the field has them."""
    for i in range(u.shape[1]):
        for d in ti.static(range(3)):
            u[0, i][d] += field[i][d] - known[0, i][d]


@runtime.kernel
def take_vectors(field: ti.template(), zero: ti.types.ndarray(ti.i32, ndim=1), target: ti.types.ndarray(ndim=2)):
    """target[0] = field, but nothing where `zero` says so."""
    for i in range(target.shape[1]):
        for d in ti.static(range(3)):
            target[0, i][d] = field[i][d]
            if zero[i] > 0:
                target[0, i][d] = 0


@runtime.kernel
def add_numbers(field: ti.template(), values: ti.types.ndarray()):
    """field += values, for a field of numbers."""
    for I in ti.grouped(field):
        field[I] += values[I]


@runtime.kernel
def add_vectors(field: ti.template(), values: ti.types.ndarray()):
    """field += values, for a field of 3-vectors."""
    for I in ti.grouped(field):
        for d in ti.static(range(3)):
            field[I][d] += values[I, d]


def field_seed(face, k: int | None, change: Change) -> HostSeed:
    """Gradients by the frames of run k, and those in `change`; on the host where the solver's adjoint is there."""
    if face.rollout.solver.explicit:
        return FieldSeed(face, k, change)
    by_frames = Change(face.row(k, "positions") + face.row(k, "displacements"), face.row(k, "velocities"))
    by_frames.add(Change(change.positions, change.velocities))
    for name in ("positions", "velocities"):
        check_finite(name, getattr(by_frames, name), face.rollout.save_every)
    return HostSeed(by_frames.positions, by_frames.velocities, change.noted)


class FieldSeed(HostSeed):
    """Gradients by the frames in the fields, copied on the device, with those that came by further outputs."""

    def __init__(self, face, k: int | None, change: Change):
        self.face, self.k, self.change, self.noted = face, k, change, change.noted

    def put(self, adjoint, last_frame_is_state: bool) -> tuple[float, float]:
        face = self.face
        adjoint.clear()
        take_seeds(*(face.field(name).grad for name in STATES), self.k or 0, *adjoint.frames)
        norms = []
        for name, frames, running in zip(STATES, adjoint.frames, (adjoint.u, adjoint.v)):
            further = getattr(self.change, name)
            if further is not None:
                runtime.fill(frames, runtime.fetch(frames) + further)
            if last_frame_is_state:
                copy_slot(frames, frames.shape[0] - 1, running, 0)
            norms.append(_norm(frames, face.fp))
            if not np.isfinite(norms[-1]):
                check_finite(name, runtime.fetch(frames), face.rollout.save_every)
        return tuple(norms)


def _norm(array, fp) -> float:
    """Euclidean norm of an array of vectors; infinite where its square overflows."""
    host = runtime.view(array)
    if host is not None:
        return norm(host[..., :3])
    total = runtime.upload(np.zeros(1), fp)
    add_squares(array, total)
    return float(np.sqrt(runtime.fetch(total)[0]))
