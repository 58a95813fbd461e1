"""Drawing triangles without any graphics driver: NumPy with a depth buffer.

Rather than a library: VTK's modules weigh half a gigabyte on disk, matplotlib's Poly3DCollection has no depth buffer.
"""

import numpy as np

from diffsim_ti.surface import Soup

SUPERSAMPLING = 2  # pictures are drawn larger and averaged, which smooths their edges


def covered_pixels(corners: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(triangle, pixel, weights) of every pixel centre inside a triangle; corners (n, 3, 2) in pixels.

    Triangles are taken in groups of similar size, each group on one square stencil of pixels.
    """
    width, height = size
    low = np.floor(np.clip(corners.min(1), 0, [width, height])).astype(np.int32)
    high = np.ceil(np.clip(corners.max(1), 0, [width, height])).astype(np.int32)
    extent = (high - low).max(1)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    usable = ((high - low).min(1) > 0) & (np.abs(area) > 1e-12)
    found = []
    level = np.ceil(2 * np.log2(np.maximum(extent, 1))).astype(int)
    for power in np.unique(level[usable]):
        side = int(2 ** (power / 2))
        dx, dy = (g.ravel().astype(np.int32) for g in np.meshgrid(np.arange(side), np.arange(side)))
        members = np.flatnonzero(usable & (level == power))
        for chunk in np.array_split(members, -(-members.size * side * side // 500_000)):
            px, py = low[chunk, :1] + dx, low[chunk, 1:] + dy
            x, y = px + 0.5 - corners[chunk, 0, :1], py + 0.5 - corners[chunk, 0, 1:]
            e1, e2, a = edge1[chunk, None], edge2[chunk, None], area[chunk, None]
            b1, b2 = (x * e2[..., 1] - y * e2[..., 0]) / a, (y * e1[..., 0] - x * e1[..., 1]) / a
            inside = (b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (px < width) & (py < height)
            row, _ = np.nonzero(inside)
            b1, b2 = b1[inside], b2[inside]
            found.append((chunk[row], py[inside] * width + px[inside], np.stack([1 - b1 - b2, b1, b2], 1)))
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
    return tuple(np.concatenate(parts) for parts in zip(*found))


class SoftwarePainter:
    """Paints triangles over a background in NumPy."""

    name = "NumPy"

    def __init__(self, size: tuple[int, int]):
        self.size = tuple(size)

    def paint(self, soup: Soup, background: np.ndarray) -> np.ndarray:
        """RGB in [0, 1], float32 (height, width, 3); soup in pixels of this size."""
        s, (width, height) = SUPERSAMPLING, self.size
        triangle, pixel, weights = covered_pixels(soup.corners[..., :2] * s, (width * s, height * s))
        share = weights / soup.corners[triangle, :, 2]
        nearness = share.sum(1)
        nearest = np.zeros(width * s * height * s)
        np.maximum.at(nearest, pixel, nearness)
        front = np.flatnonzero(nearness == nearest[pixel])
        front = front[np.unique(pixel[front], return_index=True)[1]]  # of triangles equally near, one
        colour = np.einsum("nk,nkd->nd", share[front] / nearness[front, None], soup.colours[triangle[front]])
        row, column = np.divmod(pixel[front], width * s)
        coarse, count = row // s * width + column // s, width * height
        painted = np.stack([np.bincount(coarse, colour[:, d], count) for d in range(3)], 1) / s**2
        bare = 1 - np.bincount(coarse, minlength=count)[:, None] / s**2
        return background * bare.reshape(height, width, 1) + painted.reshape(height, width, 3)

    def close(self) -> None:
        """Nothing is held."""
