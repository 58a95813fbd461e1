"""The corners and edges by which an obstacle acts on edges and faces of bodies, and the place of these by its numbers."""

from dataclasses import dataclass

import numpy as np

BOW = 0.12  # of a width: how far a surface may bow over a straight edge before it is felt between the edge's ends
NONE = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Primitives:
    """What bodies feel of an obstacle between their own vertices, as pairs (mechanics/surfaces/obstacle_corners.py).

    points: numbers of the corners that act on faces. edges: two corners of each edge that acts on edges, shape (k, 2).
    Corners lie where the numbers p of the obstacle's shape say, as it was made:

        (corners [m], radius [m]) = at(p),    and derivatives by p

    radius: how far bodies stay from corners and edges, beside the gap of the barrier.
    """

    points: np.ndarray
    edges: np.ndarray

    def felt_by(self, longest: float, width: float) -> "Primitives | None":
        """Those that bodies whose edges are up to `longest` [m] long feel besides at their vertices, by a barrier of a width
        [m]; None if they feel none."""
        return self

    def at(self, p: np.ndarray) -> tuple[np.ndarray, float]:
        raise NotImplementedError

    def jvp(self, p: np.ndarray, dp: np.ndarray) -> tuple[np.ndarray, float]:
        """Their change."""
        raise NotImplementedError

    def vjp(self, p: np.ndarray, by_corners: np.ndarray, by_radius: float) -> np.ndarray:
        """Adjoint of p."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class RoundPrimitives(Primitives):
    """Of all that is within a radius, the last number, of corners, the others."""

    def at(self, p):
        return p[:-1].reshape(-1, 3), float(p[-1])

    def jvp(self, p, dp):
        return self.at(dp)

    def vjp(self, p, by_corners, by_radius):
        return np.append(by_corners.ravel(), by_radius)


@dataclass(frozen=True, eq=False)
class MeshPrimitives(Primitives):
    """Of all that is within a radius, the fourth number, of triangles, segments and points, displaced by the first three.

    turns [rad], spacing [m]: by which angle the surface turns outwards over each edge, and how far away the next edges are.
    Where it turns by an angle t over each s, the middle of a straight edge of length L across it is nearer to it than
    its ends by about

        t L^2 / 6 min(s, L)

    so that edges act for which that is BOW of the width, and their ends; boundaries of open sheets, segments and points
    always do.
    """

    vertices: np.ndarray
    turns: np.ndarray
    spacing: np.ndarray

    @classmethod
    def of(cls, surface, base: np.ndarray) -> "MeshPrimitives":
        """surface: a KinematicSurface; base: what its vertices have less [m]."""
        edges = surface.edges
        turns, spacing = _turns_of(surface, edges)
        return cls(surface.one[surface.points], edges, surface.vertices - base, turns, spacing)

    def felt_by(self, longest, width):
        bow = self.turns * longest**2 / (6 * np.minimum(np.maximum(self.spacing, 1e-300), longest))
        edges = self.edges[bow > BOW * width]
        points = np.union1d(self.points, edges)
        kept, place = np.unique(points, return_inverse=True)
        if not len(kept):
            return None
        number = np.full(len(self.vertices), -1)
        number[kept] = np.arange(len(kept))
        return MeshPrimitives(place.ravel(), number[edges], self.vertices[kept], NONE, NONE)

    def at(self, p):
        return self.vertices + p[:3], float(p[3])

    def jvp(self, p, dp):
        return np.broadcast_to(dp[:3], self.vertices.shape), float(dp[3])

    def vjp(self, p, by_corners, by_radius):
        return np.append(by_corners.sum(0), by_radius)


def _turns_of(surface, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(by which angle the surface turns outwards over each edge, how far its neighbours are from it); pi and zero where it
    has no two triangles."""
    turns, spacing, n = np.full(len(edges), np.pi), np.zeros(len(edges)), len(surface.vertices)
    t, x = surface.one[surface.triangles], surface.vertices
    sides = np.sort(t[:, [[0, 1], [1, 2], [2, 0]]], 2)
    keys, named = edges @ [n, 1], (sides @ [n, 1]).ravel()
    number = np.searchsorted(keys, named)
    known = sides.reshape(-1, 2)[:, 0] != sides.reshape(-1, 2)[:, 1]  # others have no length
    order = np.argsort(np.where(known, number, len(edges)), kind="stable")[: known.sum()]
    two = np.bincount(number[known], minlength=len(edges)) == 2
    two &= ~np.isin(keys, np.sort(surface.one[surface.segments], 1) @ [n, 1])
    first = np.searchsorted(number[order], np.flatnonzero(two))
    f, g = order[first], order[first + 1]  # sides of triangles
    (a, b), across = (x[edges[two]][:, k] for k in (0, 1)), []
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    for side in (f, g):
        apex = x[t[side // 3, (side + 2) % 3]] - a
        across.append(apex - (apex * along).sum(1, keepdims=True) * along)
    size = [np.maximum(np.linalg.norm(y, axis=1), 1e-300) for y in across]
    u, v = (y / s[:, None] for y, s in zip(across, size))
    angle = np.pi - 2 * np.arctan2(np.linalg.norm(u - v, axis=1), np.linalg.norm(u + v, axis=1))
    corners = x[t[f // 3]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    hollow = ((across[1] * normal).sum(1) > 0) & surface.is_sided[f // 3]
    turns[two], spacing[two] = np.where(hollow, 0.0, angle), 0.5 * (size[0] + size[1])
    return turns, spacing


BALL = RoundPrimitives(np.zeros(1, int), np.zeros((0, 2), int))
CAPSULE = RoundPrimitives(np.arange(2), np.array([[0, 1]]))
SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


@dataclass(frozen=True, eq=False)
class BoxPrimitives(Primitives):
    """Of a box: center, size, a quaternion q of any length; corners c + R(q) (signs size / 2)."""

    def at(self, p):
        return p[:3] + 0.5 * (SIGNS * p[3:6]) @ _rotation(p[6:])[0].T, 0.0

    def jvp(self, p, dp):
        R, by_q = _rotation(p[6:])
        turned = np.einsum("dij,d->ij", by_q, dp[6:])
        return dp[:3] + 0.5 * ((SIGNS * dp[3:6]) @ R.T + (SIGNS * p[3:6]) @ turned.T), 0.0

    def vjp(self, p, by_corners, by_radius):
        R, by_q = _rotation(p[6:])
        by_size = 0.5 * (SIGNS * (by_corners @ R)).sum(0)
        by_R = 0.5 * by_corners.T @ (SIGNS * p[3:6])
        return np.concatenate([by_corners.sum(0), by_size, np.einsum("dij,ij->d", by_q, by_R)])


BOX = BoxPrimitives(
    np.arange(8), np.array([[a, b] for a in range(8) for b in range(a + 1, 8) if (SIGNS[a] != SIGNS[b]).sum() == 1])
)


def _rotation(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rotation matrix of a quaternion of any length, its derivatives by the four numbers)."""
    length = np.linalg.norm(q)
    w, x, y, z = q / length
    R = np.eye(3) + 2 * np.array(
        [
            [-y * y - z * z, x * y - w * z, x * z + w * y],
            [x * y + w * z, -x * x - z * z, y * z - w * x],
            [x * z - w * y, y * z + w * x, -x * x - y * y],
        ]
    )
    by_unit = 2 * np.array(
        [
            [[0, -z, y], [z, 0, -x], [-y, x, 0]],
            [[0, y, z], [y, -2 * x, -w], [z, w, -2 * x]],
            [[-2 * y, x, w], [x, 0, z], [-w, z, -2 * y]],
            [[-2 * z, -w, x], [w, -2 * z, y], [x, y, 0]],
        ]
    )
    unit = q / length
    return R, np.einsum("ed,eij->dij", (np.eye(4) - np.outer(unit, unit)) / length, by_unit)
