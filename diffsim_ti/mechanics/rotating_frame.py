"""Coriolis and centrifugal forces: f = -m (2 Omega x v + Omega x (Omega x r)), r = x - c."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.differentiation.arrays import cross
from diffsim_ti.inputs.consistent_mass import consistent
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mechanics.interaction import Interaction, VertexwiseForce
from diffsim_ti.runtime import A, traced
from diffsim_ti.terms import RotatingFrame


@dataclass(frozen=True)
class InertialForce(VertexwiseForce):
    """Of one vertex i. first: where Omega and c stand among the parameters.

    A kick v+ = v - 2 h Omega x y with y = (1 + h [Omega])^-1 v is Cayley's rotation of v.
    """

    first: int
    name, is_load, reads_rates, reads_rest = "inertial", True, True, True
    adjoints = dict(inertial_adjoint="vectors")  # three of each vertex: of Omega, of c, and (of the mass, 0, 0)

    @traced
    def sizes(self, plan):
        return dict(inertial_adjoint=3 * plan.num_vertices)

    @ti.func
    def number(self, x):
        return ti.cast(x, self.fp)

    @ti.func
    def numbers(self, p: A):
        """(Omega, c)"""
        n, zero = ti.static(self.first), self.number(0)
        return self.vector(p[n], p[n + 1], p[n + 2], zero), self.vector(p[n + 3], p[n + 4], p[n + 5], zero)

    @ti.func
    def mass(self, i, scene: A):
        inverse, zero = scene.inverse_mass[i], self.number(0)
        return ti.select(inverse > 0, self.number(1) / ti.max(inverse, self.number(1e-30)), zero)

    @ti.func
    def solved(self, v, spin):
        """y of y + spin x y = v; with -spin that of the transposed equation."""
        return (v - self.cross(spin, v) + spin.dot(v) * spin) / (self.number(1) + spin.dot(spin))

    @ti.func
    def force(self, i, u, v, now: A, scene: A):
        spin, c = self.numbers(scene.parameters)
        y, r = self.solved(v, (now.pre + now.post) * spin), scene.rest[i] + u - c
        return -self.mass(i, scene) * (self.number(2) * self.cross(spin, y) + self.cross(spin, self.cross(spin, r)))

    @ti.func
    def force_jvp(self, i, u, v, du, dv, now: A, scene: A, tangent: A):
        spin, c = self.numbers(scene.parameters)
        dspin, dc = self.numbers(tangent.parameters)
        h = now.pre + now.post
        y, r, dr = self.solved(v, h * spin), scene.rest[i] + u - c, tangent.rest[i] + du - dc
        dy = self.solved(dv - h * self.cross(dspin, y), h * spin)
        a = self.number(2) * self.cross(spin, y) + self.cross(spin, self.cross(spin, r))
        da = self.number(2) * (self.cross(dspin, y) + self.cross(spin, dy)) + self.cross(dspin, self.cross(spin, r))
        da += self.cross(spin, self.cross(dspin, r) + self.cross(spin, dr))
        return -self.mass(i, scene) * da - tangent.mass[i] * a

    @ti.func
    def force_vjp(self, i, u, v, w, now: A, scene: A, adjoint: A):
        h, z, zero = now.pre + now.post, self.mass(i, scene) * w, self.number(0)
        spin, c = self.numbers(scene.parameters)
        y, r = self.solved(v, h * spin), scene.rest[i] + u - c
        across, turned = self.cross(spin, r), self.cross(spin, z)
        by_u, by_v = self.cross(turned, spin), self.solved(self.number(2) * turned, -h * spin)
        by_spin = (
            self.number(2) * self.cross(z, y) - h * self.cross(y, by_v) + self.cross(z, across) - self.cross(turned, r)
        )
        by_mass = -w.dot(self.number(2) * self.cross(spin, y) + self.cross(spin, across))
        adjoint.inertial_adjoint[3 * i] = adjoint.inertial_adjoint[3 * i] + by_spin
        adjoint.inertial_adjoint[3 * i + 1] = adjoint.inertial_adjoint[3 * i + 1] - by_u
        by_numbers = self.vector(by_mass, zero, zero, zero)
        adjoint.inertial_adjoint[3 * i + 2] = adjoint.inertial_adjoint[3 * i + 2] + by_numbers
        return by_u, by_v


class InertialForceOnHost(HostForce):
    """f = M a, M the lumped or the consistent mass. rows: those of Omega and c among the parameters."""

    reads_velocities = True

    def __init__(self, mesh, rows: slice):
        self.mesh, self.rows = mesh, rows

    @property
    def symmetric(self) -> bool:
        return not np.isfinite(self.instant.gamma)

    def take(self, values, instant):
        numbers = values.parameters[self.rows]
        self.spin, self.center = numbers[:3], numbers[3:]
        return super().take(values, instant)

    def forces(self, u):
        W, r = self.spin, self.values.rest + u - self.center
        a = -2 * cross(W, self.velocities(u)) - cross(W, cross(W, r))
        if self.values.element_masses is None:
            return self.values.mass[:, None] * a
        return consistent(self.mesh.elements, self.values.element_masses, a)

    def turning(self, u, w):
        return 0.0


class InertialForces(Interaction):
    name, kinds, works = "inertial", (RotatingFrame,), "a rotating frame"

    def __init__(self, scene, terms):
        super().__init__(scene, terms)
        if len(terms) > 1:
            raise ValueError(
                "a scene takes one RotatingFrame, got several: give the frame that everything is seen from"
            )

    @property
    def rows(self) -> slice:
        return self.scene.inputs.parameters.of(self.terms[0])

    def kernel(self, values, precision, shape):
        return InertialForce(precision, self.rows.start)

    def host(self):
        return InertialForceOnHost(self.mesh, self.rows)

    def adjoints(self, values, shape):
        return dict(inertial_adjoint=(3 * self.mesh.num_vertices,))

    def collect(self, found, out, shape):
        sums = found["inertial_adjoint"]
        by_spin, by_center, by_mass = (sums[..., k::3, :] for k in range(3))
        out.parameters[..., self.rows] += np.concatenate([by_spin.sum(-2), by_center.sum(-2)], -1)
        out.mass += by_mass[..., 0]
        if shape:
            out.rest -= by_center
