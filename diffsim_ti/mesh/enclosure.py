"""The volume that triangles of a surface enclose, with lids over what is open."""

import numpy as np

FLAT = 1e-6  # of the size of a surface: how far its rim may lie off the planes that hold it


def open_edges(triangles: np.ndarray, num_vertices: int) -> np.ndarray:
    """Directed edges (i, j) that have no edge (j, i) against them, shape (k, 2); one of each where several are left."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = np.sort(edges, 1).T
    key, sense = low * num_vertices + high, np.where(edges[:, 0] == low, 1, -1)
    keys, inverse = np.unique(key, return_inverse=True)
    net = np.bincount(inverse.ravel(), sense, len(keys)).astype(int)
    rim = np.stack(np.divmod(keys[net != 0], num_vertices), 1)
    return np.where(net[net != 0, None] > 0, rim, rim[:, ::-1])


def spanned_by_edges(edges: np.ndarray, free: np.ndarray, x: np.ndarray) -> np.ndarray:
    """What each edge's ends may do, with the edge itself, as rows that span it, shape (k, 7, 3).

    free: projectors on what each vertex may do, shape (num_vertices, 3, 3).
    """
    i, j = edges.T
    along = x[j] - x[i]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    return np.concatenate([free[i], free[j], along[:, None]], 1)


class Enclosure:
    """V = -1/6 sum over triangles of (a - o) . ((b - o) x (c - o)) [m^3], triangles turned as the surface of the body is,
    whose normals point into the volume.

    triangles: (k, 3), after those of the surface, `num_own` of them, those of lids: a rim that is held wholly, or in one
    plane, is closed by triangles from its first vertex. One in several planes is closed by parts of these, which add nothing
    where o is the point that the planes share, `point`. Otherwise o is the first vertex, and V the same from anywhere.
    Mirtich 1996, Fast and accurate computation of polyhedral mass properties, doi:10.1080/10867651.1996.10487458.
    """

    def __init__(self, triangles: np.ndarray, num_own: int, point: np.ndarray | None):
        self.triangles, self.num_own, self.point = triangles, num_own, point

    @classmethod
    def of(cls, own: np.ndarray, free: np.ndarray, x: np.ndarray, name: str, moves: bool = False) -> "Enclosure":
        """Of a surface's triangles on a body whose vertices may do `free` (projectors, (num_vertices, 3, 3)) from rest x.

        moves: whether something moves what holds the body. Raises ValueError, which calls the surface `name`, where V is not
        well defined, or not positive.
        """
        rim, point, lids = open_edges(own, len(x)), None, []
        rows = spanned_by_edges(rim, free, x)
        loose = np.linalg.matrix_rank(rows, tol=1e-9) > 2 if len(rim) else np.zeros(0, bool)
        if loose.any():
            i, j = rim[np.argmax(loose)]
            raise ValueError(
                f"{name}: the surface is open at the edge of vertices {i} and {j}, which moves freely, so that it encloses "
                "no volume: name all triangles of the cavity, or hold its rim wholly or in a plane (fixed={...})"
            )
        for loop in _loops(rim):
            edges = rim[loop]
            shared = _shared_point(edges, rows[loop], x, name)
            if shared is None:
                first = edges[0, 0]
                lids += [(j, i, first) for i, j in edges if first not in (i, j)]
            elif point is not None and np.linalg.norm(shared - point) > FLAT * np.ptp(x[own.ravel()], 0).max():
                raise ValueError(f"{name}: two rims lie in planes that share no point: name the cavities one by one")
            elif moves:
                raise ValueError(f"{name}: its rim lies in several planes, which must not be moved: drop motion=")
            else:
                point = shared
        out = cls(np.concatenate([own, np.array(lids, np.int64).reshape(-1, 3)]), len(own), point)
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
        return float((a * np.cross(b, c)).sum()) / -6

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """dV/dx, shape (num_vertices, 3); what is held counts too."""
        y = self._corners(x)
        by = np.stack([np.cross(y[:, (a + 1) % 3], y[:, (a + 2) % 3]) for a in range(3)], 1).reshape(-1, 3) / -6
        at = self.triangles.ravel()
        return np.stack([np.bincount(at, by[:, d], len(x)) for d in range(3)], 1)

    def change(self, x: np.ndarray, step: np.ndarray) -> float:
        """V(x + step) - V(x), without the rounding of a difference: V is a cubic along a step."""
        by = self.gradient(x) + 4 * self.gradient(x + 0.5 * step) + self.gradient(x + step)
        return float((by * step).sum()) / 6


def _loops(rim: np.ndarray) -> list[np.ndarray]:
    """Rows of the rim's edges, one array for each connected part."""
    if len(rim) == 0:
        return []
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    names, place = np.unique(rim, return_inverse=True)
    i, j = place.reshape(-1, 2).T
    _, part = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (len(names), len(names))), directed=False)
    return [np.flatnonzero(part[i] == k) for k in range(part.max() + 1)]


def _shared_point(edges: np.ndarray, rows: np.ndarray, x: np.ndarray, name: str) -> np.ndarray | None:
    """The point that all planes share in which a rim may move; None where it is one plane, or the rim does not move.

    rows: as `spanned_by_edges` gives them.
    """
    places = x[np.unique(edges)]
    middle, size = places.mean(0), float(np.ptp(places, 0).max())
    moves = np.abs(rows[:, :6]).max((1, 2)) > 0
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
