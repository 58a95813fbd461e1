"""Triangles, segments and points as an obstacle, by the exact distance to what is nearest of them."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from diffsim_ti.common.origin import OF_WIDTHS, middle_far_part, rounding_of
from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.terms.described import place
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.kinematic_surface import KinematicSurface
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce
from diffsim_ti.terms.obstacles.surface_distance import SurfaceDistance
from diffsim_ti.terms.obstacles.surface_tree import SurfaceTree


class MeshObstacle(Obstacle):
    """All that is within `radius` [m] of triangles, segments and points, by the exact distance to what is nearest of them.

    vertices [m], shape (k, 3); triangles, shape (t, 3), segments, shape (s, 2), points, shape (p,), any of them, name
    vertices by index; where none is given all vertices are points. position [m]: where the vertices' origin lies.
    Parts whose triangles are closed, each edge passed once each way, have an inside, which their normals point out of: they
    push out what got into them, and no body may start there; triangles that face inwards are the wall of a room. All
    other triangles, segments and points are felt from both sides alike. A tree of boxes finds what is nearest, so that
    triangles that are far away cost next to nothing. `resolution` has no meaning.

    Inputs with gradient: "mesh_position", shape (3,), "mesh_radius", and those of every `Obstacle`, whose other arguments
    it takes. The distance is C1 but where two parts are equally near; where the nearest goes from a face to an edge or
    a corner the contact's stiffness jumps.
    Raises ValueError for vertices or indices that do not fit.
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
        **options,
    ):
        if resolution is not None:
            warnings.warn(
                "MeshObstacle: resolution has no meaning, for distances are exact; it goes with the next version",
                DeprecationWarning,
                stacklevel=2,
            )
        thick = Input("radius", radius, ((),), "m", NOT_NEGATIVE, plain="mesh_radius")
        super().__init__([place("position", position, "mesh_position"), thick], **options)
        if rounding_of(vertices) > OF_WIDTHS * self.values["barrier_width"]:
            coarse = f"float32 resolves vertices to {rounding_of(vertices):.2g} m, too little for the barrier's width"
            warnings.warn(f"MeshObstacle: {coarse}: give them in float64", stacklevel=2)
        self._made = KinematicSurface.checked("MeshObstacle", vertices, triangles, segments, points)
        self._base = middle_far_part(self._made.vertices)
        self._tree = SurfaceTree(self._made, self._base)

    @cached_property
    def table(self) -> np.ndarray:
        """What kernels find distances in."""
        return self._tree.table()

    def distance(self, positions):
        from_base = positions - (self._base + self.values["mesh_position"])
        return self._tree.distance(from_base) - self.values["mesh_radius"]

    def shift(self, origin):
        """The tree is measured from `_base`, which the position has more."""
        out = super().shift(origin)
        out[:3] -= self._base
        return out

    def kinematic_surface(self):
        moved = self._made.vertices + self.values["mesh_position"]
        return replace(self._made, vertices=moved, radius=float(self.values["mesh_radius"]))

    def surface(self, size):
        return shapes.skeleton(self.kinematic_surface(), 0.002 * size)

    def kernel(self, precision, table=0):
        if precision == "f32" and table + self.table.size > 2**24:
            raise ValueError(
                f"MeshObstacle: float32 cannot count the {table + self.table.size} numbers of a surface of "
                f"{self._tree.count} triangles, segments and points: pass precision='f64', or fewer"
            )
        return MeshForce(precision, self.has_friction, table, self._tree.is_sided, self._made.is_convex)


@dataclass(frozen=True)
class MeshForce(ObstacleForce):
    """d and its derivatives by the tree that starts at `table` in the parameters; sided: whether parts have an inside."""

    table: int = 0
    sided: bool = False
    convex: bool = False

    count = 4

    @cached_property
    def nearest(self) -> SurfaceDistance:
        return SurfaceDistance(self.precision, self.table, self.sided)

    @traced
    def distance_and_normal(self, g, p, X, u):
        local = [(x - c) + y for x, c, y in zip(X, p, u)]
        point = let(ti.types.vector(3, self.fp)(*(k.value for k in local)))
        found = let(self.nearest.look(point, g.parameters))
        n = [at(found, 1 + k) for k in range(3)]
        H = [[at(found, 4 + k) for k in row] for row in ((0, 1, 2), (1, 3, 4), (2, 4, 5))]
        d = g.function(at(found, 0), *((x, lambda k=k: n[k]) for k, x in enumerate(local)))
        rows = [g.function(n[a], *((x, lambda a=a, b=b: H[a][b]) for b, x in enumerate(local))) for a in range(3)]
        return d - p[3], rows

    @ti.func
    def may_touch(self, parameters: ti.template(), first, X, u):
        return True
