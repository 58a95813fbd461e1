"""The tangent of a chain of kick-drift passes, along recorded states."""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.obstacles.impulse_record import ImpulseRecord
from diffsim_ti.mechanics.stage import Passes
from diffsim_ti.mechanics.stress.law_frames import LawFrames
from diffsim_ti.mechanics.workspace import FrameArrays
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.solvers.explicit.stages import with_buffers
from diffsim_ti.state.numbers import Tangent


class ExplicitTangent:
    """The tangent of a run: changes of the state for changes of everything that kernels read."""

    def __init__(self, workspace, tangent: Derived):
        self.ws, self.tangent = weakref.proxy(workspace), tangent
        a = workspace.arrays
        self.features = a.features(density=True, shape=True)
        self.u = runtime.upload(tangent.displacement[None], a.vector)
        self.v = runtime.upload(tangent.velocity[None], a.vector)
        self.frames = FrameArrays.of(a, *workspace.frames.frames_u.shape)
        self.numbers, self.z = Tangent(a, tangent), a.law_states(1)
        self.law_frames = LawFrames(workspace) if workspace.law_frames else None
        self.impulses = ImpulseRecord(workspace, workspace.impulses.of_obstacles) if workspace.impulses else None
        if a.bodies:
            vars(self).update(a.bodies.tangent(tangent))
        if self.z is not None:
            runtime.fill(self.z, 0)
        self.rate_dot = float(tangent.parameters[self.features.drag]) if self.features.drag >= 0 else 0.0
        self.stages = with_buffers("tangent", workspace.stages, self)

    def advance(self, first: int, last: int, num_passes: int, save_every: int) -> None:
        """Tangent of passes first .. last - 1, recorded from slot 0."""
        ws = self.ws
        launches = ws.launches(first, last, num_passes, save_every, ws.most_passes(2 * ws.arrays.num_tetrahedra))
        if self.law_frames:
            launches = self.law_frames.noted_before(launches, self.z)
        Passes(ws, self, ws.record, first, 1, num_passes, save_every).go("tangent", self.stages, launches)

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        """Changes of the frames' contact forces."""
        return self.impulses.collect() / frame_time

    def save_frame(self, frame: int) -> None:
        """Copy the current tangent to a frame."""
        copy_slot(self.u, 0, self.frames.frames_u, frame)
        copy_slot(self.v, 0, self.frames.frames_v, frame)
        if self.law_frames:
            self.law_frames.note(frame, self.z)

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities, float64."""
        du, dv = (runtime.fetch(x).astype(np.float64) for x in self.frames)
        return du + self.tangent.rest, dv
