"""Kernels of the explicit solvers: passes over all tetrahedra and vertices, forward, tangent and adjoint."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.mechanics.obstacles.outside_work import with_drag
from diffsim_ti.mechanics.reduced.body_adjoint import BodyStage
from diffsim_ti.mechanics.stress.tetrahedron import Onwards
from diffsim_ti.runtime import A, Bundle, Kernel, as_kernel, let, traced
from diffsim_ti.solvers.explicit.kick_drift import KickDrift
from diffsim_ti.solvers.explicit.vertex_parts import ItemForces
from diffsim_ti.state.numbers import ADJOINT, OF_STEPS, SCENE, TANGENT, adjoints, needed, with_state
from diffsim_ti.state.pass_table import pass_at, reversed_pass

STATE = dict.fromkeys(("u", "v", "f", "frames_u", "frames_v"), "vectors2")
STATE |= dict(seen="scalars2", stage="vectors2", work="scalars", own_work="scalars")
RECORDED = {name: STATE[name] for name in ("u", "v", "f", "stage")}  # what the way back reads of it
CHANGE = dict(u="vectors2", v="vectors2", frames_u="vectors2", frames_v="vectors2")  # of a state, or its adjoint
PLAN = dict(ints="ints", floats="scalars")  # the tables of the passes, from pass `window` on
LED = dict(offsets="vectors")  # where robots have moved obstacles, and its change
TURNS = dict(turns="ints")  # of the loops of a launch for many passes
NUMBERS = dict.fromkeys(("num_items", "num_vertices", "window", "first", "count", "base"), "int") | dict(
    contact_damping="float"
)


@traced
def unseen(now) -> Bundle:
    """A pass that shows no frame."""
    return Bundle(**vars(now) | dict(frame=let(0 * now.frame - 1)))


@dataclass(frozen=True)
class ExplicitKernels:
    """parallel: passes on all threads, one after the other, else a single loop over `count` passes on one.

    repeated: `count` passes per launch in parallel too. Its two loops are gone through `times` times (Kernel), and count
    themselves: the first reads in turns[0] which time it is and notes it in turns[1], the second reads that and notes the
    next in turns[0], so that no thread reads what another may be writing. After the last time it is 0 again.
    """

    vertex: KickDrift
    parallel: bool
    repeated: bool = False

    @property
    def element(self):
        return self.vertex.element

    @cached_property
    def items(self) -> ItemForces:
        return ItemForces(self.vertex.features, blocks=True)

    @cached_property
    def bodies(self) -> BodyStage:
        return BodyStage(self.vertex)

    @property
    def reduced(self) -> bool:
        return self.vertex.features.reduced

    @traced
    def onwards(self, now) -> Onwards:
        """How the law's state goes on in a pass; one that only kicks leaves it as it is."""
        return Onwards(h=now.h, moves=let(now.alpha > 0))

    def with_state(self, arrays: dict) -> dict:
        return with_state(arrays, self.vertex.law)

    def with_record(self, arrays: dict) -> dict:
        """The same, with the impulses of obstacles where they are recorded."""
        return self.with_state(arrays) | (dict(impulse="vectors2") if self.vertex.features.recorded else {})

    def along_record(self) -> dict:
        """What a tangent reads and changes."""
        changed = self.with_record(CHANGE) | TANGENT | LED | self.items.tangent
        return dict(state=self.with_record(STATE), tangent=changed)

    @property
    def corners(self) -> dict:
        """Adjoints of u and v, still to be gathered."""
        return dict(corner="vectors") | (dict(rate_corner="vectors") if self.vertex.reads_rates else {})

    @property
    def is_short(self) -> bool:
        """Whether passes are of linear tetrahedra in lanes and little else: polished, these are a tenth faster."""
        has, short = self.vertex.features, self.vertex.law.short and self.vertex.lanes
        return short and has.order == 1 and not (has.groups or has.reduced or self.items.any)

    # ---- which scene a loop's item or vertex k is of, where they are of many (batch/innermost_kernels.py) ---------------

    @traced
    def split(self, k, plan) -> tuple:
        """(item or vertex, number b of its scene)"""
        return k, 0

    @traced
    def scene_of(self, b, scene, plan):
        return scene

    @traced
    def record_of(self, b, record, plan):
        """Its state, change or adjoint."""
        return record

    @traced
    def numbers_of(self, b, j, table, plan):
        """Of its pass j."""
        return pass_at(table, j - plan.window)

    @traced
    def rated(self, b, tangent, plan):
        """The numbers of a kernel with the change of its drag rate."""
        return plan

    @traced
    def scene_at(self, k, j, scene, state, table, plan) -> tuple:
        """(item or vertex, b, numbers of pass j, scene, state)"""
        i, b = self.split(k, plan)
        return i, b, self.numbers_of(b, j, table, plan), self.scene_of(b, scene, plan), self.record_of(b, state, plan)

    @traced
    def item(self, e, plan):
        """Tetrahedron e for functions of these."""
        return e

    @traced
    def tetrahedron_at(self, e, j, table, plan) -> tuple:
        """(tetrahedron e, numbers of pass j if they are asked for)"""
        asked = self.element.has_state or self.vertex.features.growing
        now = self.numbers_of(self.split(e, plan)[1], j, table, plan) if asked else Bundle()
        return self.item(e, plan), now

    @traced
    def tetrahedra_of(self, record, now):
        """The scene for functions of tetrahedra, which knows its pass where they grow."""
        return Bundle(**vars(record), now=now) if self.vertex.features.growing else record

    changed = tetrahedra_of  # changes of it

    @traced
    def on(self, now, scene):
        """A pass at vertices on the way forward."""
        return with_drag(self.vertex, self.vertex.obstacles.counted(now), scene)

    @traced
    def back(self, now, j, plan):
        """The same on the way back."""
        return self.vertex.obstacles.counted(self.vertex.obstacles.noting(reversed_pass(now, j, plan), plan))

    @traced
    def after(self, plan):
        """Number of tetrahedra and of what else writes to corners."""
        return self.items.after(plan)

    @traced
    def num_vertices(self, plan):
        return plan.num_vertices

    @traced
    def num_parts(self, plan):
        """Of sums of adjoints of a path."""
        return plan.num_parts

    @ti.func
    def turn_of_first(self, item, table: A):
        """Which time this is that the first loop is gone through."""
        turn = 0
        if ti.static(self.repeated):
            turn = table.turns[0]
            if item == 0:
                table.turns[1] = turn
        return turn

    @ti.func
    def turn_of_second(self, item, table: A, plan: A):
        """The same of the second loop."""
        turn = 0
        if ti.static(self.repeated):
            turn = table.turns[1]
            if item == 0:
                table.turns[0] = ti.select(turn + 1 < plan.times, turn + 1, 0)
        return turn

    # ---- forward -----------------------------------------------------------------------------------------------------

    @ti.func
    def elements(self, e, j, scene: A, state: A, table: A, plan: A):
        if ti.static(self.items.any):
            if e < plan.num_items:
                self.tetrahedra(e, j, scene, state, table, plan)
            else:
                i, b, now, own, at_ = self.scene_at(e - plan.num_items, j, scene, state, table, plan)
                self.items.forces(i, now, own, at_, (j - plan.base) * plan.stride, plan)
        else:
            self.tetrahedra(e, j, scene, state, table, plan)

    @ti.func
    def tetrahedra(self, e, j, scene: A, state: A, table: A, plan: A):
        item, now = self.tetrahedron_at(e, j, table, plan)
        of, s = self.tetrahedra_of(scene, now), (j - plan.base) * plan.stride
        self.element.forces(item, of, state, s, scene.corner)
        if ti.static(self.element.has_state):
            self.element.move_on(item, of, state, s, s + plan.stride, self.onwards(now))

    @as_kernel("step", lambda self: dict(state=self.with_record(STATE)), lambda self: self.repeated, stride="int")
    def step(self, scene: A, state: A, table: A, plan: A):
        """`count` passes from pass `first` on. Slot 0 holds the state before pass `base`; with stride 1 each pass writes the
        next slot, and its forces."""
        if ti.static(self.parallel):
            num_items, num_vertices = self.after(plan), self.num_vertices(plan)  # both bounds are read by one task
            for e in range(num_items):
                turn = self.turn_of_first(e, table)
                if turn < plan.count:
                    self.elements(e, plan.first + turn, scene, state, table, plan)
            for k in range(num_vertices):
                turn = self.turn_of_second(k, table, plan)
                if turn < plan.count:
                    j = plan.first + turn
                    i, b, now, own, at_ = self.scene_at(k, j, scene, state, table, plan)
                    self.vertex.step(i, j, self.on(now, own), own, at_, plan)
            if ti.static(self.reduced):
                for b in range(plan.num_bodies):
                    now = self.on(self.numbers_of(0, plan.first, table, plan), scene)
                    self.bodies.step(b, plan.first, now, scene, state, plan)
        else:
            ti.loop_config(serialize=True)
            for j in range(plan.first, plan.first + plan.count):
                for e in range(self.items.after(plan)):
                    self.elements(e, j, scene, state, table, plan)
                now = self.on(self.numbers_of(0, j, table, plan), scene)
                for i in range(plan.num_vertices):
                    self.vertex.step(i, j, now, scene, state, plan)
                if ti.static(self.reduced):
                    for b in range(plan.num_bodies):
                        self.bodies.step(b, j, now, scene, state, plan)

    # ---- tangent -----------------------------------------------------------------------------------------------------

    @ti.func
    def elements_jvp(self, e, j, scene: A, state: A, tangent: A, table: A, plan: A):
        if ti.static(self.items.any):
            if e < plan.num_items:
                self.tetrahedra_jvp(e, j, scene, state, tangent, table, plan)
            else:
                i, b, now, own, at_ = self.scene_at(e - plan.num_items, j, scene, state, table, plan)
                self.items.forces_jvp(i, now, own, at_, j - plan.base, self.record_of(b, tangent, plan), plan)
        else:
            self.tetrahedra_jvp(e, j, scene, state, tangent, table, plan)

    @ti.func
    def tetrahedra_jvp(self, e, j, scene: A, state: A, tangent: A, table: A, plan: A):
        item, now = self.tetrahedron_at(e, j, table, plan)
        of, dots, s = self.tetrahedra_of(scene, now), self.changed(tangent, now), j - plan.base
        self.element.forces_jvp(item, of, state, s, tangent, scene.corner, dots)
        if ti.static(self.element.has_state):
            self.element.move_on_jvp(item, of, state, s, tangent, dots, self.onwards(now))

    @as_kernel("step_jvp", along_record, lambda self: self.repeated, rate_dot="float")
    def step_jvp(self, scene: A, state: A, tangent: A, table: A, plan: A):
        """The tangent of passes first .. first + count - 1 along recorded slots; the change of the state is advanced in
        place."""
        if ti.static(self.parallel):
            num_items, num_vertices = self.after(plan), self.num_vertices(plan)
            for e in range(num_items):
                turn = self.turn_of_first(e, table)
                if turn < plan.count:
                    self.elements_jvp(e, plan.first + turn, scene, state, tangent, table, plan)
            for k in range(num_vertices):
                turn = self.turn_of_second(k, table, plan)
                if turn < plan.count:
                    j = plan.first + turn
                    i, b, now, own, at_ = self.scene_at(k, j, scene, state, table, plan)
                    change, rated = self.record_of(b, tangent, plan), self.rated(b, tangent, plan)
                    self.vertex.step_jvp(i, j, self.vertex.obstacles.counted(now), own, at_, change, rated)
            if ti.static(self.reduced):
                for b in range(plan.num_bodies):
                    now = self.vertex.obstacles.counted(self.numbers_of(0, plan.first, table, plan))
                    self.bodies.step_jvp(b, plan.first, now, scene, state, tangent, plan)
        else:
            ti.loop_config(serialize=True)
            for j in range(plan.first, plan.first + plan.count):
                for e in range(self.items.after(plan)):
                    self.elements_jvp(e, j, scene, state, tangent, table, plan)
                now = self.vertex.obstacles.counted(self.numbers_of(0, j, table, plan))
                for i in range(plan.num_vertices):
                    self.vertex.step_jvp(i, j, now, scene, state, tangent, plan)
                if ti.static(self.reduced):
                    for b in range(plan.num_bodies):
                        self.bodies.step_jvp(b, j, now, scene, state, tangent, plan)

    # ---- vertices again, where joints of robots meet them (mechanics/joints/explicit.py) --------------------------------

    @as_kernel("press", lambda self: dict(state=self.with_record(STATE)), False, stride="int")
    def press(self, scene: A, state: A, table: A, plan: A):
        num_vertices = self.num_vertices(plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(num_vertices):
            now = self.vertex.obstacles.counted(self.numbers_of(0, plan.first, table, plan))
            self.vertex.press(i, now, scene, state, plan)

    @as_kernel("press_jvp", along_record, False, rate_dot="float")
    def press_jvp(self, scene: A, state: A, tangent: A, table: A, plan: A):
        """Its change where only the rows of obstacles change."""
        num_vertices = self.num_vertices(plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(num_vertices):
            now = unseen(self.vertex.obstacles.counted(self.numbers_of(0, plan.first, table, plan)))
            self.vertex.go_on_jvp(i, plan.base, self.vertex.vector(0), now, scene, state, tangent, plan)

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    @ti.func
    def elements_vjp(self, e, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        if ti.static(self.items.any):
            if e < plan.num_items:
                self.tetrahedra_vjp(e, j, scene, state, adjoint, table, plan)
            else:
                i, b, now, own, at_ = self.scene_at(e - plan.num_items, j, scene, state, table, plan)
                self.items.forces_vjp(i, now, own, at_, j - plan.base, self.record_of(b, adjoint, plan), plan)
        else:
            self.tetrahedra_vjp(e, j, scene, state, adjoint, table, plan)

    @ti.func
    def tetrahedra_vjp(self, e, j, scene: A, state: A, adjoint: A, table: A, plan: A):
        item, now = self.tetrahedron_at(e, j, table, plan)
        of, s = self.tetrahedra_of(scene, now), j - plan.base
        if ti.static(self.element.has_state):
            on = self.onwards(reversed_pass(now, j, plan))
            self.element.move_on_vjp(item, of, state, s, on, adjoint.corner, adjoint, self.vertex.features.shape)
        self.element.forces_vjp(
            item, of, state, s, adjoint.w, adjoint.corner, adjoint, self.vertex.features.shape, self.element.has_state
        )

    @ti.func
    def fold(self, k, first, last, adjoint: A, table: A, plan: A):
        """Sum adjoints of paths over vertices."""
        p, b = self.split(k, plan)
        by = self.record_of(b, adjoint, plan)
        self.vertex.obstacles.fold_part(p, plan.num_vertices, first, last, by, table, plan)

    @ti.func
    def passes_vjp(self, scene: A, state: A, adjoint: A, table: A, plan: A):
        """The gather of K w is left to the next call (or to `finish_vjp`), so that each pass has two loops, as forward."""
        moving = ti.static(self.vertex.features.moving)
        if ti.static(self.parallel):
            num_items, num_vertices, parts = self.after(plan), self.num_vertices(plan), moving * self.num_parts(plan)
            if ti.static(self.reduced):
                for b in range(plan.num_bodies):
                    now = self.back(self.numbers_of(0, plan.first, table, plan), plan.first, plan)
                    self.bodies.step_vjp(b, plan.first, now, scene, state, adjoint, plan)
            for k in range(num_vertices):
                turn = self.turn_of_first(k, table)
                if turn < plan.count:
                    j = plan.first + plan.count - 1 - turn
                    i, b, now, own, at_ = self.scene_at(k, j, scene, state, table, plan)
                    by = self.record_of(b, adjoint, plan)
                    self.vertex.step_vjp(i, j, self.back(now, j, plan), own, at_, by, plan)
            for e in range(num_items):
                turn = self.turn_of_second(e, table, plan)
                if turn < plan.count:
                    self.elements_vjp(e, plan.first + plan.count - 1 - turn, scene, state, adjoint, table, plan)
            if ti.static(moving > 0):
                for p in range(parts):
                    self.fold(p, plan.first, plan.first + plan.count - 1, adjoint, table, plan)
        else:
            ti.loop_config(serialize=True)
            for back in range(plan.count):
                j = plan.first + plan.count - 1 - back
                now = self.back(self.numbers_of(0, j, table, plan), j, plan)
                if ti.static(self.reduced):
                    for b in range(plan.num_bodies):
                        self.bodies.step_vjp(b, j, now, scene, state, adjoint, plan)
                for i in range(plan.num_vertices):
                    self.vertex.step_vjp(i, j, now, scene, state, adjoint, plan)
                for e in range(self.items.after(plan)):
                    self.elements_vjp(e, j, scene, state, adjoint, table, plan)
                if ti.static(moving > 0):
                    for p in range(moving * plan.num_parts):
                        self.fold(p, j, j, adjoint, table, plan)

    @cached_property
    def step_vjp(self) -> Kernel:
        """The adjoint of passes first + count - 1 .. first.

        halt: the pass at whose state the sweep stops, between its two kicks; kick: only the kick before the state.
        steps: those for which adjoints of paths have room; num_parts: sums over vertices that are made for each path.
        """
        numbers = dict.fromkeys(("halt", "kick", "steps", "num_parts"), "int")
        own = adjoints(self.with_record(CHANGE) | ADJOINT | OF_STEPS, self.vertex.features) | self.corners
        own |= dict.fromkeys(("w", "path_adjoint", "offsets"), "vectors2") | self.items.adjoint
        arrays = dict(state=self.with_record(RECORDED), adjoint=own)
        return self._kernel("step_vjp", self.passes_vjp, arrays, self.repeated, **numbers)

    @ti.func
    def gather_rest(self, scene: A, adjoint: A, plan: A):
        num_vertices = self.num_vertices(plan)
        ti.loop_config(serialize=not self.parallel)
        for k in range(num_vertices):
            i, b = self.split(k, plan)
            by = self.record_of(b, adjoint, plan)
            by.u[0, i] = by.u[0, i] + self.element.gather(i, scene, by.corner)
            if ti.static(self.vertex.reads_rates):
                by.v[0, i] = by.v[0, i] + self.element.gather(i, scene, by.rate_corner)

    @cached_property
    def finish_vjp(self) -> Kernel:
        """Add the gather that the first pass of the run has left."""
        gathered = dict(u="vectors2") | (dict(v="vectors2") if self.vertex.reads_rates else {})
        own = dict(scene={name: SCENE[name] for name in ("start", "corner_of")}, adjoint=gathered | self.corners)
        return self.kernel("finish_vjp", self.gather_rest, own, dict(num_vertices="int"))

    def _kernel(self, name: str, body, arrays: dict, repeated: bool, **numbers) -> Kernel:
        arrays = dict(scene=SCENE | LED | self.items.arrays) | arrays | dict(table=PLAN)
        arrays = {bundle: needed(own, self.vertex.features) for bundle, own in arrays.items()}
        numbers = NUMBERS | self.items.counts | numbers
        if repeated:
            arrays["table"], numbers = PLAN | TURNS, numbers | dict(times="int")
        return self.kernel(name, body, arrays, numbers, 2 * repeated, self.is_short)

    def kernel(self, name: str, body, arrays: dict, numbers: dict, *options) -> Kernel:
        return Kernel(name, body, self.vertex.law.precision, arrays, numbers, *options)


@lru_cache(maxsize=None)
def explicit_kernels(law, features, parallel: bool, lanes: bool, repeated: bool) -> ExplicitKernels:
    """Kernels for a law and a scene's features."""
    return ExplicitKernels(KickDrift(law, features, lanes), parallel, repeated)
