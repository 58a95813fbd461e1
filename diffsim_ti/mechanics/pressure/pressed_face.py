"""Faces under a pressure that follows them: forces, their differential and adjoint, x = X + u.

Corners of a triangle have -p n / 3, n = (x_1 - x_0) x (x_2 - x_0) / 2, nodes of a face of six f_a = -p integral of
N_a dx/ds x dx/dt, of which the integrand is of degree four, and the rule of reference_face.py exact. Node a of pressed face
t writes corner `first + 6 t + a`, or 3 t + a, and vertices gather it with those of tetrahedra.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.mechanics.interaction import ItemForce, edges, store_alike
from diffsim_ti.mechanics.stress.step_numbers import StepNumbers
from diffsim_ti.mesh import reference_face
from diffsim_ti.runtime import A, assign, at, let, traced


@dataclass(frozen=True)
class PressedTriangle(StepNumbers, ItemForce):
    """Functions of one triangle in a pass; per_step: whether pressures have a row for each step; shape: of adjoints."""

    shape: bool
    nodes = 3
    name, reads_rest, asks_for_steps = "pressed", True, True
    arrays, derived = dict.fromkeys(("pressed", "pressed_load"), "ints"), dict(follower="vectors2")
    adjoints = dict(pressure_adjoint="vectors2", pressed_rest="vectors")

    @traced
    def sizes(self, plan) -> dict:
        return super().sizes(plan) | dict(pressure_adjoint=plan.num_pressed, pressed_rest=self.nodes * plan.num_pressed)

    @ti.func
    def factor(self, t, now: A, rows: A, scene: A):
        """-p / 6, by which the product of edges gives the force of a corner."""
        return self.mean(scene.pressed_load[t], now, rows) * ti.cast(-1.0 / 6.0, self.fp)

    @ti.func
    def forces(self, t, now: A, scene: A, state: A, s, plan: A):
        e, f = edges(scene.pressed, t, state.u, scene.rest, s)
        store_alike(self.factor(t, now, scene.follower, scene) * self.cross(e, f), scene.corner, self.first(plan), t)

    @ti.func
    def forces_jvp(self, t, now: A, scene: A, state: A, s, tangent: A, plan: A):
        e, f = edges(scene.pressed, t, state.u, scene.rest, s)
        de, df = edges(scene.pressed, t, tangent.u, tangent.rest, 0)
        p, dp = self.factor(t, now, scene.follower, scene), self.factor(t, now, tangent.follower, scene)
        change = p * (self.cross(de, f) + self.cross(e, df)) + dp * self.cross(e, f)
        store_alike(change, scene.corner, self.first(plan), t)

    @ti.func
    def forces_vjp(self, t, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        """Products of the transposed derivative with adjoint.w, to corners; adds the adjoints of pressures to
        adjoint.pressure_adjoint and, if `shape`, those of places to adjoint.pressed_rest."""
        e, f = edges(scene.pressed, t, state.u, scene.rest, s)
        w = adjoint.w[0, scene.pressed[3 * t]]
        for a in ti.static((1, 2)):
            w += adjoint.w[0, scene.pressed[3 * t + a]]
        p = self.factor(t, now, scene.follower, scene)
        by_e, by_f = p * self.cross(f, w), p * self.cross(w, e)
        balance = ti.cast(-1, self.fp) * (by_e + by_f)
        for a, by in ti.static(enumerate((balance, by_e, by_f))):
            adjoint.corner[self.first(plan) + 3 * t + a] = by
            if ti.static(self.shape):
                adjoint.pressed_rest[3 * t + a] = adjoint.pressed_rest[3 * t + a] + by
        self.add_mean(t, ti.cast(-1.0 / 6.0, self.fp) * w.dot(self.cross(e, f)), now, adjoint.pressure_adjoint)


BY = reference_face.derivatives(reference_face.POINTS)
# three times N_a times the points' shares: what the factor of a triangle's corner is to be multiplied by
SHARES = 3 * reference_face.WEIGHTS[:, None] * reference_face.functions(reference_face.POINTS)


@dataclass(frozen=True)
class PressedFace(PressedTriangle):
    """Functions of one face in a pass, as those of `PressedTriangle`."""

    nodes = 6

    @traced
    def times(self, factors, vectors):
        """Sum of vectors times numbers that are known when the kernel is compiled."""
        parts = [v * ti.cast(float(c), self.fp) for c, v in zip(factors, vectors) if c != 0]
        return let(sum_of(parts)) if parts else let(self.vector(0))

    @traced
    def tangents(self, t, x, rest, s, scene) -> list[tuple]:
        """(dx/ds, dx/dt) at each point, of rest + x in slot s."""
        i = [let(at(scene.pressed, 6 * t + a)) for a in range(6)]
        y = [let((at(rest, k) - at(rest, i[0])) + (at(x, s, k) - at(x, s, i[0]))) for k in i[1:]]
        return [tuple(self.times(by[1:, d], y) for d in range(2)) for by in BY]

    @traced
    def put(self, t, first, crosses, corner) -> None:
        """Forces of nodes from what points have."""
        for a in range(6):
            assign(at(corner, first + 6 * t + a), self.times(SHARES[:, a], crosses))

    @traced
    def push(self, t, p, scene, state, s, first) -> None:
        crosses = [let(self.cross(e, f) * p) for e, f in self.tangents(t, state.u, scene.rest, s, scene)]
        self.put(t, first, crosses, scene.corner)

    @traced
    def push_jvp(self, t, p, dp, scene, state, s, tangent, first) -> None:
        changes = []
        both = zip(self.tangents(t, state.u, scene.rest, s, scene), self.tangents(t, tangent.u, tangent.rest, 0, scene))
        for (e, f), (de, df) in both:
            turned = self.cross(de, f) + self.cross(e, df)
            changes.append(let(turned * p + self.cross(e, f) * dp))
        self.put(t, first, changes, scene.corner)

    @traced
    def push_vjp(self, t, p, scene, state, s, adjoint, first):
        """Writes and adds adjoints of places; returns w . sum of products, which p multiplies."""
        w = [let(at(adjoint.w, 0, at(scene.pressed, 6 * t + a))) for a in range(6)]
        by_s, by_t, products = [], [], []
        for q, (e, f) in enumerate(self.tangents(t, state.u, scene.rest, s, scene)):
            own = self.times(SHARES[q], w)
            by_s.append(let(self.cross(f, own) * p))
            by_t.append(let(self.cross(own, e) * p))
            n = self.cross(e, f)
            products += [at(own, d) * at(n, d) for d in range(3)]
        for a in range(6):
            by = let(self.times(BY[:, a, 0], by_s) + self.times(BY[:, a, 1], by_t))
            assign(at(adjoint.corner, first + 6 * t + a), by)
            if self.shape:
                assign(at(adjoint.pressed_rest, 6 * t + a), at(adjoint.pressed_rest, 6 * t + a) + by)
        return let(sum_of(products))

    @ti.func
    def forces(self, t, now: A, scene: A, state: A, s, plan: A):
        self.push(t, self.factor(t, now, scene.follower, scene), scene, state, s, self.first(plan))

    @ti.func
    def forces_jvp(self, t, now: A, scene: A, state: A, s, tangent: A, plan: A):
        p, dp = self.factor(t, now, scene.follower, scene), self.factor(t, now, tangent.follower, scene)
        self.push_jvp(t, p, dp, scene, state, s, tangent, self.first(plan))

    @ti.func
    def forces_vjp(self, t, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        p = self.factor(t, now, scene.follower, scene)
        products = self.push_vjp(t, p, scene, state, s, adjoint, self.first(plan))
        self.add_mean(t, ti.cast(-1.0 / 6.0, self.fp) * products, now, adjoint.pressure_adjoint)


def pressed_element(order: int, precision: str, per_step: bool, shape: bool) -> PressedTriangle:
    """Of faces of elements of order 1 or 2."""
    return (PressedFace if order == 2 else PressedTriangle)(precision, per_step, shape)
