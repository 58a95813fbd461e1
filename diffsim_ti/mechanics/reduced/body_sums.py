"""Sums over the vertices of bodies of few numbers, and fields that are affine in y (state/bodies.py), with derivatives.

A field is q + Q y at a vertex: `o` is q, and x, y, z are the columns of Q. That nearest to vectors x by the masses has
q = sum m x / M and Q = sum m x y^T J^-1; of forces f in their place, without the masses, it is the acceleration. All of it
is float64.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import taichi as ti

from diffsim_ti.mechanics.reduced.body_motion import VECTOR, columns
from diffsim_ti.runtime import A, Bundle, at, let, traced
from diffsim_ti.state.bodies import NUMBERS, PAIRS, SIZE, SUMS

if TYPE_CHECKING:
    from diffsim_ti.solvers.explicit.kick_drift import KickDrift

INVERSE, MOMENTS = 4, 10  # where they begin among a body's numbers


@dataclass(frozen=True)
class BodySums:
    """Taichi functions of body b."""

    vertex: "KickDrift"

    @property
    def fp(self):
        return self.vertex.fp

    @ti.func
    def wide(self, x):
        return VECTOR(x.x, x.y, x.z, 0)

    @ti.func
    def narrow(self, x):
        return self.vertex.vector(
            ti.cast(x.x, self.fp), ti.cast(x.y, self.fp), ti.cast(x.z, self.fp), ti.cast(0, self.fp)
        )

    @ti.func
    def double(self, x):
        return ti.cast(x, ti.f64)

    @ti.func
    def dot(self, a, b):
        return a.dot(b)

    @traced
    def number(self, b, k, scene):
        return let(at(scene.body_numbers, b * NUMBERS + k))

    @traced
    def matrix(self, b, first, scene):
        """Rows of a symmetric matrix."""
        out = [[None] * 3 for _ in range(3)]
        for k, (r, c) in enumerate(PAIRS):
            out[r][c] = out[c][r] = self.number(b, first + k, scene)
        return out

    @traced
    def J(self, b, scene):
        """Columns of J, or of its change."""
        zero = ti.cast(0, ti.f64)
        return columns(*(let(VECTOR(*column, zero)) for column in self.matrix(b, MOMENTS, scene)))

    @ti.func
    def arm(self, m, b, scene: A):
        """y of vertex m of all bodies."""
        first = b * NUMBERS
        centre = VECTOR(scene.body_numbers[first + 1], scene.body_numbers[first + 2], scene.body_numbers[first + 3], 0)
        return self.wide(scene.body_place[m]) - centre

    @traced
    def field(self, o, x, y, z):
        return Bundle(o=let(o), x=let(x), y=let(y), z=let(z))

    @traced
    def columns(self, field):
        return [field.x, field.y, field.z]

    @ti.func
    def at_arm(self, q: A, y):
        """The field at a vertex."""
        return q.o + y.x * q.x + y.y * q.y + y.z * q.z

    @ti.func
    def slope_at(self, q: A, dy):
        return dy.x * q.x + dy.y * q.y + dy.z * q.z

    @traced
    def along(self, q, x):
        """What an adjoint x of the field at a vertex says of y there."""
        return let(VECTOR(*(self.dot(column, x) for column in self.columns(q)), ti.cast(0, ti.f64)))

    @traced
    def kicked(self, v, share, f):
        """v + share f."""
        s = let(self.double(share))
        return self.field(v.o + s * f.o, v.x + s * f.x, v.y + s * f.y, v.z + s * f.z)

    # ---- the nearest field ---------------------------------------------------------------------------------------------

    @ti.func
    def moments(self, b, state: A, s, forces: A, slot, scene: A):
        """sum m x, sum m y_k x of displacements and velocities, and the same of forces without m."""
        ao, ax, ay, az = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        co, cx, cy, cz = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        fo, fx, fy, fz = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i, y, mass = scene.body_vertex[m], self.arm(m, b, scene), self.double(scene.body_mass[m])
            u, v, f = mass * self.wide(state.u[s, i]), mass * self.wide(state.v[s, i]), self.wide(forces[slot, i])
            ao, ax, ay, az = ao + u, ax + y.x * u, ay + y.y * u, az + y.z * u
            co, cx, cy, cz = co + v, cx + y.x * v, cy + y.y * v, cz + y.z * v
            fo, fx, fy, fz = fo + f, fx + y.x * f, fy + y.y * f, fz + y.z * f
        return ao, ax, ay, az, co, cx, cy, cz, fo, fx, fy, fz

    @traced
    def solved(self, b, sums, scene):
        K, o = self.matrix(b, INVERSE, scene), let(sums[0] / self.number(b, 0, scene))
        return self.field(o, *(K[k][0] * sums[1] + K[k][1] * sums[2] + K[k][2] * sums[3] for k in range(3)))

    @traced
    def nearest(self, b, state, s, forces, slot, scene):
        """Fields of displacements, velocities and accelerations without gravity."""
        sums = self.moments(b, state, s, forces, slot, scene)
        return tuple(self.solved(b, sums[k : k + 4], scene) for k in (0, 4, 8))

    @traced
    def with_gravity(self, f, parameters):
        """Accelerations with that of gravity; parameters: the scene's, or their change."""
        if self.vertex.features.gravity < 0:
            return f
        return self.field(f.o + self.wide(self.vertex.gravity(parameters)), f.x, f.y, f.z)

    # ---- its tangent ---------------------------------------------------------------------------------------------------

    @ti.func
    def moments_jvp(self, b, state: A, s, scene: A, tangent: A):
        ao, ax, ay, az = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        co, cx, cy, cz = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        fo, fx, fy, fz = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i, y, dy = scene.body_vertex[m], self.arm(m, b, scene), self.wide(tangent.body_place[m])
            mass, dm = self.double(scene.body_mass[m]), self.double(tangent.body_mass[m])
            u, v, f = self.wide(state.u[s, i]), self.wide(state.v[s, i]), self.wide(state.f[s, i])
            du = mass * self.wide(tangent.u[0, i]) + dm * u
            dv, df = mass * self.wide(tangent.v[0, i]) + dm * v, self.wide(tangent.body_force[0, i])
            u, v = mass * u, mass * v
            ao, ax, ay, az = ao + du, ax + y.x * du + dy.x * u, ay + y.y * du + dy.y * u, az + y.z * du + dy.z * u
            co, cx, cy, cz = co + dv, cx + y.x * dv + dy.x * v, cy + y.y * dv + dy.y * v, cz + y.z * dv + dy.z * v
            fo, fx, fy, fz = fo + df, fx + y.x * df + dy.x * f, fy + y.y * df + dy.y * f, fz + y.z * df + dy.z * f
        return ao, ax, ay, az, co, cx, cy, cz, fo, fx, fy, fz

    @traced
    def solved_jvp(self, b, q, sums, scene, tangent):
        """Change of a field q for those of its sums."""
        dJ, Q = self.matrix(b, MOMENTS, tangent), self.columns(q)
        left = [s - sum((dJ[k][n] * Q[n] for n in (1, 2)), dJ[k][0] * Q[0]) for k, s in enumerate(sums[1:])]
        return self.solved(b, [sums[0] - self.number(b, 0, tangent) * q.o, *map(let, left)], scene)

    @traced
    def nearest_jvp(self, b, u, v, f, state, s, scene, tangent):
        """Changes of these fields."""
        sums = self.moments_jvp(b, state, s, scene, tangent)
        return tuple(self.solved_jvp(b, q, sums[4 * k : 4 * k + 4], scene, tangent) for k, q in enumerate((u, v, f)))

    # ---- its adjoint ---------------------------------------------------------------------------------------------------

    @traced
    def solved_vjp(self, b, q, by, scene, adjoint):
        """Adjoints of the sums as a field, for those of q; adds those of M and J."""
        K, B, Q, first = self.matrix(b, INVERSE, scene), self.columns(by), self.columns(q), b * SUMS
        o = let(by.o / self.number(b, 0, scene))
        sums = [let(K[0][k] * B[0] + K[1][k] * B[1] + K[2][k] * B[2]) for k in range(3)]
        self.add(adjoint.body_sums, first, -self.dot(q.o, o))
        for k, (r, c) in enumerate(PAIRS):
            both = self.dot(Q[r], sums[c])
            both = both if r == c else both + self.dot(Q[c], sums[r])
            self.add(adjoint.body_sums, first + 1 + k, -both)
        return self.field(o, *sums)

    @ti.func
    def add(self, array: A, k, x):
        array[k] = array[k] + x

    @ti.func
    def add_adjoint(self, m, by_y, by_mass, adjoint: A):
        """Of vertex m of all bodies."""
        first = SIZE * m
        for d in ti.static(range(3)):
            adjoint.body_adjoints[first + d] = adjoint.body_adjoints[first + d] + by_y[d]
        adjoint.body_adjoints[first + 3] = adjoint.body_adjoints[first + 3] + by_mass
