"""Kernels of many scenes: a thread takes a block of eight scenes through all passes of a launch.

Tetrahedra are worked on in lanes, one scene in each, and add straight to the forces of their block. So are vertices at
which nothing else acts in any of the eight (free_vertices.py); at the others the functions of a single scene
(explicit/kick_drift.py) go through the eight scenes one after the other, by views of them.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.batch.free_vertices import FreeVertices
from diffsim_ti.batch.views import Corners, Item, Scratch, Shared, TetrahedronOfEight, Uniform, Vectors, View
from diffsim_ti.elements.tetrahedron import Onwards
from diffsim_ti.runtime import LANES, Bundle, Kernel, at, let, traced
from diffsim_ti.solvers.explicit.kick_drift import KickDrift
from diffsim_ti.state.features import Features
from diffsim_ti.state.pass_table import pass_at, reversed_pass

A = ti.template()
STATE = dict.fromkeys(("u", "v", "f", "frames_u", "frames_v", "seen"), "blocks2")
STATE |= dict(stage="vectors2", work="scalars", calm="ints")
CHANGE = dict.fromkeys(("u", "v", "frames_u", "frames_v"), "blocks2")
TABLE = dict(ints="ints", floats="scalars")
# what all scenes may share, and how it lies then
SHARED = dict(gradients="scalars", volumes="scalars", inverse_mass="scalars", rest="vectors", surface="scalars")
OF_STEPS = dict(forces="blocks2", motion="blocks2", path="blocks2", anchor="blocks")
CHANGED = dict.fromkeys(("coefficients", "gradients", "volumes", "mass", "parameters", "rest", "surface"), "blocks")
ADJOINT = dict.fromkeys(("coefficients", "gradients", "volumes", "corner", "rate_corner"), "blocks")
ADJOINT |= dict.fromkeys(("w", "sums", "felt"), "blocks2")
SIZES = (
    *("num_tetrahedra", "num_vertices", "num_blocks", "spread"),
    *("num_loaded", "num_held", "num_parameters", "num_passes_shown"),
)
NUMBERS = dict.fromkeys((*SIZES, "window", "first", "count", "base"), "int") | dict(contact_damping="float")


@dataclass(frozen=True)
class KickDriftOfEight(KickDrift):
    """As KickDrift, whose tetrahedra are those of eight scenes, and whose energy nobody follows."""

    counts_work = False

    @cached_property
    def element(self):
        return TetrahedronOfEight(self.law, self.features.uniform, True, self.features.order)


@dataclass(frozen=True)
class BatchKernels:
    """own: names of what may be shared (SHARED, and "table") of which each scene has its own."""

    law: object
    features: Features
    own: frozenset

    @cached_property
    def vertex(self) -> KickDriftOfEight:
        return KickDriftOfEight(self.law, self.features, True)

    @cached_property
    def free(self) -> FreeVertices:
        return FreeVertices(self.law, self.features, self.own)

    @property
    def element(self) -> TetrahedronOfEight:
        return self.vertex.element

    # ---- arrays ------------------------------------------------------------------------------------------------------

    def scene(self) -> dict:
        kinds = {name: "blocks" if name in self.own else kind for name, kind in SHARED.items()}
        lanes = dict.fromkeys(("coefficients", "parameters", "corner"), "blocks") | OF_STEPS
        topology = dict.fromkeys(("tets", "force_slot", "motion_slot", "special"), "ints")
        guided = dict(guide_slot="ints", guides="vectors") if self.features.guided else {}
        return topology | kinds | lanes | guided

    def table(self) -> dict:
        return TABLE | (dict(floats="blocks") if "table" in self.own else {})

    def with_state(self, arrays: dict) -> dict:
        return arrays | dict(z="blocks2") if self.law.state_names else arrays

    # ---- what a kernel hands to functions ----------------------------------------------------------------------------

    @traced
    def item(self, e, b, plan):
        return Item(e, b, let(3 * b * plan.num_vertices), let(b * plan.num_tetrahedra))

    @traced
    def tetrahedra_of(self, scene, corner):
        """The scene for functions of tetrahedra."""
        coefficients = Uniform(scene.coefficients) if self.features.uniform else scene.coefficients
        shape = {n: getattr(scene, n) if n in self.own else Shared(getattr(scene, n)) for n in ("gradients", "volumes")}
        return Bundle(tets=scene.tets, coefficients=coefficients, corner=Corners(corner, scene.tets), **shape)

    @traced
    def of_tetrahedra(self, scene, adjoint):
        """Adjoints that functions of tetrahedra add to."""
        names = ("coefficients", "gradients", "volumes", *(("z",) if self.law.state_names else ()))
        corner = Corners(adjoint.rate_corner, scene.tets)
        return Bundle(rate_corner=corner, **{name: getattr(adjoint, name) for name in names})

    @traced
    def onwards(self, now):
        """How the law's state goes on in a pass; one that only kicks leaves it as it is."""
        alpha = at(now.alpha, 0) if _in_lanes(now.alpha) else now.alpha
        return Onwards(h=now.h, moves=let(alpha > 0))

    @traced
    def vectors(self, array, first, lane):
        return Vectors(array, let(3 * first), lane, self.vertex.vector, ti.cast(0, self.vertex.fp))

    @traced
    def scene_of(self, b, lane, scene, plan):
        """Scene `lane` of block b, for functions of vertices."""
        n, F = let(b * plan.num_vertices), self.features
        out = {name: getattr(scene, name) for name in ("force_slot", "motion_slot")}
        if F.guided:
            out |= dict(guide_slot=scene.guide_slot, guides=scene.guides)
        for name in ("inverse_mass", "surface"):
            out[name] = View(getattr(scene, name), n, lane) if name in self.own else getattr(scene, name)
        out["rest"] = self.vectors(scene.rest, n, lane) if "rest" in self.own else scene.rest
        out["parameters"] = View(scene.parameters, let(b * plan.num_parameters), lane)
        return Bundle(corner=self.vectors(scene.corner, n, lane), **out, **self.of_steps(b, lane, scene, plan))

    @traced
    def of_steps(self, b, lane, record, plan):
        sizes = dict(
            forces=plan.num_loaded, motion=plan.num_held, anchor=plan.num_held, path=max(self.features.moving, 1)
        )
        return {name: self.vectors(getattr(record, name), let(b * size), lane) for name, size in sizes.items()}

    @traced
    def states_of(self, names, b, lane, record, plan):
        n = let(b * plan.num_vertices)
        return {name: self.vectors(getattr(record, name), n, lane) for name in names}

    @traced
    def state_of(self, b, lane, state, plan):
        out = self.states_of(("u", "v", "f", "frames_u", "frames_v"), b, lane, state, plan)
        seen = View(state.seen, let(b * plan.num_vertices), lane)
        return Bundle(seen=seen, stage=Scratch(state.stage, b), work=Scratch(state.work, b), **out)

    @traced
    def change_of(self, b, lane, tangent, plan):
        """The changes of scene `lane`."""
        n = let(b * plan.num_vertices)
        own = {name: View(getattr(tangent, name), n, lane) for name in ("mass", "surface")}
        own["parameters"] = View(tangent.parameters, let(b * plan.num_parameters), lane)
        own["rest"] = self.vectors(tangent.rest, n, lane)
        states = self.states_of(("u", "v", "frames_u", "frames_v"), b, lane, tangent, plan)
        return Bundle(**own, **states, **self.of_steps(b, lane, tangent, plan))

    @traced
    def adjoint_of(self, b, lane, adjoint, plan):
        """The adjoints of scene `lane`."""
        names = ("u", "v", "w", "frames_u", "frames_v", "felt", "corner")
        names += ("rate_corner",) if self.element.reads_rates else ()
        states = self.states_of(names, b, lane, adjoint, plan)
        sums = View(adjoint.sums, let(b * plan.num_vertices), lane)
        return Bundle(sums=sums, **states, **self.of_steps(b, lane, adjoint, plan))

    @traced
    def pass_of(self, b, j, table, plan):
        """Pass j of the scenes of block b."""
        k = let(j - plan.window)
        return pass_at(table, k, let(b * plan.num_passes_shown + k) if "table" in self.own else None)

    @traced
    def one(self, now, lane):
        """A pass as one of the scenes has it."""
        if "table" not in self.own:
            return now
        return Bundle(**{n: let(at(x, lane)) if _in_lanes(x) else x for n, x in vars(now).items()})

    # ---- forward -----------------------------------------------------------------------------------------------------

    @ti.func
    def passes(self, scene: A, state: A, table: A, plan: A):
        for t in range(plan.spread * plan.num_blocks):
            if t % plan.spread == 0:
                for j in range(plan.first, plan.first + plan.count):
                    self.one_pass(t // plan.spread, j, scene, state, table, plan)

    @ti.func
    def one_pass(self, b, j, scene: A, state: A, table: A, plan: A):
        s, now = (j - plan.base) * plan.stride, self.pass_of(b, j, table, plan)
        tetrahedra = self.tetrahedra_of(scene, scene.corner)
        for e in range(plan.num_tetrahedra):
            item = self.item(e, b, plan)
            self.element.forces(item, tetrahedra, state, s, tetrahedra.corner)
            if ti.static(self.element.has_state):
                self.element.move_on(item, tetrahedra, state, s, s + plan.stride, self.onwards(now))
        for i in range(plan.num_vertices):
            calm = self.free.step(i, b, s, now, scene, state, plan)
            if ti.static(self.free.some_special):
                if plan.stride > 0:
                    state.calm[(s * plan.num_blocks + b) * plan.num_vertices + i] = calm
                if calm == 0:
                    for lane in range(LANES):
                        own, at_ = self.scene_of(b, lane, scene, plan), self.state_of(b, lane, state, plan)
                        self.vertex.step(i, j, self.one(now, lane), own, at_, plan)
            self.free.clear(b, i, scene.corner, plan)

    @cached_property
    def step(self) -> Kernel:
        """`count` passes from pass `first` on."""
        return self._kernel("step", self.passes, dict(state=self.with_state(STATE)), stride="int")

    # ---- tangent -----------------------------------------------------------------------------------------------------

    @ti.func
    def passes_jvp(self, scene: A, state: A, tangent: A, table: A, plan: A):
        for t in range(plan.spread * plan.num_blocks):
            if t % plan.spread == 0:
                for j in range(plan.first, plan.first + plan.count):
                    self.one_pass_jvp(t // plan.spread, j, scene, state, tangent, table, plan)

    @ti.func
    def one_pass_jvp(self, b, j, scene: A, state: A, tangent: A, table: A, plan: A):
        s, now = j - plan.base, self.pass_of(b, j, table, plan)
        tetrahedra, changed = self.tetrahedra_of(scene, scene.corner), self.changed_of(tangent)
        for e in range(plan.num_tetrahedra):
            item = self.item(e, b, plan)
            self.element.forces_jvp(item, tetrahedra, state, s, tangent, tetrahedra.corner, changed)
            if ti.static(self.element.has_state):
                self.element.move_on_jvp(item, tetrahedra, state, s, tangent, changed, self.onwards(now))
        for i in range(plan.num_vertices):
            calm = self.was_calm(s, b, i, state, plan)
            if calm == 1:
                self.free.step_jvp(i, b, s, now, scene, state, tangent, plan)
            if ti.static(self.free.some_special):
                if calm == 0:
                    for lane in range(LANES):
                        own, at_ = self.scene_of(b, lane, scene, plan), self.state_of(b, lane, state, plan)
                        change = self.change_of(b, lane, tangent, plan)
                        rated = self.rated(b, lane, tangent, plan)
                        self.vertex.step_jvp(i, j, self.one(now, lane), own, at_, change, rated)
            self.free.clear(b, i, scene.corner, plan)

    @traced
    def changed_of(self, tangent):
        """Changes of what functions of tetrahedra read."""
        coefficients = Uniform(tangent.coefficients) if self.features.uniform else tangent.coefficients
        return Bundle(coefficients=coefficients, gradients=tangent.gradients, volumes=tangent.volumes)

    @traced
    def rated(self, b, lane, tangent, plan):
        """The numbers of a kernel with the change of a scene's drag rate."""
        drag = self.features.drag
        rate = (
            at(at(tangent.parameters, b * plan.num_parameters + drag), lane) if drag >= 0 else ti.cast(0, self.free.fp)
        )
        return Bundle(**vars(plan), rate_dot=let(rate))

    @ti.func
    def was_calm(self, s, b, i, state: A, plan: A):
        calm = 1
        if ti.static(self.free.some_special):
            calm = state.calm[(s * plan.num_blocks + b) * plan.num_vertices + i]
        return calm

    @cached_property
    def step_jvp(self) -> Kernel:
        """The tangent of these passes along recorded slots; the change of the state is advanced in place."""
        tangent = self.with_state(CHANGE) | CHANGED | OF_STEPS
        return self._kernel("step_jvp", self.passes_jvp, dict(state=self.with_state(STATE), tangent=tangent))

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    @ti.func
    def passes_vjp(self, scene: A, state: A, adjoint: A, table: A, plan: A):
        for t in range(plan.spread * plan.num_blocks):
            if t % plan.spread == 0:
                for back in range(plan.count):
                    j = plan.first + plan.count - 1 - back
                    self.one_pass_vjp(t // plan.spread, j, scene, state, adjoint, table, plan)

    @traced
    def pass_back(self, b, j, table, plan):
        """Pass j on the way back."""
        return self.vertex.obstacles.noting(reversed_pass(self.pass_of(b, j, table, plan), j, plan), plan)

    @ti.func
    def one_pass_vjp(self, b, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        s, now = j - plan.base, self.pass_back(b, j, table, plan)
        for i in range(plan.num_vertices):
            calm = self.was_calm(s, b, i, state, plan)
            if calm == 1:
                self.free.step_vjp(i, b, s, now, scene, state, adjoint, plan)
            if ti.static(self.free.some_special):
                if calm == 0:
                    for lane in range(LANES):
                        own, at_ = self.scene_of(b, lane, scene, plan), self.state_of(b, lane, state, plan)
                        by = self.adjoint_of(b, lane, adjoint, plan)
                        self.vertex.step_vjp(i, j, self.one(now, lane), own, at_, by, plan)
            self.free.clear(b, i, adjoint.corner, plan)
            if ti.static(self.element.reads_rates):
                self.free.clear(b, i, adjoint.rate_corner, plan)
        tetrahedra, by_tetrahedra = self.tetrahedra_of(scene, adjoint.corner), self.of_tetrahedra(scene, adjoint)
        for e in range(plan.num_tetrahedra):
            item, corner = self.item(e, b, plan), tetrahedra.corner
            if ti.static(self.element.has_state):
                self.element.move_on_vjp(
                    item, tetrahedra, state, s, self.onwards(now), corner, by_tetrahedra, self.features.shape
                )
            self.element.forces_vjp(item, tetrahedra, state, s, adjoint.w, corner, by_tetrahedra, self.features.shape)
        for p in range(ti.static(self.features.moving)):
            for lane in range(LANES):
                by = self.adjoint_of(b, lane, adjoint, plan)
                self.vertex.obstacles.fold_part(p, plan.num_vertices, j, j, by, table, plan)

    @cached_property
    def step_vjp(self) -> Kernel:
        """The adjoint of passes first + count - 1 .. first; numbers as of a single scene (explicit/kernels.py)."""
        numbers = dict.fromkeys(("num_passes", "halt", "kick", "steps", "num_parts"), "int")
        arrays = dict(state=self.with_state(STATE), adjoint=self.with_state(CHANGE) | ADJOINT | OF_STEPS)
        return self._kernel("step_vjp", self.passes_vjp, arrays, **numbers)

    def _kernel(self, name: str, body, arrays: dict, **numbers) -> Kernel:
        arrays = dict(scene=self.scene()) | arrays | dict(table=self.table())
        few = self.law.short and self.features.order == 1 and not self.features.groups
        return Kernel(f"batch_{name}", body, self.law.precision, arrays, NUMBERS | numbers, polished=few)


@lru_cache(maxsize=None)
def batch_kernels(law, features: Features, own: frozenset) -> BatchKernels:
    """Kernels for a law, a scene's features, and what each scene has of its own."""
    return BatchKernels(law, features, own)


def _in_lanes(number) -> bool:
    return not isinstance(number, int) and number.is_tensor()
