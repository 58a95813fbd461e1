"""What a pass at a vertex is made of: elements, obstacles, given forces, supports."""

from dataclasses import dataclass
from functools import cached_property

from diffsim_ti.mechanics.loads.explicit import AppliedForces
from diffsim_ti.mechanics.obstacles.contact_stage import ContactStage
from diffsim_ti.mechanics.obstacles.obstacle_stages import ObstacleStages
from diffsim_ti.mechanics.stress.patched_tetrahedron import functions_of
from diffsim_ti.mechanics.supports.sliding_supports import SlidingSupports
from diffsim_ti.runtime import number_type, vector_type
from diffsim_ti.state.features import Features


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
