"""Where a camera sees points of the body: what tracking of markers in a film measures."""

from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh.geometry import barycentric_in_plane
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.material_points import MaterialPoints
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene

if TYPE_CHECKING:
    from diffsim_ti.visual.camera import Camera


class PixelTracks(Output):
    """(column, row) of points of the body in a camera's picture [pixels], shape (frames, num_points, 2):

        (c_x + f_x a . r / d, c_y - f_y a . u / d),    a = x - position,    d = -a . b

    x: `MaterialPoints(points)`; r, u, b: the camera's axes (right, up, backwards), f and c: its focal lengths and principal
    point. Columns and rows count from the corner of the picture, so that the first pixel's centre is (0.5, 0.5).
    camera: `picture.Camera`, at rest; size: width and height of its picture [pixels]. points, nearest: as of
    `MaterialPoints`. name: how a loss calls them.

    A point has a place in the picture also where something hides it: `visible(frames)` says where not. In `identify` a
    sample that is missing is NaN. The gradient is exact by positions and rest_positions.
    Raises ValueError as `MaterialPoints` does, and FloatingPointError for a point that is not in front of the camera.
    Hartley, Zisserman, Multiple View Geometry, 2nd ed., 2004, sec. 6.1, doi:10.1017/CBO9780511811685.
    """

    unit = "pixels"

    def __init__(
        self,
        camera: "Camera",
        points: ArrayLike,
        size: tuple[int, int] = (640, 480),
        name: str = "pixel_tracks",
        nearest: bool = False,
    ):
        self.camera, self.size, self.name = camera, (int(size[0]), int(size[1])), name
        self._given = MaterialPoints(points, name, nearest)

    def __repr__(self) -> str:
        return f"PixelTracks({len(self._given.points)} points, {self.size}, name={self.name!r})"

    def settled(self, scene: Scene) -> "PixelTracks":
        out = copy(self)
        out.points, out.triangles = self._given.settled(scene), scene.mesh.surface_triangles
        out.length = float(np.ptp(scene.mesh.bounding_box, 0).max())
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, len(self.points.points), 2

    def _jacobian(self, x: np.ndarray) -> np.ndarray:
        """d(column, row) / dx, shape (..., 2, 3)."""
        axes, focal = self.camera.axes, self.camera.focal_lengths(self.size)
        a = (x - self.camera.position) @ axes.T
        depth = -a[..., 2:]
        by_a = np.zeros((*x.shape[:-1], 2, 3))
        by_a[..., 0, 0] = by_a[..., 1, 1] = 1
        by_a[..., 2] = a[..., :2] / depth
        return (np.array([focal[0], -focal[1]])[:, None] * by_a / depth[..., None]) @ axes

    def value(self, frames: Frames) -> np.ndarray:
        x = self.points.value(frames)
        depth = -(x - self.camera.position) @ self.camera.axes[2]
        if not np.all(depth > 0):
            frame, k = np.argwhere(~(depth > 0))[0]
            raise FloatingPointError(
                f"{self!r}: in frame {frame} point {k} is {-depth[frame, k]:.3g} m behind the camera; move it back"
            )
        return self.camera.project(x, self.size)[..., :2]

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        x = self.points.value(frames)
        return np.einsum("fpij,fpj->fpi", self._jacobian(x), self.points.jvp(frames, change))

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        x = self.points.value(frames)
        return self.points.vjp(frames, np.einsum("fpij,fpi->fpj", self._jacobian(x), seed))

    def visible(self, frames: Frames, within: float = 1e-3) -> np.ndarray:
        """Which points lie within the picture and are not hidden by the body, bool (frames, num_points).

        within: how deep under the surface a marker may lie and still be seen, as a share of the body's length.
        """
        if not hasattr(self, "points"):
            raise ValueError(f"{self!r}: it has no scene yet; take frames.computed[{self.name!r}].visible(frames)")
        x, out = self.points.value(frames), np.zeros(self.shape(len(frames.positions))[:2], bool)
        for k in range(len(x)):
            seen = self.camera.project(x[k], self.size)
            inside = np.all((seen[:, :2] >= 0) & (seen[:, :2] <= self.size), 1)
            body = frames.positions[k].astype(np.float64)
            ahead = ((body - self.camera.position) @ self.camera.axes[2] < 0)[self.triangles].all(1)
            triangles = self.camera.project(body, self.size)[self.triangles[ahead]]
            out[k] = inside & (_nearest_depth(triangles, seen[:, :2]) > seen[:, 2] - within * self.length)
        return out


def _nearest_depth(triangles: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Depth [m] of the nearest triangle, of corners (column, row, depth), at each place; infinite for none."""
    out = np.full(len(places), np.inf)
    for k, place in enumerate(places):
        w = barycentric_in_plane(place, triangles)
        hit = np.flatnonzero((w > -1e-9).all(1))
        if len(hit):
            out[k] = (1 / (w[hit] / triangles[hit, :, 2]).sum(1)).min()  # 1 / depth is linear over the picture
    return out
