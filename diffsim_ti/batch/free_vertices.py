"""Vertices at which nothing acts but tetrahedra, gravity, prescribed forces and drag, of eight scenes simultaneously.

What happens there is what explicit/kick_drift.py says; an obstacle that none of the eight comes near in a pass does nothing
in it. Vectors are lists of three numbers in lanes here.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.loads.explicit import AppliedForces
from diffsim_ti.runtime import LANES, PRECISIONS, Bundle, assign, at, let, traced, variable
from diffsim_ti.runtime.piecewise import Piece
from diffsim_ti.solvers.explicit import kick_drift
from diffsim_ti.state.features import Features

A = ti.template()
NEAR, SPECIAL = 1, 2  # vertices that are as above if obstacles are far; never
MARGIN = 1.01  # of an obstacle's width, and of a move towards it, so that rounding decides nothing


@traced
class Component:
    """A component of vectors of a block: `array[row, k]` is that of vector k, in lanes."""

    _data_oriented = True

    def __init__(self, array, first):
        self._array, self._first = array, first

    def __getitem__(self, index):
        return at(self._array, index[0], self._first + 3 * index[1])


@dataclass(frozen=True)
class GivenInLanes(AppliedForces):
    """As AppliedForces, of a component in lanes in place of a vector."""

    @property
    def vector(self):
        return ti.types.vector(LANES, self.fp)


@traced
def each(formula, *vectors, **numbers) -> list:
    """A formula of components, or lists of what several make of them."""
    found = [formula(*components, **numbers) for components in zip(*vectors)]
    return list(zip(*found)) if type(found[0]) is tuple else found


@dataclass(frozen=True)
class FreeVertices:
    """Functions of vertex i of block b; s: the slot of its state."""

    law: object
    features: Features
    own: frozenset

    @property
    def fp(self):
        return PRECISIONS[self.law.precision]

    @cached_property
    def lanes(self):
        return ti.types.vector(LANES, self.fp)

    @property
    def some_special(self) -> bool:
        """Whether something else may act at a vertex."""
        has = self.features
        return bool(has.groups) or has.motion or has.partly_fixed or bool(has.at_vertices)

    # ---- reading and writing -----------------------------------------------------------------------------------------

    @traced
    def first_of(self, i, b, plan):
        return let(3 * (b * plan.num_vertices + i))

    @traced
    def read(self, array, *place):
        *slot, first = place
        return [let(at(array, *slot, first + d)) for d in range(3)]

    @traced
    def write(self, array, numbers, *place):
        *slot, first = place
        for d, number in enumerate(numbers):
            assign(at(array, *slot, first + d), number)

    @traced
    def add_number(self, array, number, *place):
        target = at(array, *place)
        assign(target, target + number)

    @ti.func
    def clear(self, b, i, corner: A, plan: A):
        first = 3 * (b * plan.num_vertices + i)
        for d in ti.static(range(3)):
            corner[first + d] = self.lanes(0)

    @traced
    def inverse_mass(self, i, b, scene, plan):
        return let(at(scene.inverse_mass, b * plan.num_vertices + i if "inverse_mass" in self.own else i))

    @traced
    def moves(self, inverse):
        """Whether a vertex has a mass: 1 or 0 for all eight."""
        one = at(inverse, 0) if "inverse_mass" in self.own else inverse
        return let(ti.select(one > 0, ti.cast(1, self.fp), ti.cast(0, self.fp)))

    @traced
    def gravity(self, b, parameters, plan):
        first = let(b * plan.num_parameters + self.features.gravity)
        return self.read(parameters, first)

    # ---- forces given on vertices --------------------------------------------------------------------------------------

    @cached_property
    def given(self) -> GivenInLanes:
        return GivenInLanes(self.features, self.law.precision)

    @traced
    def given_on(self, b, record, plan) -> list:
        """Components of the forces on vertices of block b, or of changes or adjoints of them."""
        first = let(3 * b * plan.num_loaded)
        return [Bundle(forces=Component(record.forces, let(first + d))) for d in range(3)]

    @traced
    def with_load(self, f, i, b, now, scene, record, plan) -> list:
        """f, and what is given on vertex i in a pass."""
        components = self.given_on(b, record, plan)
        return [let(x + self.given.force(i, now, scene, own.forces)) for x, own in zip(f, components)]

    # ---- forward -------------------------------------------------------------------------------------------------------

    @traced
    def moved(self, i, b, s, now, scene, state, plan):
        """What a pass makes of vertex i: u, v before, f, v_mid, u_next, v_next."""
        first, F = self.first_of(i, b, plan), self.features
        u, v, f = self.read(state.u, s, first), self.read(state.v, s, first), self.read(scene.corner, first)
        if F.forces:
            f = self.with_load(f, i, b, now, scene, scene, plan)
        inverse = self.inverse_mass(i, b, scene, plan)
        a = [let(inverse * x) for x in f]
        if F.gravity >= 0:
            moves = self.moves(inverse)
            a = [let(x + moves * g) for x, g in zip(a, self.gravity(b, scene.parameters, plan))]
        v_mid, v_plus = each(kick_drift.kick, v, a, now=now)
        u_next, v_next = each(kick_drift.drift, u, v_plus, now=now)
        return Bundle(first=first, u=u, f=f, v_mid=v_mid, u_next=u_next, v_next=v_next)

    @ti.func
    def step(self, i, b, s, now: A, scene: A, state: A, plan: A):
        """Do the pass and return 1, or do nothing and return 0 if something else acts."""
        moved, calm = self.moved(i, b, s, now, scene, state, plan), 1
        if ti.static(self.some_special):
            kind = scene.special[i]
            if kind == SPECIAL:
                calm = 0
            if ti.static(len(self.lane_groups) > 0):
                if kind == NEAR:
                    if self.hits(i, b, moved, now, scene, plan) > 0:
                        calm = 0
        if calm == 1:
            self.note_frame(now, state, moved.u, moved.v_mid, moved.first)
            if plan.stride > 0:
                self.write(state.f, moved.f, s, moved.first)
            self.write(state.u, moved.u_next, s + plan.stride, moved.first)
            self.write(state.v, moved.v_next, s + plan.stride, moved.first)
        return calm

    # ---- obstacles -----------------------------------------------------------------------------------------------------

    @property
    def lane_groups(self) -> tuple:
        """Obstacles whose distance can be told in lanes; none if one cannot."""
        staged = self.features.staged
        all_in_lanes = len(staged) == len(self.features.groups) and all(
            g.force.lanes and not g.force.turns for g in staged
        )
        return staged if all_in_lanes else ()

    @ti.func
    def hits(self, i, b, moved: A, now: A, scene: A, plan: A):
        """In how many scenes an obstacle may act or be noted in the pass."""
        count = ti.cast(0, self.fp)
        for g in ti.static(self.lane_groups):
            for k in range(g.count):
                count += self.hits_of(g, k, i, b, moved, now, scene, plan)
        return count

    @traced
    def hits_of(self, g, k, i, b, moved, now, scene, plan):
        first, parameters = let(g.first + k * g.size), Piece(scene.parameters, let(b * plan.num_parameters))
        X = self.rest(i, b, scene, plan)
        move = [let(x - y) for x, y in zip(moved.u_next, moved.u)]
        if g.path >= 0:
            column = let(3 * (b * self.features.moving + g.path + k))
            start, end = (self.read(scene.path, row, column) for row in (now.row, now.next))
            gone = [let(y - x) for x, y in zip(start, end)]
            X = [let(x - (y + now.begin * z)) for x, y, z in zip(X, start, gone)]
            move = [let(x - (now.end - now.begin) * y) for x, y in zip(move, gone)]
        X = [let(self.lanes(*[x] * LANES)) if not x.is_tensor() else x for x in X]
        d, width = g.force.record(parameters, first, X, moved.u)[3].value, let(g.force.width(parameters, first))
        far = let(d - MARGIN * width)
        square = let(MARGIN * MARGIN * (move[0] * move[0] + move[1] * move[1] + move[2] * move[2]))
        one, none = ti.cast(1, self.fp), ti.cast(0, self.fp)
        out = none
        for lane in range(LANES):
            gap, way = let(at(far, lane)), let(at(square, lane))
            out = out + ti.select(gap < 0, one, ti.select(way >= gap * gap, one, none))
        return let(out)

    @traced
    def rest(self, i, b, scene, plan):
        if "rest" in self.own:
            return self.read(scene.rest, self.first_of(i, b, plan))
        whole = let(at(scene.rest, i))
        return [let(at(whole, d)) for d in range(3)]

    # ---- tangent -------------------------------------------------------------------------------------------------------

    @traced
    def step_jvp(self, i, b, s, now, scene, state, tangent, plan):
        first, F, n = self.first_of(i, b, plan), self.features, let(b * plan.num_vertices + i)
        du, dv, df = self.read(tangent.u, 0, first), self.read(tangent.v, 0, first), self.read(scene.corner, first)
        if F.forces:
            df = self.with_load(df, i, b, now, scene, tangent, plan)
        inverse, f = self.inverse_mass(i, b, scene, plan), self.read(state.f, s, first)
        dm = let(at(tangent.mass, n))
        da = each(kick_drift.acceleration_jvp, f, df, dm=dm, inverse=inverse)
        if F.gravity >= 0:
            moves = self.moves(inverse)
            da = [let(x + moves * g) for x, g in zip(da, self.gravity(b, tangent.parameters, plan))]
        dv_mid, dv_plus = each(kick_drift.kick, dv, da, now=now)
        du_next, dv_next = each(kick_drift.drift, du, dv_plus, now=now)
        if F.drag >= 0:
            rate = let(at(tangent.parameters, b * plan.num_parameters + F.drag))
            v_plus = [let(x / now.decay) for x in self.read(state.v, let(s + 1), first)]
            du_next, dv_next = each(kick_drift.drift_by_rate, du_next, dv_next, v_plus, rate=rate, now=now)
        self.note_frame(now, tangent, du, dv_mid, first)
        self.write(tangent.u, du_next, 0, first)
        self.write(tangent.v, dv_next, 0, first)

    @ti.func
    def note_frame(self, now: A, record: A, u: A, v: A, first):
        if now.frame >= 0:
            self.write(record.frames_u, u, now.frame, first)
            self.write(record.frames_v, v, now.frame, first)

    # ---- adjoint -------------------------------------------------------------------------------------------------------

    @ti.func
    def add_frame(self, now: A, p: A, v: A, adjoint: A, first):
        """Add the adjoints of the frame that the pass shows."""
        if now.frame >= 0:
            self.add_to(p, adjoint.frames_u, now.frame, first)
            self.add_to(v, adjoint.frames_v, now.frame, first)

    @traced
    def add_to(self, numbers, array, *place):
        for number, more in zip(numbers, self.read(array, *place)):
            assign(number, number + more)

    @traced
    def dot(self, x, y):
        return let(x[0] * y[0] + x[1] * y[1] + x[2] * y[2])

    @traced
    def step_vjp(self, i, b, s, now, scene, state, adjoint, plan):
        first, F, n = self.first_of(i, b, plan), self.features, let(b * plan.num_vertices + i)
        p = [let(x + y) for x, y in zip(self.read(adjoint.u, 0, first), self.read(adjoint.corner, first))]
        q = self.read(adjoint.v, 0, first)
        if "H_dot" in self.law.reads or any(x.reads_rates for x in F.interactions):
            q = [let(x + y) for x, y in zip(q, self.read(adjoint.rate_corner, first))]
        v_plus_adj = each(kick_drift.drift_vjp, p, q, now=now)
        if F.drag >= 0:
            v_plus = [let(x / now.decay) for x in self.read(state.v, let(s + 1), first)]
            by_rate = now.alpha_by_rate * self.dot(p, v_plus) + now.decay_by_rate * self.dot(q, v_plus)
            self.add_number(adjoint.sums, let(by_rate), F.drag, n)
        p, v_mid_adj = ([variable(x) for x in y] for y in (p, v_plus_adj))
        self.add_frame(now, p, v_mid_adj, adjoint, first)
        a_adj = each(kick_drift.kick_vjp, v_plus_adj, v_mid_adj, now=now)
        inverse = self.inverse_mass(i, b, scene, plan)
        f_adj = [let(inverse * x) for x in a_adj]
        if F.density:
            by_mass = let(inverse * self.dot(f_adj, self.read(state.f, s, first)))
            self.add_number(adjoint.sums, let(0 - by_mass), F.sums().first("mass"), n)
        if F.gravity >= 0:
            moves = self.moves(inverse)
            for d in range(3):
                self.add_number(adjoint.sums, let(moves * a_adj[d]), F.gravity + d, n)
        if F.forces:
            for x, own in zip(f_adj, self.given_on(b, adjoint, plan)):
                self.given.add_vjp(i, x, now, scene, own)
        self.write(adjoint.u, p, 0, first)
        self.write(adjoint.v, v_mid_adj, 0, first)
        self.write(adjoint.w, f_adj, 0, first)
