"""What lies behind a body: the sky, and a floor with a grid that fades away and the shadows that fall on it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.painters import covered
from diffsim_ti.visual.surface import LIGHT

SKY, HORIZON, FLOOR, LINE = (np.array(c) for c in ([0.99] * 3, [0.93, 0.945, 0.96], [0.965] * 3, [0.80, 0.82, 0.85]))
COARSE = 3  # shadows are soft: they are looked up at every third pixel


class Backdrop:
    """The background of pictures of one size, kept while the camera stays.

    ground: height of the floor [m] or None. box: what the pictures show, shape (2, 3) [m]; it sets the grid's cells.
    """

    def __init__(self, size: tuple[int, int], ground: float | None, box: ArrayLike):
        self.size, self.ground, self.box = tuple(size), ground, np.asarray(box, np.float64)
        self._camera = None

    def image(self, camera: Camera, shapes: Sequence[Triangles]) -> np.ndarray:
        """RGB in [0, 1], float32 (height, width, 3). shapes: (points, triangles) of what throws a shadow."""
        if camera is not self._camera:
            self._camera, self._image = camera, self._without_shadow(camera)
            self._below = None if self.ground is None else self._floor_points(camera, COARSE)
        if self.ground is None:
            return self._image
        from scipy.ndimage import zoom

        hit, at, fade = self._below
        dark = np.zeros(hit.shape, np.float32)
        dark[hit] = fade * self._shadow(shapes, at)
        image, (rows, columns) = self._image.copy(), np.nonzero(dark > 1e-3)
        if len(rows):  # the rest is not touched
            top, left = max(rows.min() - 1, 0), max(columns.min() - 1, 0)
            bottom, right = rows.max() + 2, columns.max() + 2
            part = image[COARSE * top : COARSE * bottom, COARSE * left : COARSE * right]
            fine = zoom(dark[top:bottom, left:right], COARSE, order=1, grid_mode=True, mode="nearest")
            part *= 1 - fine[: part.shape[0], : part.shape[1], None]
        return image

    def _floor_points(self, camera, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which picture points (every stride-th) see the floor, where (k, 2) [m], and how clearly (k,)."""
        rows, columns = (np.arange(stride / 2, n + stride - 1, stride) for n in (self.size[1], self.size[0]))
        column, row = np.meshgrid(columns, rows)
        rays = camera.rays(column, row, self.size)
        hit = rays[..., 1] * (self.ground - camera.position[1]) > 0
        along = (self.ground - camera.position[1]) / rays[hit][:, 1]
        at = camera.position[[0, 2]] + along[:, None] * rays[hit][:, [0, 2]]
        far = ((at - self.box.mean(0)[[0, 2]]) ** 2).sum(1)
        return hit, at, np.exp(-far / (3.0 * np.ptp(self.box, 0).max()) ** 2)

    def _without_shadow(self, camera) -> np.ndarray:
        width, height = self.size
        image = (HORIZON + (SKY - HORIZON) * np.linspace(1, 0, height)[:, None, None]) * np.ones((1, width, 1))
        if self.ground is None:
            return image.astype(np.float32)
        hit, at, fade = self._floor_points(camera, 1)
        extent = np.ptp(self.box, 0).max()
        step = grid_step(2.0 * extent)
        away = np.sqrt(((at - camera.position[[0, 2]]) ** 2).sum(1) + (self.ground - camera.position[1]) ** 2)
        pixel, slant = away / camera.focal(self.size), np.abs(self.ground - camera.position[1]) / away
        off = np.abs((at / step + 0.5) % 1 - 0.5) * step
        broad = np.maximum(0.003 * extent, pixel / np.sqrt(slant))
        line = np.clip(1.5 - off.min(1) / broad, 0, 1) * np.clip(0.35 * step * slant / pixel, 0, 1)
        image[hit] += (FLOOR + (LINE - FLOOR) * line[:, None] - image[hit]) * fade[:, None]
        return image.astype(np.float32)

    def _shadow(self, shapes, at: np.ndarray) -> np.ndarray:
        """How much light is kept from floor points `at` (k, 2): the shapes, projected along LIGHT and blurred."""
        from scipy.ndimage import gaussian_filter, map_coordinates

        corners = [np.asarray(points)[triangles] for points, triangles in shapes]
        corners = np.concatenate(corners) if corners else np.zeros((0, 3, 3))
        corners = corners[corners[..., 1].min(1) >= self.ground - 0.05 * np.ptp(self.box, 0).max()]
        if not len(corners):
            return np.zeros(len(at))
        flat = corners[..., [0, 2]] - (corners[..., 1:2] - self.ground) * LIGHT[[0, 2]] / LIGHT[1]
        low, high = flat.min((0, 1)), flat.max((0, 1))
        margin, cells = 0.12 * (high - low).max(), 256
        scale = cells / ((high - low).max() + 2 * margin)
        soft = gaussian_filter(covered((flat - low + margin) * scale, (cells, cells)).astype(np.float32), 3.0)
        column, row = ((at - low + margin) * scale).T - 0.5
        return 0.38 * map_coordinates(soft, [row, column], order=1, cval=0.0)


def grid_step(length: float) -> float:
    """A round distance [m] of which some eight make `length`."""
    power = 10.0 ** np.floor(np.log10(length / 8))
    return float(power * min((1, 2, 5, 10), key=lambda k: abs(np.log(k * power * 8 / length))))
