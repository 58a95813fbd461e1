"""The reverse sweep and the tangent of many scenes side by side."""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.layouts import growths_placed, in_slots, placed
from diffsim_ti.batch.workspace import BatchImpulses
from diffsim_ti.inputs import Derived

OF_STEPS = "forces", "motion", "path"


class BatchAdjoint:
    """Adjoint arrays of one run of a batch and the sweep that fills them; see ExplicitAdjoint (solvers/explicit)."""

    def __init__(self, workspace, density: bool, shape: bool):
        self.ws = weakref.proxy(workspace)
        ws, a = workspace, workspace.arrays
        self.features, self.own = a.features(density, shape), workspace.own
        layout, n, m, moving = ws.layout, a.num_vertices, a.num_places, self.features.moving
        self.reads_rates = "H_dot" in a.law.reads or any(x.reads_rates for x in self.features.interactions)
        # those of interactions, of vectors
        self.further = {
            name: layout.vectors(*own) for x in a.interactions for name, own in x.adjoints(a.values, shape).items()
        }
        arrays = {name: layout.vectors(1, n) for name in ("u", "v", "w")} | self.further
        arrays["corner"] = ws.room_for_corners()
        arrays["rate_corner"] = ws.room_for_corners() if self.reads_rates else runtime.array(layout.vector, 1)
        if ws.law_rows:
            arrays["z"] = layout.numbers(1, ws.law_rows)
        arrays["coefficients"] = layout.numbers(a.num_coefficients * m)
        arrays["gradients"] = layout.numbers(9 * a.points * m * shape)
        arrays["volumes"] = layout.numbers(a.points * m * shape)
        arrays["sums"] = layout.numbers(self.features.sums().total, n)
        arrays["path_adjoint"] = layout.vectors(2 * moving * self._steps, n if moving else 1)
        for name in (*OF_STEPS, "anchor"):
            arrays[name] = runtime.array(layout.vector, *getattr(ws.numbers, name).shape)
        if self.features.growing:
            arrays["growths"] = runtime.array(layout.number, *ws.numbers.growths.shape)
        self.impulses = BatchImpulses(ws) if ws.impulses else None
        if self.impulses:
            arrays["impulse"] = self.impulses.impulse
        self._arrays, self.made_for = arrays, self._shapes()
        vars(self).update(arrays)
        frames = ws.room_for_frames(ws.frames.frames_u.shape[0])
        self.frames_u, self.frames_v = frames.frames_u, frames.frames_v

    @property
    def _steps(self) -> int:
        """The most steps that the passes of a launch on a GPU lie in; on the CPU sums are made after each pass."""
        substeps = int(np.min(self.ws.solver.schedule.substeps))
        return 1 + -(-(self.ws.in_parallel - 1) // substeps)

    def fits(self, workspace) -> bool:
        """Whether kernels and shapes are still those of the run."""
        a, ws = workspace.arrays, workspace
        same = self.features == a.features(self.features.density, self.features.shape) and self.own == ws.own
        return same and self.made_for == self._shapes()

    def _shapes(self) -> dict:
        """Of the scenes' arrays that adjoints have the shapes of."""
        names = *OF_STEPS, "anchor", "growths", *self.ws.arrays.own
        return {name: tuple(getattr(self.ws.numbers, name).shape) for name in names}

    def start(self, positions_adj: np.ndarray, velocities_adj: np.ndarray, last_frame_is_input: bool) -> None:
        """Set the adjoints of the frames, shape (scenes, frames, n, 3), and clear the rest."""
        layout = self.ws.layout
        runtime.clear(self._arrays.values())
        for target, state, adjoint in ((self.frames_u, self.u, positions_adj), (self.frames_v, self.v, velocities_adj)):
            runtime.fill(target, layout.pack_vectors(adjoint))
            if last_frame_is_input:
                runtime.fill(state, layout.pack_vectors(adjoint[:, -1:]))

    def seed_contacts(self, forces_adj: np.ndarray | None, frame_time: np.ndarray) -> None:
        """Set the adjoints of the frames' contact forces, (scenes, frames, ...) (None: zero)."""
        if forces_adj is not None:
            self.impulses.put(forces_adj / frame_time)

    def reverse(
        self, base: int, last: int, num_passes: int, save_every: int, stop: int, to_state: bool = False
    ) -> None:
        """Go back through passes last - 1 .. stop; slot 0 of the record holds the states before pass `base`."""
        halt = stop if to_state else -1
        for numbers in self.ws.launches(stop, last, num_passes, save_every, backwards=True):
            ws = self.ws
            launch = ws.bound(ws.kernels(self.features).step_vjp, state=(ws.record, ws.frames, ws.met), adjoint=self)
            launch(**numbers, base=base, halt=halt, kick=0, steps=self._steps, num_parts=1)

    def finish(self) -> None:
        """Complete the adjoint of the start."""
        ws = self.ws
        if not ws.layout.in_lanes:
            gather = ws.bound(ws.kernels(self.features).finish_vjp, adjoint=self)
            gather(
                **ws.layout.counts(ws.arrays.num_places, ws.arrays.num_vertices), num_vertices=ws.arrays.num_vertices
            )
            return
        u, corner = runtime.fetch(self.u), runtime.fetch(self.corner)
        runtime.fill(self.u, u + corner[None])
        if self.reads_rates:
            runtime.fill(self.v, runtime.fetch(self.v) + runtime.fetch(self.rate_corner)[None])

    def collect(self) -> Derived:
        """Adjoints of what kernels read, in float64, all with the scenes as their first axis."""
        ws, B = self.ws, self.ws.num_scenes
        a, features, rows = ws.arrays, self.features, self.features.sums()
        one, sums, vectors = ws.derived[0], self._of(self.sums), self._vectors
        out = one.mapped(lambda x: np.zeros((B, *x.shape)))
        out.coefficients = self._of_tetrahedra(self.coefficients, -1)
        out.parameters[:, : features.num_parameters] = sums[:, rows.of("parameters")].sum(2)
        if features.density:
            out.mass = sums[:, rows.first("mass")]
        if features.shape:
            frames = vectors(self.frames_u).sum(1)
            out.rest = sums[:, rows.of("rest")].swapaxes(1, 2) + frames
            out.gradients = self._of_tetrahedra(self.gradients, *one.gradients.shape[1:])
            out.volumes = self._of_tetrahedra(self.volumes, *one.volumes.shape[1:])
        if features.areas:
            out.surface = sums[:, rows.first("surface")]
        for name in OF_STEPS:
            if getattr(one, name) is not None:
                setattr(out, name, vectors(getattr(self, name)))
        out.displacement, out.velocity = (vectors(x)[:, 0] for x in (self.u, self.v))
        if one.motion is not None:
            out.displacement[:, a.held] += vectors(self.anchor)
        found = {name: vectors(x) for name, x in self.further.items()}
        for x in a.interactions:
            x.collect(found, out, self.features.shape)
        if self.features.growing:
            rows = self._of(self.growths).reshape(*out.growths.shape[:2], a.num_places, 2)[:, :, a.place]
            own = np.swapaxes(rows, 2, 3)
            out.growths = own.sum(3, keepdims=True) if out.growths.shape[3] == 1 else own
        return out

    def _of_tetrahedra(self, array, *shape: int) -> np.ndarray:
        a = self.ws.arrays
        return self._of(array).reshape(self.ws.num_scenes, a.num_places, *shape)[:, a.place]

    def _of(self, array) -> np.ndarray:
        return self.ws.layout.unpack(array).astype(np.float64)

    def _vectors(self, array) -> np.ndarray:
        return self.ws.layout.unpack_vectors(array).astype(np.float64)


class BatchTangent:
    """The tangents of the runs of a batch: changes of the states for changes of everything that kernels read."""

    def __init__(self, workspace, tangents: list[Derived]):
        self.ws = weakref.proxy(workspace)
        ws, a, layout = workspace, workspace.arrays, workspace.layout
        self.features = a.features(density=True, shape=True)
        for name, part in (("u", "displacement"), ("v", "velocity")):
            data = layout.pack_vectors(np.stack([getattr(d, part)[None] for d in tangents]))
            setattr(self, name, runtime.upload(data, layout.vector))
        self.z = layout.numbers(1, ws.law_rows) if ws.law_rows else None
        if self.z is not None:
            runtime.fill(self.z, 0)
        uniform = self.features.uniform
        whole = [np.broadcast_to(d.coefficients, (a.num_tetrahedra, a.num_coefficients)) for d in tangents]
        flat = dict(
            coefficients=[d.coefficients if uniform else w for d, w in zip(tangents, whole)],
            gradients=[d.gradients for d in tangents],
            volumes=[d.volumes for d in tangents],
            mass=[d.mass for d in tangents],
            parameters=[np.concatenate([d.parameters, 0 * a.tables]) for d in tangents],
            surface=[np.zeros(a.num_vertices) if d.surface is None else d.surface for d in tangents],
        )
        for name, arrays in flat.items():
            rows = np.stack([placed(a, name, x).ravel() for x in arrays])
            setattr(self, name, runtime.upload(layout.pack(rows), layout.number))
        growths = growths_placed(a, [d.growths for d in tangents])
        self.growths = runtime.upload(layout.pack(growths), layout.number)
        vectors = dict(
            rest=[d.rest for d in tangents],
            anchor=[np.zeros((1, 3)) if d.motion is None else d.displacement[a.held] for d in tangents],
        )
        vectors |= {name: [getattr(d, name) for d in tangents] for name, kind in a.own.items() if kind == "vectors"}
        for name, arrays in vectors.items():
            setattr(self, name, runtime.upload(layout.pack_vectors(np.stack(arrays)), layout.vector))
        for name in (*OF_STEPS, *a.rows_of_steps):
            rows = [np.zeros((1, 1, 3)) if getattr(d, name) is None else getattr(d, name) for d in tangents]
            setattr(self, name, runtime.upload(layout.pack_vectors(in_slots(rows)), layout.vector))
        frames = ws.room_for_frames(ws.frames.frames_u.shape[0])
        self.frames_u, self.frames_v = frames.frames_u, frames.frames_v
        self.impulses = BatchImpulses(ws) if ws.impulses else None
        if self.impulses:
            self.impulse = self.impulses.impulse

    def advance(self, first: int, last: int, num_passes: int, save_every: int) -> None:
        """Tangents of passes first .. last - 1, recorded from slot 0."""
        ws = self.ws
        launch = ws.bound(ws.kernels(self.features).step_jvp, state=(ws.record, ws.frames, ws.met), tangent=self)
        for numbers in ws.launches(first, last, num_passes, save_every):
            launch(**numbers, base=first, rate_dot=0.0)  # each scene has its own

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        """Changes of the frames' contact forces."""
        return self.impulses.collect() / frame_time

    def save_frame(self, frame: int) -> None:
        """Copy the current change to a frame."""
        for target, source in ((self.frames_u, self.u), (self.frames_v, self.v)):
            rows = runtime.fetch(target)
            rows[frame] = runtime.fetch(source)[0]
            runtime.fill(target, rows)

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities, (scenes, frames, n, 3), float64."""
        unpack = self.ws.layout.unpack_vectors
        return tuple(unpack(x).astype(np.float64) for x in (self.frames_u, self.frames_v))
