"""Drag and lift of a fluid on triangles of the surface in implicit passes, in float64 on the host: forces and their
derivatives. dragged_triangle.py has the formulas."""

import numpy as np

from diffsim_ti.mesh.geometry import triangle_normals, triangle_normals_jvp, triangle_normals_vjp
from diffsim_ti.terms.surface_drag import SurfaceDrag


def _dot(a, b):
    return (a * b).sum(1, keepdims=True)


def _inverse(x):
    return np.divide(1.0, x, out=np.zeros_like(x), where=x > 0)


class Fluid:
    """Of triangles, shape (m, 3), whose numbers (rho, c_n, c_t, stream) stand in the parameters from `first` on, (m,).

    What is asked for is at places x, where velocities are (x - origin) / gamma; `at` tells these.
    """

    symmetric = False

    def __init__(self, triangles: np.ndarray, first: np.ndarray, num_vertices: int):
        self.triangles, self.first, self.num_vertices = triangles, first, num_vertices

    @classmethod
    def of(cls, scene) -> "Fluid | None":
        """Of a scene; None without."""
        if not scene.fluids:
            return None
        parts = [term.triangles(scene.mesh) for term in scene.fluids]
        first = [np.full(len(p), scene.inputs.parameters.first(t)) for t, p in zip(scene.fluids, parts)]
        return cls(np.concatenate(parts), np.concatenate(first), scene.mesh.num_vertices)

    def at(self, parameters: np.ndarray, origin: np.ndarray, gamma: float) -> "Fluid":
        self.numbers, self.origin, self.gamma = self._numbers(parameters), origin, gamma
        return self

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

    def _known(self, x):
        _, c, k, stream = self.numbers
        N = 2 * triangle_normals(x, self.triangles)
        v = self._mean(x - self.origin) / self.gamma - stream
        L, along, size = np.sqrt(_dot(N, N)), _dot(v, N), np.sqrt(_dot(v, v))
        return v, size, N, L, along, c * L * v + k * along * _inverse(L) * N

    def _to_vertices(self, of_corners):
        """Sums at vertices of what each corner of a triangle has alike."""
        at, each = self.triangles.ravel(), np.repeat(of_corners, 3, 0)
        return np.stack([np.bincount(at, each[:, d], self.num_vertices) for d in range(each.shape[1])], 1)

    def _corner(self, x):
        _, size, *_, B = self._known(x)
        return -self.numbers[0] * size * B

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Forces on vertices [N]."""
        return self._to_vertices(self._corner(x))

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """Sum of the sizes of the forces that meet at each vertex [N]."""
        return self._to_vertices(np.linalg.norm(self._corner(x), axis=1, keepdims=True))[:, 0]

    def tangent(self, x: np.ndarray) -> "_At":
        """Change of the forces for many changes of x."""
        return _At(self, x)

    def jvp(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Change of the forces for a change of x, and of velocities with it."""
        return self.jvp_of_all(x, dx, dx / self.gamma)

    def jvp_of_all(self, x, dx, dv, parameters_dot: np.ndarray | None = None) -> np.ndarray:
        """The same for changes of places, velocities and numbers by themselves."""
        rho, c, k, _ = self.numbers
        v, size, N, L, along, B = self._known(x)
        dN, dv, over = 2 * triangle_normals_jvp(x, self.triangles, dx), self._mean(dv), _inverse(L)
        drho = dc = dk = 0.0
        if parameters_dot is not None:
            drho, dc, dk, stream = self._numbers(parameters_dot)
            dv = dv - stream
        dL, dalong, dsize = _dot(N, dN) * over, _dot(dv, N) + _dot(v, dN), _dot(v, dv) * _inverse(size)
        dB = c * (dL * v + L * dv) + dc * L * v + dk * along * over * N
        dB = dB + k * over * ((dalong - along * dL * over) * N + along * dN)
        return self._to_vertices(-(rho * (dsize * B + size * dB) + drho * size * B))

    def vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of x, and of velocities with it, for the adjoint w of the forces."""
        by_place, by_speed, _ = self.vjp_of_all(x, w, 0)
        return by_place + by_speed / self.gamma

    def vjp_of_all(self, x, w, num_parameters: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Adjoints of places, of velocities, and of the parameters (none of them with num_parameters = 0)."""
        rho, c, k, _ = self.numbers
        v, size, N, L, along, B = self._known(x)
        w, over = w[self.triangles].sum(1), _inverse(L)
        b, by_size = -rho * size * w, _dot(-rho * w, B)
        across, straight = _dot(b, N), _dot(b, v)
        by_along = k * over * across
        by_L = c * straight - by_along * along * over
        by_v = c * L * b + by_along * N + by_size * _inverse(size) * v
        by_N = k * along * over * b + by_along * v + by_L * over * N
        by_k, by_c, by_rho = along * over * across, L * straight, -size * _dot(w, B) / 12
        numbers = np.zeros(num_parameters)
        if num_parameters:
            np.add.at(numbers, self._rows, np.hstack([by_rho, by_k, by_c - by_k, -by_v]))
        return triangle_normals_vjp(x, self.triangles, 2 * by_N), self._to_vertices(by_v / 3), numbers

    def work(self, x: np.ndarray, step: np.ndarray) -> float:
        """Work along a straight step [J], by Simpson's rule."""
        middle = 4 * self.forces(x + 0.5 * step)
        return float(((self.forces(x) + middle + self.forces(x + step)) * step).sum()) / 6


class _At:
    """Change of a fluid's forces around one place, as `Tangent` has it of pressures."""

    def __init__(self, fluid: Fluid, x: np.ndarray, transposed: bool = False):
        self.fluid, self.x, self.change = fluid, x, fluid.vjp if transposed else fluid.jvp

    def __call__(self, dx: np.ndarray) -> np.ndarray:
        return self.change(self.x, dx)

    @property
    def T(self) -> "_At":
        return _At(self.fluid, self.x, transposed=True)


class _Sum:
    def __init__(self, parts: list):
        self.parts = parts

    def __call__(self, dx):
        return sum(part(dx) for part in self.parts)

    @property
    def T(self) -> "_Sum":
        return _Sum([part.T for part in self.parts])


class Together:
    """Pressures that follow and a fluid, as Newton's method takes them."""

    symmetric = False

    def __init__(self, *parts):
        self.parts = parts

    def forces(self, x):
        return sum(part.forces(x) for part in self.parts)

    def sizes(self, x):
        return sum(part.sizes(x) for part in self.parts)

    def tangent(self, x):
        return _Sum([part.tangent(x) for part in self.parts])

    def work(self, x, step):
        return sum(part.work(x, step) for part in self.parts)
