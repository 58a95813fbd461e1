"""What Taichi functions of obstacles at a vertex share, in explicit passes and in the potential energy."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.obstacles.turned import Turned
from diffsim_ti.runtime import A, number_type, traced, vector_type
from diffsim_ti.state.features import Features
from diffsim_ti.state.obstacle_poses import MORE


@dataclass(frozen=True)
class ObstacleFunctions:
    """Functions of one vertex; in them g is a group of obstacles and k a place in it (state/features.py)."""

    features: Features
    precision: str

    fp, vector = number_type, vector_type

    @cached_property
    def turned(self) -> Turned:
        return Turned(self.precision)

    @traced
    def seen(self, g, rest, place):
        """X: a rest position relative to an obstacle at a place; of one that turns seven numbers (obstacle_force.py)."""
        return self.turned.seen(rest, place) if g.force.turns else rest - place

    @ti.func
    def normal(self, plane):
        """n of (n, d)."""
        return self.vector(plane.x, plane.y, plane.z, ti.cast(0, self.fp))

    @property
    def num_obstacles(self) -> int:
        return sum(group.count for group in self.features.groups)

    @traced
    def turning_row(self, g, k):
        """Where the rows of an obstacle that turns begin."""
        return 3 * self.num_obstacles + MORE * (g.turning + k)

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

    # ---- the force of a barrier on vertex i, whatever says where obstacles are; X: as `seen` has it ---------------------

    @ti.func
    def force(self, g: A, k, i, X, u, v, scene: A):
        return self.on_area(g, i, g.force.force(scene.parameters, g.first + k * g.size, X, u, v), scene)

    @ti.func
    def force_jvp(self, g: A, k, i, X, u, v, moved, dv, scene: A, tangent: A):
        """Its change; moved: that of the place as the obstacle sees it."""
        first = g.first + k * g.size
        df = g.force.force_jvp(scene.parameters, first, X, u, v, moved, dv)
        by = g.force.parameter_derivatives(scene.parameters, first, X, u, v)
        for m in ti.static(range(g.size)):
            df += by[m] * tangent.parameters[first + m]
        if ti.static(g.force.corners):
            df += g.force.force_by_corners(scene.parameters, first, X, u, tangent.parameters)
        df = self.on_area(g, i, df, scene)
        if ti.static(g.force.per_area):
            df += tangent.surface[i] * g.force.force(scene.parameters, first, X, u, v)
        return df

    @ti.func
    def force_vjp(self, g: A, k, i, X, u, v, w, scene: A, adjoint: A):
        """(adjoints of the place as the obstacle sees it, of v) for the adjoint w; adds those of numbers and area."""
        first = g.first + k * g.size
        if ti.static(g.force.per_area and self.features.shape):
            self.add_to_area(g, i, g.force.force(scene.parameters, first, X, u, v).dot(w), adjoint)
        w = self.on_area(g, i, w, scene)
        by = g.force.parameter_derivatives(scene.parameters, first, X, u, v)
        for m in ti.static(range(g.size)):
            adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by[m].dot(w)
        if ti.static(g.force.corners):
            g.force.add_by_corners(scene.parameters, first, X, u, w, adjoint.sums, i)
        by_place, by_v = g.force.force_vjp(scene.parameters, first, X, u, v, w)
        return by_place, by_v

    @ti.func
    def add_to_numbers(self, g: A, k, i, by: A, adjoint: A):
        """Add the adjoints of an obstacle's numbers."""
        for m in ti.static(range(g.size)):
            row = g.first + k * g.size + m
            adjoint.sums[row, i] = adjoint.sums[row, i] + by[m]
        self.add_to_corners(g, g.size, i, by, adjoint)

    @ti.func
    def add_to_corners(self, g: A, begin: A, i, by: A, adjoint: A):
        """Add those of its corners, which stand in `by` from `begin` on, and behind them their rows."""
        for c in ti.static(range(g.force.corners)):
            for d in ti.static(range(3)):
                row = by[begin + 3 * g.force.corners + c] + d
                adjoint.sums[row, i] = adjoint.sums[row, i] + by[begin + 3 * c + d]
