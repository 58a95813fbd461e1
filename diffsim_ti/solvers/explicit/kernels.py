"""Kernels of the explicit solvers: passes over all tetrahedra and vertices, forward, tangent and adjoint."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.elements.tetrahedron import Onwards
from diffsim_ti.runtime import Kernel, let, traced
from diffsim_ti.solvers.explicit.kick_drift import KickDrift
from diffsim_ti.state.numbers import ADJOINT, OF_STEPS, SCENE, TANGENT, with_state
from diffsim_ti.state.schedule import pass_at, reversed_pass

A = ti.template()
STATE = dict(
    u="vectors2",
    v="vectors2",
    f="vectors2",
    frames_u="vectors2",
    frames_v="vectors2",
    seen="scalars2",
    stage="vectors2",
    work="scalars",
)
CHANGE = dict(u="vectors2", v="vectors2", frames_u="vectors2", frames_v="vectors2")  # of a state, or its adjoint
CORNERS = dict(corner="vectors", rate_corner="vectors")  # adjoints of u and v, still to be gathered
PLAN = dict(ints="ints", floats="scalars")  # the tables of the passes, from pass `window` on
NUMBERS = dict.fromkeys(("num_items", "num_vertices", "window", "first", "count", "base"), "int") | dict(
    contact_damping="float"
)


@dataclass(frozen=True)
class ExplicitKernels:
    """parallel: one pass per launch on all threads; else one serial launch for `count` passes."""

    vertex: KickDrift
    parallel: bool

    @property
    def element(self):
        return self.vertex.element

    @traced
    def onwards(self, now) -> Onwards:
        """How the law's state goes on in a pass; one that only kicks leaves it as it is."""
        return Onwards(h=now.h, moves=let(now.alpha > 0))

    def with_state(self, arrays: dict) -> dict:
        return with_state(arrays, self.vertex.law)

    # ---- forward -----------------------------------------------------------------------------------------------------

    @ti.func
    def elements(self, e, j, scene: A, state: A, table: A, plan: A):
        s = (j - plan.base) * plan.stride
        self.element.forces(e, scene, state, s, scene.corner)
        if ti.static(self.element.has_state):
            now = pass_at(table, j - plan.window)
            self.element.move_on(e, scene, state, s, s + plan.stride, self.onwards(now))

    @ti.func
    def passes(self, scene: A, state: A, table: A, plan: A):
        """Slot 0 holds the state before pass `base`; with stride 1 each pass writes the next slot, and its forces."""
        if ti.static(self.parallel):
            for e in range(plan.num_items):
                self.elements(e, plan.first, scene, state, table, plan)
            for i in range(plan.num_vertices):
                self.vertex.step(i, plan.first, pass_at(table, plan.first - plan.window), scene, state, plan)
        else:
            ti.loop_config(serialize=True)
            for j in range(plan.first, plan.first + plan.count):
                for e in range(plan.num_items):
                    self.elements(e, j, scene, state, table, plan)
                now = pass_at(table, j - plan.window)
                for i in range(plan.num_vertices):
                    self.vertex.step(i, j, now, scene, state, plan)

    @cached_property
    def step(self) -> Kernel:
        """`count` passes from pass `first` on."""
        return self._kernel("step", self.passes, dict(state=self.with_state(STATE)), stride="int")

    # ---- tangent -----------------------------------------------------------------------------------------------------

    @ti.func
    def passes_jvp(self, scene: A, state: A, tangent: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            s = plan.first - plan.base
            self.element.forces_jvp(e, scene, state, s, tangent, scene.corner, tangent)
            if ti.static(self.element.has_state):
                now = pass_at(table, plan.first - plan.window)
                self.element.move_on_jvp(e, scene, state, s, tangent, tangent, self.onwards(now))
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            now = pass_at(table, plan.first - plan.window)
            self.vertex.step_jvp(i, plan.first, now, scene, state, tangent, plan)

    @cached_property
    def step_jvp(self) -> Kernel:
        """The tangent of pass `first` along recorded slots; the change of the state is advanced in place."""
        own = dict(state=self.with_state(STATE), tangent=self.with_state(CHANGE) | TANGENT)
        return self._kernel("step_jvp", self.passes_jvp, own, rate_dot="float")

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    @ti.func
    def elements_vjp(self, e, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        s = j - plan.base
        if ti.static(self.element.has_state):
            now = reversed_pass(pass_at(table, j - plan.window), j, plan)
            on = self.onwards(now)
            self.element.move_on_vjp(e, scene, state, s, on, adjoint.corner, adjoint, self.vertex.features.shape)
        self.element.forces_vjp(
            e, scene, state, s, adjoint.w, adjoint.corner, adjoint, self.vertex.features.shape, self.element.has_state
        )

    @ti.func
    def passes_vjp(self, scene: A, state: A, adjoint: A, table: A, plan: A):
        """The gather of K w is left to the next call (or to `finish_vjp`), so that each pass has two loops, as forward."""
        moving = ti.static(self.vertex.features.moving)
        if ti.static(self.parallel):
            for i in range(plan.num_vertices):
                now = reversed_pass(pass_at(table, plan.first - plan.window), plan.first, plan)
                self.vertex.step_vjp(i, plan.first, now, scene, state, adjoint, plan)
            for e in range(plan.num_items):
                self.elements_vjp(e, plan.first, scene, state, adjoint, table, plan)
            for c in range(moving):
                now = pass_at(table, plan.first - plan.window)
                self.vertex.obstacles.fold_path(c, now, plan.num_vertices, adjoint)
        else:
            ti.loop_config(serialize=True)
            for back in range(plan.count):
                j = plan.first + plan.count - 1 - back
                now = reversed_pass(pass_at(table, j - plan.window), j, plan)
                for i in range(plan.num_vertices):
                    self.vertex.step_vjp(i, j, now, scene, state, adjoint, plan)
                for e in range(plan.num_items):
                    self.elements_vjp(e, j, scene, state, adjoint, table, plan)
                for c in range(moving):
                    self.vertex.obstacles.fold_path(c, now, plan.num_vertices, adjoint)

    @cached_property
    def step_vjp(self) -> Kernel:
        """The adjoint of passes first + count - 1 .. first; `num_passes` is that of the run.

        halt: the pass at whose state the sweep stops, between its two kicks; kick: only the kick before the state.
        """
        numbers = dict.fromkeys(("num_passes", "halt", "kick"), "int")
        own = self.with_state(CHANGE) | ADJOINT | OF_STEPS | dict(w="vectors2", felt="vectors2") | CORNERS
        return self._kernel("step_vjp", self.passes_vjp, dict(state=self.with_state(STATE), adjoint=own), **numbers)

    @ti.func
    def gather_rest(self, scene: A, adjoint: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            adjoint.u[0, i] = adjoint.u[0, i] + self.element.gather(i, scene, adjoint.corner)
            if ti.static(self.element.reads_rates):
                adjoint.v[0, i] = adjoint.v[0, i] + self.element.gather(i, scene, adjoint.rate_corner)

    @cached_property
    def finish_vjp(self) -> Kernel:
        """Add the gather that the first pass of the run has left."""
        corners = {name: SCENE[name] for name in ("start", "corner_of")}
        own = dict(scene=corners, adjoint=dict(u="vectors2", v="vectors2") | CORNERS)
        return Kernel("finish_vjp", self.gather_rest, self.vertex.law.precision, own, dict(num_vertices="int"))

    def _kernel(self, name: str, body, arrays: dict, **numbers) -> Kernel:
        arrays = dict(scene=SCENE) | arrays | dict(table=PLAN)
        return Kernel(name, body, self.vertex.law.precision, arrays, NUMBERS | numbers)


@lru_cache(maxsize=None)
def explicit_kernels(law, features, parallel: bool, lanes: bool) -> ExplicitKernels:
    """Kernels for a law and a scene's features."""
    return ExplicitKernels(KickDrift(law, features, lanes), parallel)
