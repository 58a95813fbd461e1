"""Drawing triangles without any graphics driver: NumPy with a depth buffer, row by row of each triangle.

Rather than a library: VTK's modules weigh half a gigabyte on disk, matplotlib's Poly3DCollection has no depth buffer.
"""

import numpy as np

from diffsim_ti.visual.surface import Soup

SUPERSAMPLING = 2  # pictures are drawn larger and averaged, which smooths their edges


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
        corners = soup.corners[..., :2] * s
        triangle, row, first, end = spans(corners, (width, height))
        if not len(triangle):
            return np.array(background)
        inverse = 1 / soup.corners[..., 2:]  # which, as colour / depth, is linear over the picture
        planes = planes_of(corners, np.concatenate([inverse, soup.colours * inverse], 2))
        span, along = enumerated(end - first)
        at_start = np.einsum("nk,nk->n", planes[triangle, 0], np.stack([first + 0.5, row + 0.5, np.ones(len(row))], 1))
        nearness = at_start[span] + planes[triangle, 0, 0][span] * along
        pixel = (row * width + first)[span] + along
        nearest = np.zeros(width * height)
        np.maximum.at(nearest, pixel, nearness)
        front = np.flatnonzero(nearness == nearest[pixel])
        winner = np.full(width * height, -1)
        winner[pixel[front]] = front  # of triangles equally near, the last
        front = winner[winner >= 0]

        of, pixel = planes[:, 1:].astype(np.float32)[triangle[span[front]]], pixel[front]
        row, column = np.divmod(pixel, width)
        x, y = (column + 0.5).astype(np.float32), (row + 0.5).astype(np.float32)
        colour = of[..., 0] * x[:, None] + of[..., 1] * y[:, None] + of[..., 2]
        colour /= nearness[front, None].astype(np.float32)
        return _averaged(np.clip(colour, 0, 1), row, column, background)

    def close(self) -> None:
        """Nothing is held."""


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
