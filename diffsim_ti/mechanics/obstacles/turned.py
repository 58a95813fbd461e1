"""A vertex as an obstacle that turns sees it: its place, changes of that, the obstacle's velocity there, and adjoints.

The obstacle takes a point z of its own, as it was made, to c + t + R (z - c). A vertex at X + u, from which t is taken, lies
at the arm r = X + u - c from the point c. Changes of t, of R by dR = [theta]x R and of c act as a change of place

    - dt - theta x r + (R - 1) dc,    besides the turn theta of what acts.

The obstacle's velocity is that of the obstacle's point at the vertex, on the chord that it goes in a time tau,

    v + (R(tau omega) - 1) r / tau = v + omega x J(tau omega) r,

so that what turns with the obstacle has no velocity relative to it.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import A, at, let, number_type, traced
from diffsim_ti.terms.obstacles import turning


@dataclass(frozen=True)
class Turned:
    """Taichi functions of one vertex; `first`: where the numbers of the obstacle begin."""

    precision: str

    fp = number_type

    @traced
    def short(self, x, begin=0):
        """Three components of a vector."""
        return let(ti.types.vector(3, self.fp)(*(at(x, begin + d) for d in range(3))))

    @traced
    def long(self, x):
        """Four components, the last zero."""
        return let(ti.types.vector(4, self.fp)(*(at(x, d) for d in range(3)), ti.cast(0, self.fp)))

    @traced
    def joined(self, a, b, of_b=3):
        """Three components of a, then some of b."""
        numbers = [at(a, d) for d in range(3)] + [at(b, d) for d in range(of_b)]
        return let(ti.types.vector(3 + of_b, self.fp)(*numbers))

    @traced
    def about(self, g, first, parameters):
        """The point c."""
        start = first + g.force.index.about
        return let(ti.types.vector(3, self.fp)(*(at(parameters, start + d) for d in range(3))))

    @traced
    def quaternion(self, X):
        return let(ti.types.vector(4, self.fp)(*(at(X, 3 + d) for d in range(4))))

    @ti.func
    def seen(self, rest, place):
        """X of a rest position, for a place of seven numbers."""
        out = place
        for d in ti.static(range(3)):
            out[d] = rest[d] - place[d]
        return out

    @ti.func
    def arm(self, g: A, first, X, u, scene: A):
        return self.short(X) + self.short(u) - self.about(g, first, scene.parameters)

    @ti.func
    def moved(self, g: A, first, X, u, dr, dplace, scene: A, tangent: A):
        """Change of the place, six numbers, for dr of X + u and dplace, six, of the obstacle's."""
        dc, q, theta = self.about(g, first, tangent.parameters), self.quaternion(X), self.short(dplace, 3)
        out = self.short(dr) - self.short(dplace) - theta.cross(self.arm(g, first, X, u, scene))
        out += turning.turned(q, 1, dc, self.fp) - dc
        return self.joined(out, theta)

    @ti.func
    def v_obstacle(self, v, omega, tau, r):
        """The obstacle's velocity; v, omega and r have three components."""
        return self.long(v + omega.cross(turning.jacobian(tau * omega, r, self.fp)))

    @ti.func
    def obstacle_velocity_jvp(self, dv, omega, domega, tau, r, dr):
        a = tau * omega
        out = dv + turning.jacobian(a, domega, self.fp).cross(turning.rotated(a, r, self.fp))
        return self.long(out + omega.cross(turning.jacobian(a, dr, self.fp)))

    @ti.func
    def obstacle_velocity_vjp(self, omega, tau, r, by):
        """(adjoint of omega, of r)"""
        back = -tau * omega
        by_omega = turning.jacobian(back, turning.rotated(tau * omega, r, self.fp).cross(by), self.fp)
        return by_omega, turning.jacobian(back, by, self.fp).cross(omega)

    @ti.func
    def spread(self, g: A, first, i, X, u, by, by_arm, scene: A, sums: A):
        """(adjoints of u, of the translation, of theta) for six numbers, the adjoint of a changed place, and that of the
        arm; adds those of the point c to column i of the sums."""
        by_place, r, q = self.short(by), self.arm(g, first, X, u, scene), self.quaternion(X)
        by_theta = self.short(by, 3) - r.cross(by_place)
        by_c = turning.turned(q, -1, by_place, self.fp) - by_place - by_arm
        for d in ti.static(range(3)):
            row = first + g.force.index.about + d
            sums[row, i] = sums[row, i] + by_c[d]
        by_u = by_place + by_arm
        return self.long(by_u), self.long(0 - by_u), by_theta
