"""The reverse sweep of a chain of kick-drift passes, along recorded states."""

import weakref
from collections.abc import Callable
from contextlib import contextmanager, nullcontext
from functools import partial
from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.held_volume_derivatives import HeldAdjoint
from diffsim_ti.mechanics.obstacles.felt_derivatives import FeltAdjoint
from diffsim_ti.mechanics.obstacles.impulse_record import ImpulseRecord
from diffsim_ti.mechanics.stress.law_frames import LawFrames
from diffsim_ti.mechanics.workspace import FrameArrays
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.numbers import OF_STEPS, Adjoint

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
        self.u, self.v, self.w = (runtime.array(a.vector, 1, a.num_vertices) for _ in range(3))
        self.corner = runtime.array(a.vector, *a.corner.shape)  # products with the stiffness, still to be gathered
        rates = "H_dot" in a.law.reads or any(x.reads_rates for x in self.features.interactions)
        self.rate_corner = runtime.array(a.vector, *(a.corner.shape if rates else (1,)))
        whole = [runtime.array(a.vector, 1, a.num_vertices) for _ in range(1 + rates)]
        self.whole = SimpleNamespace(u=whole[0], v=whole[-1] if rates else self.v)  # with what is still to be gathered
        moving = self.features.moving
        self.num_parts = 1 if runtime.runs_on_cpu() else PARTS
        # of paths: what each vertex felt in the steps that a launch goes through, and the sums of that
        self.felt = runtime.array(a.vector, 2 * moving * self._steps, a.num_vertices if moving else 1)
        self.path = runtime.array(a.vector, a.path.shape[0], moving * self.num_parts)
        self.frames = FrameArrays.of(a, *workspace.frames.frames_u.shape)
        self.z = a.law_states(1)  # of the state of the law
        self.law_frames = LawFrames(workspace) if workspace.law_frames else None
        self._made_for = self._shapes(workspace)
        self.of_interactions = {name: runtime.array(a.vector, *shape) for name, shape in self._made_for.items()}
        vars(self).update(self.of_interactions)
        self.faces = FeltAdjoint(self, workspace.faces) if workspace.faces else None
        self.felt_by_bodies = a.bodies.adjoint() if a.bodies else {}
        vars(self).update(self.felt_by_bodies)
        self._sums = self._summed()
        self.held = HeldAdjoint(self, workspace.volumes) if workspace.volumes else None
        self.chamber_record = self.held.chambers if self.held else None
        if workspace.impulses:
            self.impulses = ImpulseRecord(workspace)
            self.impulse, self.mass_adj = self.impulses.impulse, np.zeros(a.num_vertices)

    def fits(self, workspace) -> bool:
        """Whether kernels and shapes are still those of the run; they are as long as launches stay bound."""
        return workspace.kept(("fits", id(self)), lambda: self if self._fits(workspace) else None) is self

    def _fits(self, workspace) -> bool:
        a = workspace.arrays
        same = self.numbers.fits(a, a.features(self.features.density, self.features.shape))
        same = same and self.felt.shape[0] == max(1, 2 * self.features.moving * self._steps)
        same = same and self.path.shape[0] == a.path.shape[0]
        same = same and self._made_for == self._shapes(workspace)
        return same and self.frames.frames_u.shape == workspace.frames.frames_u.shape

    def _shapes(self, workspace) -> dict[str, tuple[int, ...]]:
        """Of the arrays of vectors that interactions add adjoints to."""
        a, out = workspace.arrays, {}
        for x in a.interactions:
            out |= x.adjoints(a.values, self.features.shape)
        return out

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

    def _summed(self) -> list:
        """What passes add to, besides the numbers of the scene."""
        has, out = self.features, [self.u, self.v, self.w]
        out += [self.z] if self.z is not None else []
        out += [self.felt, self.path] if has.moving else []
        return [*out, *self.of_interactions.values(), *self.felt_by_bodies.values()]

    def clear(self) -> None:
        """All adjoints zero, but those of the frames."""
        if self.ws.impulses:
            self.impulses.clear()
            self.mass_adj[:] = 0
        self.numbers.clear()
        runtime.clear(self._sums)
        if self.ws.pairs:
            self.ws.pairs.clear_sums()
        for further in (self.faces, self.held):
            if further:
                further.clear()

    @property
    def _steps(self) -> int:
        """The most steps that the passes of a launch lie in; 1 where sums are made after each pass."""
        substeps = int(np.min(self.ws.solver.schedule.substeps))
        return 1 + -(-(self.ws.in_parallel - 1) // substeps) if self.ws.repeated else 1

    def reverse(
        self, base: int, last: int, num_passes: int, save_every: int, stop: int, to_state: bool = False
    ) -> None:
        """Go back through passes last - 1 .. stop; slot 0 of the record holds the state before pass `base`.

        to_state: stop at the state that pass `stop` shows, and leave the half kick that leads to it to `reverse_kick`.
        """
        halt = stop if to_state else -1
        most = self.ws.most_passes(2 * self.ws.arrays.num_tetrahedra)  # a pass costs twice as much as forward
        launch = self._bound(num_passes)
        for numbers in self.ws.launches(stop, last, num_passes, save_every, most, backwards=True):
            self._launch(launch, numbers, base, num_passes, save_every, halt, kick=0)
            if self.law_frames:
                self.law_frames.add_to(self.z, numbers["shown"])

    def reverse_kick(self, j: int, base: int, num_passes: int) -> None:
        """Go back through the half kick that leads to the state which pass j shows."""
        if self.held:
            self.held.go_before_state()
        if np.any(self.ws.solver.weights(np.array([j]), num_passes, self.ws.rate).pre):
            for numbers in self.ws.launches(j, j + 1, num_passes, 0, 1):
                self._launch(self._bound(num_passes), numbers, base, num_passes, 0, halt=-1, kick=1)

    def _bound(self, num_passes: int) -> Callable:
        """The kernel of a pass, with what all passes of a run share."""
        return self.ws.kept(("pass", id(self), num_passes), lambda: (self._bind(num_passes), self))[0]

    def _bind(self, num_passes: int) -> Callable:
        ws, own = self.ws, (self, self.numbers, self.frames)
        states = (ws.record, ws.frames, ws.watch, ws.contact)
        launch = ws.bound(ws.kernels(self.features).step_vjp, state=states, adjoint=own, table=ws.table)
        return partial(launch, num_passes=num_passes, steps=self._steps, num_parts=self.num_parts)

    def _launch(
        self, launch: Callable, numbers: dict, base: int, num_passes: int, save_every: int, halt: int, kick: int
    ) -> None:
        ws, history = self.ws, self.ws.record
        if not (ws.pairs or ws.chambers or self.faces or self.held):
            launch(**numbers, base=base, halt=halt, kick=kick)
            return
        slot = numbers["first"] - base
        if self.held and not kick:
            self._complete(numbers, num_passes)
            self.held.start(numbers["first"], slot, num_passes, save_every, numbers["first"] == halt)
            with ws.volumes.alone(history, slot + 1):
                self._launch_rest(launch, numbers, base, num_passes, halt, kick)
            self.held.end()
            return
        self._launch_rest(launch, numbers, base, num_passes, halt, kick)

    def _complete(self, numbers: dict, num_passes: int) -> None:
        """Gather what the pass after that of a launch has left."""
        if numbers["first"] < num_passes - 1:
            self._gather(self)
            runtime.fill(self.corner, 0)
            runtime.fill(self.rate_corner, 0)

    def _launch_rest(self, launch: Callable, numbers: dict, base: int, num_passes: int, halt: int, kick: int) -> None:
        ws, history, slot = self.ws, self.ws.record, numbers["first"] - base
        rubs = ws.pairs.friction if ws.pairs and not kick else None
        with self._rubbing(rubs, slot, numbers, num_passes), self._faces_of(slot + 1, kick) as alone:
            if alone:
                self._complete(numbers, num_passes)
                self._start_faces(alone, numbers)
            launch(**numbers, base=base, halt=halt, kick=kick)
            if alone:
                self.faces.end(alone, numbers)
        if ws.chambers:
            ws.chambers.vjp(history, slot, numbers, self, self.features.shape)
        if ws.pairs:
            ws.pairs.ensure(history.u, slot)
            ws.pairs.vjp(history.u, slot, self.w, self.corner)

    @contextmanager
    def _rubbing(self, friction, slot: int, numbers: dict, num_passes: int):
        """Go back through the friction of surfaces on each other, and then through the pass without it."""
        now = self.ws.numbers_of(numbers["first"], num_passes) if friction else None
        if now is None or not now.alpha > 0:
            yield
            return
        if not friction.takes_pending:
            self._complete(numbers, num_passes)
        with friction.alone(self.ws.record, slot + 1):
            pending = friction.takes_pending and numbers["first"] < num_passes - 1
            friction.slide_vjp(self.ws.record, slot, now, self, pending)
            yield
        friction.add_place(self)

    def _start_faces(self, alone, numbers: dict) -> None:
        """Go back through the contact of faces, whose impulse may be asked for."""
        self.faces.slide(alone, self.impulses.seed_friction(numbers) if self.ws.impulses else None)
        by_speed = self.impulses.seed(numbers, alone.pushes) if self.ws.impulses else None
        if by_speed is None:
            self.faces.start(alone, numbers)
            return
        runtime.fill(self.v, runtime.fetch(self.v) + by_speed)
        self.faces.start(alone, numbers)
        runtime.fill(self.v, runtime.fetch(self.v) - by_speed)
        self.mass_adj += self.impulses.by_mass(numbers, alone.speed, alone.pushes)

    def _faces_of(self, slot: int, kick: int):
        """The pass to a slot without contact within faces; nothing where there was none, or in a kick alone."""
        alone = self.faces.faces.alone(self.ws.record, slot) if self.faces and not kick else None
        return nullcontext() if alone is None else alone

    def finish(self) -> None:
        """Complete the adjoint of the start."""
        self._gather(self)

    def _gather(self, into) -> None:
        """Add to `into.u` and `into.v` what the last pass handed to the corners of tetrahedra."""
        ws = self.ws
        gather = ws.bound(ws.kernels(self.features).finish_vjp, adjoint=(into, self))
        gather(num_vertices=ws.arrays.num_vertices)

    def norm(self) -> tuple[float, float]:
        """Euclidean norms of the adjoints of displacement and velocity where the sweep stands.

        Held vertices have no velocity, and affine sets only the motions that they can do.
        """
        copy_slot(self.u, 0, self.whole.u, 0)
        if self.whole.v is not self.v:
            copy_slot(self.v, 0, self.whole.v, 0)
        self._gather(self.whole)
        u, v = (runtime.fetch(x)[0].astype(np.float64) for x in (self.whole.u, self.whole.v))
        reduced = self.ws.scene.reduced
        u, v = reduced.of(u), reduced.of(self.ws.arrays.supports.free(v))
        return float(np.linalg.norm(u)), float(np.linalg.norm(v))

    def scale(self, factor: float) -> None:
        """Multiply the running adjoint (clipping; the pending gather is scaled with it)."""
        for x in (self.u, self.v, self.corner, self.rate_corner, self.z):
            if x is not None:
                runtime.fill(x, runtime.fetch(x) * factor)

    def collect(self, state: bool = True) -> Derived:
        """Adjoints of what kernels read, in float64, at the start of the run; state=False leaves out those of the state."""
        out, rest = self.numbers.collect(), 0.0
        if state:
            out.displacement += runtime.fetch(self.u)[0]
            out.velocity += runtime.fetch(self.v)[0]
        if self.ws.pairs:
            out.parameters[self.ws.arrays.parameters_of_self_contact], rest = self.ws.pairs.collect()
            if self.ws.pairs.friction:
                by_mass, by_rate = self.ws.pairs.friction.collect_pass()
                out.mass = out.mass + by_mass
                if self.features.drag >= 0:
                    out.parameters[self.features.drag] += by_rate
        if self.features.moving:
            path = runtime.fetch(self.path).astype(np.float64)
            out.path += path.reshape(len(path), self.features.moving, self.num_parts, 3).sum(2)
        if self.features.shape:
            rest = rest + runtime.fetch(self.frames.frames_u).astype(np.float64).sum(0)
        out.rest = rest + out.rest
        found = {name: runtime.fetch(x).astype(np.float64) for name, x in self.of_interactions.items()}
        for x in self.ws.arrays.interactions:
            x.collect(found, out, self.features.shape)
        if self.felt_by_bodies:
            self.ws.arrays.bodies.collect(self.felt_by_bodies, out)
        if self.faces:
            self.faces.collect(out)
        if self.held:
            self.held.collect(out, self.features.drag)
        if self.ws.impulses:
            out.mass = out.mass + self.mass_adj
        return out
