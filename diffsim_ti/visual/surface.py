"""The lit triangles of a picture: surfaces with smooth or sharp edges, wireframe and marks, in picture coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.visual.camera import Camera

LIGHT = np.array([-0.45, 1.0, 0.55]) / np.linalg.norm([-0.45, 1.0, 0.55])
PLAIN, OBSTACLE, EDGE, MARK = (
    np.array(c) for c in ([0.33, 0.55, 0.80], [0.68, 0.68, 0.70], [0.16] * 3, [0.90, 0.35, 0.10])
)
CREASE = np.cos(np.radians(50.0))  # triangles that meet at more than this in the rest shape keep a sharp edge


@dataclass
class Soup:
    """Triangles without shared corners: picture coordinates (column, row, depth) and RGB, both of shape (n, 3, 3).

    distance [m], shape (n,): by which to paint them where there is no depth buffer, the farthest first.
    """

    corners: np.ndarray
    colours: np.ndarray
    distance: np.ndarray

    @staticmethod
    def joined(soups: Sequence["Soup"]) -> "Soup":
        return Soup(*(np.concatenate([getattr(s, part) for s in soups]) for part in ("corners", "colours", "distance")))


class Surface:
    """A closed triangle surface whose points move. points: the shape that tells edges from curves, (k, 3) [m]."""

    def __init__(self, points: ArrayLike, triangles: ArrayLike):
        from scipy.sparse import coo_matrix

        self.points, self.triangles = np.asarray(points, np.float64), np.ascontiguousarray(triangles)
        m, corners = len(self.triangles), self.triangles.ravel()
        used = coo_matrix((np.ones(3 * m), (corners, np.repeat(np.arange(m), 3))), (len(self.points), m)).tocsr()
        around = used[corners].tocoo()  # triangle `col` touches corner `row` of triangle row // 3
        unit = _normalized(triangle_normals(self.points, self.triangles))
        smooth = np.einsum("nd,nd->n", unit[around.row // 3], unit[around.col]) > CREASE
        self._around = coo_matrix((np.ones(smooth.sum()), (around.row[smooth], around.col[smooth])), (3 * m, m)).tocsr()

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Unit normal of each triangle's corners, shape (n, 3, 3): mean of those around, weighted by area, up to creases."""
        return _normalized(self._around @ triangle_normals(points, self.triangles)).reshape(-1, 3, 3)

    def lit(self, points: ArrayLike, colour: ArrayLike, camera: Camera, size: tuple[int, int]) -> Soup:
        """The triangles that face the camera, shaded. colour: RGB of all or of each point, shape (3,) or (k, 3)."""
        screen = camera.project(points, size)[self.triangles]
        (ax, ay), (bx, by) = ((screen[:, k, :2] - screen[:, 0, :2]).T for k in (1, 2))
        seen = (ax * by - ay * bx < 0) & (screen[..., 2].min(1) > 1e-6)
        colour = np.broadcast_to(colour, (len(points), 3))[self.triangles[seen]]
        return Soup(screen[seen], shaded(colour, self.normals(points)[seen]), screen[seen, :, 2].mean(1))


def shaded(colour: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """RGB in light from above the left shoulder and from the sky."""
    diffuse = np.clip(normal @ LIGHT, 0, 1)[..., None]
    return np.clip(colour * (0.57 + 0.13 * normal[..., 1:2] + 0.45 * diffuse) + 0.03, 0, 1)


def with_edges(soup: Soup, width: float) -> Soup:
    """Each triangle framed by a dark line, `width` pixels inside it."""
    xy = soup.corners[..., :2]
    sides = np.linalg.norm(np.roll(xy, -1, 1) - np.roll(xy, 1, 1), axis=2)  # opposite each corner
    girth = np.maximum(sides.sum(1), 1e-12)
    (ax, ay), (bx, by) = ((xy[:, k] - xy[:, 0]).T for k in (1, 2))
    radius = np.abs(ax * by - ay * bx) / girth  # of the inscribed circle
    share = np.minimum(width / np.maximum(radius, 1e-12), 1)[:, None, None]
    weights = (1 - share) * np.eye(3) + share * (sides / girth[:, None])[:, None, :]
    inverse = 1 / soup.corners[..., 2]  # linear over the picture
    inner = np.concatenate([weights @ xy, 1 / (weights @ inverse[..., None])], 2)
    frame = soup.corners * [1, 1, 1 + 1e-6]
    dark = 0.35 * soup.colours + 0.65 * EDGE
    corners, colours = np.stack([frame, inner], 1), np.stack([dark, weights @ soup.colours], 1)
    return Soup(corners.reshape(-1, 3, 3), colours.reshape(-1, 3, 3), np.repeat(soup.distance, 2))


def marks(
    points: ArrayLike, camera: Camera, size: tuple[int, int], radius: float, nearer: float, colour: np.ndarray = MARK
) -> Soup:
    """A disc of `radius` pixels at each point, drawn `nearer` [m] to the eye than it lies."""
    angle = np.linspace(0, 2 * np.pi, 9)
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    middle = camera.project(np.asarray(points, np.float64), size)
    corners = np.repeat(middle[:, None, None, :], 8, 1).repeat(3, 2)
    corners[:, :, 1, :2] += rim[:-1]
    corners[:, :, 2, :2] += rim[1:]
    corners[..., 2] = np.maximum(corners[..., 2] - nearer, 1e-6)
    corners = corners.reshape(-1, 3, 3)
    return Soup(corners, np.broadcast_to(colour, corners.shape), corners[:, :, 2].mean(1))


def _normalized(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300)
