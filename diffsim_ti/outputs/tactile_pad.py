"""What a tactile sensor reads: pressure and shear on a grid of a surface, in axes that go with it."""

from copy import copy

import numpy as np

from diffsim_ti.mesh.geometry import barycentric_in_plane, triangle_normals
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.contact_traction import ContactTraction
from diffsim_ti.outputs.output import Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Term


class TactilePad(Output):
    """Pressure and shear [Pa] of an obstacle on a grid of a surface set, shape (frames, rows, columns, 3):

        (-t . n, t . a, t . b),    t = sum over a triangle's corners of w_i t_i

    t_i: `ContactTraction` of the obstacle, w_i: where the grid's point lies in the triangle, in the mesh as it was made. The
    grid spans the smallest rectangle around the set there (columns along its longer side); points beside the set read 0,
    `inside` says which. n, a, b go with the set: n is the mean of its triangles' normals, outwards, a along the columns, b
    along the rows. So turning the pad as a rigid body does not change what it reads. Of the output that a Rollout has,
    `rollout.outputs["tactile_pad"]`, `places` [m] says where the points were in the mesh, shape (rows, columns, 3).

    obstacle: its name, or the term as the scene lists it. on: a surface set's name, indices of surface triangles or a mask.
    size: (rows, columns). The resultant is `ContactForce(obstacle, on=...)`, its moment that with about=.
    The gradient is exact by all inputs; that by rest_positions leaves the weights w_i as they are.
    Raises ValueError as `ContactTraction` does, for a set that there is not or is empty, and for no rows or columns.
    Yuan, Dong, Adelson 2017, GelSight, doi:10.3390/s17122762.
    """

    reads_contact_forces, unit = True, "Pa"

    def __init__(
        self, obstacle: Term | str, on: SetOrIndices, size: tuple[int, int] = (16, 16), name: str = "tactile_pad"
    ):
        if len(size) != 2 or min(size) < 1:
            raise ValueError(f"TactilePad: size must be (rows, columns), at least 1 of each, got {size}")
        self._given, self.on, self.name = ContactTraction(obstacle), on, name
        self.size = int(size[0]), int(size[1])

    def __repr__(self) -> str:
        return f"TactilePad({self._given._given.obstacle!r}, {self.on!r}, {self.size}, name={self.name!r})"

    def settled(self, scene: Scene) -> "TactilePad":
        out, mesh = copy(self), scene.mesh
        out.traction, rows = self._given.settled(scene), mesh.surface_indices(self.on)
        if not len(rows):
            raise ValueError(f"{self!r}: the surface set has no triangles; choose one that has")
        out.triangles = mesh.surface_triangles[rows]
        X = mesh.vertices
        corners = np.unique(out.triangles)
        middle = X[corners].mean(0)
        normal = triangle_normals(X, out.triangles).sum(0)
        normal /= np.linalg.norm(normal)
        flat = X - middle - np.outer((X - middle) @ normal, normal)
        a = _longer_side(flat[corners], normal)
        b = np.cross(normal, a)
        p = flat @ np.stack([a, b], 1)  # in the plane
        low, high = p[corners].min(0), p[corners].max(0)
        shares = [(np.arange(k) + 0.5) / k for k in self.size[::-1]]
        x, y = np.meshgrid(*(l + s * (h - l) for l, h, s in zip(low, high, shares)))
        out.corners, out.weights = _within(np.stack([x, y], -1).reshape(-1, 2), p, out.triangles)
        out.inside = (out.weights.sum(1) > 0).reshape(self.size)
        on_set = np.einsum("pc,pcd->pd", out.weights, X[out.corners]).reshape(*self.size, 3)
        out.places = np.where(out.inside[..., None], on_set, middle + np.stack([x, y], -1) @ np.stack([a, b]))
        lever = p[corners, 0] - p[corners, 0].mean()
        out.along = np.zeros(mesh.num_vertices)
        out.along[corners] = lever / (lever @ lever)  # of places: how much the set's coordinate along a leads them on
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, *self.size, 3)

    def value(self, frames: Frames) -> np.ndarray:
        t = np.einsum("pc,fpcd->fpd", self.weights, self.traction.value(frames)[:, self.corners])
        axes = np.stack([self._axes(x) for x in frames.positions.astype(np.float64)])
        return np.einsum("fpd,fkd->fpk", t, axes).reshape(self.shape(len(t)))

    def _axes(self, x: np.ndarray) -> np.ndarray:
        """Rows -n, a, b: n along the sum of the faces' normals, a along the set's longer side, less what is along n."""
        N, g = triangle_normals(x, self.triangles).sum(0), self.along @ x
        n = N / np.linalg.norm(N)
        flat = g - n * (n @ g)
        a = flat / np.linalg.norm(flat)
        return np.stack([-n, a, np.cross(n, a)])


def _longer_side(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Unit vector along the longer side of the smallest rectangle around points of a plane through the origin: a side of it
    lies on one of their convex hull."""
    from scipy.spatial import ConvexHull

    first = np.linalg.svd(points, full_matrices=False)[2][0]
    plane = np.stack([first, np.cross(normal, first)])
    p = points @ plane.T
    hull = p[ConvexHull(p).vertices]
    sides = np.roll(hull, -1, 0) - hull
    sides = sides[np.linalg.norm(sides, axis=1) > 1e-9 * np.abs(p).max()]
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    across = np.stack([-sides[:, 1], sides[:, 0]], 1)
    wide, high = np.ptp(p @ sides.T, axis=0), np.ptp(p @ across.T, axis=0)
    areas = wide * high
    best = np.flatnonzero(areas <= areas.min() * (1 + 1e-9))[0]
    a = (sides if wide[best] > high[best] * (1 + 1e-9) else across)[best] @ plane
    return a * np.sign(a[np.argmax(np.abs(a))])


def _within(points: np.ndarray, p: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each point of a plane (corners of the triangle around it, weights there); weights of 0 where there is none."""
    corners, weights = np.zeros((len(points), 3), np.int64), np.zeros((len(points), 3))
    for k, point in enumerate(points):
        w = barycentric_in_plane(point, p[triangles])
        least = np.where(np.isfinite(w).all(1), w.min(1), -np.inf)  # what is seen as a line has none
        best = np.argmax(least)
        if least[best] > -1e-9:
            corners[k], weights[k] = triangles[best], w[best]
    return corners, weights
