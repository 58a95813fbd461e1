"""Impulses of obstacles in the contact stage of explicit passes, summed over the passes of a frame where a loss names them.

In a pass obstacle o gives vertex i h P_o n_o by its push and c m (v_o - v_(o-1)) by its friction, v_o being the velocity
after the frictions of obstacles 1 .. o, and c the share of them that the vertex takes (contact_friction.py): what the stage
adds to the vertex's momentum, to round-off, or, in directions in which it is fixed, to what holds it. They are added to rows
now.into + 2 o and now.into + 2 o + 1 of `impulse`; now.into is negative in passes that no frame counts.
"""

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_stages import PLANE, PUSH, ROWS, SEED
from diffsim_ti.runtime import A


@ti.func
def note_impulses(self: A, i, v_plus, z, ratio, now: A, scene: A, state: A):
    """Add what the noted pushes, and the frictions on v+, are."""
    if now.into >= 0:
        x, _ = self.crowding(i, v_plus, self.slide_all(i, v_plus, ratio, scene, state), z, now, state)
        share, _ = self.share_and_slope(x)
        v = v_plus
        for c in range(ti.static(self.features.num_staged)):
            o = ti.static(self.features.first_staged) + c
            row, at = ROWS * o, now.into + 2 * o
            pushed, after = state.stage[row + PUSH, i], self.slide(o, i, v, ratio, scene, state)
            n = self.normal(state.stage[row + PLANE, i])
            state.impulse[at, i] = state.impulse[at, i] + now.h * pushed.x * n
            state.impulse[at + 1, i] = state.impulse[at + 1, i] + share * (after - v) / scene.inverse_mass[i]
            v = self.led(i, v, after, scene)


@ti.func
def note_pushes_jvp(self: A, i, now: A, state: A, tangent: A):
    """The change of those of pushes, from the noted changes of (n, P)."""
    if now.into >= 0:
        for c in range(ti.static(self.features.num_staged)):
            o = ti.static(self.features.first_staged) + c
            row, at = ROWS * o, now.into + 2 * o
            pushed, change = state.stage[row + PUSH, i], state.stage[row + SEED, i]
            turned = pushed.x * self.normal(change) + change.w * self.normal(state.stage[row + PLANE, i])
            tangent.impulse[at, i] = tangent.impulse[at, i] + now.h * turned


@ti.func
def note_friction_jvp(self: A, i, u, du, v, dv, share, dshare, ratio, dratio, now: A, scene: A, state: A, tangent: A):
    """The change of those of friction, v being the velocity before it."""
    if now.into >= 0:
        inverse = scene.inverse_mass[i]
        for g in ti.static(self.features.staged_rough):
            for k in range(g.count):
                at = now.into + 2 * (g.number + k) + 1
                after, dafter = self.slide_jvp_of(g, k, i, u, du, v, dv, ratio, dratio, now, scene, state, tangent)
                gained = (share * (dafter - dv) + dshare * (after - v)) / inverse + share * tangent.mass[i] * (
                    after - v
                )
                tangent.impulse[at, i] = tangent.impulse[at, i] + gained
                v, dv = self.led(i, v, after, scene), self.led(i, dv, dafter, scene)


@ti.func
def seed_impulses(self: A, i, now: A, state: A, adjoint: A):
    """Add to the noted adjoints of (n, P) those by the impulses of pushes."""
    if now.into >= 0:
        for c in range(ti.static(self.features.num_staged)):
            o = ti.static(self.features.first_staged) + c
            row, by = ROWS * o, adjoint.impulse[now.into + 2 * o, i]
            seed = state.stage[row + SEED, i]
            more = now.h * state.stage[row + PUSH, i].x * by
            more.w = now.h * self.normal(state.stage[row + PLANE, i]).dot(by)
            state.stage[row + SEED, i] = seed + more


@ti.func
def seed_of_friction(self: A, c, i, now: A, scene: A, adjoint: A):
    """Adjoint of the velocity after the friction of staged obstacle c, by its impulse; that before it has the opposite."""
    out = self.vector(0)
    if now.into >= 0:
        out = adjoint.impulse[now.into + 2 * (ti.static(self.features.first_staged) + c) + 1, i] / scene.inverse_mass[i]
    return out


@ti.func
def friction_by_mass(self: A, c, i, before, share, ratio, now: A, scene: A, state: A, adjoint: A):
    """Add the adjoint of the mass by the impulse of friction, `before` being the velocity before it."""
    if ti.static(self.features.density):
        if now.into >= 0:
            o, row = ti.static(self.features.first_staged) + c, ti.static(self.features.sums().first("mass"))
            gained = share * (self.slide(o, i, before, ratio, scene, state) - before)
            by = gained.dot(adjoint.impulse[now.into + 2 * o + 1, i])
            adjoint.sums[row, i] = adjoint.sums[row, i] + by


@ti.func
def friction_by_share(self: A, i, v, ratio, now: A, scene: A, state: A, adjoint: A):
    """Adjoint of the share of friction that the vertex takes, by the impulses."""
    out = ti.cast(0, self.fp)
    for c in range(ti.static(self.features.num_staged)):
        after = self.slide(ti.static(self.features.first_staged) + c, i, v, ratio, scene, state)
        out += (after - v).dot(seed_of_friction(self, c, i, now, scene, adjoint))
        v = self.led(i, v, after, scene)
    return out
