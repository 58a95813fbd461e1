"""Triangles, segments and points that an obstacle consists of: their edges, and which side of them is inside."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim_ti.common.checked import numbers, shown, wholes
from diffsim_ti.differentiation.arrays import cross
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.mesh.sets import components

CORNERS = dict(triangles=3, segments=2, points=1)


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """vertices [m], shape (k, 3); triangles, shape (t, 3), segments, (s, 2), and points, (p,), which name them by index.

    Vertices in one place are one to the topology (`one`), so that surfaces whose triangles share none are
    closed, too. Parts that are closed and oriented have an inside, others act on both sides alike.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    segments: np.ndarray
    points: np.ndarray

    @classmethod
    def checked(cls, owner: str, vertices, triangles, segments, points) -> "SurfaceMesh":
        """Of what a user gives; where nothing names vertices, all of them are points. Raises ValueError."""
        vertices = numbers(f"{owner}: vertices", vertices)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
            raise ValueError(f"{owner}: vertices must be finite, of shape (k, 3), got {shown(vertices)}")
        if not np.all(np.isfinite(vertices)):
            k = int(np.flatnonzero(~np.isfinite(vertices).all(1))[0])
            raise ValueError(f"{owner}: vertices must be finite, of shape (k, 3), got {vertices[k]} of vertex {k}")
        if triangles is None and segments is None and points is None:
            points = np.arange(len(vertices))
        parts = dict(triangles=triangles, segments=segments, points=points)
        for name, corners in CORNERS.items():
            part = wholes(f"{owner}: {name}", np.zeros((0, corners)) if parts[name] is None else parts[name])
            part = part[:, None] if corners == 1 and part.ndim == 1 else part
            part = part.reshape(-1, corners) if not part.size else part
            if part.ndim != 2 or part.shape[1] != corners:
                raise ValueError(f"{owner}: {name} must have shape (m, {corners}), got {part.shape}")
            if part.size and not 0 <= part.min() <= part.max() < len(vertices):
                outside = part.min() if part.min() < 0 else part.max()
                raise ValueError(
                    f"{owner}: {name} must name vertices by index, 0 to {len(vertices) - 1}, got {outside}"
                    + "; these count from 1: subtract 1" * bool(part.min() == 1 and outside == len(vertices))
                )
            parts[name] = part
        if not any(len(part) for part in parts.values()):
            raise ValueError(f"{owner}: give it at least one triangle, segment or point")
        return cls(vertices, parts["triangles"], parts["segments"], parts["points"][:, 0])

    @cached_property
    def one(self) -> np.ndarray:
        """Of each vertex the first that lies where it does, shape (k,)."""
        order = np.lexsort(self.vertices.T)  # stable, so that the first of those in one place comes first
        new = np.ones(len(order), bool)
        new[1:] = (np.diff(self.vertices[order], axis=0) != 0).any(1)
        out = np.empty(len(order), np.int64)
        out[order] = order[new][np.cumsum(new) - 1]
        return out

    @cached_property
    def _edges_of_triangles(self) -> tuple[np.ndarray, np.ndarray]:
        return edges_of(self.one[self.triangles])

    def sharp_edges(self, length: float, bow: float) -> np.ndarray:
        """Edges that act on a flat face of this length [m]: segments, edges of one triangle or of more than two, and
        those where a face that rests on the surface lies more than a bow [m] off it, shape (e, 2).

        Where two triangles of height h bend by phi, away from where the body may be, that is phi length^2 / 6 h, as over
        a ball of radius h / phi, or phi length / 6 if it is shorter than they are.
        """
        edges, which = self._edges_of_triangles
        real = np.flatnonzero(self._is_real)
        which = which[real].ravel()
        count, order = np.bincount(which, minlength=len(edges)), np.argsort(which, kind="stable")
        first = (np.cumsum(count) - count)[count == 2]
        x, keeps = self.vertices[self.triangles[real]], (count != 2) & (count > 0)
        (f, g), (i, j) = np.divmod(order[np.stack([first, first + 1])], 3)  # an edge's triangles, and their sides
        along = x[f, (i + 1) % 3] - x[f, i]
        along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        a, b = x[f, (i + 2) % 3] - x[f, i], x[g, (j + 2) % 3] - x[f, i]
        a, b = (y - np.einsum("ij,ij->i", y, along)[:, None] * along for y in (a, b))
        height = np.minimum(*(np.linalg.norm(y, axis=1) for y in (a, b)))
        bend = np.arctan2(np.linalg.norm(cross(a, b), axis=1), -np.einsum("ij,ij->i", a, b))
        is_concave = self.is_sided[real][f] & (
            np.einsum("ij,ij->i", cross(x[f, 1] - x[f, 0], x[f, 2] - x[f, 0]), b) > 0
        )
        keeps[count == 2] = ~is_concave & (bend * length * np.maximum(length / height.clip(1e-300), 1) > 6 * bow)
        out = np.unique(np.concatenate([edges[keeps], np.sort(self.one[self.segments], 1)]), axis=0)
        return out[out[:, 0] < out[:, 1]]

    @cached_property
    def shares(self) -> np.ndarray:
        """How often each triangle, segment and point counts in a sum over all that is near, and its sides ab, bc, ca and its
        corners a, b, c, shape (m, 7): what two of them share counts once, as a side of two triangles that is taken from
        their sum, or a corner that is added to that. Segments are (i, j, j), points (i, i, i).
        Li, Kaufman, Jiang 2023, Convergent Incremental Potential Contact, arXiv:2307.15908.
        """
        (t, s, p), n = (self.one[x] for x in (self.triangles, self.segments, self.points)), len(self.vertices)
        corners = np.concatenate([t, s[:, [0, 1, 1]], p[:, None][:, [0, 0, 0]]])
        a, b, c = corners.T
        edges, which = edges_of(corners)
        side = np.stack([a != b, (b != c) & (a != c), (c != a) & (a != b) & (b != c)], 1)
        corner = np.stack([a == a, a != b, (c != a) & (c != b)], 1)
        faces = np.flatnonzero(side.all(1))
        two = np.sort(which[faces], 1)
        _, same, times = np.unique(two[:, 0] * len(edges) + two[:, 1], return_inverse=True, return_counts=True)
        out = np.zeros((len(corners), 7))
        out[faces, 0] = 1 / times[same]
        count = np.bincount(which.ravel(), side.ravel(), len(edges))
        of_side = np.where(count > 0, 1 - np.bincount(which.ravel(), np.repeat(out[:, 0], 3), len(edges)), 0)
        out[:, 1:4] = side * (of_side / np.maximum(count, 1))[which]
        of_corner = 1 - np.bincount(corners.ravel(), np.repeat(out[:, 0], 3), n)
        for end in edges.T:
            of_corner -= np.bincount(end, of_side, n)
        out[:, 4:] = corner * (of_corner / np.maximum(np.bincount(corners.ravel(), corner.ravel(), n), 1))[corners]
        return out

    @cached_property
    def _is_real(self) -> np.ndarray:
        """Whether a triangle's corners lie in three places; the neighbours of others meet."""
        t = self.one[self.triangles]
        return (t != np.roll(t, -1, axis=1)).all(1)

    @cached_property
    def is_sided(self) -> np.ndarray:
        """Whether each triangle belongs to a part that is closed and oriented, each edge being passed once each way."""
        if not len(self.triangles):
            return np.zeros(0, bool)
        t, (edges, which) = self.one[self.triangles], self._edges_of_triangles
        following, real = np.roll(t, -1, axis=1), self._is_real[:, None]
        count = np.bincount(which.ravel(), np.repeat(real, 3), len(edges))
        net = np.bincount(which.ravel(), (real * np.where(t < following, 1, -1)).ravel(), len(edges))
        fits = ((count == 2) & (net == 0))[which].all(1) | ~real[:, 0]
        body = components(t[:, [0, 1]].ravel(), t[:, [1, 2]].ravel(), len(self.vertices))[t[:, 0]]
        good = np.ones(body.max() + 1, bool)
        good[body[~fits]] = False
        return good[body]

    @cached_property
    def pseudonormals(self) -> tuple[np.ndarray, np.ndarray]:
        """Outward directions, of sides ab, bc, ca of each triangle, (t, 3, 3), and of vertices, (k, 3), zero where there is
        no inside: sums over the triangles there, at vertices weighted by their angles.

        Baerentzen, Aanaes 2005, Signed distance computation using the angle weighted pseudonormal, doi:10.1109/TVCG.2005.49.
        """
        x, sided = self.vertices[self.triangles], self.is_sided
        normals = cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300) * sided[:, None]
        edges, which = self._edges_of_triangles
        of_edges, of_vertices = np.zeros((len(edges), 3)), np.zeros_like(self.vertices)
        for a in range(3):
            b, c = x[:, (a + 1) % 3] - x[:, a], x[:, (a + 2) % 3] - x[:, a]
            angle = np.arctan2(np.linalg.norm(cross(b, c), axis=1), np.einsum("ij,ij->i", b, c))
            for d in range(3):
                of_edges[:, d] += np.bincount(which[:, a], normals[:, d], len(edges))
                own = self.one[self.triangles[:, a]]
                of_vertices[:, d] += np.bincount(own, angle * normals[:, d], len(self.vertices))
        return of_edges[which], of_vertices[self.one]
