"""Gases in chambers, whose pressures explicit steps find before the kick."""

import weakref
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.chambers.gas_kernels import ChamberKernels
from diffsim_ti.mechanics.chambers.interaction import Gases
from diffsim_ti.mechanics.host_force import Instant
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.runtime import kernels_of

PARTS = 64  # sums that a GPU's threads make side by side for each chamber


class Chambers(Stage):
    """What an explicit run knows of its chambers: their triangles, and launches that write forces at corners."""

    in_kicks = True

    def __init__(self, workspace):
        self.ws, scene, a = weakref.proxy(workspace), workspace.scene, workspace.arrays
        gases = scene.interaction(Gases)
        self.host = gases.host()
        closed, self.rows = [chamber.enclosure for chamber in gases.terms], gases.rows
        counts = [len(enclosure.triangles) for enclosure in closed]
        self.curved, weights = scene.mesh.order == 2, [e.weights for e in closed]
        push = weights if self.curved else [np.arange(len(e.triangles)) < e.num_own for e in closed]
        self.parts = 1 if runtime.runs_on_cpu() else PARTS
        self.count, self.triangles = len(closed), np.concatenate([e.triangles for e in closed])

        def ints(x):
            return runtime.upload(np.asarray(x, np.int64).ravel(), ti.i32)

        zero = np.zeros(3)
        self.arrays = SimpleNamespace(
            triangles=ints(self.triangles),
            chamber=ints(np.repeat(np.arange(self.count), counts)),
            first_row=ints([rows.start for rows in self.rows]),
            begins=ints(np.cumsum([0, *counts])),
            anchor=ints([e.triangles[0, 0] if e.point is None else -1 for e in closed]),
            point=runtime.upload(np.array([zero if e.point is None else e.point - a.origin for e in closed]), a.vector),
            volume=runtime.array(a.fp, self.count * self.parts),
            by_pressure=runtime.array(a.fp, self.count * self.parts),
            weight=runtime.upload(np.concatenate(weights), a.fp),
            push=runtime.upload(np.concatenate(push).astype(float), a.fp),
        )
        self.now = 0  # the pass that forces were last taken in

    def _launch(self, name: str, at: Passes, shape: bool = False, **records) -> None:
        """A kernel at the beginning of a pass."""
        ws, a = self.ws, self.ws.arrays
        per_step = len(a.values.follower) > 1
        kernels = kernels_of(ChamberKernels, a.precision, per_step, self.parts, ws.parallel, shape, self.curved)
        sizes = dict(num_triangles=len(self.triangles), num_sums=self.count * self.parts, slot=at.slot)
        sizes |= dict(first=a.counts["first_gases"])
        launch = ws.bound(getattr(kernels, name), chambers=self.arrays, table=ws.table, at=at.history, **records)
        launch(**sizes, pass_=at.j, window=at.numbers["window"])

    @contextmanager
    def do(self, at: Passes):
        self.now = at.j
        self._launch("forces", at, out=self.ws.arrays)
        yield

    @contextmanager
    def tangent(self, at: Passes):
        self._launch("jvp", at, tangent=(at.run, at.run.numbers), out=self.ws.arrays)
        yield

    @contextmanager
    def adjoint(self, at: Passes):
        yield
        self._launch("vjp", at, at.run.features.shape, adjoint=at.run)

    def product(self, w: np.ndarray) -> np.ndarray:
        """df/dx w of the gases in the current state, shape (num_vertices, 3)."""
        ws, u = self.ws, runtime.fetch_row(self.ws.state.u, 0)
        kicks = ((x, Instant(ws.solver.schedule, *k)) for x, k in ws.kicks(self.now, self.now + 2))
        return sum(x * self.host.take(ws.arrays.now, instant).jvp(u, w) for x, instant in kicks)
