"""Drag and lift of a fluid on triangles of the surface in implicit passes, in float64 on the host: forces and their
derivatives. drag.py has the formula."""

import numpy as np

from diffsim_ti.mechanics.fluid.drag import pull, pull_jvp, pull_vjp
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mesh.geometry import triangle_normals, triangle_normals_jvp, triangle_normals_vjp
from diffsim_ti.terms.surface_drag import SurfaceDrag


def _dot(a, b):
    return (a * b).sum(1, keepdims=True)


def _inverse(x):
    return np.divide(1.0, x, out=np.zeros_like(x), where=x > 0)


class Fluid(HostForce):
    """Of triangles, shape (m, 3), whose numbers (rho, c_n, c_t, stream) stand in the parameters from `first` on, (m,)."""

    reads_velocities = True

    def __init__(self, triangles: np.ndarray, first: np.ndarray, num_vertices: int):
        self.triangles, self.first, self.num_vertices = triangles, first, num_vertices

    def take(self, values, instant):
        self.numbers = self._numbers(values.parameters)
        return super().take(values, instant)

    def _numbers(self, parameters):
        """(rho / 12, c_t, c_n - c_t, stream) of each triangle."""
        rows, index = parameters[self._rows], SurfaceDrag.index
        rho, c_n, c_t = (rows[:, [k]] for k in (index.density, index.normal, index.tangential))
        return rho / 12, c_t, c_n - c_t, rows[:, index.stream :]

    @property
    def _rows(self):
        """Where the numbers of each triangle stand, shape (m, numbers)."""
        return self.first[:, None] + np.arange(SurfaceDrag.index.end)

    def _mean(self, v):
        return v[self.triangles].mean(1)

    def _known(self, u):
        _, c, k, stream = self.numbers
        N = 2 * triangle_normals(self.values.rest + u, self.triangles)
        v = self._mean(self.velocities(u)) - stream
        L, along, size = np.sqrt(_dot(N, N)), _dot(v, N), np.sqrt(_dot(v, v))
        return v, size, N, L, along, pull(c, k, v, N, L, along, _inverse(L))

    def _to_vertices(self, of_corners):
        """Sums at vertices of what each corner of a triangle has alike."""
        at, each = self.triangles.ravel(), np.repeat(of_corners, 3, 0)
        return np.stack([np.bincount(at, each[:, d], self.num_vertices) for d in range(each.shape[1])], 1)

    def _corner(self, u):
        _, size, *_, B = self._known(u)
        return -self.numbers[0] * size * B

    def forces(self, u):
        return self._to_vertices(self._corner(u))

    def sizes(self, u):
        return self._to_vertices(np.linalg.norm(self._corner(u), axis=1, keepdims=True))[:, 0]

    def jvp(self, u, du, dv, moved=None):
        rho, c, k, _ = self.numbers
        v, size, N, L, along, B = self._known(u)
        dv, over = self._mean(dv), _inverse(L)
        drho = dc = dk = 0.0
        if moved is not None:
            drho, dc, dk, stream = self._numbers(moved.parameters)
            du, dv = du + moved.rest, dv - stream
        dN = 2 * triangle_normals_jvp(self.values.rest + u, self.triangles, du)
        dL, dalong, dsize = _dot(N, dN) * over, _dot(dv, N) + _dot(v, dN), _dot(v, dv) * _inverse(size)
        dB = pull_jvp(c, k, v, N, L, along, over, dc, dk, dv, dN, dL, dalong)
        return self._to_vertices(-(rho * (dsize * B + size * dB) + drho * size * B))

    def vjp(self, u, w, adj=None):
        rho, c, k, _ = self.numbers
        v, size, N, L, along, B = self._known(u)
        w, over = w[self.triangles].sum(1), _inverse(L)
        b, by_size = -rho * size * w, _dot(-rho * w, B)
        across, straight = _dot(b, N), _dot(b, v)
        by_v, by_N = pull_vjp(c, k, v, N, L, along, over, b, across, straight)
        by_v = by_v + by_size * _inverse(size) * v
        by_place = triangle_normals_vjp(self.values.rest + u, self.triangles, 2 * by_N)
        if adj is not None:
            by_k, by_c, by_rho = along * over * across, L * straight, -size * _dot(w, B) / 12
            np.add.at(adj.parameters, self._rows, np.hstack([by_rho, by_k, by_c - by_k, -by_v]))
            adj.rest += by_place
        return by_place, self._to_vertices(by_v / 3)
