"""Obstacles of every kind, laid against a body so that their barriers act from the start, or from some time on."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import diffsim_ti as ds

from .structures import CELL, ObstacleKind

MESH_SIZE, MESH_WIDTH = (
    np.array([5.0, 4.0, 4.5]) * CELL,
    0.4 * CELL,
)  # kernels hold the table of a mesh: it stays the same
MESH_TURN = Rotation.from_rotvec([0.3, -0.2, 0.4])


@dataclass(frozen=True)
class Placed:
    """A term, and the distance of points from it by formulas of this fuzz's own."""

    term: object
    kind: ObstacleKind
    distance: Callable
    width: float
    friction_speed: float

    def touching(self, x: np.ndarray, v: np.ndarray, offset, speed) -> tuple[np.ndarray, np.ndarray]:
        """(whether points are within the width, their tangential speeds beside the obstacle's [m/s])."""
        d = self.distance(x - offset)
        eps = 1e-5 * CELL
        n = np.stack([(self.distance(x - offset + eps * e) - d) / eps for e in np.eye(3)], 1)
        relative = v - speed
        along = relative - (relative * n).sum(1, keepdims=True) * n
        return d < self.width, np.linalg.norm(along, axis=1)


def frame(n, rng) -> np.ndarray:
    """An orthonormal matrix whose second column is n, turned about it at random."""
    a = np.cross(n, rng.standard_normal(3))
    a /= np.linalg.norm(a)
    return np.stack([a, n, np.cross(a, n)], 1)


def box_distance(local: np.ndarray, size) -> np.ndarray:
    q = np.abs(local) - np.asarray(size) / 2
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)


def box_surface():
    box = ds.TetrahedralMesh.create_box(2, size=tuple(MESH_SIZE))
    return MESH_TURN.apply(box.vertices - MESH_SIZE / 2), box.surface_triangles


def push_direction(name: str, rng) -> np.ndarray:
    """A direction in which an obstacle of this kind may push."""
    if name == "Ground":
        return np.array([0.0, 1.0, 0.0])
    if name == "MeshObstacle":
        return MESH_TURN.as_matrix()[:, rng.integers(0, 3)] * rng.choice([-1, 1])
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def place(
    kind: ObstacleKind, rng, x: np.ndarray, n: np.ndarray, width: float, options: dict, p=None, calm=1.0, late=False
) -> Placed:
    """An obstacle that pushes the points x along n and begins a part of its width below the lowest of them, or below p.
    calm: share of a blade that is there; late: about all of its width, so that what moves acts in some passes alone."""
    p, gap = x[np.argmin(x @ n)] if p is None else p, width * (rng.uniform(0.3, 0.8) + 0.4 * late)
    foot, turned = p - gap * n, frame(n, rng)
    aside = turned[:, 0] * rng.uniform(-1, 1) + turned[:, 2] * rng.uniform(-1, 1)
    options = options | dict(width=width)
    radius = rng.uniform(1.0, 4.0) * CELL * (0.05 if kind.narrow else 1.0)
    if kind.name == "Ground":
        term, distance = ds.Ground(height=foot[1], **options), lambda y: y[:, 1] - foot[1]
    elif kind.name == "HalfSpace":
        point = foot + CELL * aside
        term = ds.HalfSpace(point=point, normal=n * rng.uniform(0.5, 2.0), **options)
        distance = lambda y: (y - point) @ n  # noqa: E731
    elif kind.name == "Sphere":
        center = foot - radius * n
        term = ds.Sphere(center=center, radius=radius, **options)
        distance = lambda y: np.linalg.norm(y - center, axis=1) - radius  # noqa: E731
    elif kind.name == "Bowl":
        center = x.mean(0) + 0.3 * CELL * rng.uniform(-1, 1, 3)
        around = np.linalg.norm(x - center, axis=1).max() + gap
        term = ds.Sphere(center=center, radius=around, inside=True, **options)
        distance = lambda y: around - np.linalg.norm(y - center, axis=1)  # noqa: E731
    elif kind.name == "Box":
        size = CELL * rng.uniform(2.0, 6.0, 3) * ([0.05, calm, calm] if kind.narrow else 1.0)
        center = foot - size[1] / 2 * n + 0.5 * aside * size[[0, 2]].min() * 0.9
        turn = Rotation.from_matrix(turned)
        term = ds.Box(center=center, size=size, rotation=turn.as_rotvec(), **options)
        distance = lambda y: box_distance(turn.inv().apply(y - center), size)  # noqa: E731
    elif kind.name in ("Capsule", "Cylinder"):
        term, distance = _round(kind.name, rng, foot, n, turned, radius, options)
    else:
        vertices, triangles = box_surface()
        depth = MESH_SIZE @ np.abs(MESH_TURN.inv().apply(n)) / 2
        radius = 0.1 * CELL * rng.uniform(0, 1)
        position = foot - (depth + radius) * n + 0.5 * CELL * aside
        term = ds.MeshObstacle(vertices, triangles, position=position, radius=radius, shapeable=True, **options)
        distance = lambda y: box_distance(MESH_TURN.inv().apply(y - position), MESH_SIZE) - radius  # noqa: E731
    return Placed(term, kind, distance, width, options.get("friction_speed", 0.0))


def _round(name: str, rng, foot, n, turned, radius, options):
    """A capsule or a cylinder, met at its side or at its end."""
    if rng.random() < 0.7:
        middle, axis = foot - radius * n + CELL * rng.uniform(-1, 1) * turned[:, 0], turned[:, 0]
        a, b = middle - rng.uniform(1, 4) * CELL * axis, middle + rng.uniform(1, 4) * CELL * axis
    else:
        end = foot + CELL * rng.uniform(-0.5, 0.5) * turned[:, 0] if name == "Cylinder" else foot - radius * n
        radius = radius + 2 * CELL * (name == "Cylinder" and radius > 0.5 * CELL)
        a, b = end - rng.uniform(1, 4) * CELL * n, end
    kind = ds.Capsule if name == "Capsule" else ds.Cylinder
    axis, length = (b - a) / np.linalg.norm(b - a), np.linalg.norm(b - a)

    def distance(y):
        along = (y - a) @ axis
        if name == "Capsule":
            return np.linalg.norm(y - a - np.clip(along, 0, length)[:, None] * axis, axis=1) - radius
        across = np.linalg.norm(y - a - along[:, None] * axis, axis=1)
        q = np.stack([across - radius, np.abs(along - length / 2) - length / 2], 1)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    return kind(a, b, radius, **options), distance
