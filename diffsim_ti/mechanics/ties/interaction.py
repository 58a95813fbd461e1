"""Springs, cables, muscles and elastic foundations, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.ties.foundations import FoundationForce, FoundationOnHost
from diffsim_ti.mechanics.ties.tie_force import TieForce
from diffsim_ti.mechanics.ties.ties import Ties
from diffsim_ti.runtime import LANES
from diffsim_ti.state.corners import slots
from diffsim_ti.terms import Cable, ElasticFoundation, Spring


class SpringsAndCables(Interaction):
    """Each spring, cable or fibre of a muscle is an item; cables, which are loads, come last."""

    name, kinds, pulls = "ties", (Spring, Cable), True

    def __init__(self, scene, terms):
        super().__init__(scene, scene.ties)
        self.paths = scene.tie_paths
        springs = sum(len(term.paths(self.mesh)) for term in scene.springs)
        self.first_load = int(self.paths.first_corner[self.paths.first_point[springs]])
        self.vertices, self.count = self.paths.vertices, len(self.paths)

    @cached_property
    def topology(self):
        paths, scene = self.paths, self.scene
        # 1: pulls only, 0: pushes too, -1: pulls as it is told, whose length nobody asks for
        sides = np.where(scene.given_tensions, -1, scene.one_sided_ties)
        out = dict(tie_start=paths.first_point, point_start=paths.first_corner, point_vertex=paths.vertices)
        return out | dict(point_weight=np.asarray(paths.weights, np.float64), tie_sides=sides)

    @property
    def num_fibre_blocks(self) -> int:
        """Eights of fibres, the last ties, where kernels may take them so."""
        return (self.scene.law.lanes and runtime.runs_on_cpu()) * (self.scene.num_fibres // LANES)

    @property
    def counts(self):
        return dict(num_fibre_blocks=self.num_fibre_blocks)

    def kernel(self, values, precision, shape):
        fibres = self.num_fibre_blocks > 0
        nodes = self.mesh.reference.num_nodes if fibres else 0
        return TieForce(precision, len(values.ties) > 1, bool(self.scene.cables), fibres, nodes, shape and fibres)

    def host(self):
        return Ties(self.scene)

    def adjoints(self, values, shape):
        return dict(tie_felt=values.ties.shape[:2], tie_rest=values.tie_segments.shape[:1])

    def collect(self, found, out, shape):
        out.ties, out.tie_segments = found["tie_felt"], found["tie_rest"]


class Foundations(Interaction):
    """They act vertex by vertex."""

    name, kinds = "foundation", (ElasticFoundation,)

    @property
    def topology(self):
        return dict(foundation_slot=slots(self.acts_at, self.mesh.num_vertices))

    @cached_property
    def acts_at(self) -> np.ndarray:
        """Sorted vertices on a foundation."""
        return self.scene.founded_vertices

    def kernel(self, values, precision, shape):
        return FoundationForce(precision)

    def host(self):
        return FoundationOnHost(self.acts_at)

    def adjoints(self, values, shape):
        return dict(foundation_felt=values.foundation.shape[:1])

    def collect(self, found, out, shape):
        out.foundation = found["foundation_felt"]
