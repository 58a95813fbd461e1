"""The volume that triangles of a surface enclose, with lids over what is open."""

from copy import copy
from itertools import combinations

import numpy as np

from diffsim_ti.differentiation.arrays import cross, summed_at, value_of, with_slopes
from diffsim_ti.mesh import reference_face
from diffsim_ti.mesh.sets import components

FLAT = 1e-6  # of the size of a surface: how far its rim may lie off the planes that hold it


def open_edges(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """Directed edges (i, j) that have no edge (j, i) against them, shape (k, 2); one of each where several are left. Of
    faces of six nodes (i, j, mid-edge vertex), shape (k, 3)."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = np.sort(edges, 1).T
    key, sense = low * num_vertices + high, np.where(edges[:, 0] == low, 1, -1)
    keys, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    net = np.bincount(inverse.ravel(), sense, len(keys)).astype(int)
    rim = np.stack(np.divmod(keys[net != 0], num_vertices), 1)
    rim = np.where(net[net != 0, None] > 0, rim, rim[:, ::-1])
    return rim if faces.shape[1] == 3 else np.column_stack([rim, faces[:, 3:].ravel()[first[net != 0]]])


def spanned_by_edges(edges: np.ndarray, free: np.ndarray, x: np.ndarray) -> np.ndarray:
    """What each edge's vertices may do, with the edge itself, as rows that span it, shape (k, 7, 3), or (k, 11, 3).

    free: projectors on what each vertex may do, shape (num_vertices, 3, 3).
    """
    i, *others = edges.T
    along = [x[j] - x[i] for j in others]
    along = [a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300) for a in along]
    return np.concatenate([free[i], *(free[j] for j in others), *(a[:, None] for a in along)], 1)


class Enclosure:
    """V = -1/6 sum over triangles of w (a - o) . ((b - o) x (c - o)) [m^3], triangles turned as the surface of the body is,
    whose normals point into the volume.

    faces: the surface, (k, 3) or (k, 6). triangles: (k, 3), of weight w = 1, after those of the surface, `num_own` of them,
    those of lids: a rim that is fixed wholly, or in one plane, is closed by triangles from its first vertex. One in several
    planes is closed by parts of these, which add nothing where o is the point that the planes share, `point`. Otherwise o
    is the first vertex, and V the same from anywhere. The volume under a face of six nodes is cubic in their places: all 20
    triangles of its nodes with weights, and three for a curved edge of a lid.
    Mirtich 1996, Fast and accurate computation of polyhedral mass properties, doi:10.1080/10867651.1996.10487458.
    """

    def __init__(self, faces: np.ndarray, lids: list[tuple[int, int, int, float]], point: np.ndarray | None):
        own, weights = weighted_triangles(faces)
        self.faces, self.num_own, self.point = faces, len(own), point
        rows = np.array([lid[:3] for lid in lids], np.int64).reshape(-1, 3)
        self.triangles = np.concatenate([own, rows])
        self.weights = np.concatenate([weights, [lid[3] for lid in lids]])

    @classmethod
    def of(cls, own: np.ndarray, free: np.ndarray, x: np.ndarray, name: str, moves: bool = False) -> "Enclosure":
        """Of a surface's faces on a body whose vertices may do `free` (projectors, (num_vertices, 3, 3)) from rest x.

        moves: whether something moves what holds the body. Raises ValueError, which calls the surface `name`, where V is not
        well defined, or not positive.
        """
        rim, point, lids = open_edges(own, len(x)), None, []
        rows = spanned_by_edges(rim, free, x)
        loose = np.linalg.matrix_rank(rows, tol=1e-9) > 2 if len(rim) else np.zeros(0, bool)
        if loose.any():
            i, j = rim[np.argmax(loose), :2]
            raise ValueError(
                f"{name}: the surface is open at the edge of vertices {i} and {j}, which moves freely, so that it encloses "
                "no volume: name all triangles of the cavity, or hold its rim wholly or in a plane (fixed={...})"
            )
        for loop in _loops(rim):
            edges = rim[loop]
            shared = _shared_point(edges, rows[loop], x, name)
            if shared is None:
                first = edges[0, 0]
                lids += [lid for edge in edges for lid in _lid(edge, first) if first not in lid[:2]]
            elif point is not None and np.linalg.norm(shared - point) > FLAT * np.ptp(x[own.ravel()], 0).max():
                raise ValueError(f"{name}: two rims lie in planes that share no point: name the cavities one by one")
            elif moves:
                raise ValueError(f"{name}: its rim lies in several planes, which must not be moved: drop motion=")
            else:
                point = shared
        out = cls(own, lids, point)
        if not out.volume(x) > 0:
            raise ValueError(
                f"{name}: the surface encloses {out.volume(x):.3g} m^3 at rest; normals of the body must point into the "
                "chamber: name the triangles of a cavity"
            )
        return out

    def _corners(self, x: np.ndarray) -> np.ndarray:
        return (x - (x[self.triangles[0, 0]] if self.point is None else self.point))[self.triangles]

    def volume(self, x: np.ndarray) -> float:
        """V at positions x, shape (num_vertices, 3)."""
        a, b, c = np.moveaxis(self._corners(x), 1, 0)
        return float((self.weights[:, None] * a * cross(b, c)).sum()) / -6

    def recorded(self, x: np.ndarray) -> np.ndarray:
        """V; of arrays that record, too (differentiation/arrays.py)."""
        places = np.asarray(value_of(x), np.float64)
        return with_slopes(self.volume(places), (x, lambda: self.gradient(places)))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """dV/dx, shape (num_vertices, 3); what is held counts too."""
        y = self._corners(x)
        by = np.stack([cross(y[:, (a + 1) % 3], y[:, (a + 2) % 3]) for a in range(3)], 1)
        return self._summed(by, len(x))

    def _summed(self, by: np.ndarray, num_vertices: int) -> np.ndarray:
        """What triangles' corners have, weighted, at the vertices."""
        return summed_at(self.triangles, self.weights[:, None, None] * by / -6, num_vertices)

    def gradient_jvp(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Change of `gradient` for that of x; as a function of dx symmetric, so its own adjoint."""
        y, dy = self._corners(x), dx[self.triangles]
        if self.point is None:
            dy = dy - dx[self.triangles[0, 0]]
        nexts = [((a + 1) % 3, (a + 2) % 3) for a in range(3)]
        by = np.stack([cross(dy[:, b], y[:, c]) + cross(y[:, b], dy[:, c]) for b, c in nexts], 1)
        return self._summed(by, len(x))

    def of_nodes(self, nodes: np.ndarray) -> "Enclosure":
        """The same for positions of these vertices alone, sorted indices with all of the triangles' among them."""
        out = copy(self)
        out.faces, out.triangles = np.searchsorted(nodes, self.faces), np.searchsorted(nodes, self.triangles)
        return out

    def change(self, x: np.ndarray, step: np.ndarray) -> float:
        """V(x + step) - V(x), without the rounding of a difference: V is a cubic along a step."""
        by = self.gradient(x) + 4 * self.gradient(x + 0.5 * step) + self.gradient(x + step)
        return float((by * step).sum()) / 6


def weighted_triangles(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(triangles (k, 3), weights (k,)) whose cones have the volume of those of the faces."""
    if faces.shape[1] == 3:
        return faces, np.ones(len(faces))
    N, by = reference_face.functions(reference_face.POINTS), reference_face.derivatives(reference_face.POINTS)
    parts = np.einsum("q,qa,qb,qc->abc", reference_face.WEIGHTS, N, by[..., 0], by[..., 1])
    triples = np.array(list(combinations(range(6), 3)))
    turns = [((0, 1, 2), 1), ((1, 2, 0), 1), ((2, 0, 1), 1), ((0, 2, 1), -1), ((2, 1, 0), -1), ((1, 0, 2), -1)]
    weights = sum(sign * parts[tuple(triples[:, list(turn)].T)] for turn, sign in turns)
    return faces[:, triples].reshape(-1, 3), np.tile(weights, len(faces))


def _lid(edge: np.ndarray, first: int) -> list[tuple[int, int, int, float]]:
    """Triangles with weights, of a lid from a vertex to an edge, straight, or a parabola through its middle vertex."""
    if len(edge) == 2:
        i, j = edge
        return [(j, i, first, 1.0)]
    i, j, m = edge
    return [(m, i, first, 4 / 3), (j, m, first, 4 / 3), (j, i, first, -1 / 3)]


def _loops(rim: np.ndarray) -> list[np.ndarray]:
    """Rows of the rim's edges, one array for each connected part."""
    if len(rim) == 0:
        return []
    names, place = np.unique(rim[:, :2], return_inverse=True)
    i, j = place.reshape(-1, 2).T
    part = components(i, j, len(names))
    return [np.flatnonzero(part[i] == k) for k in range(part.max() + 1)]


def _shared_point(edges: np.ndarray, rows: np.ndarray, x: np.ndarray, name: str) -> np.ndarray | None:
    """The point that all planes share in which a rim may move; None where it is one plane, or the rim does not move.

    rows: as `spanned_by_edges` gives them.
    """
    places = x[np.unique(edges)]
    middle, size = places.mean(0), float(np.ptp(places, 0).max())
    moves = np.abs(rows[:, : 3 * edges.shape[1]]).max((1, 2)) > 0
    _, sizes, V = np.linalg.svd(rows[moves])
    flat = sizes[:, 1] > 1e-6 if moves.any() else np.zeros(0, bool)  # one that slides along itself lies in any plane
    n, off = V[flat, 2], ((x[edges[moves][flat, 0]] - middle) * V[flat, 2]).sum(1)
    if np.abs(off).max(initial=0.0) <= FLAT * size:
        return None
    step, *_ = np.linalg.lstsq(n, off, rcond=1e-6)
    if np.abs(n @ step - off).max() > FLAT * size:
        raise ValueError(
            f"{name}: the rim of the surface lies in planes that share no point, so that no lid is known: name cavities "
            "with rims in one plane each, or in planes through one point"
        )
    return middle + step
