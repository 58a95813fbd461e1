"""Drag and lift of a fluid on triangles of the surface in implicit passes, in float64 on the host; drag.py has the
formula."""

import numpy as np

from diffsim_ti.differentiation.arrays import ratio, summed_at
from diffsim_ti.mechanics.fluid.drag import pull
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.terms.surface_drag import SurfaceDrag


def _dot(a, b):
    return (a * b).sum(1, keepdims=True)


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

    def _corner(self, u):
        """What each corner of a triangle has."""
        rho, c, k, stream = self.numbers
        N = 2 * triangle_normals(self.values.rest + u, self.triangles)
        v = self.velocities(u)[self.triangles].mean(1) - stream
        L, along, size = np.sqrt(_dot(N, N)), _dot(v, N), np.sqrt(_dot(v, v))
        return -rho * size * pull(c, k, v, N, L, along, ratio(1.0, L))

    def _to_vertices(self, of_corners):
        """Sums at vertices of what each corner of a triangle has alike."""
        return summed_at(self.triangles, np.repeat(of_corners[:, None], 3, 1), self.num_vertices)

    def forces(self, u):
        return self._to_vertices(self._corner(u))

    def sizes(self, u):
        return self._to_vertices(np.linalg.norm(self._corner(u), axis=1, keepdims=True))[:, 0]
