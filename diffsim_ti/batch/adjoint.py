"""The reverse sweep and the tangent of many scenes in lanes."""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.lanes import in_slots, pack, unpack, vectors
from diffsim_ti.inputs import Derived

OF_STEPS = "forces", "motion", "path"
CLEARED = ("u", "v", "w", "corner", "rate_corner", "coefficients", "gradients", "volumes", "sums", "felt", "anchor")
CLEARED += OF_STEPS


class LanesAdjoint:
    """Adjoint arrays of one run of a batch and the sweep that fills them; see ExplicitAdjoint (solvers/explicit)."""

    def __init__(self, workspace, density: bool, shape: bool):
        self.ws = weakref.proxy(workspace)
        ws, a = workspace, workspace.arrays
        self.features, self.own = a.features(density, shape), workspace.own
        n, m = 3 * ws.num_rows, ws.num_blocks * a.num_tetrahedra
        self.u, self.v, self.w = (runtime.array(ws.lanes, 1, n) for _ in range(3))
        self.corner = runtime.array(ws.lanes, n)
        self.rate_corner = runtime.array(ws.lanes, n if "H_dot" in a.law.reads else 1)
        self.z = runtime.array(ws.lanes, 1, ws.law_rows) if ws.law_rows else None
        self.coefficients = runtime.array(ws.lanes, a.num_coefficients * m)
        self.gradients = runtime.array(ws.lanes, 9 * a.points * m * shape)
        self.volumes = runtime.array(ws.lanes, a.points * m * shape)
        self.sums = runtime.array(ws.lanes, self.features.sums().total, ws.num_rows)
        self.felt = runtime.array(ws.lanes, 2 * self.features.moving, n if self.features.moving else 1)
        for name in (*OF_STEPS, "anchor"):
            setattr(self, name, runtime.array(ws.lanes, *getattr(ws.numbers, name).shape))
        frames = ws.room_for_frames(ws.frames.frames_u.shape[0])
        self.frames_u, self.frames_v = frames.frames_u, frames.frames_v

    def fits(self, workspace) -> bool:
        """Whether kernels and shapes are still those of the run."""
        a, ws = workspace.arrays, workspace
        same = self.features == a.features(self.features.density, self.features.shape) and self.own == ws.own
        names = (*OF_STEPS, "anchor")
        return same and all(getattr(self, name).shape == getattr(ws.numbers, name).shape for name in names)

    def start(self, positions_adj: np.ndarray, velocities_adj: np.ndarray, last_frame_is_input: bool) -> None:
        """Set the adjoints of the frames, shape (scenes, frames, n, 3), and clear the rest."""
        for name in (
            "u",
            "v",
            "w",
            "corner",
            "coefficients",
            "gradients",
            "volumes",
            "sums",
            "felt",
            "anchor",
            *OF_STEPS,
        ):
            runtime.fill(getattr(self, name), 0)
        for target, state, adjoint in ((self.frames_u, self.u, positions_adj), (self.frames_v, self.v, velocities_adj)):
            runtime.fill(target, pack(adjoint.reshape(*adjoint.shape[:2], -1)))
            if last_frame_is_input:
                runtime.fill(state, pack(adjoint[:, -1:].reshape(len(adjoint), 1, -1)))

    def reverse(
        self, base: int, last: int, num_passes: int, save_every: int, stop: int, to_state: bool = False
    ) -> None:
        """Go back through passes last - 1 .. stop; slot 0 of the record holds the states before pass `base`."""
        halt = stop if to_state else -1
        for numbers in self.ws.launches(stop, last, num_passes, save_every, backwards=True):
            ws = self.ws
            launch = ws.bound(ws.kernels(self.features).step_vjp, state=(ws.record, ws.frames, ws.met), adjoint=self)
            launch(**numbers, base=base, num_passes=num_passes, halt=halt, kick=0, steps=1, num_parts=1)

    def finish(self) -> None:
        """Complete the adjoint of the start."""
        u, corner = runtime.fetch(self.u), runtime.fetch(self.corner)
        runtime.fill(self.u, u + corner[None])
        if "H_dot" in self.ws.arrays.law.reads:
            runtime.fill(self.v, runtime.fetch(self.v) + runtime.fetch(self.rate_corner)[None])

    def collect(self) -> Derived:
        """Adjoints of what kernels read, in float64, all with the scenes as their first axis."""
        ws, B = self.ws, self.ws.num_scenes
        a, features, rows = ws.arrays, self.features, self.features.sums()
        one, sums = ws.derived[0], self._of(self.sums)
        out = Derived(*(None if x is None else np.zeros((B, *x.shape)) for x in one.parts().values()))
        out.coefficients = self._of(self.coefficients).reshape(B, a.num_tetrahedra, -1)
        out.parameters[:, : features.num_parameters] = sums[:, rows.of("parameters")].sum(2)
        if features.density:
            out.mass = sums[:, rows.first("mass")]
        if features.shape:
            frames = vectors(self.frames_u, B).astype(np.float64).sum(1)
            out.rest = sums[:, rows.of("rest")].swapaxes(1, 2) + frames
            out.gradients = self._of(self.gradients).reshape(B, *one.gradients.shape)
            out.volumes = self._of(self.volumes).reshape(B, *one.volumes.shape)
        if features.areas:
            out.surface = sums[:, rows.first("surface")]
        for name in OF_STEPS:
            if getattr(one, name) is not None:
                setattr(out, name, vectors(getattr(self, name), B).astype(np.float64))
        out.displacement, out.velocity = (vectors(x, B)[:, 0].astype(np.float64) for x in (self.u, self.v))
        if one.motion is not None:
            out.displacement[:, a.held] += self._of(self.anchor).reshape(B, -1, 3)
        return out

    def _of(self, array) -> np.ndarray:
        return unpack(runtime.fetch(array), self.ws.num_scenes).astype(np.float64)


class LanesTangent:
    """The tangents of the runs of a batch: changes of the states for changes of everything that kernels read."""

    def __init__(self, workspace, tangents: list[Derived]):
        self.ws = weakref.proxy(workspace)
        ws, a = workspace, workspace.arrays
        self.features = a.features(density=True, shape=True)
        for name, part in (("u", "displacement"), ("v", "velocity")):
            data = pack(np.stack([getattr(d, part).ravel() for d in tangents]))
            setattr(self, name, runtime.upload(data[None], ws.lanes))
        self.z = runtime.array(ws.lanes, 1, ws.law_rows) if ws.law_rows else None
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
            rest=[d.rest for d in tangents],
            surface=[np.zeros(a.num_vertices) if d.surface is None else d.surface for d in tangents],
            rate=[
                np.atleast_1d(d.parameters[self.features.drag] if self.features.drag >= 0 else 0.0) for d in tangents
            ],
            anchor=[np.zeros(3) if d.motion is None else d.displacement[a.held] for d in tangents],
        )
        for name, arrays in flat.items():
            setattr(self, name, runtime.upload(pack(np.stack([x.ravel() for x in arrays])), ws.lanes))
        for name in OF_STEPS:
            rows = [np.zeros((1, 1, 3)) if getattr(d, name) is None else getattr(d, name) for d in tangents]
            setattr(self, name, runtime.upload(pack(in_slots(rows)), ws.lanes))
        frames = ws.room_for_frames(ws.frames.frames_u.shape[0])
        self.frames_u, self.frames_v = frames.frames_u, frames.frames_v

    def advance(self, first: int, last: int, num_passes: int, save_every: int) -> None:
        """Tangents of passes first .. last - 1, recorded from slot 0."""
        ws = self.ws
        launch = ws.bound(ws.kernels(self.features).step_jvp, state=(ws.record, ws.frames, ws.met), tangent=self)
        for j in range(first, last):
            for numbers in ws.launches(j, j + 1, num_passes, save_every):
                launch(**numbers, base=first)

    def save_frame(self, frame: int) -> None:
        """Copy the current change to a frame."""
        for target, source in ((self.frames_u, self.u), (self.frames_v, self.v)):
            rows = runtime.fetch(target)
            rows[frame] = runtime.fetch(source)[0]
            runtime.fill(target, rows)

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities, (scenes, frames, n, 3), float64."""
        B = self.ws.num_scenes
        return tuple(vectors(x, B).astype(np.float64) for x in (self.frames_u, self.frames_v))
