"""Drawing triangles: without any graphics driver by NumPy with a depth buffer, row by row of each triangle, and through
Vulkan by a Taichi window that no display shows.

Rather than a library: VTK's modules weigh half a gigabyte on disk, matplotlib's Poly3DCollection has no depth buffer. With
Vulkan triangles go through `canvas.triangles`, sorted from far to near: `scene.mesh` has a depth buffer, but keeps 0.3 MB of
memory for every mesh of every frame (Taichi 1.7.4), where this keeps none.
"""

import atexit
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.visual.surface import Soup

if TYPE_CHECKING:
    from taichi.ui import Window


SUPERSAMPLING = 2  # pictures are drawn larger and averaged, which smooths their edges
_open: "list[VulkanPainter]" = []  # two hidden windows at once end in a crash when the process exits


def spans(corners: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(triangle, row, first, end) of every run of pixel centres of a row inside a triangle: columns first .. end - 1.

    corners: (n, 3, 2) in pixels; size: width and height.
    """
    width, height = size
    by_height = np.argsort(corners[..., 1], axis=1)
    (x0, y0), (x1, y1), (x2, y2) = np.take_along_axis(corners, by_height[..., None], 1).transpose(1, 2, 0)
    top, bottom = (np.clip(np.ceil(y - 0.5), 0, height).astype(np.int64) for y in (y0, y2))
    triangle, within = enumerated(bottom - top)
    row = top[triangle] + within
    y = row + 0.5

    def crossing(xa, ya, xb, yb):
        """Columns where the row crosses an edge."""
        slope = (xb - xa) / np.where(yb > ya, yb - ya, 1.0)
        return (xa - slope * ya)[triangle] + slope[triangle] * y

    long = crossing(x0, y0, x2, y2)
    short = np.where(y < y1[triangle], crossing(x0, y0, x1, y1), crossing(x1, y1, x2, y2))
    sides = np.minimum(long, short), np.maximum(long, short)
    first, end = (np.clip(np.ceil(x - 0.5), 0, width).astype(np.int64) for x in sides)
    some = end > first
    return triangle[some], row[some], first[some], end[some]


def enumerated(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, j) of every j = 0 .. counts[k] - 1, in that order."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)


def covered(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which pixels have their centre in some triangle, bool (height, width); corners (n, 3, 2) in pixels."""
    width, height = size
    _, row, first, end = spans(corners, size)
    start, cells = row * (width + 1), height * (width + 1)
    depth = np.bincount(start + first, minlength=cells) - np.bincount(start + end, minlength=cells)
    return np.cumsum(depth.reshape(height, width + 1), 1)[:, :width] > 0


class SoftwarePainter:
    """Paints triangles over a background in NumPy."""

    name = "NumPy"

    def __init__(self, size: tuple[int, int]):
        self.size = tuple(size)

    def paint(self, soup: Soup, background: np.ndarray) -> np.ndarray:
        """RGB in [0, 1], float32 (height, width, 3); soup in pixels of this size."""
        s = SUPERSAMPLING
        width, height = (s * n for n in self.size)
        corners, inverse = soup.corners[..., :2] * s, 1 / soup.corners[..., 2:]
        pixel, triangle, nearness = nearest(corners, inverse, (width, height))
        if not len(pixel):
            return np.array(background)
        of = planes_of(corners, soup.colours * inverse).astype(np.float32)[triangle]  # colour / depth is linear, too
        row, column = np.divmod(pixel, width)
        x, y = (column + 0.5).astype(np.float32), (row + 0.5).astype(np.float32)
        colour = of[..., 0] * x[:, None] + of[..., 1] * y[:, None] + of[..., 2]
        colour /= nearness[:, None].astype(np.float32)
        return _averaged(np.clip(colour, 0, 1), row, column, background)

    def close(self) -> None:
        """Nothing is held."""


def nearest(corners: np.ndarray, inverse: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """(pixels whose centre is in some triangle, ascending; the nearest triangle there, of those equally near the last; the
    inverse of its depth): corners (n, 3, 2) in pixels, and inverses of their depths (n, 3, 1), linear over the picture."""
    width, height = size
    triangle, row, first, end = spans(corners, size)
    plane, (span, along) = planes_of(corners, inverse)[triangle, 0], enumerated(end - first)
    at_start = np.einsum("nk,nk->n", plane, np.stack([first + 0.5, row + 0.5, np.ones(len(row))], 1))
    nearness, pixel = at_start[span] + plane[span, 0] * along, (row * width + first)[span] + along
    most = np.zeros(width * height)
    np.maximum.at(most, pixel, nearness)
    front, winner = np.flatnonzero(nearness == most[pixel]), np.full(width * height, -1)
    winner[pixel[front]] = front
    front = winner[winner >= 0]
    return pixel[front], triangle[span[front]], nearness[front]


def planes_of(corners: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at the corners of triangles, (n, 3, k), as a x + b y + c over the picture: (n, k, 3) of each triangle."""
    (x0, y0), (x1, y1), (x2, y2) = corners.transpose(1, 2, 0)
    area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    area = np.where(np.abs(area) > 1e-12, area, np.inf)
    d1, d2 = (values[:, k] - values[:, 0] for k in (1, 2))
    a = (d1 * (y2 - y0)[:, None] - d2 * (y1 - y0)[:, None]) / area[:, None]
    b = (d2 * (x1 - x0)[:, None] - d1 * (x2 - x0)[:, None]) / area[:, None]
    return np.stack([a, b, values[:, 0] - a * x0[:, None] - b * y0[:, None]], 2)


def _averaged(colour, row, column, background) -> np.ndarray:
    """The background with samples of `colour` at fine rows and columns, averaged to its pixels."""
    s = SUPERSAMPLING
    top, left = row.min() // s, column.min() // s
    shape = s * (row.max() // s - top + 1), s * (column.max() // s - left + 1), 4
    fine = np.zeros(shape, np.float32)
    fine[row - s * top, column - s * left, :3], fine[row - s * top, column - s * left, 3] = colour, 1
    mean = sum(fine[i::s, j::s] for i in range(s) for j in range(s)) / s**2
    out = np.array(background, np.float32)
    part = out[top : top + len(mean), left : left + mean.shape[1]]
    part *= 1 - mean[..., 3:]
    part += mean[..., :3]
    return out


def has_vulkan() -> bool:
    """Whether a Vulkan driver can be had (Mesa's lavapipe is one in software)."""
    return "vulkan" in runtime.available_archs()


class Canvas:
    """A Taichi window's canvas with arrays for a background and for triangles, made once and reused."""

    def __init__(self, window: "Window"):
        self.window, self.canvas = window, window.get_canvas()
        self._room, self._image = 0, None

    def draw(self, soup: Soup, background: np.ndarray, size: tuple[int, int]) -> None:
        """Put triangles, in pixels of a picture of `size`, over a background of any size (it is stretched)."""
        import taichi as ti

        height, width = background.shape[:2]
        if self._image is None or self._image.shape != (width, height):
            self._image = ti.Vector.field(3, ti.f32, (width, height))
        self._image.from_numpy(np.ascontiguousarray(background[::-1].transpose(1, 0, 2), np.float32))
        self.canvas.set_image(self._image)
        if len(soup.corners) > self._room:
            self._room = max(1024, 2 * len(soup.corners))
            self._at, self._colours = (ti.Vector.field(k, ti.f32, 3 * self._room) for k in (2, 3))
        order = np.argsort(-soup.distance, kind="stable")
        at, colours = (np.zeros((3 * self._room, k), np.float32) for k in (2, 3))
        at[: 3 * len(order)] = (soup.corners[order, :, :2] / size).reshape(-1, 2)
        at[:, 1] = 1 - at[:, 1]
        colours[: 3 * len(order)] = soup.colours[order].reshape(-1, 3)
        self._at.from_numpy(at)
        self._colours.from_numpy(colours)
        self.canvas.triangles(self._at, per_vertex_color=self._colours)


class VulkanPainter:
    """Paints triangles over a background in a hidden window. Making another closes it; RuntimeError without Vulkan."""

    name = "Vulkan"

    def __init__(self, size: tuple[int, int]):
        import taichi as ti

        while _open:
            _open[0].close()
        self.size = tuple(size)
        runtime.program()
        with settings_elsewhere():
            window = ti.ui.Window("diffsim_ti", tuple(SUPERSAMPLING * n for n in size), show_window=False)
        self._window, self._canvas = window, Canvas(window)
        _open.append(self)

    def paint(self, soup: Soup, background: np.ndarray) -> np.ndarray:
        """RGB in [0, 1], float32 (height, width, 3); soup in pixels of this size."""
        if self._window is None:
            raise RuntimeError("this drawing was closed, or another took the one hidden window; make a new one")
        self._canvas.draw(soup, background, self.size)
        s, (width, height) = SUPERSAMPLING, self.size
        seen = self._window.get_image_buffer_as_numpy()
        seen = sum(seen[i::s, j::s, :3] for i in range(s) for j in range(s)) / s**2
        return seen.reshape(width, height, 3).transpose(1, 0, 2)[::-1]

    def close(self) -> None:
        """Destroy the window."""
        if self._window is not None:
            with settings_elsewhere():
                self._window.destroy()
            self._window = self._canvas = None
            _open.remove(self)


@atexit.register
def _close_all() -> None:
    while _open:
        _open[0].close()


@contextmanager
def settings_elsewhere() -> Iterator[None]:
    """The window's toolkit leaves an imgui.ini in the working directory; let that be a temporary one."""
    here = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(here)
