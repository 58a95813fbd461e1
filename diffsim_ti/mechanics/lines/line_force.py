"""Springs, cables and muscles of a scene in explicit passes: one by one, and fibres of muscles eight at a time."""

from dataclasses import dataclass, replace
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.interaction import ItemForce
from diffsim_ti.mechanics.lines.fibres import FibreBlock
from diffsim_ti.mechanics.lines.line import LineElement
from diffsim_ti.runtime import LANES, let, traced

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class LineForce(ItemForce):
    """per_step: whether their numbers have a row for each step; cables: whether some are cables, which are loads;
    fibres: whether the last ones are fibres that go eight at a time, of tetrahedra of `nodes` nodes; shape: of adjoints."""

    per_step: bool
    cables: bool
    fibres: bool
    nodes: int
    shape: bool

    name, pulls, asks_for_steps = "lines", True, True
    arrays = dict.fromkeys(("line_start", "point_start", "point_vertex", "line_sides"), "ints")
    arrays |= dict(point_weight="scalars")
    # between points at rest (points, 3) [m]; numbers of each (inputs/lines.py), (1 or steps, 2 elements, 3)
    derived = dict(line_segments="vectors", lines="vectors2")
    adjoints = dict(line_adjoint="vectors2", line_rest="vectors")

    @property
    def is_load(self) -> bool:
        return self.cables

    @property
    def counts(self) -> tuple[str, ...]:
        return (*super().counts, *(("num_fibre_blocks",) if self.fibres else ()))

    def alone(self) -> "LineForce":
        return replace(self, fibres=False)

    @cached_property
    def line(self) -> LineElement:
        return LineElement(self.precision, self.per_step)

    @cached_property
    def fibre(self) -> FibreBlock:
        return FibreBlock(self.precision, self.per_step, self.nodes, self.shape)

    @traced
    def sizes(self, plan) -> dict:
        return super().sizes(plan) | dict(line_adjoint=plan.len_lines, line_rest=plan.len_line_segments)

    @traced
    def num_single(self, plan):
        """Number of line elements that go one by one."""
        return let(plan.num_lines - LANES * plan.num_fibre_blocks) if self.fibres else plan.num_lines

    @traced
    def count(self, plan):
        return let(self.num_single(plan) + plan.num_fibre_blocks) if self.fibres else plan.num_lines

    @traced
    def first_fibre(self, k, plan):
        """The line element with which the block that item k is begins."""
        single = self.num_single(plan)
        return let(single + LANES * (k - single))

    @ti.func
    def forces(self, k, now: A, scene: A, state: A, s, plan: A):
        if ti.static(not self.fibres):
            self.line.forces(k, now, scene, state, s, self.first(plan))
        elif k < self.num_single(plan):
            self.line.forces(k, now, scene, state, s, self.first(plan))
        else:
            self.fibre.forces(self.first_fibre(k, plan), now, scene, state, s, self.first(plan))

    @ti.func
    def forces_jvp(self, k, now: A, scene: A, state: A, s, tangent: A, plan: A):
        if ti.static(not self.fibres):
            self.line.forces_jvp(k, now, scene, state, s, tangent, self.first(plan))
        elif k < self.num_single(plan):
            self.line.forces_jvp(k, now, scene, state, s, tangent, self.first(plan))
        else:
            self.fibre.forces_jvp(self.first_fibre(k, plan), now, scene, state, s, tangent, self.first(plan))

    @ti.func
    def forces_vjp(self, k, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        if ti.static(not self.fibres):
            self.line.forces_vjp(k, now, scene, state, s, adjoint, self.first(plan))
        elif k < self.num_single(plan):
            self.line.forces_vjp(k, now, scene, state, s, adjoint, self.first(plan))
        else:
            self.fibre.forces_vjp(self.first_fibre(k, plan), now, scene, state, s, adjoint, self.first(plan))
