"""What passes go through besides tetrahedra, and what else only some scenes have: pressed triangles, springs and cables,
foundations, guides."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.fluid.dragged_triangle import DRAGGED, DraggedTriangle
from diffsim_ti.mechanics.pressure.pressed_face import pressed_element
from diffsim_ti.mechanics.pressure.pressed_triangle import PRESSED, PressedTriangle
from diffsim_ti.mechanics.stress.nodes import nodes_of
from diffsim_ti.mechanics.supports.guides import GUIDED
from diffsim_ti.mechanics.ties.fibres import FibreBlock
from diffsim_ti.mechanics.ties.foundations import FOUNDED
from diffsim_ti.mechanics.ties.tie import TIED, TieElement
from diffsim_ti.runtime import LANES, PRECISIONS, let, traced
from diffsim_ti.state.bodies import BODIES
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ALONE

OF_BODIES = "body_place", "body_mass", "body_numbers", "body_force"  # of which there are changes
A = ti.template()  # an array or Bundle handed to a Taichi function


def counts_of_further(arrays) -> dict:
    """How many there are, and where their corners begin."""
    names = "num_ties", "first_tied", "first_load", "num_pressed", "first_pressed", "num_dragged", "first_dragged"
    names += ("num_fibre_blocks",)
    return {name: getattr(arrays, name) for name in names} | dict(first_push=arrays.first_pressed)


@dataclass(frozen=True)
class FurtherElements:
    """Functions of item k of those after the tetrahedra: pressed triangles, ties, fibres, triangles in a fluid.

    blocks: whether fibres go eight at a time, where there are as many in a row.
    """

    features: Features
    precision: str
    blocks: bool = False

    @property
    def any(self) -> bool:
        return self.pressed or self.tied or self.dragged

    @property
    def pressed(self) -> bool:
        return self.features.pressed

    @property
    def tied(self) -> bool:
        return self.features.tied

    @property
    def in_eights(self) -> bool:
        """Whether some of the ties, the last ones, are fibres that go eight at a time."""
        return self.blocks and self.features.fibres

    @property
    def dragged(self) -> bool:
        return self.features.dragged

    @cached_property
    def in_fluid(self) -> DraggedTriangle:
        return DraggedTriangle(self.precision, self.features.shape)

    @cached_property
    def triangle(self) -> PressedTriangle:
        has = self.features
        return pressed_element(has.order, self.precision, has.pressure_per_step, has.shape)

    @cached_property
    def tie(self) -> TieElement:
        return TieElement(self.precision, self.features.ties_per_step)

    @cached_property
    def fibre(self) -> FibreBlock:
        has, nodes = self.features, nodes_of(self.features.order, PRECISIONS[self.precision])
        return FibreBlock(self.precision, has.ties_per_step, nodes.count, has.shape)

    @traced
    def num_single(self, plan):
        """Number of ties that go one by one."""
        return let(plan.num_ties - LANES * plan.num_fibre_blocks) if self.in_eights else plan.num_ties

    @traced
    def num_tied(self, plan):
        """Number of items that ties are."""
        return let(self.num_single(plan) + plan.num_fibre_blocks) if self.in_eights else plan.num_ties

    @traced
    def after(self, plan):
        """Number of items of tetrahedra and of these."""
        if self.dragged:
            return let(plan.num_items + plan.num_pressed + self.num_tied(plan) + plan.num_dragged)
        if self.tied:
            return let(plan.num_items + plan.num_pressed + self.num_tied(plan))
        return let(plan.num_items + plan.num_pressed) if self.pressed else plan.num_items

    @property
    def arrays(self) -> dict:
        """What kernels read of the scene for all of that."""
        has, out = self.features, {}
        given = (has.pressed, PRESSED), (has.dragged, DRAGGED)
        for some, own in (
            *given,
            (has.tied, TIED),
            (has.founded, FOUNDED),
            (has.guided, GUIDED),
            (has.reduced, BODIES),
        ):
            out |= own if some else {}
        return out

    @property
    def tangent(self) -> dict:
        """Those of which there are changes."""
        own = {name: kind for name, kind in self.arrays.items() if name in ALONE}
        return own | ({name: BODIES[name] for name in OF_BODIES} if self.features.reduced else {})

    @property
    def adjoint(self) -> dict:
        """Where their adjoints are added."""
        out = dict(pressed_felt="vectors2", pressed_rest="vectors") if self.pressed else {}
        out |= dict(dragged_felt="vectors", dragged_rest="vectors") if self.dragged else {}
        out |= dict(tie_felt="vectors2", tie_rest="vectors") if self.tied else {}
        out |= dict(body_felt="doubles", body_sums="doubles") if self.features.reduced else {}
        return out | (dict(foundation_felt="vectors") if self.features.founded else {})

    @property
    def counts(self) -> dict:
        """The numbers that kernels take."""
        out = ["num_pressed"] if self.any else []
        out += ["first_pressed"] if self.pressed else []
        out += ["num_ties"] if self.tied or self.dragged else []
        out += ["first_tied"] if self.tied else []
        out += ["num_fibre_blocks"] if self.in_eights else []
        out += ["num_dragged", "first_dragged"] if self.dragged else []
        out += ["num_bodies"] if self.features.reduced else []
        out += ["first_load"] if self.features.loaded_corners else []
        return dict.fromkeys([*out, *(["first_push"] if self.features.cabled else [])], "int")

    @traced
    def is_tie(self, k, plan):
        """Whether item k is a tie by itself."""
        after = k >= plan.num_pressed
        return let(after & (k < plan.num_pressed + self.num_single(plan))) if self.dragged or self.in_eights else after

    @traced
    def is_block(self, k, plan):
        """Whether item k is a block of fibres."""
        after = k >= plan.num_pressed + self.num_single(plan)
        return let(after & (k < plan.num_pressed + self.num_tied(plan))) if self.dragged else after

    @traced
    def first_fibre(self, k, plan):
        """The tie with which the block that item k is begins."""
        single = self.num_single(plan)
        return let(single + LANES * (k - plan.num_pressed - single))

    @ti.func
    def forces(self, k, now: A, scene: A, state: A, s, plan: A):
        if ti.static(self.pressed):
            if k < plan.num_pressed:
                self.triangle.forces(k, now, scene, state, s, plan.first_pressed)
        if ti.static(self.tied):
            if self.is_tie(k, plan):
                self.tie.forces(k - plan.num_pressed, now, scene, state, s, plan.first_tied)
        if ti.static(self.in_eights):
            if self.is_block(k, plan):
                self.fibre.forces(self.first_fibre(k, plan), now, scene, state, s, plan.first_tied)
        if ti.static(self.dragged):
            t = k - plan.num_pressed - self.num_tied(plan)
            if t >= 0:
                self.in_fluid.forces(t, scene, state, s, plan.first_dragged)

    @ti.func
    def forces_jvp(self, k, now: A, scene: A, state: A, s, tangent: A, plan: A):
        if ti.static(self.pressed):
            if k < plan.num_pressed:
                self.triangle.forces_jvp(k, now, scene, state, s, tangent, plan.first_pressed)
        if ti.static(self.tied):
            if self.is_tie(k, plan):
                self.tie.forces_jvp(k - plan.num_pressed, now, scene, state, s, tangent, plan.first_tied)
        if ti.static(self.in_eights):
            if self.is_block(k, plan):
                self.fibre.forces_jvp(self.first_fibre(k, plan), now, scene, state, s, tangent, plan.first_tied)
        if ti.static(self.dragged):
            t = k - plan.num_pressed - self.num_tied(plan)
            if t >= 0:
                self.in_fluid.forces_jvp(t, scene, state, s, tangent, plan.first_dragged)

    @ti.func
    def forces_vjp(self, k, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        if ti.static(self.pressed):
            if k < plan.num_pressed:
                self.triangle.forces_vjp(k, now, scene, state, s, adjoint, plan.first_pressed)
        if ti.static(self.tied):
            if self.is_tie(k, plan):
                self.tie.forces_vjp(k - plan.num_pressed, now, scene, state, s, adjoint, plan.first_tied)
        if ti.static(self.in_eights):
            if self.is_block(k, plan):
                self.fibre.forces_vjp(self.first_fibre(k, plan), now, scene, state, s, adjoint, plan.first_tied)
        if ti.static(self.dragged):
            t = k - plan.num_pressed - self.num_tied(plan)
            if t >= 0:
                self.in_fluid.forces_vjp(t, scene, state, s, adjoint, plan.first_dragged)
