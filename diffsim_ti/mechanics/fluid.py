"""Drag and lift of a fluid on triangles of the surface (terms/surface_drag.py), in kernels and, in float64, on the host.

With v the mean velocity of the corners against the stream, N = (x_1 - x_0) x (x_2 - x_0), L = |N|, s = v . N, a corner has

    G = -rho / 12 |v| B,    B = c L v + k (s / L) N,    c = c_t, k = c_n - c_t.

Corner a of triangle t writes corner `first + 3 t + a`, and vertices gather it with those of tetrahedra. per_L: 1 / L, or 0
where L is.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import taichi as ti

from diffsim_ti.differentiation.arrays import ratio, summed_at
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mechanics.interaction import Interaction, ItemForce, add_at, edges, store_alike
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.runtime import A, traced
from diffsim_ti.terms import SurfaceDrag


def pull(c, k, v, N, L, s, per_L):
    """B"""
    return c * L * v + k * s * per_L * N


pull_in_kernels = ti.func(pull)


@ti.func
def pull_jvp(c, k, v, N, L, s, per_L, dc, dk, dv, dN, dL, ds):
    """Its change."""
    dB = c * (dL * v + L * dv) + dc * L * v + dk * s * per_L * N
    return dB + k * per_L * ((ds - s * dL * per_L) * N + s * dN)


@ti.func
def pull_vjp(c, k, v, N, L, s, per_L, b, across, straight):
    """Adjoints (of v, of N) for the adjoint b of B; across: b . N, straight: b . v."""
    by_s = k * per_L * across
    by_L = c * straight - by_s * s * per_L
    return c * L * b + by_s * N, k * s * per_L * b + by_s * v + by_L * per_L * N


@dataclass(frozen=True)
class DraggedTriangle(ItemForce):
    """Functions of one triangle in a pass; shape: of adjoints."""

    shape: bool
    name, reads_rates, reads_rest = "dragged", True, True
    arrays = dict(dragged="ints", dragged_numbers="ints")  # corners of each, where its numbers stand in the parameters
    adjoints = dict(fluid_adjoint="vectors", dragged_rest="vectors")

    @traced
    def sizes(self, plan) -> dict:
        return dict(fluid_adjoint=2 * plan.num_dragged, dragged_rest=3 * plan.num_dragged)

    @ti.func
    def number(self, x: ti.template()):
        return ti.cast(x, self.fp)

    @ti.func
    def speed(self, t, v: A, s, parameters: A, scene: A):
        """Mean velocity of the corners in slot s, less the stream."""
        first = scene.dragged_numbers[t] + SurfaceDrag.index.stream
        stream = self.vector(parameters[first], parameters[first + 1], parameters[first + 2], ti.cast(0, self.fp))
        total = v[s, scene.dragged[3 * t]] + v[s, scene.dragged[3 * t + 1]] + v[s, scene.dragged[3 * t + 2]]
        return total * self.number(1.0 / 3.0) - stream

    @ti.func
    def numbers(self, t, parameters: A, scene: A):
        """(rho / 12, c_t, c_n - c_t)"""
        k = scene.dragged_numbers[t]
        rho, c_t = parameters[k + SurfaceDrag.index.density], parameters[k + SurfaceDrag.index.tangential]
        return rho * self.number(1.0 / 12.0), c_t, parameters[k + SurfaceDrag.index.normal] - c_t

    @ti.func
    def inverse(self, x):
        out = ti.cast(0, self.fp)
        if x > 0:
            out = ti.cast(1, self.fp) / x
        return out

    @ti.func
    def known(self, t, scene: A, state: A, s):
        """(e, f, v, |v|, N, L, s, B)"""
        e, f = edges(scene.dragged, t, state.u, scene.rest, s)
        v = self.speed(t, state.v, s, scene.parameters, scene)
        rho, c, k = self.numbers(t, scene.parameters, scene)
        N = self.cross(e, f)
        L, along = ti.sqrt(N.dot(N)), v.dot(N)
        return e, f, v, ti.sqrt(v.dot(v)), N, L, along, pull_in_kernels(c, k, v, N, L, along, self.inverse(L))

    @ti.func
    def forces(self, t, now: A, scene: A, state: A, s, plan: A):
        rho, c, k = self.numbers(t, scene.parameters, scene)
        e, f, v, size, N, L, along, B = self.known(t, scene, state, s)
        store_alike(-rho * size * B, scene.corner, self.first(plan), t)

    @ti.func
    def forces_jvp(self, t, now: A, scene: A, state: A, s, tangent: A, plan: A):
        rho, c, k = self.numbers(t, scene.parameters, scene)
        drho, dc, dk = self.numbers(t, tangent.parameters, scene)
        e, f, v, size, N, L, along, B = self.known(t, scene, state, s)
        de, df = edges(scene.dragged, t, tangent.u, tangent.rest, 0)
        dv = self.speed(t, tangent.v, 0, tangent.parameters, scene)
        dN, over = self.cross(de, f) + self.cross(e, df), self.inverse(L)
        dL, dalong, dsize = N.dot(dN) * over, dv.dot(N) + v.dot(dN), v.dot(dv) * self.inverse(size)
        dB = pull_jvp(c, k, v, N, L, along, over, dc, dk, dv, dN, dL, dalong)
        change = rho * (dsize * B + size * dB) + drho * size * B
        store_alike(self.number(-1) * change, scene.corner, self.first(plan), t)

    @ti.func
    def forces_vjp(self, t, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        """Products of the transposed derivatives with adjoint.w, to corners; adds the adjoints of numbers to
        adjoint.fluid_adjoint and, if `shape`, those of places to adjoint.dragged_rest."""
        rho, c, k = self.numbers(t, scene.parameters, scene)
        e, f, v, size, N, L, along, B = self.known(t, scene, state, s)
        w = adjoint.w[0, scene.dragged[3 * t]]
        for a in ti.static((1, 2)):
            w += adjoint.w[0, scene.dragged[3 * t + a]]
        over, a_B, b = self.inverse(L), -rho * w, -rho * size * w
        across, straight = b.dot(N), b.dot(v)
        by_v, by_N = pull_vjp(c, k, v, N, L, along, over, b, across, straight)
        by_v += a_B.dot(B) * self.inverse(size) * v
        by_e, by_f = self.cross(f, by_N), self.cross(by_N, e)
        balance = self.number(-1) * (by_e + by_f)
        for a, by in ti.static(enumerate((balance, by_e, by_f))):
            adjoint.corner[self.first(plan) + 3 * t + a] = by
            adjoint.rate_corner[self.first(plan) + 3 * t + a] = by_v * self.number(1.0 / 3.0)
            if ti.static(self.shape):
                adjoint.dragged_rest[3 * t + a] = adjoint.dragged_rest[3 * t + a] + by
        by_k, by_c = along * over * across, L * straight
        by_rho = -size * w.dot(B) * self.number(1.0 / 12.0)
        by_numbers = self.vector(by_rho, by_k, by_c - by_k, self.number(0))
        adjoint.fluid_adjoint[2 * t] = adjoint.fluid_adjoint[2 * t] + by_numbers
        adjoint.fluid_adjoint[2 * t + 1] = adjoint.fluid_adjoint[2 * t + 1] - by_v


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


class FluidDrag(Interaction):
    """Each triangle in a fluid is an item. Its six numbers stand in the scene's parameters, from `first_number` on."""

    name, kinds, works, is_load = "dragged", (SurfaceDrag,), "drag", False
    no_equilibrium = "SurfaceDrag is of velocities, and an equilibrium has none"

    @cached_property
    def triangles(self) -> np.ndarray:
        return np.concatenate([term.triangles(self.mesh) for term in self.terms])

    @cached_property
    def first_number(self) -> np.ndarray:
        parameters = self.scene.inputs.parameters
        return np.concatenate([np.full(len(t.triangles(self.mesh)), parameters.first(t)) for t in self.terms])

    @property
    def vertices(self) -> np.ndarray:
        return self.triangles.ravel()

    @property
    def count(self) -> int:
        return len(self.triangles)

    @property
    def topology(self):
        return dict(dragged=self.vertices, dragged_numbers=self.first_number)

    def kernel(self, values, precision, shape):
        return DraggedTriangle(precision, shape)

    def host(self):
        return Fluid(self.triangles, self.first_number, self.mesh.num_vertices)

    def adjoints(self, values, shape):
        return dict(fluid_adjoint=(2 * self.count,), dragged_rest=(3 * self.count * shape,))

    def collect(self, found, out, shape):
        numbers = self.first_number[:, None] + np.arange(6)
        by_numbers = found["fluid_adjoint"]
        np.add.at(out.parameters, (..., numbers.ravel()), by_numbers.reshape(*by_numbers.shape[:-2], -1))
        if shape:
            add_at(out.rest, self.vertices, found["dragged_rest"])
