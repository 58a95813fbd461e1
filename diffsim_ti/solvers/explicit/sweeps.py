"""The reverse sweep and the tangent of a chain of kick-drift passes, along recorded states."""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.joints.explicit import JointStageAdjoint, JointStageTangent
from diffsim_ti.mechanics.obstacles.impulse_record import ImpulseRecord
from diffsim_ti.mechanics.stage import Passes
from diffsim_ti.mechanics.stress.law_state import LawFrames
from diffsim_ti.mechanics.workspace import FrameArrays
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.numbers import OF_STEPS, Adjoint, Tangent

STEPS = [name for name in OF_STEPS if name != "path"]
PARTS = 64  # sums over vertices that a GPU's threads make side by side


class ExplicitAdjoint:
    """Adjoint arrays of one run and the sweep that fills them.

    density, shape: also the adjoints by vertex masses and by the rest shape, which cost extra.
    """

    def __init__(self, workspace, density: bool, shape: bool):
        self.ws = weakref.proxy(workspace)  # which keeps launches with these arrays: no circle
        a = workspace.arrays
        self.features = a.features(density, shape)
        self.numbers = Adjoint(a, self.features, more=STEPS)
        self.frames = FrameArrays.of(a, *workspace.frames.frames_u.shape)
        self.num_parts = 1 if runtime.runs_on_cpu() else PARTS
        self.steps, self._made = self._most_steps(workspace), self._shapes(workspace)
        self._arrays = {name: runtime.array(a.vector, *shape) for name, shape in self._made.items()}
        if a.law.state_names:
            self._arrays["z"] = a.law_states(1)
        self.law_frames = LawFrames(workspace) if workspace.law_frames else None
        self._of_bodies = a.bodies.adjoint() if a.bodies else {}
        self._arrays |= self._of_bodies
        vars(self).update(self._arrays)
        self.impulses = ImpulseRecord(workspace, workspace.impulses.wanted) if workspace.impulses else None
        self.stages = [stage.with_buffers("adjoint", self) for stage in workspace.stages]
        self.joints = next((stage for stage in self.stages if isinstance(stage, JointStageAdjoint)), None)

    def fits(self, workspace) -> bool:
        """Whether kernels and shapes are still those of the run; they are as long as launches stay bound."""
        return workspace.kept(("fits", id(self)), lambda: self if self._fits(workspace) else None) is self

    def _fits(self, workspace) -> bool:
        a = workspace.arrays
        same = self.numbers.fits(a, a.features(self.features.density, self.features.shape))
        same = same and self._made == self._shapes(workspace)
        return same and self.frames.frames_u.shape == workspace.frames.frames_u.shape

    def _shapes(self, workspace) -> dict[str, tuple[int, ...]]:
        """Of arrays of vectors: what is still to be gathered from corners, sums, and what interactions add adjoints to."""
        a, has = workspace.arrays, self.features
        n, moving = a.num_vertices, has.moving
        rates = "H_dot" in a.law.reads or any(x.reads_rates for x in has.interactions)
        out = dict.fromkeys(("u", "v", "w"), (1, n))
        out |= dict(corner=a.corner.shape, rate_corner=a.corner.shape if rates else (1,))
        # of paths: the adjoint by each vertex in the steps that a launch goes through, and the sums of that
        out["path_adjoint"] = 2 * moving * self._most_steps(workspace), n if moving else 1
        out["path"] = a.path.shape[0], moving * self.num_parts
        if has.led:
            out["offsets"] = a.poses.size, n
        for x in a.interactions:
            out |= x.adjoints(a.values, has.shape)
        return out

    def _most_steps(self, workspace) -> int:
        """The most steps that the passes of a launch lie in; 1 where sums are made after each pass."""
        substeps = int(np.min(workspace.solver.schedule.substeps))
        return 1 + -(-(workspace.in_parallel - 1) // substeps) if workspace.repeated else 1

    def start(self, positions_adj: np.ndarray, velocities_adj: np.ndarray, last_frame_is_input: bool) -> None:
        """Set the adjoints of the frames, shape (frames, n, 3), and clear the rest.

        last_frame_is_input: the last frame is the state after the last pass (else the last pass shows it itself).
        """
        self.clear()
        runtime.fill(self.frames.frames_u, positions_adj)
        runtime.fill(self.frames.frames_v, velocities_adj)
        if last_frame_is_input:
            runtime.fill(self.u, positions_adj[-1:])
            runtime.fill(self.v, velocities_adj[-1:])

    def seed_contacts(self, forces_adj: np.ndarray | None, frame_time: np.ndarray) -> None:
        """Set the adjoints of the frames' contact forces (None: zero)."""
        if forces_adj is not None:
            self.impulses.put(forces_adj / frame_time)

    def clear(self) -> None:
        """All adjoints zero, but those of the frames."""
        self.numbers.clear()
        runtime.clear(self._arrays.values())
        if self.impulses:
            self.impulses.clear()
        for stage in self.stages:
            stage.clear()

    def reverse(
        self, base: int, last: int, num_passes: int, save_every: int, stop: int, to_state: bool = False
    ) -> None:
        """Go back through passes last - 1 .. stop; slot 0 of the record holds the state before pass `base`.

        to_state: stop at the state that pass `stop` shows, and leave the half kick that leads to it to `reverse_kick`.
        """
        most = self.ws.most_passes(2 * self.ws.arrays.num_tetrahedra)  # a pass costs twice as much as forward
        launches = self.ws.launches(stop, last, num_passes, save_every, most, backwards=True)
        if self.law_frames:
            launches = self.law_frames.added_after(launches, self.z)
        self._run(launches, base, num_passes, save_every, halt=stop if to_state else -1)

    def reverse_kick(self, j: int, base: int, num_passes: int) -> None:
        """Go back through the half kick that leads to the state which pass j shows."""
        if np.any(self.ws.solver.weights(np.array([j]), num_passes, self.ws.rate).pre):
            self._run(self.ws.launches(j, j + 1, num_passes, 0, 1), base, num_passes, 0, kick=True)

    def _run(self, launches, base: int, num_passes: int, save_every: int, **options) -> None:
        at = Passes(self.ws, self, self.ws.record, base, 1, num_passes, save_every, **options)
        at.go("adjoint", self.stages, launches)

    def finish(self) -> None:
        """Add to the adjoint of the start what the last pass handed to the corners of tetrahedra."""
        ws = self.ws
        ws.bound(ws.kernels(self.features).finish_vjp, adjoint=self)(num_vertices=ws.arrays.num_vertices)

    def complete(self) -> None:
        """The same within a sweep, which goes on without it."""
        self.finish()
        runtime.clear((self.corner, self.rate_corner))

    def norm(self) -> tuple[float, float]:
        """Euclidean norms of the adjoints of displacement and velocity where the sweep stands.

        Fixed vertices have no velocity, and affine sets only admissible motions.
        """
        self.complete()
        u, v = (runtime.fetch(x)[0].astype(np.float64) for x in (self.u, self.v))
        reduced = self.ws.scene.reduced
        u, v = reduced.of(u), reduced.of(self.ws.arrays.supports.free(v))
        if self.joints:
            u, v = np.append(u, self.joints.by_q), np.append(v, self.joints.by_v)
        return float(np.linalg.norm(u)), float(np.linalg.norm(v))

    def scale(self, factor: float) -> None:
        """Multiply the running adjoint, for clipping."""
        for name in {"u", "v", "corner", "rate_corner", "z"} & self._arrays.keys():
            x = self._arrays[name]
            runtime.fill(x, runtime.fetch(x) * factor)
        if self.joints:
            self.joints.scale(factor)

    def collect(self, state: bool = True) -> Derived:
        """Adjoints of what kernels read, in float64, at the start of the run; state=False leaves out those of the state."""
        out = self.numbers.collect()
        if state:
            out.displacement += runtime.fetch(self.u)[0]
            out.velocity += runtime.fetch(self.v)[0]
        if self.features.moving:
            path = runtime.fetch(self.path).astype(np.float64)
            out.path += path.reshape(len(path), self.features.moving, self.num_parts, 3).sum(2)
        if self.features.shape:
            out.rest = runtime.fetch(self.frames.frames_u).astype(np.float64).sum(0) + out.rest
        a, shape = self.ws.arrays, self.features.shape
        names = [name for x in a.interactions for name in x.adjoints(a.values, shape)]
        found = {name: runtime.fetch(self._arrays[name]).astype(np.float64) for name in names}
        for x in a.interactions:
            x.collect(found, out, shape)
        if self._of_bodies:
            a.bodies.collect(self._of_bodies, out)
        for stage in self.stages:
            stage.collect(out)
        return out


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
        self.impulses = ImpulseRecord(workspace, workspace.impulses.wanted) if workspace.impulses else None
        if a.bodies:
            vars(self).update(a.bodies.tangent(tangent))
        if self.z is not None:
            runtime.fill(self.z, 0)
        self.rate_dot = float(tangent.parameters[self.features.drag]) if self.features.drag >= 0 else 0.0
        self.stages = [stage.with_buffers("tangent", self) for stage in workspace.stages]
        self.joints = next((stage.joints for stage in self.stages if isinstance(stage, JointStageTangent)), None)
        self.offsets = (
            runtime.array(a.vector, a.poses.size) if self.features.led else None
        )  # where robots move obstacles

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
        if self.joints:
            self.joints.note()

    @property
    def joint_frames(self) -> list:
        """Changes of the frames' joint positions and velocities."""
        return self.joints.frames

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities, float64."""
        du, dv = (runtime.fetch(x).astype(np.float64) for x in self.frames)
        return du + self.tangent.rest, dv
