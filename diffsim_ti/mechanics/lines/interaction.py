"""Springs, cables, muscles and elastic foundations, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs.lines import FoundationRows, JoinedRows
from diffsim_ti.inputs.links import Joined
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.lines.foundations import FoundationForce, FoundationOnHost
from diffsim_ti.mechanics.lines.line_force import LineForce
from diffsim_ti.mechanics.lines.on_host import LinesOnHost
from diffsim_ti.mesh.paths import Paths
from diffsim_ti.runtime import LANES
from diffsim_ti.state.corners import slots
from diffsim_ti.terms import Cable, ElasticFoundation, Spring


class SpringsAndCables(Interaction):
    """Each spring, cable or fibre of a muscle is an item; cables, which are loads, come last, and of these fibres.

    paths: where they run; of each whether it is a cable (cables), whether it pulls only (one_sided), whether with a tension
    that is given, however long it is (by_tension), and whether what is given changes within steps (keyed).
    """

    name, kinds, pulls = "lines", (Spring, Cable), True
    derived = LineForce.derived

    def __init__(self, scene, terms):
        super().__init__(scene, tuple(sorted(terms, key=lambda t: (isinstance(t, Cable), t.of_fibres))))
        self.paths = Paths.joined([term.paths(self.mesh) for term in self.terms])
        self.cables = self._of_each([isinstance(term, Cable) for term in self.terms])
        self.one_sided = self._of_each([term.one_sided for term in self.terms])
        self.by_tension = self._of_each([term.by_tension for term in self.terms])
        self.is_load = bool(self.cables.any())
        self.works = "muscles and cables" if self.is_load else ""
        self.keyed = self._of_each([getattr(term, "keyed", False) for term in self.terms])
        springs = int((~self.cables).sum())
        self.first_load = int(self.paths.first_corner[self.paths.first_point[springs]])
        self.vertices, self.count = self.paths.vertices, len(self.paths)

    def _of_each(self, of_terms: list) -> np.ndarray:
        """What each spring, cable or fibre has of its term."""
        return np.repeat(of_terms, [len(term.paths(self.mesh)) for term in self.terms])

    def places(self, number: int) -> slice:
        """Places of a term's own among them."""
        ends = np.cumsum([0, *(len(term.paths(self.mesh)) for term in self.terms)]).tolist()
        return slice(*ends[number : number + 2])

    def links(self, own):
        rows, segments = ([f"{own[t]} {part}" for t in self.terms] for part in ("rows", "segments"))
        return [JoinedRows(rows, "lines"), Joined(segments, "line_segments", (3,))]

    @cached_property
    def topology(self):
        paths = self.paths
        # 1: pulls only, 0: pushes too, -1: pulls as it is told, whose length is not asked for
        sides = np.where(self.by_tension, -1, self.one_sided)
        out = dict(line_start=paths.first_point, point_start=paths.first_corner, point_vertex=paths.vertices)
        return out | dict(point_weight=np.asarray(paths.weights, np.float64), line_sides=sides)

    @property
    def num_fibre_blocks(self) -> int:
        """Eights of fibres, the last line elements, where kernels may take them so."""
        fibres = sum(len(term.paths(self.mesh)) for term in self.terms if term.of_fibres)
        return (self.scene.law.lanes and runtime.runs_on_cpu()) * (fibres // LANES)

    @property
    def counts(self):
        return dict(num_fibre_blocks=self.num_fibre_blocks)

    def kernel(self, values, precision, shape):
        fibres = self.num_fibre_blocks > 0
        nodes = self.mesh.reference.num_nodes if fibres else 0
        return LineForce(precision, len(values.lines) > 1, self.is_load, fibres, nodes, shape and fibres)

    def host(self):
        return LinesOnHost(self)

    def adjoints(self, values, shape):
        return dict(line_adjoint=values.lines.shape[:2], line_rest=values.line_segments.shape[:1])

    def collect(self, found, out, shape):
        out.lines, out.line_segments = found["line_adjoint"], found["line_rest"]

    def pulls_steadily(self, values):
        """By tension and slack as each step begins and ends (inputs/lines.py)."""
        ends = values.lines.reshape(len(values.lines), -1, 2, 3)[..., :2]
        return bool((ends == ends[0, :, :, :1]).all())


class Foundations(Interaction):
    """They act vertex by vertex."""

    name, kinds, is_load = "foundation", (ElasticFoundation,), False
    derived = FoundationForce.derived

    def links(self, own):
        indices = [term.indices(self.mesh) for term in self.terms]
        return [FoundationRows([f"{own[t]} matrices" for t in self.terms], indices, "foundation")]

    @property
    def topology(self):
        return dict(foundation_slot=slots(self.acts_at, self.mesh.num_vertices))

    @cached_property
    def acts_at(self) -> np.ndarray:
        """Sorted vertices on a foundation."""
        return np.unique(np.concatenate([term.indices(self.mesh) for term in self.terms]))

    def kernel(self, values, precision, shape):
        return FoundationForce(precision)

    def host(self):
        return FoundationOnHost(self.acts_at)

    def adjoints(self, values, shape):
        return dict(foundation_adjoint=values.foundation.shape[:1])

    def collect(self, found, out, shape):
        out.foundation = found["foundation_adjoint"]
