"""Products with the Hessian of lagged friction (lagged_friction.py), in the same launch order as those of pairs."""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import put
from diffsim_ti.mechanics.surfaces.listed_pair import three
from diffsim_ti.runtime import Kernel, kernels_of, vector_type

A = ti.template()
ROWS = dict(pairs="ints", weights="vectors", stiffness="vectors", pull="vectors", row="ints", corner_of="ints")


@dataclass(frozen=True)
class FrictionProductKernels:
    """Each pair p writes its pull -S_p sum_k w_k dx_k, and surface vertices add up those of theirs, in order."""

    precision: str
    parallel: bool

    vec4 = vector_type

    @ti.func
    def add_products(self, of: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_pairs):
            moved, pull = 0 * three(of.weights[p]), self.vec4(0)
            for k in ti.static(range(4)):
                moved += of.weights[p][k] * three(at.w[0, of.pairs[4 * p + k]])
            for d in ti.static(range(3)):
                pull[d] = three(of.stiffness[3 * p + d]).dot(moved)
            of.pull[p] = pull
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total = self.vec4(0)
            for k in range(of.row[s], of.row[s + 1]):
                p, corner = of.corner_of[k] // 4, of.corner_of[k] % 4
                total += of.weights[p][corner] * of.pull[p]
            if of.row[s + 1] > of.row[s]:
                at.out[plan.first_out + s] = at.out[plan.first_out + s] - total

    @cached_property
    def products(self) -> Kernel:
        """Adds the change of the forces for changes w[0] of the positions to the last corners of `out`."""
        numbers = dict.fromkeys(("num_pairs", "num_surface", "first_out"), "int")
        own = dict(of=ROWS, at=dict(w="vectors2", out="vectors"))
        return Kernel("friction_products", self.add_products, self.precision, own, numbers)


class FrictionProduct:
    """Of the pairs that press in a pass: where they lie, and their stiffness where it was last put."""

    def __init__(self, pairs):
        self.pairs, self.arrays = pairs, pairs.a
        self.kernels = kernels_of(FrictionProductKernels, pairs.a.precision, pairs.parallel)
        self.of, self.count = SimpleNamespace(row=runtime.array(ti.i32, len(pairs.mesh.surface_vertices) + 1)), 0
        self.begin(np.zeros((0, 4), int), np.zeros((0, 4)))
        # on one thread it costs nothing without pairs, and conjugate gradients, of which it is then a part, compile once
        self.always = runtime.runs_on_cpu() and not pairs.parallel

    def begin(self, corners: np.ndarray, weights: np.ndarray) -> None:
        """Four corners and weights of each pair."""
        self.count, surface = len(corners), self.pairs.mesh.surface_vertices
        at = np.searchsorted(surface, corners.ravel())
        runtime.fill(self.of.row, np.concatenate([[0], np.bincount(at, minlength=len(surface)).cumsum()]))
        self._put("pairs", ti.i32, corners.ravel())
        self._put("corner_of", ti.i32, at.argsort(kind="stable"))
        self._put("weights", self.pairs.kernels.vec4, weights)
        self._put("pull", self.pairs.kernels.vec4, np.zeros((self.count, 4)))

    def put(self, stiffness: np.ndarray) -> None:
        """The stiffness S of each pair, shape (count, 3, 3) [N/m]."""
        self._put("stiffness", self.pairs.kernels.vec4, stiffness.reshape(-1, 3))

    def _put(self, name: str, dtype, data: np.ndarray) -> None:
        array = self.pairs.list.buffers.take(f"{name} of lagged friction", dtype, len(data))
        setattr(self.of, name, array)
        put(array, data)

    def part(self, w, out) -> tuple:
        """What adds the change of the forces for changes w[0] to the last corners of `out`: kernel, records, numbers."""
        sizes = dict(num_pairs=self.count, num_surface=len(self.pairs.mesh.surface_vertices))
        sizes["first_out"] = self.arrays.first_contact_corner
        return self.kernels.products, dict(of=self.of, at=SimpleNamespace(w=w, out=out)), sizes
