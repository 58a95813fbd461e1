"""A closed triangle mesh as an obstacle: its signed distance on a grid, between whose points cubic B-splines are C2."""

import warnings
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers, whole, wholes
from diffsim_ti.common.origin import OF_WIDTHS, middle_far_part, rounding_of
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.terms.described import place
from diffsim_ti.terms.obstacles.kinematic_surface import KinematicSurface
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce


class MeshObstacle(Obstacle):
    """A body bounded by a closed triangle mesh: vertices [m], shape (k, 3), triangles, shape (t, 3), outward.

    position [m]: where its origin lies. The distance is sampled on a cubic grid of `resolution` cells along the longest
    side, by libigl (signs from pseudonormals), and interpolated by cubic B-splines: C2, exact at grid points, with edges
    rounded within a cell. Beyond 2 cells and a width from the mesh there is no force.

    Inputs with gradient: "mesh_position", shape (3,), and those of every `Obstacle`, whose other arguments it takes.
    Raises ValueError for a mesh that is not closed or oriented, RuntimeError without libigl (`pip install
    'diffsim-ti[mesh-obstacles]'`).
    Baerentzen, Aanaes 2005, Signed distance computation using the angle weighted pseudonormal, doi:10.1109/TVCG.2005.49.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        triangles: ArrayLike,
        position: ArrayLike = (0.0, 0.0, 0.0),
        resolution: int = 48,
        **options,
    ):
        super().__init__([place("position", position, "mesh_position")], **options)
        if rounding_of(vertices) > OF_WIDTHS * self.values["barrier_width"]:
            coarse = f"float32 resolves vertices to {rounding_of(vertices):.2g} m, too little for the barrier's width"
            warnings.warn(f"MeshObstacle: {coarse}: give them in float64", stacklevel=2)
        vertices, triangles = numbers("MeshObstacle: vertices", vertices), wholes("MeshObstacle: triangles", triangles)
        check_closed(vertices, triangles)
        resolution = whole("MeshObstacle: resolution", resolution, 4)
        low, high = vertices.min(0), vertices.max(0)
        cell = (high - low).max() / resolution
        pad = float(self.values["barrier_width"]) + 2 * cell
        counts = np.ceil((high - low + 2 * pad) / cell).astype(int) + 1
        self._base = middle_far_part(vertices)
        self.origin, self.cell, self.counts = low - self._base - pad, float(cell), tuple(int(n) for n in counts)
        self._surface = vertices, triangles
        axes = [self._base[d] + self.origin[d] + cell * np.arange(counts[d]) for d in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        from scipy.ndimage import spline_filter

        self.table = spline_filter(self._exact(points).reshape(self.counts), 3, mode="mirror").ravel()

    def _exact(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [m] to the mesh itself at position zero."""
        try:
            import igl
        except ImportError:
            raise RuntimeError("MeshObstacle needs libigl for distances: pip install libigl") from None
        kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        return igl.signed_distance(np.ascontiguousarray(points, np.float64), *self._surface, sign_type=kind)[0]

    def distance(self, positions):
        return self._exact(positions - self.values["mesh_position"])

    def shift(self, origin):
        """The grid is measured from `_base`, which the position has more."""
        out = super().shift(origin)
        out[:3] -= self._base
        return out

    def kinematic_surface(self):
        none = np.zeros((0, 2), np.int64)
        vertices, triangles = self._surface
        return KinematicSurface(vertices + self.values["mesh_position"], triangles, none, none[:, 0])

    def surface(self, size):
        points, triangles = self._surface
        return points + self.values["mesh_position"], triangles

    def kernel(self, precision, table=0):
        return MeshForce(precision, self.has_friction, table, self.counts, self.cell, tuple(self.origin))


def check_closed(vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Raise ValueError unless every edge belongs to two triangles that run along it in opposite directions."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        shapes = f"{vertices.shape}, {triangles.shape}"
        raise ValueError(f"MeshObstacle: vertices must have shape (k, 3) and triangles (t, 3), got {shapes}")
    if (
        not triangles.size
        or not np.all(np.isfinite(vertices))
        or triangles.min() < 0
        or triangles.max() >= len(vertices)
    ):
        raise ValueError("MeshObstacle: vertices must be finite, and triangles must name them by index")
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    keys = edges[:, 0] * len(vertices) + edges[:, 1]
    back = edges[:, 1] * len(vertices) + edges[:, 0]
    lonely = ~np.isin(keys, back)
    if lonely.any() or len(np.unique(keys)) < len(keys):
        raise ValueError(
            f"MeshObstacle: the mesh must be closed and consistently oriented; {int(lonely.sum())} edges have no "
            "neighbour that runs the other way; close its holes and orient its triangles outwards"
        )
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) <= 0:
        raise ValueError("MeshObstacle: triangles face inwards; swap two corners of each")


@dataclass(frozen=True)
class MeshForce(ObstacleForce):
    """d and its derivatives from the table of spline coefficients, which starts at `table` in the parameters."""

    table: int = 0
    counts: tuple = (1, 1, 1)
    cell: float = 1.0
    origin: tuple = (0.0, 0.0, 0.0)

    count = 3

    @property
    def grain(self):
        return 0.25 * self.cell

    @traced
    def distance_and_normal(self, g, p, X, u):
        local = [(x - c) + y for x, c, y in zip(X, p, u)]
        point = let(ti.types.vector(3, self.fp)(*(k.value for k in local)))
        found = let(self.sample(g.parameters, point))
        n = [at(found, 1 + k) for k in range(3)]
        H = [[at(found, 4 + k) for k in row] for row in ((0, 1, 2), (1, 3, 4), (2, 4, 5))]
        d = g.function(at(found, 0), *((x, lambda k=k: n[k]) for k, x in enumerate(local)))
        rows = [g.function(n[a], *((x, lambda a=a, b=b: H[a][b]) for b, x in enumerate(local))) for a in range(3)]
        return d, rows

    @ti.func
    def clearance(self, parameters: ti.template(), first, X, u):
        """Outside the grid the distance to it and a cell; within, with a margin for splines steeper than distances."""
        point, outside, out = ti.Vector.zero(self.fp, 3), ti.cast(0, self.fp), 0 * X
        for d in ti.static(range(3)):
            point[d] = (X[d] - parameters[first + d]) + u[d]
            low = ti.cast(self.origin[d] + self.cell, self.fp)
            high = ti.cast(self.origin[d] + (self.counts[d] - 3) * self.cell, self.fp)
            beyond = ti.max(low - point[d], point[d] - high, ti.cast(0, self.fp))
            outside += beyond * beyond
        if outside > 0:
            out[3] = ti.sqrt(outside) + ti.cast(0.5 * self.cell, self.fp)
        else:
            found = self.sample(parameters, point)
            for d in ti.static(range(3)):
                out[d] = found[1 + d]
            out[3] = ti.cast(0.8, self.fp) * ti.min(found[0], ti.cast(1e3 * self.cell, self.fp))
        return out

    @ti.func
    def sample(self, parameters: ti.template(), point):
        """(d, its gradient, its second derivatives xx, xy, xz, yy, yz, zz); far outside d is large."""
        out, inside = ti.Vector.zero(self.fp, 10), True
        out[0] = ti.cast(1e6 * self.cell, self.fp)
        start, share = ti.Vector.zero(ti.i32, 3), ti.Vector.zero(self.fp, 3)
        for d in ti.static(range(3)):
            y = (point[d] - ti.cast(self.origin[d], self.fp)) * ti.cast(1 / self.cell, self.fp)
            start[d] = ti.cast(ti.floor(y), ti.i32) - 1
            share[d] = y - ti.floor(y)
            inside = inside and start[d] >= 0 and start[d] + 3 < self.counts[d]
        if inside:
            out = self.gather(parameters, start, share)
        return out

    @ti.func
    def gather(self, parameters: ti.template(), start, share):
        """The sum over the 64 grid points around."""
        out = ti.Vector.zero(self.fp, 10)
        w, w1, w2 = self.weights(share)
        for a in range(4):
            for b in range(4):
                for c in range(4):
                    index = ((start[0] + a) * self.counts[1] + start[1] + b) * self.counts[2] + start[2] + c
                    q = parameters[self.table + index]
                    out[0] += q * w[a, 0] * w[b, 1] * w[c, 2]
                    out[1] += q * w1[a, 0] * w[b, 1] * w[c, 2]
                    out[2] += q * w[a, 0] * w1[b, 1] * w[c, 2]
                    out[3] += q * w[a, 0] * w[b, 1] * w1[c, 2]
                    out[4] += q * w2[a, 0] * w[b, 1] * w[c, 2]
                    out[5] += q * w1[a, 0] * w1[b, 1] * w[c, 2]
                    out[6] += q * w1[a, 0] * w[b, 1] * w1[c, 2]
                    out[7] += q * w[a, 0] * w2[b, 1] * w[c, 2]
                    out[8] += q * w[a, 0] * w1[b, 1] * w1[c, 2]
                    out[9] += q * w[a, 0] * w[b, 1] * w2[c, 2]
        return out

    @ti.func
    def weights(self, t):
        """Cubic B-spline weights (4, 3) of the points around, and their first and second derivatives by position."""
        w, w1, w2 = ti.Matrix.zero(self.fp, 4, 3), ti.Matrix.zero(self.fp, 4, 3), ti.Matrix.zero(self.fp, 4, 3)
        sixth, half, per = ti.cast(1 / 6, self.fp), ti.cast(0.5, self.fp), ti.cast(1 / self.cell, self.fp)
        for d in ti.static(range(3)):
            x, y = t[d], 1 - t[d]
            w[0, d], w[3, d] = sixth * y * y * y, sixth * x * x * x
            w[1, d] = sixth * (4 - 6 * x * x + 3 * x * x * x)
            w[2, d] = sixth * (4 - 6 * y * y + 3 * y * y * y)
            w1[0, d], w1[3, d] = 0 - half * y * y * per, half * x * x * per
            w1[1, d] = half * (3 * x * x - 4 * x) * per
            w1[2, d] = half * (4 * y - 3 * y * y) * per
            w2[0, d], w2[3, d] = y * per * per, x * per * per
            w2[1, d], w2[2, d] = (3 * x - 2) * per * per, (3 * y - 2) * per * per
        return w, w1, w2
