"""The corners and edges by which an obstacle acts on edges and faces of bodies, and the place of these by its numbers."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Primitives:
    """By what an obstacle acts on bodies between their own vertices, as pairs (mechanics/surfaces/obstacle_corners.py).

    points: numbers of the corners that act on faces. edges: two corners of each edge that acts on edges, shape (k, 2).
    Corners lie where the numbers p of the obstacle's shape say, as it was made:

        (corners [m], radius [m]) = at(p)

    radius: how far bodies stay from corners and edges, beside the gap of the barrier.
    """

    points: np.ndarray
    edges: np.ndarray

    whole = False  # whether they are all of the obstacle, so that nothing of it acts by its distance alone
    many = False  # whether they are so many that a run has those near bodies alone, by `of_some`

    def at(self, p: np.ndarray) -> tuple[np.ndarray, float]:
        """By functions that record (differentiation/arrays.py)."""
        raise NotImplementedError


@dataclass(frozen=True)
class RoundPrimitives(Primitives):
    """Of all that is within a radius, the last number, of corners, the others."""

    whole = True

    def at(self, p):
        return p[:-1].reshape(-1, 3), p[-1]


BALL = RoundPrimitives(np.zeros(1, int), np.zeros((0, 2), int))
CAPSULE = RoundPrimitives(np.arange(2), np.array([[0, 1]]))
SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


@dataclass(frozen=True)
class BoxPrimitives(Primitives):
    """Of a box: center, size, a quaternion q of any length; corners c + R(q) (signs size / 2)."""

    def at(self, p):
        w, x, y, z = p[6:] / np.linalg.norm(p[6:])
        first, second = [-y * y - z * z, x * y - w * z, x * z + w * y], [x * y + w * z, -x * x - z * z, y * z - w * x]
        R = np.eye(3) + 2 * np.stack([*first, *second, x * z - w * y, y * z + w * x, -x * x - y * y]).reshape(3, 3)
        return p[:3] + 0.5 * (SIGNS * p[3:6]) @ R.T, 0.0


BOX = BoxPrimitives(
    np.arange(8), np.array([[a, b] for a in range(8) for b in range(a + 1, 8) if (SIGNS[a] != SIGNS[b]).sum() == 1])
)


MOST_SIDES = 10_000  # of a cylinder whose radius is not small against anything


@dataclass(frozen=True)
class PrismPrimitives(Primitives):
    """Of a cylinder: start, end, radius; the edges of a prism of `sides` sides whose corners lie on it. across: a direction
    that a first corner lies in, less its part along the axis."""

    sides: int
    across: np.ndarray

    @classmethod
    def of(cls, axis: np.ndarray, radius: float, off: float) -> "PrismPrimitives":
        """Of a cylinder with an axis [m], from which it is off by so much at most [m]."""
        angle = np.arccos(max(1 - off / radius, 0.0))
        n = int(np.clip(np.ceil(np.pi / max(angle, 1e-300)), 8, MOST_SIDES))
        ring, following = np.arange(n), np.roll(np.arange(n), -1)
        pairs = (ring, following), (n + ring, n + following), (ring, n + ring)
        edges = np.concatenate([np.stack(pair, 1) for pair in pairs])
        return cls(np.arange(2 * n), edges, n, np.eye(3)[np.abs(axis).argmin()])

    def at(self, p):
        start, end, radius = p[:3], p[3:6], p[6]
        axis = (end - start) / np.sqrt(((end - start) ** 2).sum())
        a = self.across - axis * (axis @ self.across)
        a = a / np.sqrt((a**2).sum())
        angle = 2 * np.pi * np.arange(self.sides) / self.sides
        ring = radius * (np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * np.cross(axis, a))
        return np.concatenate([start + ring, end + ring]), 0.0
