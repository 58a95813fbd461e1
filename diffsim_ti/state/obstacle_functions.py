"""What Taichi functions of obstacles at a vertex share, in explicit passes and in the potential energy."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import PRECISIONS
from diffsim_ti.state.features import Features


@dataclass(frozen=True)
class ObstacleFunctions:
    """Functions of one vertex; in them g is a group of obstacles and k a place in it (state/features.py)."""

    features: Features
    precision: str

    @property
    def fp(self):
        return PRECISIONS[self.precision]

    @property
    def vector(self):
        return ti.types.vector(4, self.fp)

    @ti.func
    def add_to_rest(self, i, by_X, adjoint: ti.template()):
        """Add the adjoint of a vertex's rest position."""
        row = ti.static(self.features.sums().first("rest"))
        if ti.static(self.features.shape):
            for d in ti.static(range(3)):
                adjoint.sums[row + d, i] = adjoint.sums[row + d, i] + by_X[d]
