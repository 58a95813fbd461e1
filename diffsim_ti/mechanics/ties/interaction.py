"""Springs, cables, muscles and elastic foundations, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.inputs.foundation import FoundationRows
from diffsim_ti.inputs.ties import JoinedRows, JoinedSegments, directions
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.ties.foundations import FoundationForce
from diffsim_ti.mechanics.ties.tie_force import TieForce
from diffsim_ti.mechanics.ties.ties import Ties
from diffsim_ti.mesh.paths import Paths
from diffsim_ti.runtime import LANES
from diffsim_ti.state.corners import slots
from diffsim_ti.terms import Cable, ElasticFoundation, Spring


class SpringsAndCables(Interaction):
    """Each spring, cable or fibre of a muscle is an item; cables, which are loads, come last, and of these fibres.

    paths: where they run; cables, one_sided, by_tension: of each whether it is one, whether it pulls only, and whether with
    a tension that is given, however long it is.
    """

    name, kinds, pulls, least = "ties", (Spring, Cable), True, ("cable_length",)
    derived = TieForce.derived

    def __init__(self, scene, terms):
        super().__init__(scene, tuple(sorted(terms, key=lambda t: (isinstance(t, Cable), t.of_fibres))))
        self.paths = Paths.joined([term.paths(self.mesh) for term in self.terms])
        self.cables = self._of_each([isinstance(term, Cable) for term in self.terms])
        self.one_sided = self._of_each([term.one_sided for term in self.terms])
        self.by_tension = self._of_each([term.by_tension for term in self.terms])
        self.is_load = bool(self.cables.any())
        self.works = "muscles and cables" if self.is_load else ""
        springs = int((~self.cables).sum())
        self.first_load = int(self.paths.first_corner[self.paths.first_point[springs]])
        self.vertices, self.count = self.paths.vertices, len(self.paths)

    def _of_each(self, of_terms: list) -> np.ndarray:
        """What each spring, cable or fibre has of its term."""
        return np.repeat(of_terms, [len(term.paths(self.mesh)) for term in self.terms])

    def places(self, tie) -> slice:
        """Places of a term's own, given by its name or as the scene lists it."""
        own = np.flatnonzero(
            self._of_each(np.arange(len(self.terms))) == self.scene.place_among(self.terms, tie, "spring or cable")
        )
        return slice(int(own[0]), int(own[-1]) + 1)

    def links(self, own):
        rows, segments = ([f"{own[t]} {part}" for t in self.terms] for part in ("rows", "segments"))
        return [JoinedRows(rows, "ties"), JoinedSegments(segments, "tie_segments")]

    @cached_property
    def topology(self):
        paths = self.paths
        # 1: pulls only, 0: pushes too, -1: pulls as it is told, whose length nobody asks for
        sides = np.where(self.by_tension, -1, self.one_sided)
        out = dict(tie_start=paths.first_point, point_start=paths.first_corner, point_vertex=paths.vertices)
        return out | dict(point_weight=np.asarray(paths.weights, np.float64), tie_sides=sides)

    @cached_property
    def on_host(self) -> Ties:
        """In float64, with numbers of their own."""
        return Ties(self.paths, self.one_sided, self.cables, self.mesh.num_vertices)

    @property
    def num_fibre_blocks(self) -> int:
        """Eights of fibres, the last ties, where kernels may take them so."""
        fibres = int(self._of_each([term.of_fibres for term in self.terms]).sum())
        return (self.scene.law.lanes and runtime.runs_on_cpu()) * (fibres // LANES)

    @property
    def counts(self):
        return dict(num_fibre_blocks=self.num_fibre_blocks)

    def kernel(self, values, precision, shape):
        fibres = self.num_fibre_blocks > 0
        nodes = self.mesh.reference.num_nodes if fibres else 0
        return TieForce(precision, len(values.ties) > 1, self.is_load, fibres, nodes, shape and fibres)

    def adjoints(self, values, shape):
        return dict(tie_felt=values.ties.shape[:2], tie_rest=values.tie_segments.shape[:1])

    def collect(self, found, out, shape):
        out.ties, out.tie_segments = found["tie_felt"], found["tie_rest"]

    @property
    def stiff_over_time(self):
        return tuple(term for term in self.terms if isinstance(term, Cable))

    def stiffest(self, derived: Derived, rows: np.ndarray) -> Ties:
        """With the largest tension and stiffness of each in `rows` and its least length: what a step has to follow."""
        ends = rows.reshape(len(rows), -1, 2, 3)
        a, s = ends[:, :, 0, :2].max((0, 2)), ends[:, :, 1, :2].max((0, 2))
        return self.on_host.at(derived.tie_segments, a, s, ends[:, :, 0, 2].max(0))

    def added_omega2(self, values, derived):
        rows = self.stiffest(derived, derived.ties).row_sums(derived.displacement)
        return rows / np.where(derived.mass > 0, derived.mass, 1.0)

    def resists(self, derived):
        """Springs and elastic cables that are not slack as a run begins, or whose length is given over time."""
        paths, numbers = self.paths, derived.ties[0].reshape(-1, 2, 3)
        size = np.abs(self.mesh.vertices - self.mesh.vertices.mean(0)).max()
        slack = self.one_sided & (numbers[:, 1, :2].max(1) < -1e-9 * size)
        keyed = self._of_each([getattr(term, "keyed", False) for term in self.terms])
        holds = (numbers[:, 0, 2] > 0) & ~self.by_tension & (keyed | ~slack)
        C = self.on_host.parted.tocoo()
        along, path = directions(derived.tie_segments)[paths.starts], paths.path_of
        bare, out = ~along.any(1), []  # a spring without length holds in all directions
        for k, axis in enumerate((None, *np.eye(3))):
            own = holds[path[C.row]] & (bare[C.row] == (axis is not None))
            row, vertex = C.row[own], C.col[own]
            out.append((k * len(paths) + path[row], vertex, C.data[own, None] * (along[row] if axis is None else axis)))
        return tuple(np.concatenate(parts) for parts in zip(*out))


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

    def adjoints(self, values, shape):
        return dict(foundation_felt=values.foundation.shape[:1])

    def collect(self, found, out, shape):
        out.foundation = found["foundation_felt"]

    def added_omega2(self, values, derived):
        out = np.zeros(self.mesh.num_vertices)
        out[self.acts_at] = np.abs(derived.foundation.reshape(-1, 3, 3)).sum(2).max(1)
        return out / np.where(derived.mass > 0, derived.mass, 1.0)

    def resists(self, derived):
        values, vectors = np.linalg.eigh(derived.foundation.reshape(-1, 3, 3))
        kept = (values > 1e-9 * values.max(initial=0.0))[:, None] * vectors
        held = (kept @ np.swapaxes(kept, 1, 2)).reshape(-1, 3)
        return np.arange(len(held)), np.repeat(self.acts_at, 3), held
