"""What contact did in a recorded pass."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np

from diffsim_ti.mechanics.surfaces.contact_parts import NearPairs, Part, PartSolver


@dataclass
class ContactPass:
    """What was done in a recorded pass: to which nodes, from where, and the state that the drift had led to."""

    near: NearPairs
    numbers: np.ndarray  # of the pairs in the list
    nodes: np.ndarray  # places among those of the stage
    points: np.ndarray  # vertices of the surface
    pairs: np.ndarray  # corners, which are such vertices, (pairs, 4)
    rest: tuple  # of pairs: plane and weights at rest, which coefficient of friction
    start: np.ndarray  # of all nodes, where there are sets
    u: np.ndarray | None = None
    v: np.ndarray | None = None
    parts: list[Part] = field(default_factory=list)
    e: np.ndarray | None = None  # what displacements and velocities gained
    b: np.ndarray | None = None

    @property
    def solver(self) -> PartSolver:
        return PartSolver(self.near)

    def of(self, chosen: np.ndarray, start, u, v, parts: list[Part], e: np.ndarray, b: np.ndarray) -> "ContactPass":
        """What was done to some of the pairs, those that came near, in a pass between these states of all nodes; e, b:
        what it gained. Of sets it has the vertices of these pairs alone: bits do not depend on what else was near."""
        near = replace(self.near, **{x: getattr(self.near, x)[chosen] for x in ("corners", "edges", "scale")})
        plane, weights, own = self.rest
        own = SimpleNamespace(**{name: x[chosen] for name, x in vars(own).items()})
        nodes, rest = self.nodes, (plane[chosen], weights[chosen], own)
        if near.sets:
            near, kept = near.of_own_nodes()
            nodes, e, b = nodes[kept[kept < len(nodes)]], e[kept], b[kept]
            parts = [replace(part, e=part.e[kept], b=part.b[kept]) for part in parts]
        start = start if near.sets else start[nodes]
        given = near, self.numbers[chosen], nodes, self.points, self.pairs[chosen], rest, start
        return ContactPass(*given, u, v, parts, e, b)

    def vectors(self, x: np.ndarray) -> np.ndarray:
        """Those of its nodes, from vectors of all nodes, and zeros of what stands for numbers of sets."""
        return np.concatenate([x[self.nodes], np.zeros((sum(len(y.at) - len(y.here) for y in self.near.sets), 3))])
