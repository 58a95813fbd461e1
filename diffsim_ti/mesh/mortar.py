"""Integrals over where two surfaces meet whose nodes do not match: the matrices of mortar elements.

    D_ij = int N_i N_j,    M_ij = int N_i N_j',    over the part of surface b that lies on surface a,

N being the functions of the nodes of b, three or six of a face, and N' those of a. Each pair of faces is brought into the
plane of that of b, one is clipped by the other, and the polygon is cut into triangles with a rule that is exact to degree
four, as products of quadratic functions ask for. Faces count as flat, as their corners say.
Puso, Laursen 2004, A mortar segment-to-segment contact method, doi:10.1016/j.cma.2003.06.001.
"""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.mesh import reference_face

OPPOSITE = -0.5  # cosine between the normals of faces that meet, at the most
FEW = 20_000  # pairs whose polygons are made at once


@dataclass(frozen=True)
class Mortar:
    """D and M, sparse, of all vertices of the mesh; gap [m] between the surfaces, the largest; `covered`: which share of
    each face of b lies on a, shape (k,)."""

    D: object
    M: object
    gap: float
    covered: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray, b: np.ndarray, a: np.ndarray, reach: float) -> "Mortar":
        """Of faces b and a, rows of three or six vertices at places x, as far as they lie within `reach` [m]."""
        from scipy.sparse import coo_matrix

        every, n = _near(x, b, a, reach), len(x)
        places, values = ([], []), ([], [])
        covered, gap = np.zeros(len(b)), 0.0
        for first in range(0, len(every), FEW):
            pairs = every[first : first + FEW]
            w, of_b, of_a, height = _points(x, b[pairs[:, 0]], a[pairs[:, 1]])
            near = (np.abs(height) <= reach) | (w == 0)
            pairs, w, of_b, of_a, height = (part[near.all(1)] for part in (pairs, w, of_b, of_a, height))
            gap = max(gap, float(np.abs(height[w > 0]).max(initial=0.0)))
            covered += np.bincount(pairs[:, 0], w.sum(1), len(b))
            rows = b[pairs[:, 0]]
            for k, (columns, other) in enumerate(((rows, of_b), (a[pairs[:, 1]], of_a))):
                blocks = np.einsum("pq,pqi,pqj->pij", w, of_b, other, optimize=True)
                own = np.broadcast_arrays(rows[:, :, None], columns[:, None])
                places[k].append(np.stack([part.ravel() for part in own]))
                values[k].append(blocks.ravel())
        empty = np.zeros((2, 0), np.int64), np.zeros(0)
        parts = [(np.concatenate([empty[0], *p], 1), np.concatenate([empty[1], *v])) for p, v in zip(places, values)]
        D, M = (coo_matrix((v, p), shape=(n, n)).tocsr() for p, v in parts)
        edges = x[b[:, 1:3]] - x[b[:, :1]]
        return cls(D, M, gap, covered / (0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)))


def _near(x: np.ndarray, b: np.ndarray, a: np.ndarray, reach: float) -> np.ndarray:
    """Pairs of faces whose boxes come near and whose normals are opposite, shape (k, 2)."""
    from scipy.spatial import cKDTree

    (B, A), normals, middles, radii = (x[b[:, :3]], x[a[:, :3]]), [], [], []
    for corners in (B, A):
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
        middles.append(corners.mean(1))
        radii.append(np.linalg.norm(corners - corners.mean(1, keepdims=True), axis=2).max(1))
    if not (len(b) and len(a)):
        return np.zeros((0, 2), np.int64)
    found = cKDTree(middles[1]).query_ball_point(middles[0], radii[0] + radii[1].max() + reach)
    pairs = np.stack([np.repeat(np.arange(len(b)), [len(own) for own in found]), np.concatenate(found).astype(int)], 1)
    i, j = pairs.T
    apart = np.maximum(B.min(1)[i] - A.max(1)[j], A.min(1)[j] - B.max(1)[i]).max(1)
    facing = (normals[0][i] * normals[1][j]).sum(1)
    return pairs[(apart <= reach) & (facing < OPPOSITE)]


def _points(x: np.ndarray, b: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of each pair of faces: weights [m^2] of points of where they meet, shape (k, q), the functions of both there, and the
    distance between them [m]."""
    B, A = x[b[:, :3]], x[a[:, :3]]
    e = B[:, 1] - B[:, 0]
    e = e / np.linalg.norm(e, axis=1, keepdims=True)
    n = np.cross(e, B[:, 2] - B[:, 0])
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    frame = np.stack([e, np.cross(n, e), n], 2)
    B, A = (corners - B[:, :1] for corners in (B, A))
    B, A = np.matmul(B, frame)[..., :2], np.matmul(A, frame)
    polygon = _clipped(A[..., :2], B)
    fans = np.stack(np.broadcast_arrays(polygon[:, :1], polygon[:, 1:-1], polygon[:, 2:]), 2)  # (k, triangles, 3, 2)
    p, q = fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0]
    area = 0.5 * np.abs(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])
    st = reference_face.POINTS
    at = np.einsum("qa,ktai->ktqi", np.column_stack([1 - st.sum(1), st]), fans).reshape(len(b), -1, 2)
    w = (area[:, :, None] * reference_face.WEIGHTS).reshape(len(b), -1)
    of_b, of_a = _barycentric(B, at), _barycentric(A[..., :2], at)
    height = np.einsum("kqa,ka->kq", of_a, A[..., 2])
    return w, _functions(of_b, b), _functions(of_a, a), height


def _functions(L: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of the nodes of each face at its points, shape (k, q, 3) or (k, q, 6)."""
    if faces.shape[1] == 3:
        return L
    return reference_face.functions(L[..., 1:].reshape(-1, 2)).reshape(*L.shape[:2], 6)


def _barycentric(triangle: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of points (k, q, 2) in triangles (k, 3, 2), shape (k, q, 3)."""
    edges = np.stack([triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]], 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        (p, q), (r, s) = np.moveaxis(edges, 0, -1)
        inverse = np.moveaxis(np.array([[s, -q], [-r, p]]) / (p * s - q * r), -1, 0)
        st = np.einsum("kij,kqj->kqi", inverse, at - triangle[:, :1])
    return np.concatenate([1 - st.sum(2, keepdims=True), st], 2)


def _clipped(polygon: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """The part of convex polygons (k, v, 2) within triangles (k, 3, 2) whose corners go round to the left; the last corner
    is repeated where there are fewer. Sutherland, Hodgman 1974, doi:10.1145/360767.360802."""
    for k in range(3):
        corner, along = triangle[:, k, None], (triangle[:, (k + 1) % 3] - triangle[:, k])[:, None]
        left = along[..., 0] * (polygon[..., 1] - corner[..., 1]) - along[..., 1] * (polygon[..., 0] - corner[..., 0])
        after, left_after = np.roll(polygon, -1, 1), np.roll(left, -1, 1)
        crosses = (left >= 0) != (left_after >= 0)
        share = np.divide(left, left - left_after, out=np.zeros_like(left), where=crosses)
        cut = polygon + share[..., None] * (after - polygon)
        every = np.stack([polygon, cut], 2).reshape(len(polygon), -1, 2)
        kept = np.stack([left >= 0, crosses], 2).reshape(len(polygon), -1)
        count = kept.sum(1)
        order = np.argsort(~kept, axis=1, kind="stable")
        places = np.minimum(np.arange(max(int(count.max(initial=0)), 3)), np.maximum(count - 1, 0)[:, None])
        order = np.take_along_axis(order, places, 1)
        polygon = np.take_along_axis(every, order[..., None], 1)
    return polygon
