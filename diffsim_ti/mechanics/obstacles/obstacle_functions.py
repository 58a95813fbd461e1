"""What Taichi functions of obstacles at a vertex share, in explicit passes and in the potential energy."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.mechanics.obstacles.turned import Turned
from diffsim_ti.mesh.curved_triangles import EDGES
from diffsim_ti.runtime import PRECISIONS, at, let, traced
from diffsim_ti.state.features import Features
from diffsim_ti.terms.obstacles import barrier

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
        return ti.types.matrix(self.nodes, 4, self.fp)

    @property
    def nodes(self) -> int:
        """Vertices on which a face's points depend: its corners, or all six of a curved one (mesh/curved_triangles.py)."""
        return 6 if self.features.curved else 3

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
            of_corners = g.force.force_by_corners_vjp(scene.parameters, first, X, u, w)
            self.add_to_corners(g, 0, i, of_corners, adjoint)
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

    # ---- points within a face, whose nodes are the rows of a matrix, its corners the first three ------------------------

    @ti.func
    def row_of(self, M, a):
        """Row a of such a matrix."""
        out = self.vector(0)
        for m in ti.static(range(4)):
            out[m] = ti.select(a == 0, M[0, m], ti.select(a == 1, M[1, m], M[2, m]))
            for b in ti.static(range(3, self.nodes)):
                out[m] = ti.select(a == b, M[b, m], out[m])
        return out

    @ti.func
    def mix(self, s, M):
        """Rows of such a matrix, weighted."""
        out = self.vector(0)
        for m in ti.static(range(4)):
            out[m] = s[0] * M[0, m] + s[1] * M[1, m] + s[2] * M[2, m]
            for b in ti.static(range(3, self.nodes)):
                out[m] += s[b] * M[b, m]
        return out

    @traced
    def node_weights(self, s, inner):
        """Weights of the nodes at the point of a face whose corners have the shares s; inner: whether it is the triangle
        between the others of a curved face."""
        return self.curved_weights(s, inner) if self.features.curved else s

    @ti.func
    def curved_weights(self, s, inner):
        half, a, b, c = ti.cast(0.5, self.fp), s[1] * s[2], s[2] * s[0], s[0] * s[1]
        own = ti.Vector([s[0] - half * (b + c), s[1] + c, s[2] + b, a])
        if inner:
            own = ti.Vector([s[0] + a, s[1] + b, s[2] + c, 0 - half * (b + c)])
        return ti.Vector([own[0], own[1], own[2], 0 - half * (c + a), own[3], 0 - half * (a + b)])

    @traced
    def arch(self, M, inner):
        """How far a curved triangle's points lie from those of its corners at most, of rows M; of flat ones nothing."""
        return self.curved_arch(M, inner) if self.features.curved else ti.cast(0, self.fp)

    @traced
    def curved_arch(self, M, inner):
        lengths = []
        for corner, within in zip(*EDGES):
            bow = []
            for m in range(3):
                p, y, q = (ti.select(inner, at(M, b, m), at(M, a, m)) for a, b in zip(corner, within))
                bow.append(let(y - ti.cast(0.5, self.fp) * (p + q)))
            lengths.append(let(sum_of(x * x for x in bow)))
        return let(ti.cast(1 / 3, self.fp) * ti.sqrt(ti.max(*lengths)))

    # distances change by no more than the way: where a point of a lattice is far away, the next ones are not looked at

    @ti.func
    def step_of_lattice(self, X, u, per, inner):
        """How far two neighbours in a row of a triangle's lattice lie apart at most [m]."""
        edge = ti.cast(0, self.fp)
        for m in ti.static(range(3)):
            e = per * ((X[2, m] - X[0, m]) + (u[2, m] - u[0, m]))
            edge += e * e
        length = ti.sqrt(edge)
        if ti.static(self.features.curved):
            length += 6 * per * self.arch(X + u, inner)
        return ti.max(ti.cast(1.01, self.fp) * length, ti.cast(1e-30, self.fp))

    @ti.func
    def passed(self, g: A, d, felt, step, parts):
        """(how many of the next points are farther away than `felt`, d or less than it) for a point at distance d."""
        far = d
        if ti.static(g.force.grain > 0):  # splines are steeper than distances, and end with their grid
            inside = d < ti.cast(1e6 * g.force.grain, self.fp)
            far = ti.select(inside, ti.cast(0.8, self.fp) * d, felt)
        ahead = ti.min((far - felt) / step, ti.cast(parts, self.fp))
        return ti.cast(ti.max(ahead, ti.cast(0, self.fp)), ti.i32), far

    @ti.func
    def dot3(self, a, b):
        """Of vectors whose fourth component says something else."""
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    @ti.func
    def turn(self, what: A, g: A, first, X, u, w, scene: A, more: A):
        """Change of (normal, distance) at a point that moves by w, of "jvp" for that of the obstacle's numbers too."""
        t = self.vector(0)
        if ti.static(what == "jvp"):
            t = g.force.contact_plane_jvp(scene.parameters, first, X, u, w, more.parameters)
        else:
            t = g.force.contact_plane_jvp(scene.parameters, first, X, u, w)
        return t

    # What corners say is their distance, to which that of a point is compared: (normal, distance). Before hollow obstacles,
    # which only curved faces feel within, it is their barrier (curved_faces.py): its gradient, and w beta(d / w).

    @traced
    def besides(self, g, of_corners, of_point):
        """What the corners say, less what the point does."""
        return of_corners if g.force.hollow else of_corners - of_point

    @ti.func
    def corner(self, g: A, first, X, u, scene: A):
        said = g.force.contact_plane(scene.parameters, first, X, u)
        if ti.static(g.force.hollow):
            width = g.force.width(scene.parameters, first)
            s = said[3] / width
            said = barrier.slope(s, self.fp) * said
            said[3] = width * barrier.value(s, self.fp)
        return said

    @ti.func
    def corner_turn(self, what: A, g: A, first, X, u, w, scene: A, more: A):
        """Its change, as of `turn`."""
        t = self.turn(what, g, first, X, u, w, scene, more)
        if ti.static(g.force.hollow):
            seen, width = g.force.contact_plane(scene.parameters, first, X, u), g.force.width(scene.parameters, first)
            s, dwidth = seen[3] / width, ti.cast(0, self.fp)
            if ti.static(what == "jvp"):
                dwidth = more.parameters[first + g.force.index.width]
            slope, ds = barrier.slope(s, self.fp), (t[3] - s * dwidth) / width
            of_distance = slope * t[3] + (barrier.value(s, self.fp) - s * slope) * dwidth
            t = barrier.curvature(s, self.fp) * ds * seen + slope * t
            t[3] = of_distance
        return t

    @ti.func
    def corners_vjp(self, g: A, first, X, u, by, scene: A, adjoint: A, i):
        """Add to column i of the sums what adjoints `by` of what its corners say have for an obstacle."""
        for a in range(3):
            x, y, w = self.row_of(X, a), self.row_of(u, a), self.row_of(by, a)
            if ti.static(g.force.hollow):
                seen, width = (
                    g.force.contact_plane(scene.parameters, first, x, y),
                    g.force.width(scene.parameters, first),
                )
                s, at_w = seen[3] / width, first + g.force.index.width
                slope, of_value = barrier.slope(s, self.fp), w[3]
                by_s = barrier.curvature(s, self.fp) * self.dot3(seen, w) / width
                more = (barrier.value(s, self.fp) - s * slope) * of_value - s * by_s
                adjoint.sums[at_w, i] = adjoint.sums[at_w, i] + more
                w = slope * w
                w[3] = by_s + slope * of_value
            g.force.contact_plane_vjp(scene.parameters, first, x, y, w, adjoint.sums, i)
