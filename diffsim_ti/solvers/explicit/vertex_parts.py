"""What a pass is made of: at a vertex elements, obstacles, given forces, supports; items of interactions, such as
springs."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.loads.explicit import AppliedForces
from diffsim_ti.mechanics.obstacles.contact_stage import ContactStage
from diffsim_ti.mechanics.obstacles.obstacle_stages import ObstacleStages
from diffsim_ti.mechanics.stress.patched_tetrahedron import functions_of
from diffsim_ti.mechanics.supports.sliding_supports import SLIDING_SUPPORTS, SlidingSupports
from diffsim_ti.runtime import A, let, number_type, traced, vector_type
from diffsim_ti.state.bodies import BODIES
from diffsim_ti.state.features import Features

OF_BODIES = "body_place", "body_mass", "body_numbers", "body_force"  # of which there are changes


@dataclass(frozen=True)
class VertexParts:
    """Taichi functions for a law and what a scene has; lanes: whether tetrahedra lie in blocks of eight."""

    law: object
    features: Features
    lanes: bool

    fp, vector = number_type, vector_type

    @property
    def precision(self) -> str:
        return self.law.precision

    @cached_property
    def element(self):
        return functions_of(self.law, self.features, self.lanes)

    @property
    def reads_rates(self) -> bool:
        """Whether forces at corners are of velocities too."""
        return self.element.reads_rates or any(x.reads_rates for x in self.features.interactions)

    @property
    def counts_work(self) -> bool:
        """Whether work from outside is counted, for who follows the energy."""
        return self.features.driven

    @cached_property
    def obstacles(self) -> ObstacleStages:
        return ObstacleStages(self.features, self.precision)

    @cached_property
    def contact(self) -> ContactStage:
        return ContactStage(self.features, self.precision)

    @cached_property
    def given(self) -> AppliedForces:
        return AppliedForces(self.features, self.precision)

    @cached_property
    def sliding_supports(self) -> SlidingSupports:
        return SlidingSupports(self.precision, self.features.motion)


@dataclass(frozen=True)
class ItemForces:
    """Functions of item k of those after the tetrahedra, of one interaction after the other.

    blocks: whether fibres go eight at a time, where there are as many in a row.
    """

    features: Features
    blocks: bool = False

    @property
    def any(self) -> bool:
        return bool(self.parts)

    @cached_property
    def parts(self) -> tuple:
        return self.features.items if self.blocks else tuple(part.alone() for part in self.features.items)

    @traced
    def after(self, plan):
        """Number of items of tetrahedra and of these."""
        total = plan.num_items
        for part in self.parts:
            total = total + part.count(plan)
        return let(total) if self.any else total

    @traced
    def count(self, plan):
        """Number of these items."""
        total = None
        for part in self.parts:
            total = part.count(plan) if total is None else total + part.count(plan)
        return let(total)

    @traced
    def with_begins(self, plan) -> list:
        """(interaction, number of its first item, of the first after its own)"""
        out, begin = [], None
        for part in self.parts:
            end = part.count(plan) if begin is None else let(begin + part.count(plan))
            out.append((part, let(0 * end) if begin is None else begin, end))
            begin = end
        return out

    @property
    def arrays(self) -> dict:
        """What kernels read of the scene for all of that."""
        has, out = self.features, {}
        for part in has.in_kernels:
            out |= part.arrays | part.derived
        return out | (SLIDING_SUPPORTS if has.partly_fixed else {}) | (BODIES if has.reduced else {})

    @property
    def derived(self) -> dict:
        """Those of these that inputs change."""
        return {name: kind for part in self.features.in_kernels for name, kind in part.derived.items()}

    @property
    def tangent(self) -> dict:
        """Those of which there are changes."""
        return self.derived | ({name: BODIES[name] for name in OF_BODIES} if self.features.reduced else {})

    @property
    def adjoint(self) -> dict:
        """Where their adjoints are added."""
        out = {}
        for part in self.features.in_kernels:
            out |= part.adjoints
        return out | (dict(body_adjoints="doubles", body_sums="doubles") if self.features.reduced else {})

    @property
    def counts(self) -> dict:
        """The numbers that kernels take."""
        out = [name for part in self.parts for name in part.counts]
        out += ["num_bodies"] if self.features.reduced else []
        out += ["first_load"] if self.features.loaded_corners else []
        return dict.fromkeys([*out, *(["first_push"] if self.features.pulled else [])], "int")

    @ti.func
    def forces(self, k, now: A, scene: A, state: A, s, plan: A):
        for part, begin, end in ti.static(self.with_begins(plan)):
            if k >= begin and k < end:
                part.forces(k - begin, now, scene, state, s, plan)

    @ti.func
    def forces_jvp(self, k, now: A, scene: A, state: A, s, tangent: A, plan: A):
        for part, begin, end in ti.static(self.with_begins(plan)):
            if k >= begin and k < end:
                part.forces_jvp(k - begin, now, scene, state, s, tangent, plan)

    @ti.func
    def forces_vjp(self, k, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        for part, begin, end in ti.static(self.with_begins(plan)):
            if k >= begin and k < end:
                part.forces_vjp(k - begin, now, scene, state, s, adjoint, plan)
