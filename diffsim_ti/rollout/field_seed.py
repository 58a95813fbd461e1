"""Gradients of a loss by frames that kernels of a `ti.ad.Tape` left in fields, for the reverse sweep."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.outputs import Change
from diffsim_ti.rollout import field_copies
from diffsim_ti.rollout.frames import HostSeed, check_finite, norm
from diffsim_ti.runtime.slots import copy_slot

STATES = ("positions", "velocities", "displacements")


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
        field_copies.take_seeds(*(face.field(name).grad for name in STATES), self.k or 0, *adjoint.frames)
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
    field_copies.add_squares(array, total)
    return float(np.sqrt(runtime.fetch(total)[0]))
