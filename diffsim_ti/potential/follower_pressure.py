"""Pressures that follow the surface, in float64 on the host: forces, their derivatives both ways, and their work.

The force of a triangle on each of its corners is -p n / 3, n = (x_1 - x_0) x (x_2 - x_0) / 2. Over a closed surface that is
-p dV/dx, V the volume inside. Over an open one a part is left at its edge that no potential has.
"""

import numpy as np

from diffsim_ti.mesh.enclosure import open_edges, spanned_by_edges


class FollowerPressure:
    """Of triangles (m, 3), each of which belongs to a load; `at` says how large the pressures of loads are [Pa].

    symmetric: whether there is a potential: all edges of each load's triangles are inner ones, or held so (`is_symmetric`).
    """

    def __init__(self, triangles: np.ndarray, load_of: np.ndarray, num_vertices: int, symmetric: bool = True):
        self.triangles, self.load_of, self.num_vertices = triangles, load_of, num_vertices
        self.symmetric = symmetric
        self.pressure = np.zeros(0)

    def at(self, pressures: np.ndarray, share: float = 1.0) -> "FollowerPressure":
        """With a share of pressures of the loads [Pa]."""
        self.share, self.pressure = share, share * np.asarray(pressures, np.float64)
        return self

    def _edges(self, x):
        corners = x[self.triangles]
        return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]

    def _to_vertices(self, *by_corner):
        """Sums at vertices of what the three corners of the triangles have."""
        out = np.zeros((self.num_vertices, 3))
        for a, part in enumerate(by_corner):
            out += np.stack([np.bincount(self.triangles[:, a], part[:, d], self.num_vertices) for d in range(3)], 1)
        return out

    def _factors(self, pressures):
        return pressures[self.load_of, None] / -6

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Forces on vertices at x [N], shape (num_vertices, 3)."""
        part = self._factors(self.pressure) * np.cross(*self._edges(x))
        return self._to_vertices(part, part, part)

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """Sum of the sizes of the forces that meet at each vertex [N]."""
        part = np.linalg.norm(self._factors(self.pressure) * np.cross(*self._edges(x)), axis=1)
        return np.bincount(self.triangles.ravel(), np.repeat(part, 3), self.num_vertices)

    def jvp(self, x: np.ndarray, dx: np.ndarray, pressures_dot: np.ndarray | None = None) -> np.ndarray:
        """Change of the forces for changes of x and of pressures."""
        (e, f), (de, df) = self._edges(x), self._edges(dx)
        part = self._factors(self.pressure) * (np.cross(de, f) + np.cross(e, df))
        if pressures_dot is not None:
            part += self._factors(self.share * pressures_dot) * np.cross(e, f)
        return self._to_vertices(part, part, part)

    def vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of x for the adjoint w of the forces."""
        (e, f), whole = self._edges(x), w[self.triangles].sum(1)
        p = self._factors(self.pressure)
        by_e, by_f = p * np.cross(f, whole), p * np.cross(whole, e)
        return self._to_vertices(-(by_e + by_f), by_e, by_f)

    def pressures_vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of the pressures of loads for the adjoint w of the forces."""
        by_triangle = (np.cross(*self._edges(x)) * w[self.triangles].sum(1)).sum(1) / -6
        return self.share * np.bincount(self.load_of, by_triangle, len(self.pressure))

    def work(self, x: np.ndarray, step: np.ndarray) -> float:
        """Work done along a straight step [J]: the forces are quadratic in it, so that Simpson's rule is exact."""
        middle = 4 * self.forces(x + 0.5 * step)
        return float(((self.forces(x) + middle + self.forces(x + step)) * step).sum()) / 6


def is_symmetric(triangles: np.ndarray, load_of: np.ndarray, free: np.ndarray, x: np.ndarray) -> bool:
    """Whether pressures have a potential in what may move, and so a symmetric tangent.

    Each load's triangles must be closed, or their edge be held: what an edge's ends may do, with the edge itself, must span
    a plane at most, as on a symmetry plane. free: projectors on what each vertex may do, (num_vertices, 3, 3).
    """
    for load in np.unique(load_of):
        rim = open_edges(triangles[load_of == load], len(x))
        spanned = spanned_by_edges(rim, free, x)
        if np.any(np.linalg.matrix_rank(spanned, tol=1e-9) > 2):
            return False
    return True
