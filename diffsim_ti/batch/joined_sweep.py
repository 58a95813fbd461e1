"""n steps of an implicit solver of many scenes at once, forward and in reverse."""

from copy import copy

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.joined_hosts import of_each
from diffsim_ti.batch.joined_scene import joined_scene, of_scenes
from diffsim_ti.batch.joined_workspace import JoinedWorkspace
from diffsim_ti.batch.sweep import BatchSweep
from diffsim_ti.inputs import Derived
from diffsim_ti.solvers.implicit.adjoint import ImplicitAdjoint
from diffsim_ti.state.watch import limits


class Unguarded:
    """Takes the workspace through its passes: implicit steps say themselves what goes wrong."""

    def __init__(self, workspace):
        self.advance = self.advance_again = self._advance
        self.ws = workspace

    def restart(self) -> None:
        """Nothing is kept."""

    def _advance(self, first: int, last: int, num_passes: int, save_every: int = 0, recording: bool = False) -> None:
        if recording:
            self.ws.save(self.ws.record, first)
        self.ws.advance(first, last, num_passes, save_every, 0 if recording else None)


class JoinedAdjoint(ImplicitAdjoint):
    """Adjoints of the runs of all scenes; one linear solve for a pass of all."""

    def start(self, positions_adj, velocities_adj, last_frame_is_input) -> None:
        """positions_adj, velocities_adj: (scenes, frames, n, 3)"""
        joined = (np.moveaxis(x, 0, 1).reshape(x.shape[1], -1, 3) for x in (positions_adj, velocities_adj))
        super().start(*joined, last_frame_is_input)
        self.by_hosts = of_each([d.zeros() for d in self.ws.each])

    def solve(self, b):
        ws, newton = self.ws, self.ws.newton
        b = b * ws.free
        if not b.any():
            return b
        if self._preconditioner is None:
            ws.potential.only(~ws.left)
            self._preconditioner, _ = ws.preconditioner(self.mass)
            self._preconditioner.update(self.u_star)
        newton.mass, going = self.mass, ~ws.left
        mass, more = newton.system()
        tolerances, most = np.full(len(going), self.tolerance), 20 * len(b) // len(going)
        x, solved, *_ = self._preconditioner.solver(mass, more, b, tolerances, going, most, self.eps)
        ws.leave(~solved)
        return x * ws.free

    def _sum(self, x):
        return of_scenes(x, self.ws.num_scenes).sum(1)

    def _sum_of_poses(self, rows):
        return np.concatenate(list(of_scenes(rows, self.ws.num_scenes, axis=1).sum(2)))

    def collect(self) -> Derived:
        """The scenes are the first axis."""
        ws, features, count = self.ws, self.features, self.ws.num_scenes
        found, rows = self.numbers.collect(), features.sums()
        found.displacement, found.velocity, found.mass = self.p, self.q, self.mass_adj
        found.element_masses = self.element_masses
        found.rest = self.frames[0].sum(0) + self.rest_adj + (0.0 if found.rest is None else found.rest)
        if self.motion is not None:
            found.displacement[ws.arrays.held] += self.anchor
        out = ws.each[0].mapped(lambda x: np.zeros((count, *x.shape)))
        own = "displacement velocity mass element_masses rest surface gradients volumes coefficients".split()
        for name in own:
            if getattr(found, name) is not None and getattr(out, name) is not None:
                setattr(out, name, of_scenes(getattr(found, name), count))
        of_vertices = runtime.fetch(self.numbers.sums).astype(np.float64)[rows.of("parameters")]
        out.parameters[:, : features.num_parameters] = of_scenes(of_vertices, count, axis=1).sum(2)
        if features.gravity >= 0:
            out.parameters[:, features.gravity :][:, :3] = self.gravity
        if features.drag >= 0:
            out.parameters[:, features.drag] = self.rate
        for name in ("forces", "motion", "path"):
            if getattr(self, name) is not None:
                setattr(out, name, of_scenes(getattr(self, name), count, axis=1).copy())
        if self.growth is not None:
            each = of_scenes(self.growth, count, axis=2)
            out.growths = each.sum(3, keepdims=True) if out.growths.shape[3] == 1 else each
        for b, by_hosts in enumerate(self.by_hosts.each):
            for name, more in by_hosts.parts().items():
                if more is not None and more.any():
                    getattr(out, name)[b] += more
        return out


class JoinedSweep(BatchSweep):
    """Runs of an implicit solver of all scenes at once; `left`: those that are to be run alone."""

    held = property(lambda self: self.num_scenes)  # in vectors of four

    def __init__(self, solver, steps, num_scenes: int, **options):
        super().__init__(solver, steps, num_scenes, **options)
        self.joined = copy(solver)
        self.joined.scene = joined_scene(solver.scene, num_scenes)

    def make_workspace(self, derived):
        return JoinedWorkspace(self.joined, derived)

    def _make_guard(self):
        return Unguarded(self.workspace)

    def make_adjoint(self, density, shape):
        return JoinedAdjoint(self.workspace, density, shape)

    def states(self):
        count = self.num_scenes
        return tuple(of_scenes(runtime.fetch(x), count, axis=1).copy() for x in self.workspace.frames)

    def crossed(self) -> dict:
        return {}

    def resolutions(self):
        ws = self.workspace
        rows = of_scenes(ws.watch.rows(), self.num_scenes, axis=1) if ws.arrays.contacts else [None] * self.num_scenes
        return lambda b: ws.watch.resolution_of(rows[b], ws.each[b], ws.substep, limits(self.solver))

    @property
    def left(self) -> list[int]:
        return np.flatnonzero(self.workspace.left).tolist()
