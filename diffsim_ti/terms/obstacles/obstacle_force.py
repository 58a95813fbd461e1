"""The compile-time class of an obstacle: everything that kernels need of it, from its distance alone."""

from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.common.rows import indices
from diffsim_ti.differentiation import Graph
from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.runtime import assign, at, let, traced
from diffsim_ti.terms.obstacles import barrier, friction
from diffsim_ti.terms.obstacles.turning import all_changes, changes, cross, length_of, rotation_matrix
from diffsim_ti.terms.term import VertexForce


@dataclass(frozen=True)
class ObstacleForce(VertexForce):
    """Device counterpart of an obstacle: `count` numbers of its shape, then stiffness, width [, friction, friction_speed].

    per_area: whether stiffness is per area [N/m^3]; what is said here of a vertex is then said of one square metre.
    A shape writes one function, `distance_and_normal`, in numbers of a graph; everything else follows from it. Positions
    are relative to the obstacle: callers take its displacement from X. The numbers of one that turns end in the point that
    it turns about, and its X is seven numbers: a place, and the unit quaternion of its rotation. A change of X + u is then
    six numbers, a change of place as the obstacle sees it and theta, the change dR = [theta]x R; so are adjoints.
    """

    friction: bool = False
    per_area: bool = field(default=False, kw_only=True)
    turns: bool = field(default=False, kw_only=True)

    count = 0
    watched = True
    hollow = False  # whether no point of a triangle is nearer than its nearest corner
    lanes = False  # whether `distance_and_normal` also takes numbers in lanes

    @property
    def size(self) -> int:
        return self.index.end

    @cached_property
    def index(self) -> SimpleNamespace:
        """Where each of its numbers stands, by name, counted from its first; those of its shape come first."""
        sizes = dict(shape=self.count, stiffness=1, width=1)
        sizes |= dict(friction=1, friction_speed=1) if self.friction else {}
        return indices(**sizes, **(dict(about=3) if self.turns else {}))

    @traced
    def distance_and_normal(self, g, p, X, u) -> tuple:
        """(d, n) of the point X + u; p are the shape's numbers; n is the gradient of d, a list of three."""

    # ---- recording --------------------------------------------------------------------------------------------------

    @traced
    def record(self, parameters, first, X, u, of=None):
        """(graph, all numbers, components of u, d, n) at a point; of: gives another number and vector, of all numbers.
        Behind these stand those of `corners`, each leaf with the `row` of the parameters where it is."""
        g = Graph(self.fp, parameters)
        g.first, g.corners = first, []
        p = [g.leaf(x) for x in self._numbers(parameters, first)]
        rest, moved = ([g.leaf(at(vector, d)) for d in range(3)] for vector in (X, u))
        if self.turns and length_of(X) == 7:  # else X + u is a place as the obstacle was made
            moved, d, n = self._record_turned(g, p, let(X), rest, moved, of or self._by_shape)
        else:
            d, n = (of or self._by_shape)(g, p, rest, moved)
        return g, [*p, *g.corners], moved, d, n

    @traced
    def _by_shape(self, g, p, X, u):
        return self.distance_and_normal(g, p[: self.count], X, u)

    @traced
    def rows_of(self, p):
        """Of each corner the row of its first number."""
        return [q.row for q in p[self.size :: 3]]

    @traced
    def _record_turned(self, g, p, X, rest, moved, of):
        """(leaves of u and theta, d, n) from the place as the obstacle was made, c + R^T (X - c) + R^T u."""
        R = rotation_matrix([at(X, 3 + k) for k in range(4)])
        c = [x.value for x in p[self.index.about :]]
        arm = [let(x.value - y) for x, y in zip(rest, c)]
        made = [g.leaf(c[d] + sum_of(R[e][d] * arm[e] for e in range(3))) for d in range(3)]
        theta = [g.number(0) for _ in range(3)]
        back = [
            g.function(
                sum_of(R[e][d] * moved[e].value for e in range(3)),
                *((moved[e], lambda e=e, d=d: R[e][d]) for e in range(3)),
            )
            for d in range(3)
        ]
        d, own = of(g, p, made, back)
        n = [let(sum_of(R[e][k] * own[k].value for k in range(3))) for e in range(3)]
        by_theta = (0, n[2], -n[1]), (-n[2], 0, n[0]), (n[1], -n[0], 0)  # of theta x n
        rows = [
            g.function(
                n[e],
                *((own[k], lambda e=e, k=k: R[e][k]) for k in range(3)),
                *((theta[k], lambda e=e, k=k: let(by_theta[e][k])) for k in range(3) if k != e),
            )
            for e in range(3)
        ]
        return [*moved, *theta], d, rows

    @traced
    def push(self, g, p, d):
        """Size N of the barrier's force."""
        stiffness, width = p[self.index.stiffness], p[self.index.width]
        s, fp = d / width, self.fp
        slope = g.function(barrier.slope(s.value, fp), (s, lambda: barrier.curvature(s.value, fp)))
        return g.number(0) - stiffness * width * slope

    @traced
    def rough(self, p):
        """(mu, friction speed)"""
        return p[self.index.friction], p[self.index.friction_speed]

    @traced
    def _record_force(self, parameters, first, X, u):
        g, p, moved, d, n = self.record(parameters, first, X, u)
        push = self.push(g, p, d)
        return g, p, moved, [push * k for k in n]

    @traced
    def vector_of(self, numbers):
        if len(numbers) == 6:
            return let(ti.types.vector(6, self.fp)(*numbers))
        return let(ti.types.vector(4, self.fp)(*numbers, ti.cast(0, self.fp)))

    # ---- distance ---------------------------------------------------------------------------------------------------

    @traced
    def gap(self, parameters, first, X, u):
        """Distance d [m]."""
        return self.record(parameters, first, X, u)[3].value

    @traced
    def contact_plane(self, parameters, first, X, u):
        """(n, d): normal and distance [m]."""
        _, _, _, d, n = self.record(parameters, first, X, u)
        return let(ti.types.vector(4, self.fp)(*(k.value for k in n), d.value))

    @traced
    def contact_plane_jvp(self, parameters, first, X, u, du, parameters_dot=None):
        """Its change for changes of the place and, where given, of the obstacle's numbers."""
        g, p, moved, d, n = self.record(parameters, first, X, u)
        known = p if parameters_dot is not None else ()
        dots = all_changes(known, parameters_dot, first, (moved, du))
        return let(ti.types.vector(4, self.fp)(*g.forward(dots, [*n, d])))

    @traced
    def contact_plane_vjp(self, parameters, first, X, u, adjoint, sums, i):
        """Add to sums[first.., i] what an adjoint of (n, d) says of the obstacle's numbers."""
        g, p, _, d, n = self.record(parameters, first, X, u)
        leaves = [*p[: self.count], *p[self.size :]]
        adjoints = g.reverse([(x, let(at(adjoint, k))) for k, x in enumerate([*n, d])], leaves)
        self.add_numbers(first, leaves, adjoints, sums, i)

    @ti.func
    def width(self, parameters: ti.template(), first):
        """The distance at which the barrier begins to act [m]."""
        return parameters[first + self.index.width]

    @ti.func
    def touches(self, parameters: ti.template(), first, X, u):
        """Whether the barrier acts."""
        return self.gap(parameters, first, X, u) < self.width(parameters, first)

    @ti.func
    def may_touch(self, parameters: ti.template(), first, X, u):
        """False only where the barrier does not act; what is the same without a look costs less where looking costs most."""
        return self.touches(parameters, first, X, u)

    @traced
    def approach(self, parameters, first, X, u, move):
        """Change of the distance for a small move, n . move [m]."""
        n = self.record(parameters, first, X, u)[4]
        return let(sum_of(n[d].value * at(move, d) for d in range(3)))

    @ti.func
    def reached(self, parameters: ti.template(), first, X, u, move, d, approach):
        """The least distance on the way of a move from a place at distance d, not positive where it leads through [m];
        approach: change of the distance by the plane there."""
        return ti.min(d, d + approach)

    @ti.func
    def rigidity(self, parameters: ti.template(), first, X, u):
        """b''(d) [N/m]"""
        s = self.gap(parameters, first, X, u) / self.width(parameters, first)
        return parameters[first + self.index.stiffness] * barrier.curvature(s, self.fp)

    # ---- the barrier's force ----------------------------------------------------------------------------------------

    @ti.func
    def energy(self, parameters: ti.template(), first, X, u):
        width = self.width(parameters, first)
        s = self.gap(parameters, first, X, u) / width
        return parameters[first + self.index.stiffness] * width * width * barrier.value(s, self.fp)

    @ti.func
    def force(self, parameters: ti.template(), first, X, u, v):
        f = 0 * u
        if self.may_touch(parameters, first, X, u):
            f = self._force(parameters, first, X, u)
        return f

    @ti.func
    def force_jvp(self, parameters: ti.template(), first, X, u, v, du, dv):
        df = 0 * u
        if self.may_touch(parameters, first, X, u):
            df = self._force_jvp(parameters, first, X, u, du)
        return df

    @ti.func
    def force_vjp(self, parameters: ti.template(), first, X, u, v, w):
        return self._force_vjp(parameters, first, X, u, v, w), 0 * w

    @ti.func
    def parameter_derivatives(self, parameters: ti.template(), first, X, u, v):
        by = self._zeros(u)
        if self.may_touch(parameters, first, X, u):
            self._parameter_derivatives(parameters, first, X, u, by)
        return by

    @traced
    def _force_vjp(self, parameters, first, X, u, v, w):
        by_u = self.force_jvp(parameters, first, X, u, v, w, w)  # a force with a potential
        if not self.turns:
            return by_u
        f = let(self.force(parameters, first, X, u, v))
        by_theta = cross([at(f, d) for d in range(3)], [at(w, d) for d in range(3)])
        return self.vector_of([*(at(by_u, d) for d in range(3)), *by_theta])

    @traced
    def _force(self, parameters, first, X, u):
        return self.vector_of([k.value for k in self._record_force(parameters, first, X, u)[3]])

    @traced
    def _force_jvp(self, parameters, first, X, u, du):
        g, _, moved, f = self._record_force(parameters, first, X, u)
        return self.vector_of(g.forward(changes(moved, du), f))

    @traced
    def _zeros(self, u):
        return [let(u * ti.cast(0, self.fp)) for _ in range(self.size)]

    @traced
    def _parameter_derivatives(self, parameters, first, X, u, by):
        g, p, _, f = self._record_force(parameters, first, X, u)
        rows = [g.reverse([(f[d], g.one())], p[: self.size]) for d in range(3)]
        for m, target in enumerate(by):
            assign(target, self.vector_of([row[m] for row in rows]))

    # ---- friction as a stage of explicit passes ----------------------------------------------------------------------

    @traced
    def _record_slide(self, parameters, first, X, u, v, v_obstacle, h_over_m):
        g, p, moved, d, n = self.record(parameters, first, X, u)
        before = [g.leaf(at(v, d)) for d in range(3)]
        ratio, v_obstacle = g.leaf(h_over_m), [g.leaf(at(v_obstacle, d)) for d in range(3)]
        after = friction.slide(g, n, self.push(g, p, d), before, v_obstacle, ratio, *self.rough(p))
        return g, p, moved, before, v_obstacle, ratio, after

    @traced
    def slide(self, parameters, first, X, u, v, v_obstacle, h_over_m):
        """Velocity after friction in the time h on a vertex of mass m that touches; `v_obstacle`: the obstacle's
        velocity."""
        return self.vector_of(
            [k.value for k in self._record_slide(parameters, first, X, u, v, v_obstacle, h_over_m)[-1]]
        )

    @traced
    def slide_jvp(self, parameters, first, X, u, velocities, h_over_m, parameters_dot, du, changes, dh_over_m):
        """Its change; velocities: v and v_obstacle, and changes of both."""
        g, p, moved, *both, ratio, after = self._record_slide(parameters, first, X, u, *velocities, h_over_m)
        dots = all_changes(p, parameters_dot, first, (moved, du), *zip(both, changes))
        return self.vector_of(g.forward([(ratio, dh_over_m), *dots], after))

    @traced
    def slide_vjp(self, parameters, first, X, u, v, v_obstacle, h_over_m, w):
        """(adjoints of u, v and the obstacle's velocity as vectors, of h_over_m, and of the obstacle's numbers, a
        tuple) for the adjoint w."""
        g, p, moved, before, obstacle, ratio, after = self._record_slide(
            parameters, first, X, u, v, v_obstacle, h_over_m
        )
        adjoints = g.reverse([(k, let(at(w, d))) for d, k in enumerate(after)], [*moved, *before, *obstacle, ratio, *p])
        by = (*adjoints[len(moved) + 7 :], *self.rows_of(p))
        return (*self.parted(adjoints, len(moved)), adjoints[len(moved) + 6], by)

    # ---- friction as a force of implicit passes, at the velocity v; contact: (X, u), where N and n are those of the
    # barrier, and where they are not those of `distance_and_normal`, what `record` takes them from -------------------------

    @traced
    def _record_friction_force(self, parameters, first, contact, v, v_obstacle):
        g, p, place, d, n = self.record(parameters, first, *contact)
        n, push = friction.normal_force(g, n, self.push(g, p, d))
        speed, v_obstacle = ([g.leaf(at(vector, d)) for d in range(3)] for vector in (v, v_obstacle))
        return g, p, place, speed, v_obstacle, n, push

    @traced
    def _numbers(self, parameters, first):
        return [at(parameters, first + k) for k in range(self.size)]

    @traced
    def dissipation(self, parameters, first, contact, v, v_obstacle):
        """Potential of friction by the velocity [W]."""
        g, p, _, speed, v_obstacle, n, push = self._record_friction_force(parameters, first, contact, v, v_obstacle)
        return friction.dissipation(g, n, push, speed, v_obstacle, *self.rough(p)).value

    @traced
    def _with_friction(self, parameters, first, contact, v, v_obstacle):
        g, p, moved, speed, v_obstacle, n, push = self._record_friction_force(parameters, first, contact, v, v_obstacle)
        return g, p, moved, speed, v_obstacle, friction.friction_force(g, n, push, speed, v_obstacle, *self.rough(p))

    @traced
    def friction_force(self, parameters, first, contact, v, v_obstacle):
        """Force of friction [N]; `v_obstacle`: the obstacle's velocity."""
        return self.vector_of([k.value for k in self._with_friction(parameters, first, contact, v, v_obstacle)[-1]])

    @traced
    def friction_product(self, parameters, first, contact, v, v_obstacle, dv):
        """Its change for a change of the velocity alone."""
        g, _, _, speed, _, f = self._with_friction(parameters, first, contact, v, v_obstacle)
        return self.vector_of(g.forward([(x, at(dv, d)) for d, x in enumerate(speed)], f))

    @traced
    def friction_force_jvp(self, parameters, first, contact, v, v_obstacle, parameters_dot, du, dv, dv_obstacle):
        """Its change for changes of everything."""
        g, p, moved, speed, obstacle, f = self._with_friction(parameters, first, contact, v, v_obstacle)
        dots = all_changes(p, parameters_dot, first, (moved, du), (speed, dv), (obstacle, dv_obstacle))
        return self.vector_of(g.forward(dots, f))

    @traced
    def friction_force_vjp(self, parameters, first, contact, v, v_obstacle, w, sums, i):
        """Adjoints of u, v and the obstacle's velocity as vectors for the adjoint w of the force; adds to sums[.., i] those
        of the obstacle's numbers."""
        g, p, moved, speed, obstacle, f = self._with_friction(parameters, first, contact, v, v_obstacle)
        adjoints = g.reverse([(k, let(at(w, d))) for d, k in enumerate(f)], [*moved, *speed, *obstacle, *p])
        self.add_numbers(first, p, adjoints[len(moved) + 6 :], sums, i)
        return self.parted(adjoints, len(moved))

    @traced
    def add_numbers(self, first, leaves, adjoints, sums, i):
        """Add to sums[.., i] the adjoints of the obstacle's numbers, from the first on, and of corners where they stand."""
        for k, (leaf, by) in enumerate(zip(leaves, adjoints)):
            row = getattr(leaf, "row", first + k)
            assign(at(sums, row, i), at(sums, row, i) + by)

    @traced
    def parted(self, adjoints, count):
        """Those of `count` numbers of a place, and of two vectors after them."""
        return [self.vector_of(adjoints[a:b]) for a, b in ((0, count), (count, count + 3), (count + 3, count + 6))]
