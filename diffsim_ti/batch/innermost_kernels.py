"""Kernels of many scenes on a GPU: a thread takes a tetrahedron, then a vertex, of one scene through one pass.

Neighbouring threads take neighbouring scenes, whose numbers are neighbours in memory (layouts.Innermost), so that each load
of a warp is one piece, and what scenes share is read once for all of them. Tetrahedra write forces at corners of their own,
which vertices sum in the order of a single scene; no thread adds to what another one may. The functions are those of a
single scene (explicit/kick_drift.py), by views of it.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.batch.tetrahedra import element_of_scenes
from diffsim_ti.batch.views import Column, ItemOfScene, Shared, Uniform
from diffsim_ti.runtime import Bundle, Kernel, at, let, traced
from diffsim_ti.solvers.explicit.kernels import PLAN, TURNS, ExplicitKernels
from diffsim_ti.solvers.explicit.kick_drift import KickDrift
from diffsim_ti.state.features import Features
from diffsim_ti.state.pass_table import pass_at, reversed_pass

A = ti.template()
STATE = dict.fromkeys(("u", "v", "f", "frames_u", "frames_v", "stage"), "vectors2") | dict(
    seen="scalars2", work="scalars"
)
CHANGE = dict.fromkeys(("u", "v", "frames_u", "frames_v"), "vectors2")
SCENE = dict.fromkeys(("tets", "start", "corner_of", "force_slot", "motion_slot"), "ints")
SCENE |= dict.fromkeys(("gradients", "volumes", "coefficients", "parameters", "inverse_mass", "surface"), "scalars")
SCENE |= dict(rest="vectors", corner="vectors")
OF_STEPS = dict(forces="vectors2", motion="vectors2", path="vectors2", anchor="vectors")
CHANGED = dict.fromkeys(("coefficients", "gradients", "volumes", "mass", "parameters", "surface"), "scalars")
ADJOINT = dict.fromkeys(("coefficients", "gradients", "volumes"), "scalars")
ADJOINT |= dict(corner="vectors", rate_corner="vectors", w="vectors2", sums="scalars2", felt="vectors2")
SIZES = ("num_items", "num_rows", "num_scenes", "num_vertices")
NUMBERS = dict.fromkeys((*SIZES, "window", "first", "count", "base"), "int") | dict(contact_damping="float")


@dataclass(frozen=True)
class KickDriftOfScene(KickDrift):
    """As KickDrift, whose tetrahedra are those of one scene of many, and whose energy nobody follows."""

    counts_work = False

    @cached_property
    def element(self):
        return element_of_scenes(self.law, self.features)


@dataclass(frozen=True)
class InnermostKernels(ExplicitKernels):
    """own: names of what scenes may share (kernels.SHARED, and "table") of which each has its own.

    Thread t of a loop takes item or vertex t // B of scene t % B, of B scenes.
    """

    own: frozenset = frozenset()

    # ---- one scene of many ---------------------------------------------------------------------------------------------

    @traced
    def columns(self, record, names, b, plan) -> dict:
        return {name: Column(getattr(record, name), b, plan.num_scenes) for name in names}

    @traced
    def scene_of(self, b, scene, plan):
        """Scene b for functions of vertices."""
        own = [name for name in ("inverse_mass", "surface", "rest") if name in self.own]
        own += ["parameters", "corner", *OF_STEPS, *self.items.derived]
        return Bundle(**{**vars(scene), **self.columns(scene, own, b, plan)})

    @traced
    def record_of(self, b, record, plan):
        """Its state, change or adjoint."""
        return Bundle(**self.columns(record, vars(record), b, plan))

    @traced
    def tetrahedra_of(self, b, j, scene, table, plan):
        """The scenes in pass j, as scene b has it, for functions of tetrahedra."""
        shape = {n: getattr(scene, n) if n in self.own else Shared(getattr(scene, n)) for n in ("gradients", "volumes")}
        return Bundle(tets=scene.tets, **self.coefficients_of(b, j, scene, table, plan), **shape)

    @traced
    def coefficients_of(self, b, j, record, table, plan) -> dict:
        out = dict(coefficients=Uniform(record.coefficients) if self.vertex.features.uniform else record.coefficients)
        if self.vertex.features.growing:
            out |= dict(growths=record.growths, now=self.pass_of_scene(b, j, table, plan))
        return out

    @traced
    def changed(self, b, j, tangent, table, plan):
        """Changes of what functions of tetrahedra read."""
        return Bundle(**{**vars(tangent), **self.coefficients_of(b, j, tangent, table, plan)})

    @property
    def growing(self) -> dict:
        return dict(growths="scalars2") if self.vertex.features.growing else {}

    @traced
    def item(self, t, plan):
        return ItemOfScene(let(t // plan.num_scenes), let(t % plan.num_scenes), plan.num_scenes)

    @traced
    def after(self, plan):
        """Number of tetrahedra of all scenes, and of what else acts on their bodies."""
        one = let(self.items.after(Bundle(**{**vars(plan), "num_items": 0})))
        return let(plan.num_items + one * plan.num_scenes) if self.items.any else plan.num_items

    @traced
    def acting(self, t, j, scene, state, table, plan) -> tuple:
        """(item of what else acts on bodies, its scene's number, pass, scene and state)"""
        k, b = let((t - plan.num_items) // plan.num_scenes), let((t - plan.num_items) % plan.num_scenes)
        now, own = self.pass_of_scene(b, j, table, plan), self.scene_of(b, scene, plan)
        return k, b, now, own, self.record_of(b, state, plan)

    @traced
    def pass_of_scene(self, b, j, table, plan):
        """Pass j of scene b."""
        floats = Column(table.floats, b, plan.num_scenes) if "table" in self.own else table.floats
        return pass_at(Bundle(ints=table.ints, floats=floats), let(j - plan.window))

    @traced
    def pass_of_scene_back(self, b, j, table, plan):
        now = reversed_pass(self.pass_of_scene(b, j, table, plan), j, plan)
        return self.vertex.obstacles.noting(now, plan)

    # ---- forward -------------------------------------------------------------------------------------------------------

    @ti.func
    def tetrahedron(self, t, j, scene: A, state: A, table: A, plan: A):
        item, s = self.item(t, plan), (j - plan.base) * plan.stride
        of = self.tetrahedra_of(item.b, j, scene, table, plan)
        self.element.forces(item, of, state, s, scene.corner)
        if ti.static(self.element.has_state):
            now = self.pass_of_scene(item.b, j, table, plan)
            self.element.move_on(item, of, state, s, s + plan.stride, self.onwards(now))

    @ti.func
    def act(self, t, j, scene: A, state: A, table: A, plan: A):
        k, b, now, own, at_ = self.acting(t, j, scene, state, table, plan)
        self.items.forces(k, now, own, at_, (j - plan.base) * plan.stride, plan)

    @ti.func
    def vertex_step(self, t, j, scene: A, state: A, table: A, plan: A):
        i, b = t // plan.num_scenes, t % plan.num_scenes
        now, own, at_ = (
            self.pass_of_scene(b, j, table, plan),
            self.scene_of(b, scene, plan),
            self.record_of(b, state, plan),
        )
        self.vertex.step(i, j, now, own, at_, plan)

    @ti.func
    def passes(self, scene: A, state: A, table: A, plan: A):
        num_items, num_rows = self.after(plan), plan.num_rows  # both bounds are read by one task
        for t in range(num_items):
            turn = self.turn_of_first(t, table)
            if turn < plan.count:
                if t < plan.num_items:
                    self.tetrahedron(t, plan.first + turn, scene, state, table, plan)
                elif ti.static(self.items.any):
                    self.act(t, plan.first + turn, scene, state, table, plan)
        for t in range(num_rows):
            turn = self.turn_of_second(t, table, plan)
            if turn < plan.count:
                self.vertex_step(t, plan.first + turn, scene, state, table, plan)

    @cached_property
    def step(self) -> Kernel:
        """`count` passes from pass `first` on."""
        return self._kernel("step", self.passes, dict(state=self.with_state(STATE)), self.repeated, stride="int")

    # ---- tangent -------------------------------------------------------------------------------------------------------

    @ti.func
    def tetrahedron_jvp(self, t, j, scene: A, state: A, tangent: A, table: A, plan: A):
        item, s = self.item(t, plan), j - plan.base
        of, dots = self.tetrahedra_of(item.b, j, scene, table, plan), self.changed(item.b, j, tangent, table, plan)
        self.element.forces_jvp(item, of, state, s, tangent, scene.corner, dots)
        if ti.static(self.element.has_state):
            now = self.pass_of_scene(item.b, j, table, plan)
            self.element.move_on_jvp(item, of, state, s, tangent, dots, self.onwards(now))

    @ti.func
    def act_jvp(self, t, j, scene: A, state: A, tangent: A, table: A, plan: A):
        k, b, now, own, at_ = self.acting(t, j, scene, state, table, plan)
        self.items.forces_jvp(k, now, own, at_, j - plan.base, self.record_of(b, tangent, plan), plan)

    @ti.func
    def vertex_step_jvp(self, t, j, scene: A, state: A, tangent: A, table: A, plan: A):
        i, b = t // plan.num_scenes, t % plan.num_scenes
        now, own, at_ = (
            self.pass_of_scene(b, j, table, plan),
            self.scene_of(b, scene, plan),
            self.record_of(b, state, plan),
        )
        rated = self.rated(b, tangent, plan)
        self.vertex.step_jvp(i, j, now, own, at_, self.record_of(b, tangent, plan), rated)

    @traced
    def rated(self, b, tangent, plan):
        """The numbers of a kernel with the change of a scene's drag rate."""
        drag = self.vertex.features.drag
        rate = at(tangent.parameters, drag * plan.num_scenes + b) if drag >= 0 else ti.cast(0, self.vertex.fp)
        return Bundle(**{**vars(plan), "rate_dot": let(rate)})

    @ti.func
    def passes_jvp(self, scene: A, state: A, tangent: A, table: A, plan: A):
        num_items, num_rows = self.after(plan), plan.num_rows
        for t in range(num_items):
            turn = self.turn_of_first(t, table)
            if turn < plan.count:
                if t < plan.num_items:
                    self.tetrahedron_jvp(t, plan.first + turn, scene, state, tangent, table, plan)
                elif ti.static(self.items.any):
                    self.act_jvp(t, plan.first + turn, scene, state, tangent, table, plan)
        for t in range(num_rows):
            turn = self.turn_of_second(t, table, plan)
            if turn < plan.count:
                self.vertex_step_jvp(t, plan.first + turn, scene, state, tangent, table, plan)

    @cached_property
    def step_jvp(self) -> Kernel:
        """The tangent of these passes along recorded slots; the change of the state is advanced in place."""
        tangent = (
            self.with_state(CHANGE) | CHANGED | OF_STEPS | dict(rest="vectors") | self.items.derived | self.growing
        )
        own = dict(state=self.with_state(STATE), tangent=tangent)
        return self._kernel("step_jvp", self.passes_jvp, own, self.repeated)

    # ---- adjoint -------------------------------------------------------------------------------------------------------

    @ti.func
    def tetrahedron_vjp(self, t, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        item, s = self.item(t, plan), j - plan.base
        of = self.tetrahedra_of(item.b, j, scene, table, plan)
        if ti.static(self.element.has_state):
            on = self.onwards(self.pass_of_scene_back(item.b, j, table, plan))
            self.element.move_on_vjp(item, of, state, s, on, adjoint.corner, adjoint, self.vertex.features.shape)
        self.element.forces_vjp(
            item, of, state, s, adjoint.w, adjoint.corner, adjoint, self.vertex.features.shape, self.element.has_state
        )

    @ti.func
    def act_vjp(self, t, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        k, b, now, own, at_ = self.acting(t, j, scene, state, table, plan)
        self.items.forces_vjp(k, now, own, at_, j - plan.base, self.record_of(b, adjoint, plan), plan)

    @ti.func
    def vertex_step_vjp(self, t, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        i, b = t // plan.num_scenes, t % plan.num_scenes
        now = self.pass_of_scene_back(b, j, table, plan)
        own, at_ = self.scene_of(b, scene, plan), self.record_of(b, state, plan)
        self.vertex.step_vjp(i, j, now, own, at_, self.record_of(b, adjoint, plan), plan)

    @ti.func
    def passes_vjp(self, scene: A, state: A, adjoint: A, table: A, plan: A):
        """The gather of K w is left to the next call (or to `finish_vjp`), as in a single scene."""
        moving = ti.static(self.vertex.features.moving)
        num_items, num_rows, paths = self.after(plan), plan.num_rows, moving * plan.num_scenes
        for t in range(num_rows):
            turn = self.turn_of_first(t, table)
            if turn < plan.count:
                self.vertex_step_vjp(t, plan.first + plan.count - 1 - turn, scene, state, adjoint, table, plan)
        for t in range(num_items):
            turn = self.turn_of_second(t, table, plan)
            if turn < plan.count:
                if t < plan.num_items:
                    self.tetrahedron_vjp(t, plan.first + plan.count - 1 - turn, scene, state, adjoint, table, plan)
                elif ti.static(self.items.any):
                    self.act_vjp(t, plan.first + plan.count - 1 - turn, scene, state, adjoint, table, plan)
        if ti.static(moving > 0):
            for t in range(paths):
                by = self.record_of(t % plan.num_scenes, adjoint, plan)
                first, last, c = plan.first, plan.first + plan.count - 1, t // plan.num_scenes
                self.vertex.obstacles.fold_part(c, plan.num_vertices, first, last, by, table, plan)

    @cached_property
    def step_vjp(self) -> Kernel:
        """The adjoint of passes first + count - 1 .. first; numbers as of a single scene (explicit/kernels.py)."""
        numbers = dict.fromkeys(("num_passes", "halt", "kick", "steps", "num_parts"), "int")
        adjoint = self.with_state(CHANGE) | ADJOINT | OF_STEPS | self.items.adjoint | self.growing
        arrays = dict(state=self.with_state(STATE), adjoint=adjoint)
        return self._kernel("step_vjp", self.passes_vjp, arrays, self.repeated, **numbers)

    @ti.func
    def gather_rest(self, scene: A, adjoint: A, plan: A):
        num_rows = plan.num_rows
        for t in range(num_rows):
            i, b = t // plan.num_scenes, t % plan.num_scenes
            by = self.record_of(b, adjoint, plan)
            by.u[0, i] = by.u[0, i] + self.element.gather(i, scene, by.corner)
            if ti.static(self.vertex.reads_rates):
                by.v[0, i] = by.v[0, i] + self.element.gather(i, scene, by.rate_corner)

    @cached_property
    def finish_vjp(self) -> Kernel:
        """Add the gather that the first pass of the run has left."""
        own = dict(scene=dict(start="ints", corner_of="ints"))
        own |= dict(adjoint=dict(u="vectors2", v="vectors2", corner="vectors", rate_corner="vectors"))
        numbers = dict(num_rows="int", num_scenes="int")
        return Kernel("batch_finish_vjp", self.gather_rest, self.vertex.law.precision, own, numbers)

    def with_state(self, arrays: dict) -> dict:
        return arrays | dict(z="scalars2") if self.vertex.law.state_names else arrays

    def _kernel(self, name: str, body, arrays: dict, repeated: bool, **numbers) -> Kernel:
        arrays = dict(scene=SCENE | OF_STEPS | self.items.arrays | self.growing) | arrays | dict(table=PLAN)
        numbers = NUMBERS | numbers | self.items.counts
        if repeated:
            arrays["table"], numbers = PLAN | TURNS, numbers | dict(times="int")
        return Kernel(f"batch_{name}", body, self.vertex.law.precision, arrays, numbers, loops=2 * repeated)


@lru_cache(maxsize=None)
def innermost_kernels(law, features: Features, own: frozenset, repeated: bool) -> InnermostKernels:
    """Kernels for a law, a scene's features, and what each scene has of its own."""
    return InnermostKernels(KickDriftOfScene(law, features, False), True, repeated, own)
