"""Kernels of many scenes: a thread takes a block of eight scenes through all passes of a launch.

Tetrahedra are worked on in lanes, one scene in each, and add straight to the forces of their block. So are vertices at
which nothing else acts in any of the eight (free_vertices.py); at the others the functions of a single scene
(explicit/kick_drift.py) go through the eight scenes one after the other, by views of them.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.batch.block_views import OF_STEPS, BlockViews, in_blocks, in_lanes
from diffsim_ti.runtime import LANES, A, Bundle, Kernel, as_kernel, at, let, traced
from diffsim_ti.state.pass_table import reversed_pass

STATE = dict.fromkeys(("u", "v", "f", "frames_u", "frames_v", "seen"), "blocks2")
STATE |= dict(stage="vectors2", work="scalars", calm="ints")
CHANGE = dict.fromkeys(("u", "v", "frames_u", "frames_v"), "blocks2")
CHANGED = dict.fromkeys(("coefficients", "gradients", "volumes", "mass", "parameters", "rest", "surface"), "blocks")
ADJOINT = dict.fromkeys(("coefficients", "gradients", "volumes", "corner", "rate_corner"), "blocks")
ADJOINT |= dict.fromkeys(("w", "sums", "path_adjoint"), "blocks2")
SIZES = (
    *("num_tetrahedra", "num_vertices", "num_blocks", "spread"),
    *("num_loaded", "num_held", "num_parameters", "num_passes_shown"),
)
NUMBERS = dict.fromkeys((*SIZES, "window", "first", "count", "base"), "int") | dict(contact_damping="float")


@dataclass(frozen=True)
class BatchKernels(BlockViews):
    """Passes of all blocks, forward, tangent and adjoint."""

    @traced
    def one(self, now, lane):
        """A pass as one of the scenes has it."""
        if "table" in self.own:
            now = Bundle(**{n: let(at(x, lane)) if in_lanes(x) else x for n, x in vars(now).items()})
        return self.vertex.obstacles.counted(now)

    # ---- forward -----------------------------------------------------------------------------------------------------

    @as_kernel("step", {}, stride="int")
    def step(self, scene: A, state: A, table: A, plan: A):
        """`count` passes from pass `first` on."""
        for t in range(plan.spread * plan.num_blocks):
            if t % plan.spread == 0:
                for j in range(plan.first, plan.first + plan.count):
                    self.one_pass(t // plan.spread, j, scene, state, table, plan)

    @ti.func
    def one_pass(self, b, j, scene: A, state: A, table: A, plan: A):
        s, now = (j - plan.base) * plan.stride, self.pass_of(b, j, table, plan)
        tetrahedra, sums = self.tetrahedra_of(scene, scene.corner, now), self.element.room_for_sums()
        for e in range(plan.num_tetrahedra):
            item = self.item(e, b, plan)
            self.element.sum_up(item, sums, tetrahedra, state, s)
            self.element.forces(item, tetrahedra, state, s, tetrahedra.corner)
            if ti.static(self.element.has_state):
                self.element.move_on(item, tetrahedra, state, s, s + plan.stride, self.onwards(now))
        if ti.static(self.items.any):
            for t in range(self.items.count(plan)):
                for lane in range(LANES):
                    own, at_ = self.acted_on(b, lane, scene, plan), self.state_of(b, lane, state, plan)
                    self.items.forces(t, self.one(now, lane), own, at_, s, plan)
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

    # ---- tangent -----------------------------------------------------------------------------------------------------

    def changed(self) -> dict:
        return dict(tangent=self.with_record(CHANGE) | CHANGED | OF_STEPS | self.alone | self.growing)

    @as_kernel("step_jvp", changed)
    def step_jvp(self, scene: A, state: A, tangent: A, table: A, plan: A):
        """The tangent of these passes along recorded slots; the change of the state is advanced in place."""
        for t in range(plan.spread * plan.num_blocks):
            if t % plan.spread == 0:
                for j in range(plan.first, plan.first + plan.count):
                    self.one_pass_jvp(t // plan.spread, j, scene, state, tangent, table, plan)

    @ti.func
    def one_pass_jvp(self, b, j, scene: A, state: A, tangent: A, table: A, plan: A):
        s, now = j - plan.base, self.pass_of(b, j, table, plan)
        tetrahedra, changed = self.tetrahedra_of(scene, scene.corner, now), self.changed_of(tangent, now)
        sums = self.element.room_for_sums()
        for e in range(plan.num_tetrahedra):
            item = self.item(e, b, plan)
            self.element.sum_up(item, sums, tetrahedra, state, s, tangent.u, changed)
            self.element.forces_jvp(item, tetrahedra, state, s, tangent, tetrahedra.corner, changed)
            if ti.static(self.element.has_state):
                self.element.move_on_jvp(item, tetrahedra, state, s, tangent, changed, self.onwards(now))
        if ti.static(self.items.any):
            for t in range(self.items.count(plan)):
                for lane in range(LANES):
                    own, at_ = self.acted_on(b, lane, scene, plan), self.state_of(b, lane, state, plan)
                    change = self.change_of(b, lane, tangent, plan)
                    self.items.forces_jvp(t, self.one(now, lane), own, at_, s, change, plan)
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

    @ti.func
    def was_calm(self, s, b, i, state: A, plan: A):
        calm = 1
        if ti.static(self.free.some_special):
            calm = state.calm[(s * plan.num_blocks + b) * plan.num_vertices + i]
        return calm

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    def adjoints(self) -> dict:
        own = self.with_record(CHANGE) | ADJOINT | OF_STEPS | in_blocks(self.items.adjoint) | self.growing
        return dict(adjoint=own)

    @as_kernel("step_vjp", adjoints, **dict.fromkeys(("halt", "kick", "steps", "num_parts"), "int"))
    def step_vjp(self, scene: A, state: A, adjoint: A, table: A, plan: A):
        """The adjoint of passes first + count - 1 .. first; numbers as of a single scene (explicit/kernels.py)."""
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
            if ti.static(self.vertex.reads_rates):
                self.free.clear(b, i, adjoint.rate_corner, plan)
        tetrahedra = self.tetrahedra_of(scene, adjoint.corner, self.pass_of(b, j, table, plan))
        by_tetrahedra, sums = self.of_tetrahedra(scene, adjoint), self.element.room_for_sums()
        for e in range(plan.num_tetrahedra):
            item, corner = self.item(e, b, plan), tetrahedra.corner
            self.element.sum_up(item, sums, tetrahedra, state, s, adjoint.w)
            if ti.static(self.element.has_state):
                self.element.move_on_vjp(
                    item, tetrahedra, state, s, self.onwards(now), corner, by_tetrahedra, self.features.shape
                )
            self.element.forces_vjp(item, tetrahedra, state, s, adjoint.w, corner, by_tetrahedra, self.features.shape)
        if ti.static(self.items.any):
            for t in range(self.items.count(plan)):
                for lane in range(LANES):
                    own, at_ = self.acted_on(b, lane, scene, plan), self.state_of(b, lane, state, plan)
                    by = self.adjoint_of_acting(b, lane, scene, adjoint, plan)
                    self.items.forces_vjp(t, self.one(now, lane), own, at_, s, by, plan)
        for p in range(ti.static(self.features.moving)):
            for lane in range(LANES):
                by = self.adjoint_of(b, lane, adjoint, plan)
                self.vertex.obstacles.fold_part(p, plan.num_vertices, j, j, by, table, plan)

    def _kernel(self, name: str, body, arrays: dict, **numbers) -> Kernel:
        arrays = dict(scene=self.scene(), state=self.with_record(STATE)) | arrays | dict(table=self.table())
        few = self.law.short and self.features.order == 1 and not (self.features.groups or self.items.any)
        numbers = NUMBERS | numbers | self.items.counts | self.lengths
        return Kernel(f"batch_{name}", body, self.law.precision, arrays, numbers, polished=few)
