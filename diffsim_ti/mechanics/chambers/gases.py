"""Gases in chambers between explicit passes."""

import weakref
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.chambers.gas_kernels import ChamberKernels
from diffsim_ti.mechanics.chambers.interaction import Gases
from diffsim_ti.mechanics.host_force import Instant
from diffsim_ti.runtime import kernels_of

PARTS = 64  # sums that a GPU's threads make side by side for each chamber


class Chambers:
    """What an explicit run knows of its chambers: their triangles and the launches that come before and after a pass."""

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
            felt=runtime.array(a.fp, self.count * self.parts),
            weight=runtime.upload(np.concatenate(weights), a.fp),
            push=runtime.upload(np.concatenate(push).astype(float), a.fp),
        )
        self.now = 0  # the pass that forces were last taken in

    def _launch(self, name: str, numbers: dict, slot: int, shape: bool = False, **records) -> None:
        ws, a = self.ws, self.ws.arrays
        per_step = len(a.values.follower) > 1
        kernels = kernels_of(ChamberKernels, a.precision, per_step, self.parts, ws.parallel, shape, self.curved)
        sizes = dict(num_triangles=len(self.triangles), num_sums=self.count * self.parts, slot=slot)
        sizes |= dict(first=a.counts["first_gases"])
        launch = ws.bound(getattr(kernels, name), chambers=self.arrays, table=ws.table, **records)
        launch(**sizes, pass_=numbers["first"], window=numbers["window"])

    def forces(self, history, slot: int, numbers: dict) -> None:
        """Write corner forces as the pass takes them whose launch has these numbers."""
        self.now = numbers["first"]
        self._launch("forces", numbers, slot, at=history, out=self.ws.arrays)

    def jvp(self, history, slot: int, numbers: dict, u, tangent) -> None:
        """Write their change for changes u of the displacement and those of numbers in `tangent`."""
        change = SimpleNamespace(u=u, rest=tangent.rest, follower=tangent.follower)
        record = self.ws.kept(("chamber tangent", id(u), id(tangent)), lambda: (change, u, tangent))[0]
        self._launch("jvp", numbers, slot, at=history, tangent=record, out=self.ws.arrays)

    def vjp(self, history, slot: int, numbers: dict, adjoint, shape: bool) -> None:
        """Write products of the transposed derivative to adjoint corners, add the adjoints of numbers and places."""
        self._launch("vjp", numbers, slot, shape, at=history, adjoint=adjoint)

    def product(self, w: np.ndarray) -> np.ndarray:
        """df/dx w of the gases in the current state, shape (num_vertices, 3)."""
        ws, u = self.ws, runtime.fetch_row(self.ws.state.u, 0)
        kicks = ((x, Instant(ws.solver.schedule, *k)) for x, k in ws.kicks(self.now, self.now + 2))
        return sum(x * self.host.take(ws.arrays.now, instant).jvp(u, w) for x, instant in kicks)
