"""The tangent of a chain of kick-drift passes, along recorded states."""

import weakref
from contextlib import contextmanager, nullcontext

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.held_volume_derivatives import HeldTangent
from diffsim_ti.mechanics.obstacles.felt_derivatives import FeltTangent
from diffsim_ti.mechanics.obstacles.impulse_record import ImpulseRecord
from diffsim_ti.mechanics.stress.law_frames import LawFrames
from diffsim_ti.mechanics.workspace import FrameArrays
from diffsim_ti.runtime.slots import copy_slot
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
        self.faces = FeltTangent(self, workspace.faces) if workspace.faces else None
        self.held = HeldTangent(self, workspace.volumes, tangent) if workspace.volumes else None
        self.chamber_record = self.held.chambers if self.held else None
        if workspace.impulses:
            self.impulses = ImpulseRecord(workspace)
            self.impulse = self.impulses.impulse
        if a.bodies:
            vars(self).update(a.bodies.tangent(tangent))
        if self.z is not None:
            runtime.fill(self.z, 0)
        self._rate_dot = float(tangent.parameters[self.features.drag]) if self.features.drag >= 0 else 0.0

    def advance(self, first: int, last: int, num_passes: int, save_every: int) -> None:
        """Tangent of passes first .. last - 1, recorded from slot 0."""
        ws, a, history = self.ws, self.ws.arrays, self.ws.record
        states, own = (history, ws.frames, ws.watch, ws.contact), (self, self.numbers, self.frames)
        launch = ws.bound(ws.kernels(self.features).step_jvp, state=states, tangent=own, table=ws.table)
        most = ws.most_passes(2 * a.num_tetrahedra)
        for numbers in ws.launches(first, last, num_passes, save_every, most):
            slot = numbers["first"] - first
            if ws.pairs:
                ws.pairs.ensure(history.u, slot)
                if ws.pairs.friction:
                    ws.pairs.friction.begin_jvp(history, slot, self.u, self.numbers)
                of_contact = self.tangent.parameters[a.parameters_of_self_contact]
                ws.pairs.product(history.u, slot, self.u, a.corner, self.numbers.rest, of_contact)
            if ws.chambers:
                ws.chambers.jvp(history, slot, numbers, self.u, self.numbers)
            if self.law_frames:
                self.law_frames.note(numbers["shown"], self.z)
            if self.held:
                self.held.before()
            with ws.volumes.alone(history, slot + 1) if self.held else nullcontext():
                alone = ws.faces.alone(history, slot + 1) if ws.faces else None
                with self._rubbing(slot, numbers, num_passes), nullcontext() if alone is None else alone:
                    if alone:
                        self.faces.start(alone, numbers)
                    launch(**numbers, base=first, rate_dot=self._rate_dot)
                    if alone:
                        self._end_faces(alone, numbers)
            if self.held:
                self.held.after(numbers["first"], slot, num_passes, save_every, self._rate_dot)

    @contextmanager
    def _rubbing(self, slot: int, numbers: dict, num_passes: int):
        """The pass without friction of surfaces on each other, and then that."""
        friction, history = self.ws.pairs.friction if self.ws.pairs else None, self.ws.record
        now = self.ws.numbers_of(numbers["first"], num_passes) if friction else None
        if now is None or not now.alpha > 0:
            yield
            return
        with friction.alone(history, slot + 1):
            yield
            friction.slide_jvp(history, slot + 1, now, self._rate_dot, self.u, self.v, self.numbers)

    def _end_faces(self, alone, numbers: dict) -> None:
        """What faces do, whose impulse may be asked for."""
        before = runtime.fetch_row(self.v, 0) if self.ws.impulses else None
        self.faces.end(alone, numbers)
        if before is not None:
            change = runtime.fetch_row(self.v, 0) - before
            self.impulses.add_jvp(numbers, alone.speed, change, self.tangent.mass, alone.pushes)
        of_friction = self.faces.slide(alone, self.tangent, self._rate_dot)
        if before is not None:
            self.impulses.add_friction(numbers, of_friction)

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
