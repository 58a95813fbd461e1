"""The reverse sweep and the tangent of a chain of kick-drift passes, along recorded states."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.solvers.explicit.kick_drift import kick_drift_kernels
from diffsim_ti.state.arrays import copy_slot, from_blocks, to_blocks


class ExplicitAdjoint:
    """Adjoint arrays of one run and the sweep that fills them.

    density, shape: also the adjoints by vertex masses and by the rest shape, which cost extra.
    """

    def __init__(self, workspace, density: bool, shape: bool):
        self.ws = workspace
        a = workspace.arrays
        self.features = a.features(density, shape)
        self.kernels = kick_drift_kernels(a.law, self.features, workspace.parallel, a.in_lanes)
        n, blocks = a.num_vertices, a.num_blocks
        self.u, self.v, self.w = (runtime.array(a.vector, 1, n) for _ in range(3))
        self.corner = runtime.array(a.vector, *a.corner.shape)
        self.coefficients = runtime.array(a.lanes, a.num_coefficients * blocks)
        self.sums = runtime.array(a.fp, self.features.sums().total, n)
        self.forces, self.motion = (runtime.array(a.vector, *x.shape) for x in (a.forces, a.motion))
        self.anchor = runtime.array(a.vector, *a.anchor.shape)
        self.path = runtime.array(a.vector, *a.path.shape)
        self.felt = runtime.array(a.vector, 2 * self.features.moving, n if self.features.moving else 1)
        self.gradients = runtime.array(a.lanes, 9 * blocks if shape else 1)
        self.volumes = runtime.array(a.lanes, blocks if shape else 1)
        self.frames = tuple(runtime.array(a.vector, *f.shape) for f in workspace.frames)

    def fits(self, workspace) -> bool:
        """Whether kernels and shapes are still those of the run."""
        a, kept = workspace.arrays, (self.forces, self.path, *self.frames)
        same = self.features == a.features(self.features.density, self.features.shape)
        return same and all(x.shape == y.shape for x, y in zip(kept, (a.forces, a.path, *workspace.frames)))

    def _sums(self) -> tuple:
        return (
            self.coefficients,
            self.sums,
            self.forces,
            self.motion,
            self.anchor,
            self.path,
            self.felt,
            self.gradients,
            self.volumes,
        )

    def start(self, positions_adj: np.ndarray, velocities_adj: np.ndarray, last_frame_is_input: bool) -> None:
        """Set the adjoints of the frames, shape (frames, n, 3), and clear the rest.

        last_frame_is_input: the last frame is the state after the last pass (else the last pass shows it itself).
        """
        self.clear()
        runtime.fill(self.frames[0], positions_adj)
        runtime.fill(self.frames[1], velocities_adj)
        if last_frame_is_input:
            runtime.fill(self.u, positions_adj[-1:])
            runtime.fill(self.v, velocities_adj[-1:])

    def clear(self) -> None:
        """All adjoints zero, but those of the frames."""
        for target in (*self._sums(), self.u, self.v, self.w):
            runtime.fill(target, 0)
        if self.ws.pairs:
            self.ws.pairs.clear_sums()

    def reverse(self, base: int, last: int, num_passes: int, save_every: int, stop: int) -> None:
        """Mirror passes last - 1 .. stop; slot 0 of the record holds the state before pass `base`."""
        ws, a = self.ws, self.ws.arrays
        history = ws.record
        launch = ws._launch(
            "vjp",
            self.kernels.step_vjp,
            *a.topology(),
            a.force_slot,
            a.motion_slot,
            a.path,
            self.corner,
            history.u,
            history.v,
            history.f,
            self.u,
            self.v,
            self.w,
            *self._sums(),
            *self.frames,
        )
        substeps, inverse_dt = ws.solver.substeps, 1 / ws.solver.dt
        chunk = 1 if ws.parallel or ws.pairs else max(1, ws.work_per_launch // (2 * a.num_tetrahedra))
        for start, count, w in reversed(ws.solver.groups(stop, last, num_passes, ws.rate)):
            end = start + count
            while end > start:
                begin = max(start, end - chunk)
                launch(
                    a.num_items,
                    a.num_vertices,
                    begin,
                    end - begin,
                    base,
                    num_passes,
                    substeps,
                    save_every,
                    w.lag0,
                    w.lag1,
                    w.pre,
                    w.post,
                    w.alpha,
                    w.decay,
                    inverse_dt,
                    ws.solver.substep,
                    w.alpha_by_rate,
                    w.decay_by_rate,
                )
                if ws.pairs:
                    ws.pairs.ensure(history.u, begin - base)
                    ws.pairs.vjp(history.u, begin - base, self.w, self.corner)
                end = begin

    def finish(self) -> None:
        """Complete the adjoint of the start."""
        a = self.ws.arrays
        self.ws._launch("finish", self.kernels.finish_vjp, a.start, a.corner_of, self.corner, self.u)(a.num_vertices)

    def norm(self) -> tuple[float, float]:
        """Euclidean norms of the adjoints of displacement and velocity where the sweep stands."""
        return tuple(float(np.linalg.norm(runtime.fetch(x).astype(np.float64))) for x in (self.u, self.v))

    def scale(self, factor: float) -> None:
        """Multiply the running adjoint (clipping; the pending gather is scaled with it)."""
        for x in (self.u, self.v, self.corner):
            runtime.fill(x, runtime.fetch(x) * factor)

    def collect(self, state: bool = True) -> Derived:
        """Adjoints of what kernels read, in float64, at the start of the run; state=False leaves out those of the state."""
        a, values = self.ws.arrays, self.ws.arrays.values
        rows = self.features.sums()
        sums = runtime.fetch(self.sums).astype(np.float64)
        out = values.zeros()
        out.coefficients = from_blocks(runtime.fetch(self.coefficients), a.place, a.num_coefficients)
        if state:
            out.displacement = runtime.fetch(self.u)[0].astype(np.float64)
            out.velocity = runtime.fetch(self.v)[0].astype(np.float64)
        if self.features.density:
            out.mass = sums[rows.first("mass")]
        out.parameters[: self.features.num_parameters] = sums[rows.of("parameters")].sum(1)
        if self.ws.pairs:
            out.parameters[a.parameters_of_self_contact], out.rest = self.ws.pairs.collect()
        if self.features.shape:
            out.rest = out.rest + runtime.fetch(self.frames[0]).astype(np.float64).sum(0)
            out.rest += sums[rows.of("rest")].T
            out.gradients = from_blocks(runtime.fetch(self.gradients), a.place, 9).reshape(-1, 3, 3)
            out.volumes = from_blocks(runtime.fetch(self.volumes), a.place, 1)[:, 0]
        if out.forces is not None:
            out.forces = runtime.fetch(self.forces).astype(np.float64)
        if out.motion is not None:
            out.motion = runtime.fetch(self.motion).astype(np.float64)
            out.displacement[a.fixed] += runtime.fetch(self.anchor)
        if out.path is not None:
            out.path = runtime.fetch(self.path).astype(np.float64)
        return out


class ExplicitTangent:
    """The tangent of a run: changes of the state for changes of everything that kernels read."""

    def __init__(self, workspace, dots: Derived):
        self.ws = workspace
        a = workspace.arrays
        self.features = a.features(density=True, shape=True)
        self.kernels = kick_drift_kernels(a.law, self.features, workspace.parallel, a.in_lanes)
        self.u = runtime.upload(dots.displacement[None], a.vector)
        self.v = runtime.upload(dots.velocity[None], a.vector)
        self.frames = tuple(runtime.array(a.vector, *f.shape) for f in workspace.frames)
        motion = np.zeros((1, 1, 3)) if dots.motion is None else dots.motion
        anchor = np.zeros((1, 3)) if dots.motion is None else dots.displacement[a.fixed]
        self._dots = (
            runtime.upload(a.coefficient_blocks(dots.coefficients), a.lanes),
            runtime.upload(dots.mass, a.fp),
            runtime.upload(dots.parameters, a.fp),
            runtime.upload(dots.rest, a.vector),
            runtime.upload(np.zeros((1, 1, 3)) if dots.forces is None else dots.forces, a.vector),
            runtime.upload(motion, a.vector),
            runtime.upload(anchor, a.vector),
            runtime.upload(np.zeros((1, 1, 3)) if dots.path is None else dots.path, a.vector),
            runtime.upload(to_blocks(dots.gradients, a.order), a.lanes),
            runtime.upload(a.volume_blocks(dots.volumes), a.lanes),
        )
        self._rate_dot = float(dots.parameters[self.features.drag]) if self.features.drag >= 0 else 0.0
        self._rest_dot, self._parameters_dot = dots.rest, dots.parameters

    def advance(self, first: int, last: int, num_passes: int, save_every: int) -> None:
        """Tangent of passes first .. last - 1, recorded from slot 0."""
        ws, a, history = self.ws, self.ws.arrays, self.ws.record
        launch = runtime.Launch(
            self.kernels.step_jvp,
            *a.topology(),
            a.force_slot,
            a.motion_slot,
            a.path,
            a.corner,
            history.u,
            history.v,
            history.f,
            self.u,
            self.v,
            *self._dots,
            *self.frames,
            vectorized=a.in_lanes,
        )
        for start, count, w in ws.solver.groups(first, last, num_passes, ws.rate):
            for j in range(start, start + count):
                if ws.pairs:
                    ws.pairs.ensure(history.u, j - first)
                    ws.pairs.product(
                        history.u,
                        j - first,
                        self.u,
                        a.corner,
                        self._dots[3],
                        self._parameters_dot[a.parameters_of_self_contact],
                    )
                launch(
                    a.num_items,
                    a.num_vertices,
                    j,
                    first,
                    ws.solver.substeps,
                    save_every,
                    w.lag0,
                    w.lag1,
                    w.pre,
                    w.post,
                    w.alpha,
                    w.decay,
                    1 / ws.solver.dt,
                    ws.solver.substep,
                    w.alpha_by_rate * self._rate_dot,
                    w.decay_by_rate * self._rate_dot,
                )

    def save_frame(self, frame: int) -> None:
        """Copy the current tangent to a frame."""
        copy_slot(self.u, 0, self.frames[0], frame)
        copy_slot(self.v, 0, self.frames[1], frame)

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities, float64."""
        du, dv = (runtime.fetch(x).astype(np.float64) for x in self.frames)
        return du + self._rest_dot, dv
