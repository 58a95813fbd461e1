"""What Taichi functions of obstacles at a vertex share, in explicit passes and in the potential energy."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, traced
from diffsim_ti.state.features import Features
from diffsim_ti.state.turned import Turned

A = ti.template()  # an array or Bundle handed to a Taichi function


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

    @property
    def rows(self):
        return ti.types.matrix(3, 4, self.fp)

    @cached_property
    def turned(self) -> Turned:
        return Turned(self.precision)

    @traced
    def seen(self, g, rest, place):
        """X: a rest position relative to an obstacle at a place; of one that turns seven numbers (obstacle_force.py)."""
        return self.turned.seen(rest, place) if g.force.turns else rest - place

    @property
    def num_obstacles(self) -> int:
        return sum(group.count for group in self.features.groups)

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

    # ---- points within a face, whose corners are the rows of a matrix -----------------------------------------------------

    @ti.func
    def row_of(self, M, a):
        """Row a of a matrix of three."""
        out = self.vector(0)
        for m in ti.static(range(4)):
            out[m] = ti.select(a == 0, M[0, m], ti.select(a == 1, M[1, m], M[2, m]))
        return out

    @ti.func
    def mix(self, s, M):
        """Rows of a matrix of three, weighted."""
        out = self.vector(0)
        for m in ti.static(range(4)):
            out[m] = s[0] * M[0, m] + s[1] * M[1, m] + s[2] * M[2, m]
        return out

    @ti.func
    def dot3(self, a, b):
        """Of vectors whose fourth component says something else."""
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    @ti.func
    def turn(self, what: A, g: A, first, X, u, w, scene: A, more: A):
        """Change of (normal, distance) at a point that moves by w, of "jvp" for that of the obstacle's numbers too."""
        t = self.vector(0)
        if ti.static(what == "jvp"):
            t = g.force.outlook_jvp(scene.parameters, first, X, u, w, more.parameters)
        else:
            t = g.force.outlook_jvp(scene.parameters, first, X, u, w)
        return t

    @ti.func
    def corners_vjp(self, g: A, first, X, u, by, scene: A, adjoint: A, i):
        """Add to column i of the sums what adjoints `by` of (normal, distance) at three corners say of an obstacle."""
        for a in range(3):
            x, y, w = self.row_of(X, a), self.row_of(u, a), self.row_of(by, a)
            g.force.outlook_vjp(scene.parameters, first, x, y, w, adjoint.sums, i)
