"""Triangles of simple shapes, of which obstacles make what is drawn of them: (points [m], shape (k, 3), triangles)."""

import numpy as np
from numpy.typing import ArrayLike

ROUND = 32  # sides of what is round
Triangles = tuple[np.ndarray, np.ndarray]


def revolved(center: ArrayLike, axis: ArrayLike, along: np.ndarray, radius: np.ndarray) -> Triangles:
    """A surface of revolution: rings `along` the axis from `center` [m], closed where the radius ends in 0."""
    axis = unit(axis)
    first = unit(np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0]))
    angle = np.arange(ROUND) * 2 * np.pi / ROUND
    rim = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first)
    points = np.asarray(center) + along[:, None, None] * axis + radius[:, None, None] * rim
    k, j = np.meshgrid(np.arange(len(along) - 1), np.arange(ROUND), indexing="ij")
    a, b = (k * ROUND + j).ravel(), (k * ROUND + (j + 1) % ROUND).ravel()
    c, d = a + ROUND, b + ROUND
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def ball(center: ArrayLike, radius: float) -> Triangles:
    """A ball, closed and facing outwards: center, radius [m]."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, ROUND // 2 + 1)
    return revolved(center, (0.0, 1.0, 0.0), radius * np.sin(angle), radius * np.cos(angle))


def bowl(center: ArrayLike, radius: float) -> Triangles:
    """The lower half of a hollow ball, center and radius [m]: it faces inwards, so that the side near the eye is not
    drawn."""
    angle = np.linspace(-np.pi / 2, 0, ROUND // 2 + 1)
    points, triangles = revolved(center, (0.0, 1.0, 0.0), radius * np.sin(angle), radius * np.cos(angle))
    return points, triangles[:, ::-1]


def tube(start: ArrayLike, end: ArrayLike, radius: float, rounded: bool) -> Triangles:
    """A cylinder from start to end, of this radius [m], its ends flat or round."""
    length = np.linalg.norm(end - start)
    sides = np.linspace(0, length, 9)
    if rounded:
        angle = np.linspace(0, np.pi / 2, ROUND // 4 + 1)
        along = np.concatenate([-radius * np.cos(angle), sides[1:-1], length + radius * np.sin(angle)])
        return revolved(start, end - start, along, radius * np.concatenate([np.sin(angle), np.ones(7), np.cos(angle)]))
    caps = np.linspace(0, radius, 4)
    along = np.concatenate([np.zeros(4), sides[1:-1], np.full(4, length)])
    return revolved(start, end - start, along, np.concatenate([caps, np.full(7, radius), caps[::-1]]))


def box(center: ArrayLike, size: ArrayLike, quaternion: ArrayLike) -> Triangles:
    """A box, center and size [m], turned by a quaternion (w, x, y, z), its sides in small squares."""
    from scipy.spatial.transform import Rotation

    points, triangles = [], []
    for d in range(3):
        for sign in (-1, 1):
            flat, cells = _grid(8)
            local = np.empty((len(flat), 3))
            local[:, d], local[:, [(d + 1) % 3, (d + 2) % 3]] = 0.5 * sign, flat
            triangles.append((cells if sign > 0 else cells[:, ::-1]) + sum(map(len, points)))
            points.append(local)
    turn = Rotation.from_quat(np.roll(quaternion, -1))
    return turn.apply(np.concatenate(points) * size) + center, np.concatenate(triangles)


def square(point: ArrayLike, normal: ArrayLike, size: float) -> Triangles:
    """A square of a plane, four times as wide as `size` [m]."""
    normal = unit(normal)
    first = unit(np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0]))
    flat, cells = _grid(16)
    return point + 4 * size * (flat[:, :1] * first + flat[:, 1:] * np.cross(normal, first)), cells


def _grid(n: int) -> Triangles:
    """The unit square about 0 in 2 n^2 triangles."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(-0.5, 0.5, n + 1)] * 2, indexing="ij"))
    i, j = (g.ravel() for g in np.meshgrid(*[np.arange(n)] * 2, indexing="ij"))
    a = i * (n + 1) + j
    b, c, d = a + n + 1, a + 1, a + n + 2
    return np.stack([x, y], 1), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def skeleton(surface, r: float) -> Triangles:
    """Triangles of a `SurfaceMesh`, from both sides where they have no inside, and its segments and points as bars and
    stones of a radius [m]."""
    x, t = surface.vertices, surface.triangles
    points, triangles = [x], [t, t[~surface.is_sided][:, ::-1]]
    ends = np.concatenate([surface.segments, np.stack([surface.points, surface.points], 1)])
    corners = np.array(
        [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    )
    sides = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7]]
    sides = np.array([*sides, [2, 7, 6], [3, 0, 4], [3, 4, 7]])
    axis = x[ends[:, 1]] - x[ends[:, 0]]
    axis = np.where(axis.any(1, keepdims=True), axis, [0.0, 0.0, 1.0])
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    first = np.cross(axis, np.where(np.abs(axis[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(axis, first), axis], 1)
    ended = x[ends[:, (corners[:, 2] > 0).astype(int)]]
    points.append((ended + r * np.einsum("kd,mde->mke", corners, frame)).reshape(-1, 3))
    triangles.append((len(x) + len(corners) * np.arange(len(ends))[:, None, None] + sides).reshape(-1, 3))
    return np.concatenate(points), np.concatenate(triangles)


def unit(v: ArrayLike) -> np.ndarray:
    """The vector made one long."""
    return np.asarray(v, np.float64) / np.linalg.norm(v)
