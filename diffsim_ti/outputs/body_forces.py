"""Forces of the body's own stress on its vertices in the frames of a run, with derivatives, for outputs."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stress.patched_tetrahedron import functions_of
from diffsim_ti.runtime import Kernel
from diffsim_ti.state.arrays import SceneArrays
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT, Adjoint, Tangent, with_state
from diffsim_ti.terms import Growth

A = ti.template()
STATE = dict(u="vectors2", v="vectors2")
CORNERS = dict(corner="vectors", rate_corner="vectors")


@dataclass(frozen=True)
class BodyForceKernels:
    """At the displacement and velocity in slot 0 of `at`."""

    law: object
    features: Features
    lanes: bool

    @cached_property
    def element(self):
        return functions_of(self.law, self.features, self.lanes)

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = (
            dict(scene=SCENE, at=with_state(STATE, self.law), out=CORNERS | dict(y="vectors2", y_rate="vectors2"))
            | arrays
        )
        return Kernel(name, body, self.law.precision, own, dict(num_items="int", num_vertices="int"))

    @ti.func
    def all_forces(self, scene: A, at: A, out: A, plan: A):
        for e in range(plan.num_items):
            self.element.forces(e, scene, at, 0, out.corner)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.element.gather(i, scene, out.corner)

    @cached_property
    def forces(self) -> Kernel:
        return self._kernel("body_forces", self.all_forces)

    @ti.func
    def all_jvp(self, scene: A, at: A, out: A, change: A, tangent: A, plan: A):
        for e in range(plan.num_items):
            self.element.forces_jvp(e, scene, at, 0, change, out.corner, tangent)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.element.gather(i, scene, out.corner)

    @cached_property
    def jvp(self) -> Kernel:
        change = with_state(STATE, self.law)
        return self._kernel("body_forces_jvp", self.all_jvp, change=change, tangent=TANGENT)

    @ti.func
    def all_vjp(self, scene: A, at: A, out: A, seed: A, adjoint: A, plan: A):
        for e in range(plan.num_items):
            self.element.forces_vjp(e, scene, at, 0, seed.w, out.corner, adjoint, True)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.element.gather(i, scene, out.corner)
            if ti.static(self.element.reads_rates):
                out.y_rate[0, i] = self.element.gather(i, scene, out.rate_corner)

    @cached_property
    def vjp(self) -> Kernel:
        own = with_state(ADJOINT | dict(rate_corner="vectors"), self.law)
        return self._kernel("body_forces_vjp", self.all_vjp, seed=dict(w="vectors2"), adjoint=own)


@lru_cache(maxsize=None)
def _kernels(law, features: Features, lanes: bool) -> BodyForceKernels:
    return BodyForceKernels(law, features, lanes)


class BodyForces:
    """Forces -dE/du [N] of stress, shape (num_vertices, 3), at the states that frames show, for outputs of any law."""

    def __init__(self, scene):
        if scene.term(Growth):
            raise ValueError(
                "forces of the body at frames do not support Growth over time; take Grown(material, growth)"
            )
        self.scene, self.arrays = scene, SceneArrays(scene)
        a = self.arrays
        self.at, self.change, self.out = (
            SimpleNamespace(**{name: runtime.array(a.vector, 1, a.num_vertices) for name in names})
            for names in (("u", "v", "w"), ("u", "v"), ("y", "y_rate"))
        )
        self.at.z, self.change.z, self.out.z = (a.law_states(1) for _ in range(3))
        self.out.corner, self.out.rate_corner = (runtime.array(a.vector, *a.corner.shape) for _ in range(2))

    def load(self, values: dict) -> Derived:
        """The numbers of a run; what kernels read of them."""
        derived = self.scene.inputs.derive(values)
        self.arrays.load(derived)
        self.kernels = _kernels(self.arrays.law, self.arrays.features(True, True), self.arrays.in_lanes)
        return derived

    def _run(self, name: str, **records) -> np.ndarray:
        a = self.arrays
        launch = getattr(self.kernels, name).bind(a.in_vectors, scene=a, at=self.at, out=self.out, **records)
        launch(num_items=a.num_items, num_vertices=a.num_vertices)
        return runtime.fetch_row(self.out.y, 0)

    def place(self, u: np.ndarray, v: np.ndarray, law_state: np.ndarray | None = None) -> None:
        """Go to a displacement [m] and a velocity [m/s], and to what the law remembers."""
        if self.at.z is not None:
            runtime.fill(self.at.z, self.arrays.to_blocks(law_state)[None])
        runtime.fill(self.at.u, u[None])
        runtime.fill(self.at.v, v[None])

    def forces(self) -> np.ndarray:
        """f."""
        return self._run("forces")

    def jvp(self, du: np.ndarray, dv: np.ndarray, tangent: Tangent, dz: np.ndarray | None = None) -> np.ndarray:
        """Its change; dz: of what the law remembers."""
        if self.change.z is not None:
            runtime.fill(self.change.z, self.arrays.to_blocks(dz)[None])
        runtime.fill(self.change.u, du[None])
        runtime.fill(self.change.v, dv[None])
        return self._run("jvp", change=self.change, tangent=tangent)

    def tangent(self, change: Derived) -> Tangent:
        """Changes of the scene's numbers, for `jvp`."""
        return Tangent(self.arrays, change)

    def adjoint(self) -> Adjoint:
        """Room for the adjoints of the scene's numbers, for `vjp`; `collect()` gives them."""
        out = Adjoint(self.arrays, self.arrays.features(True, True))
        out.clear()
        return out

    def vjp(self, w: np.ndarray, adjoint: Adjoint) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """(adjoint of u, of v, of what the law remembers) for that of f; adds those of coefficients, grad N and V."""
        runtime.fill(self.at.w, w[None])
        if self.out.z is not None:
            runtime.fill(self.out.z, 0)
        runtime.fill(self.out.y_rate, 0)
        by_u = self._run("vjp", seed=self.at, adjoint=(adjoint, self.out))
        by_z = None if self.out.z is None else self.arrays.law_state_of(runtime.fetch(self.out.z)[0])
        return by_u, runtime.fetch_row(self.out.y_rate, 0), by_z
