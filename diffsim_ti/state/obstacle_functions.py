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

    # An obstacle with a stiffness per area pushes vertex i with that times the vertex's area: energy, forces and friction
    # are linear in it. What kernels of a shape compute is that of one square metre.

    @ti.func
    def on_area(self, g: ti.template(), i, x, scene: ti.template()):
        """x, something that grows with the stiffness, on the area of vertex i."""
        out = x
        if ti.static(g.force.per_area):
            out = scene.surface[i] * x
        return out

    @ti.func
    def add_to_area(self, g: ti.template(), i, by_area, adjoint: ti.template()):
        """Add the adjoint of the area of vertex i."""
        if ti.static(g.force.per_area and self.features.shape):
            row = ti.static(self.features.sums().first("surface"))
            adjoint.sums[row, i] = adjoint.sums[row, i] + by_area

    @ti.func
    def add_to_rest(self, i, by_X, adjoint: ti.template()):
        """Add the adjoint of a vertex's rest position."""
        row = ti.static(self.features.sums().first("rest"))
        if ti.static(self.features.shape):
            for d in ti.static(range(3)):
                adjoint.sums[row + d, i] = adjoint.sums[row + d, i] + by_X[d]
