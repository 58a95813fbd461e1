"""Camera: a pinhole, the same for every way of drawing."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.public import Public

FIELD_OF_VIEW = 28.0  # [degrees]
NEAREST = 1e-9  # [m], the least depth a point is projected with


@dataclass(frozen=True)
class Camera(metaclass=Public):
    """A pinhole at `position` [m] that points to `look_at` [m]; field_of_view [degrees] is that of the picture's height.

    intrinsics: focal lengths and principal point (f_x, f_y, c_x, c_y) as shares of the picture's (width, height, width,
    height), in place of the field of view; `calibrated` makes them of a camera matrix.
    """

    position: np.ndarray
    look_at: np.ndarray
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    field_of_view: float = FIELD_OF_VIEW
    intrinsics: tuple[float, float, float, float] | None = None

    @classmethod
    def calibrated(
        cls, matrix: ArrayLike, size: tuple[int, int], rotation: ArrayLike, translation: ArrayLike
    ) -> "Camera":
        """A camera as calibrations give it (OpenCV): x' = rotation x + translation has z' ahead and y' downwards, and its
        pixel is matrix x' / z'; matrix [pixels], shape (3, 3), is that of a picture of `size`, width and height, and counts
        from the picture's corner. OpenCV counts from the middle of the first pixel: add 0.5 to its c_x and c_y, and to the
        places that it finds in pictures.

        Raises ValueError for shapes that do not fit, a matrix with skew, and a rotation that is none.
        Hartley, Zisserman, Multiple View Geometry, 2nd ed., 2004, sec. 6.1.
        """
        K, R, t = (np.asarray(x, np.float64) for x in (matrix, rotation, translation))
        if K.shape != (3, 3) or R.shape != (3, 3) or t.shape != (3,):
            raise ValueError(
                f"camera: matrix and rotation must have shape (3, 3), translation (3,), got {K.shape}, {R.shape}, {t.shape}"
            )
        if K[0, 1] or not np.allclose(K[[1, 2, 2], [0, 0, 1]], 0) or not np.isclose(K[2, 2], 1):
            raise ValueError(f"camera: matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}")
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError("camera: rotation must be a rotation matrix, whose transpose is its inverse")
        width, height = size
        shares = K[0, 0] / width, K[1, 1] / height, K[0, 2] / width, K[1, 2] / height
        place = -R.T @ t
        return cls(place, place + R[2], tuple(-R[1]), intrinsics=tuple(float(x) for x in shares))

    @classmethod
    def framing(
        cls, points: ArrayLike, size: tuple[float, float] = (4, 3), azimuth: float = 32.0, elevation: float = 14.0
    ) -> "Camera":
        """A camera that sees all points [m], shape (k, 3), in a picture of this size (only its ratio counts).

        azimuth about y (0: from +z, 90: from +x) and elevation above the floor, below 90, in degrees.
        """
        points = np.asarray(points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.all(np.isfinite(points)):
            raise ValueError(f"camera: points to frame must be finite, of shape (k, 3), got shape {points.shape}")
        if not abs(elevation) < 90:
            raise ValueError(f"elevation must lie between -90 and 90 degrees, got {elevation:g}; use 89 to look down")
        a, e = np.radians([azimuth, elevation])
        back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        center = (points.min(0) + points.max(0)) / 2
        camera = cls(center + back, center)
        x, y, z = camera.axes @ (points - center).T
        half = np.tan(np.radians(FIELD_OF_VIEW) / 2) * np.array([size[0] / size[1] * 0.72, 0.82])
        distance = max(np.max(np.abs(x) / half[0] + z), np.max(np.abs(y) / half[1] + z), 1e-6)
        return cls(center + back * distance, center)

    @property
    def axes(self) -> np.ndarray:
        """Rows: right, up, backwards; unit vectors."""
        back = self.position - self.look_at
        back = back / np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    def focal(self, size: tuple[int, int]) -> float:
        """Focal length in pixels of a picture of `size` (width, height), along it."""
        if self.intrinsics is not None:
            return self.intrinsics[1] * size[1]
        return size[1] / 2 / np.tan(np.radians(self.field_of_view) / 2)

    def focal_lengths(self, size: tuple[int, int]) -> tuple[float, float]:
        """Across and along a picture of `size`, in pixels."""
        if self.intrinsics is None:
            return (self.focal(size),) * 2
        return self.intrinsics[0] * size[0], self.intrinsics[1] * size[1]

    def middle(self, size: tuple[int, int]) -> tuple[float, float]:
        """Its principal point [pixels]."""
        x, y = (0.5, 0.5) if self.intrinsics is None else self.intrinsics[2:]
        return x * size[0], y * size[1]

    def project(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Pixel column, row and depth [m] of points, shape (..., 3)."""
        x, y, z = np.moveaxis((points - self.position) @ self.axes.T, -1, 0)
        depth = np.maximum(-z, NEAREST)
        (fx, fy), (cx, cy) = self.focal_lengths(size), self.middle(size)
        return np.stack([cx + fx / depth * x, cy - fy / depth * y, depth], -1)

    def rays(self, column: ArrayLike, row: ArrayLike, size: tuple[int, int]) -> np.ndarray:
        """Unit direction of the ray through picture points (in pixels), shape (n, 3)."""
        (fx, fy), (cx, cy) = self.focal_lengths(size), self.middle(size)
        x, y = (np.asarray(column) - cx) / fx, (cy - np.asarray(row)) / fy
        rays = np.stack([x, y, np.full(x.shape, -1.0)], -1) @ self.axes
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def orbited(self, azimuth: float, elevation: float) -> "Camera":
        """Turned about `look_at` by these angles [degrees]; stops short of straight up and down."""
        offset = self.position - self.look_at
        distance = np.linalg.norm(offset)
        a = np.arctan2(offset[0], offset[2]) + np.radians(azimuth)
        e = np.clip(np.arcsin(offset[1] / distance) + np.radians(elevation), *np.radians([-85, 85]))
        back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        return replace(self, position=self.look_at + distance * back)

    def zoomed(self, factor: float) -> "Camera":
        """So many times nearer to `look_at`."""
        return replace(self, position=self.look_at + (self.position - self.look_at) / factor)
