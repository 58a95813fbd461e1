"""Springs, cables and muscles of a scene in explicit passes: one by one, and fibres of muscles eight at a time."""

from dataclasses import dataclass, replace
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.interaction import ItemForce
from diffsim_ti.mechanics.ties.fibres import FibreBlock
from diffsim_ti.mechanics.ties.tie import TieElement
from diffsim_ti.runtime import LANES, let, traced

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class TieForce(ItemForce):
    """per_step: whether their numbers have a row for each step; cables: whether some are cables, which are loads;
    fibres: whether the last ones are fibres that go eight at a time, of tetrahedra of `nodes` nodes; shape: of adjoints."""

    per_step: bool
    cables: bool
    fibres: bool
    nodes: int
    shape: bool

    name, pulls, asks_for_steps = "ties", True, True
    arrays = dict.fromkeys(("tie_start", "point_start", "point_vertex", "tie_sides"), "ints")
    arrays |= dict(point_weight="scalars")
    # between points at rest (points, 3) [m]; numbers of each (inputs/ties.py), (1 or steps, 2 ties, 3)
    derived = dict(tie_segments="vectors", ties="vectors2")
    adjoints = dict(tie_felt="vectors2", tie_rest="vectors")

    @property
    def is_load(self) -> bool:
        return self.cables

    @property
    def counts(self) -> tuple[str, ...]:
        return (*super().counts, *(("num_fibre_blocks",) if self.fibres else ()))

    def alone(self) -> "TieForce":
        return replace(self, fibres=False)

    @cached_property
    def tie(self) -> TieElement:
        return TieElement(self.precision, self.per_step)

    @cached_property
    def fibre(self) -> FibreBlock:
        return FibreBlock(self.precision, self.per_step, self.nodes, self.shape)

    @traced
    def sizes(self, plan) -> dict:
        return super().sizes(plan) | dict(tie_felt=plan.len_ties, tie_rest=plan.len_tie_segments)

    @traced
    def num_single(self, plan):
        """Number of ties that go one by one."""
        return let(plan.num_ties - LANES * plan.num_fibre_blocks) if self.fibres else plan.num_ties

    @traced
    def count(self, plan):
        return let(self.num_single(plan) + plan.num_fibre_blocks) if self.fibres else plan.num_ties

    @traced
    def first_fibre(self, k, plan):
        """The tie with which the block that item k is begins."""
        single = self.num_single(plan)
        return let(single + LANES * (k - single))

    @ti.func
    def forces(self, k, now: A, scene: A, state: A, s, plan: A):
        if ti.static(self.fibres):
            if k < self.num_single(plan):
                self.tie.forces(k, now, scene, state, s, self.first(plan))
            else:
                self.fibre.forces(self.first_fibre(k, plan), now, scene, state, s, self.first(plan))
        else:
            self.tie.forces(k, now, scene, state, s, self.first(plan))

    @ti.func
    def forces_jvp(self, k, now: A, scene: A, state: A, s, tangent: A, plan: A):
        if ti.static(self.fibres):
            if k < self.num_single(plan):
                self.tie.forces_jvp(k, now, scene, state, s, tangent, self.first(plan))
            else:
                self.fibre.forces_jvp(self.first_fibre(k, plan), now, scene, state, s, tangent, self.first(plan))
        else:
            self.tie.forces_jvp(k, now, scene, state, s, tangent, self.first(plan))

    @ti.func
    def forces_vjp(self, k, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        if ti.static(self.fibres):
            if k < self.num_single(plan):
                self.tie.forces_vjp(k, now, scene, state, s, adjoint, self.first(plan))
            else:
                self.fibre.forces_vjp(self.first_fibre(k, plan), now, scene, state, s, adjoint, self.first(plan))
        else:
            self.tie.forces_vjp(k, now, scene, state, s, adjoint, self.first(plan))
