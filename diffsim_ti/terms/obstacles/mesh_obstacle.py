"""Triangles, segments and points as an obstacle, by the exact distance to what is nearest of them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.origin import OF_WIDTHS, middle_far_part, rounding_of
from diffsim_ti.common.warn import warn
from diffsim_ti.differentiation.arrays import cross
from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.inputs.description import length
from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.runtime import A, assign, at, let, traced, variable
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.obstacle import BOW, Obstacle, ObstacleForce, ObstacleOptions, longest_edge
from diffsim_ti.terms.obstacles.primitives import Primitives
from diffsim_ti.terms.obstacles.surface_distance import ENERGY, FORCE, JVP, VJP, SurfaceDistance
from diffsim_ti.terms.obstacles.surface_mesh import SurfaceMesh
from diffsim_ti.terms.obstacles.surface_tree import SurfaceTree
from diffsim_ti.terms.obstacles.turning import rotation_matrix
from diffsim_ti.terms.pose import brought_back
from diffsim_ti.terms.term import place

FEW = 256  # edges and points that act by pairs, from which on a run has those near bodies alone


class MeshObstacle(Obstacle):
    """All that is within `radius` [m] of triangles, segments and points, by the exact distance to what is nearest of them.

    vertices [m], shape (k, 3); triangles, shape (t, 3), segments, shape (s, 2), points, shape (p,), any of them, name
    vertices by index; where none is given all vertices are points. position [m]: where the vertices' origin lies.
    Parts whose triangles are closed, each edge passed once each way, have an inside, which their normals point out of: they
    push out what got into them, and no body may start there; triangles that face inwards bound a room. All
    other triangles, segments and points act on both sides alike. Vertices of bodies find what is nearest in a tree
    of boxes, so that triangles that are far away cost next to nothing. Segments, points, and edges and corners that are
    sharp for the body's faces also act on edges and faces of bodies, by pairs, unless by_pairs is False.
    shapeable: whether vertices are an input; in gradients each vertex of the body then has 3 k numbers of its own.
    `resolution` has no meaning, for nothing is sampled.

    Inputs with gradient: "mesh_position", shape (3,), "mesh_radius", "mesh_vertices", shape (k, 3), if it is shapeable, and
    those of every `Obstacle`, whose other arguments it takes. Implicit steps sum the barrier over all that is nearer than
    its width, what triangles share once: in a crease, where two faces are equally near, both press, and force and energy
    have no kink. Over flat parts, and convex ones that are thicker than the width and have no edges sharper than 90 degrees,
    it is the barrier of the distance; of thinner ones the far side presses, too. Friction is that of each part by its own
    normal force, so that a body which two sides of a groove with an angle 2 a between them hold slides along it against
    mu N / sin(a). In explicit steps what is nearest acts alone: in a crease the sides press in turn, and friction is
    mu N / sin(a) as a mean over steps; sides that are obstacles of their own press together. Gaps go by what is nearest, and
    the energy of contact that explicit runs report counts all parts. Where what is nearest goes from a face to an edge or a
    corner the contact's stiffness jumps.
    Raises ValueError for vertices or indices that do not fit.
    Li, Kaufman, Jiang 2023, Convergent Incremental Potential Contact, arXiv:2307.15908.
    Baerentzen, Aanaes 2005, Signed distance computation using the angle weighted pseudonormal, doi:10.1109/TVCG.2005.49.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        triangles: ArrayLike | None = None,
        position: ArrayLike = (0.0, 0.0, 0.0),
        resolution: int | None = None,
        *,
        segments: ArrayLike | None = None,
        points: ArrayLike | None = None,
        radius: float = 0.0,
        shapeable: bool = False,
        **options: Unpack[ObstacleOptions],
    ):
        if resolution is not None:
            warn(
                "MeshObstacle: resolution has no meaning, for distances are exact; it goes with the next version",
                DeprecationWarning,
            )
        thick = Input("radius", radius, ((),), "m", NOT_NEGATIVE, plain="mesh_radius")
        self._made = SurfaceMesh.checked("MeshObstacle", vertices, triangles, segments, points)
        self._base = middle_far_part(self._made.vertices)
        self._tree = SurfaceTree(self._made, self._base)
        super().__init__([place("position", position, "mesh_position"), thick], **options)
        self.by_pairs, self.shapeable = self.by_pairs is not False, bool(shapeable)
        if self.shapeable:  # behind all other numbers, as kernels read few of them at a time
            shape = Input("vertices", vertices, (self._made.vertices.shape,), "m", change=length, plain="mesh_vertices")
            self.described = (*self.described, shape)
        self._rounding = rounding_of(vertices)
        if "barrier_width" not in self.left_to_scene:
            self._check_rounding()

    def _check_rounding(self) -> None:
        if self._rounding > OF_WIDTHS * self.values["barrier_width"]:
            coarse = f"float32 resolves vertices to {self._rounding:.2g} m, too little for the barrier's width"
            warn(f"MeshObstacle: {coarse}: give them in float64")

    @cached_property
    def table(self):
        """The tree, as kernels read it (surface_tree.py)."""
        return self._tree.table()

    def table_at(self, numbers):
        """Of moved vertices, with the edges and sides that there are."""
        if not self.shapeable:
            return self.table
        moved = numbers[-self._tree.x.size :].reshape(-1, 3)
        return self.table if np.array_equal(moved, self._tree.x) else self._tree.moved(moved).table()

    def distance(self, positions):
        from_base = positions - (self._base + self.values["mesh_position"])
        return self._tree.distance(from_base) - self.values["mesh_radius"]

    def shift(self, origin):
        """The tree is measured from `_base`, which the position has more."""
        out = super().shift(origin)
        out[:3] -= self._base
        if self.shapeable:
            out[-self._tree.x.size :] = np.tile(self._base, len(self._tree.x))
        return out

    def surface(self, size):
        points, triangles = shapes.skeleton(self._made, max(float(self.values["mesh_radius"]), 0.002 * size))
        return points + self.values["mesh_position"], triangles

    def settled(self, scene, density, initial_positions, initial_velocities):
        out = super().settled(scene, density, initial_positions, initial_velocities)
        if "barrier_width" in self.left_to_scene:
            out._check_rounding()
        out._edges_of_bodies, _ = edges_of(scene.mesh.surface_triangles)
        return out

    def check_start(self, positions, surface, offset=(0.0, 0.0, 0.0)):
        super().check_start(positions, surface, offset)
        made = brought_back(np.asarray(positions, np.float64), np.asarray(offset), self.about)
        ways = (made - (self._base + self.values["mesh_position"]))[self._edges_of_bodies]
        through = self._tree.first_through(ways)
        if through is not None:
            i, j = self._edges_of_bodies[through]
            raise ValueError(
                f"the body starts with a triangle of {self!r} in it, between its vertices {i} and {j}; move the body or "
                "the obstacle"
            )

    def _refuse(self, gap, surface):
        try:
            super()._refuse(gap, surface)
        except ValueError as error:
            x, t = self._made.vertices - self._base, self._made.triangles[self._made.is_sided]
            if np.einsum("ij,ij->", x[t[:, 0]], cross(x[t[:, 1]], x[t[:, 2]])) < 0:
                raise ValueError(
                    f"{error}; its triangles face inwards, so that it is a room: turn them round, triangles[:, ::-1], for a "
                    "solid"
                ) from None
            raise

    def primitives_for(self, mesh, width):
        """Those of its edges and corners that faces of the body are wide enough to meet between their own corners."""
        edges = self._made.sharp_edges(longest_edge(mesh), BOW * width)
        points = np.union1d(edges, self._made.one[self._made.points])
        return MeshPrimitives.of(points, edges, self._tree.x) if len(points) else None

    def kernel(self, precision, table=0):
        if precision == "f32" and table + self.table.size > 2**24:
            raise ValueError(
                f"MeshObstacle: float32 cannot count the {table + self.table.size} numbers of a surface of "
                f"{self._tree.count} triangles, segments and points: pass precision='f64', or fewer"
            )
        return MeshForce(precision, self.has_friction, table, self._tree.is_sided, self.shapeable)

    @property
    def num_extra(self):
        return self._tree.x.size if self.shapeable else 0


@dataclass(frozen=True, eq=False)
class MeshPrimitives(Primitives):
    """Of a mesh: some of its vertices, whose numbers are `own`, at the position that the numbers begin with, and edges
    between these; then its radius, and all vertices where inputs move them. vertices [m]: where none does."""

    own: np.ndarray
    vertices: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, edges: np.ndarray, vertices: np.ndarray) -> "MeshPrimitives":
        own = np.union1d(edges, points)
        return cls(np.searchsorted(own, points), np.searchsorted(own, edges), own, vertices[own])

    @property
    def many(self):
        return len(self.points) + len(self.edges) > FEW

    def of_some(self, points: np.ndarray, edges: np.ndarray) -> "MeshPrimitives":
        """These points and edges alone, by their places among all."""
        out = self.of(self.points[points], self.edges[edges], self.vertices)
        return replace(out, own=self.own[out.own])

    def at(self, p):
        vertices = p[4:].reshape(-1, 3)[self.own] if len(p) > 4 else self.vertices
        return vertices + p[:3], p[3]


@dataclass(frozen=True)
class MeshForce(ObstacleForce):
    """d and its derivatives by the tree that starts at `table` in the parameters; sided: whether parts have an inside."""

    table: int = 0
    sided: bool = False
    shapeable: bool = False

    count = 4

    @property
    def corners(self):
        return 3 if self.shapeable else 0

    @cached_property
    def nearest(self) -> SurfaceDistance:
        return SurfaceDistance(self.precision, self.table, self.sided)

    @traced
    def distance_and_normal(self, g, p, X, u, seen=None):
        """seen: of what of the surface, as `SurfaceDistance.seen` has it; without, of what is nearest."""
        local = [(x - c) + y for x, c, y in zip(X, p, u)]
        if seen is None:
            point = let(ti.types.vector(3, self.fp)(*(k.value for k in local)))
            seen = self.nearest.look(point, self.begin(g.parameters, g.first), g.parameters)
        found, rows, s, t, *bent = (let(x) for x in seen)
        n = [at(found, 1 + k) for k in range(3)]
        H = [[at(found, 4 + k) for k in row] for row in ((0, 1, 2), (1, 3, 4), (2, 4, 5))]
        by_d = [(x, lambda k=k: n[k]) for k, x in enumerate(local)]
        by_n = [[(x, lambda a=a, b=b: H[a][b]) for b, x in enumerate(local)] for a in range(3)]
        for c in range(self.corners):
            share = (let(1 - s - t), s, t)[c]
            for e in range(3):
                leaf = g.leaf(at(g.parameters, let(at(rows, c) + e)))
                leaf.row = let(at(rows, c) + e)
                g.corners.append(leaf)
                turns = [let(at(bent[c - 1], a)) if c else let(-at(bent[0], a) - at(bent[1], a)) for a in range(3)]
                by_d.append((leaf, lambda e=e, share=share: let(-share * n[e])))
                for a in range(3):
                    of_n = lambda a=a, e=e, share=share, turn=turns[a]: let(-share * H[a][e] - turn * n[e])  # noqa: E731
                    by_n[a].append((leaf, of_n))
        d = g.function(at(found, 0), *by_d)
        return d - p[3], [g.function(n[a], *by_n[a]) for a in range(3)]

    @ti.func
    def may_touch(self, parameters: ti.template(), first, X, u):
        return True

    # as a force the barrier acts by all that is near: by what is nearest it would jump where two parts are equally near

    @ti.func
    def over_parts(self, what: A, parameters: A, first, X, u, w, dot: A, sums: A, i):
        radius, width = parameters[first + 3], self.width(parameters, first)
        x, begin = self.place(parameters, first, X, u), self.begin(parameters, first)
        return self.nearest.over_parts(what, x, w, radius, width, begin, parameters, dot, sums, i)

    @ti.func
    def energy(self, parameters: A, first, X, u):
        total = self.over_parts(ENERGY, parameters, first, X, u, 0, parameters, parameters, 0)
        return parameters[first + self.index.stiffness] * total[0]

    @traced
    def _record_force(self, parameters, first, X, u):
        def pushed(g, p, X, u):
            local = [(x - c) + y for x, c, y in zip(X, p, u)]
            x, begin = ti.types.vector(3, self.fp)(*(k.value for k in local)), self.begin(parameters, first)
            (r, k, w), none = (p[m] for m in (3, self.index.stiffness, self.index.width)), parameters
            at_x = let(self.nearest.over_parts(FORCE, let(x), 0, r.value, w.value, begin, parameters, none, none, 0))
            by_x = (4, 5, 6), (5, 7, 8), (6, 8, 9)

            def force(a):
                partials = [(y, lambda b=b: k.value * at(at_x, by_x[a][b])) for b, y in enumerate(local)]
                partials += [(k, lambda: at(at_x, 1 + a)), (w, lambda: k.value * at(at_x, 10 + a))]
                return g.function(k.value * at(at_x, 1 + a), *partials, (r, lambda: k.value * at(at_x, 13 + a)))

            return None, [force(a) for a in range(3)]

        g, p, moved, _, f = self.record(parameters, first, X, u, pushed)
        return g, p, moved, f

    @traced
    def force_by_corners(self, parameters, first, X, u, parameters_dot):
        total = let(self.over_parts(JVP, parameters, first, X, u, 0, parameters_dot, parameters, 0))
        k = at(parameters, first + self.index.stiffness)
        return self.vector_of([k * x for x in self.turned(X, [at(total, 1 + a) for a in range(3)], False)])

    @traced
    def add_by_corners(self, parameters, first, X, u, w, sums, i):
        k = at(parameters, first + self.index.stiffness)
        own = ti.types.vector(3, self.fp)(*self.turned(X, [k * at(w, a) for a in range(3)], True))
        let(self.over_parts(VJP, parameters, first, X, u, let(own), parameters, sums, i))

    # friction of implicit passes, by the normal force of each part, as friction acts on both sides of a crease

    @ti.func
    def each_part(self, act: A, parameters: A, first, X, u):
        """Call `act` with what `SurfaceDistance.seen` has of each part that presses, and its share."""
        x, begin = self.place(parameters, first, X, u), self.begin(parameters, first)
        reach, one = parameters[first + 3] + self.width(parameters, first), ti.cast(1, self.fp)
        j, feature, s, t, inside = self.nearest.first_part(x, begin, parameters)
        k, share, square, more = 6, one, one, True
        while more:
            if not inside:
                j, k, feature, s, t, square, share = self.nearest.next_part(j, k, x, reach, begin, parameters)
            more = j >= 0 and not inside
            if j >= 0:
                found, rows, s_of, t_of, g, h = self.nearest.seen(x, j, feature, s, t, begin, parameters)
                if found[0] < 0 and not inside:
                    found = 0 - found
                act(found, rows, s_of, t_of, g, h, share)

    @traced
    def _sum_of_parts(self, of_one, count, parameters, first, contact):
        """Sums over parts of the numbers that of_one(place of contact, share of the part) gives."""
        total = [variable(ti.cast(0, self.fp)) for _ in range(count)]

        @traced
        def add(*seen):
            there = *contact, lambda g, p, X, u: self.distance_and_normal(g, p[: self.count], X, u, seen[:-1])
            for x, more in zip(total, of_one(there, seen[-1])):
                assign(x, x + more)

        self.each_part(add, parameters, first, *contact)
        return total

    @traced
    def _sum_of_forces(self, one, parameters, first, contact, *more):
        def of_one(there, share):
            f = one(parameters, first, there, *more)
            return [share * at(f, d) for d in range(3)]

        return self.vector_of(self._sum_of_parts(of_one, 3, parameters, first, contact))

    @traced
    def dissipation(self, parameters, first, contact, v, v_obstacle):
        one = super().dissipation
        of_one = lambda there, share: [share * one(parameters, first, there, v, v_obstacle)]  # noqa: E731
        return self._sum_of_parts(of_one, 1, parameters, first, contact)[0]

    @traced
    def friction_force(self, *given):
        return self._sum_of_forces(super().friction_force, *given)

    @traced
    def friction_product(self, *given):
        return self._sum_of_forces(super().friction_product, *given)

    @traced
    def friction_force_jvp(self, *given):
        return self._sum_of_forces(super().friction_force_jvp, *given)

    @traced
    def friction_force_vjp(self, parameters, first, contact, v, v_obstacle, w, sums, i):
        one, count = super().friction_force_vjp, 6 if self.turns else 3

        def of_one(there, share):
            own = self.vector_of([share * at(w, d) for d in range(3)])
            by_place, *others = one(parameters, first, there, v, v_obstacle, own, sums, i)
            return [at(by, d) for by, k in zip((by_place, *others), (count, 3, 3)) for d in range(k)]

        return self.parted(self._sum_of_parts(of_one, count + 6, parameters, first, contact), count)

    @ti.func
    def reached(self, parameters: ti.template(), first, X, u, move, d, approach):
        """By the plane of what is nearest, and by all triangles on the way."""
        out = ti.min(d, d + approach)
        if out > 0 and move.norm_sqr() >= d * d:
            begin, x = self.begin(parameters, first), self.place(parameters, first, X, u)
            share = self.nearest.free_share(x, self.place(parameters, first, X, u + move), begin, parameters)
            if share < 1:
                out = (share - 1) * ti.sqrt(move.norm_sqr())
        return out

    @traced
    def begin(self, parameters, first):
        """Where the vertices begin in the parameters."""
        return let(first + self.size) if self.shapeable else self.nearest.vertices(parameters)

    @traced
    def place(self, parameters, first, X, u):
        """A place as the tree sees it."""
        x, y = ([at(vector, d) for d in range(3)] for vector in (X, u))
        if self.turns:
            c = [at(parameters, first + self.index.about + d) for d in range(3)]
            x, y = (self.turned(X, z, True) for z in ([a - b for a, b in zip(x, c)], y))
            x = [a + b for a, b in zip(x, c)]
        return let(ti.types.vector(3, self.fp)(*((x[d] - at(parameters, first + d)) + y[d] for d in range(3))))

    @traced
    def turned(self, X, z, back):
        """R z of the pose in X, or back, R^T z."""
        if not self.turns:
            return z
        R = rotation_matrix([at(X, 3 + k) for k in range(4)])
        return [sum_of((R[e][d] if back else R[d][e]) * z[e] for e in range(3)) for d in range(3)]
