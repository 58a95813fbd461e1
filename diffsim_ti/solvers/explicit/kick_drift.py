"""A pass of the explicit solvers, at one vertex. Every one of them is a chain of the same pass, a kick and a drift:

    a      = f(u) / m + g                       forces at displacement u
    v_mid  = v + pre a                          the velocity at this time (what frames show)
    v+     = v_mid + post a
    vs     = friction of the obstacles on v+    implicit, in closed form (friction.py), over the time h
    u'     = u + alpha vs
    v'     = decay vs                           damping, a stage of its own after the forces

Symplectic Euler: pre = 0, post = h, alpha = h decay. Velocity Verlet: pre = post = h / 2 (the two half kicks that meet at a
time share one force evaluation), alpha = h (1 + decay) / 2. Friction acts where there is a drift, so that
it acts for the whole time of a run. Below the pass stand its tangent and its adjoint.

A run's slot j holds the state before pass j. With stride 0 everything happens in slot 0 (forward only); with stride 1
each pass writes the next slot, which is what the adjoint reads.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.outside_work import add_work_of_pass, work_of_own_forces
from diffsim_ti.runtime import A, let, traced
from diffsim_ti.solvers.explicit.vertex_parts import VertexParts

# ---- formulas, of vectors or, component by component, of eight scenes in lanes (batch/free_vertices.py) -------------------


@traced
def kick(v, a, now) -> tuple:
    """(v_mid, v+) for an acceleration a, or their changes."""
    v_mid = let(v + now.pre * a)
    return v_mid, let(v_mid + now.post * a)


@traced
def drift(u, v, now) -> tuple:
    """(u', v') by a velocity v, or their changes."""
    return let(u + now.alpha * v), let(now.decay * v)


@traced
def drift_by_rate(u, v, v_plus, rate, now) -> tuple:
    """Changes of both with what a change of the drag rate adds."""
    return let(u + now.alpha_by_rate * rate * v_plus), let(v + now.decay_by_rate * rate * v_plus)


@traced
def acceleration_jvp(f, df, dm, inverse):
    """Change of f / m."""
    return let(inverse * (df - inverse * dm * f))


@traced
def drift_vjp(p, q, now):
    """Adjoint of the velocity that drifts, for those of u' and v'."""
    return let(now.alpha * p + now.decay * q)


@traced
def kick_vjp(v_plus_adj, v_mid_adj, now):
    """Adjoint of the acceleration."""
    return let(now.post * v_plus_adj + now.pre_adj * v_mid_adj)


@dataclass(frozen=True)
class KickDrift(VertexParts):
    """Taichi functions of one vertex i in pass j, whose numbers are `now` (state/schedule.py)."""

    @ti.func
    def half(self):
        return ti.cast(0.5, self.fp)  # dividing by 2 would compute in f64

    @ti.func
    def gravity(self, parameters: A):
        g = ti.static(self.features.gravity)
        return self.vector(parameters[g], parameters[g + 1], parameters[g + 2], ti.cast(0, self.fp))

    @ti.func
    def prescribed(self, i, scene: A):
        """Place of vertex i among those whose motion is prescribed, or -1."""
        k = -1
        if ti.static(self.features.motion):
            k = scene.motion_slot[i]
        return k

    @ti.func
    def kicked(self, i, v, f, now: A, scene: A):
        """(v_mid, v+) for the force f."""
        a = scene.inverse_mass[i] * f
        if ti.static(self.features.gravity >= 0):
            if scene.inverse_mass[i] > 0:
                a += self.gravity(scene.parameters)
        if ti.static(self.features.partly_fixed):
            a = self.sliding_supports.free(i, a, scene)
        return kick(v, a, now)

    @ti.func
    def lead(self, i, u, v, now: A, scene: A, of: A):
        """The displacement of vertex i in the pass where it is fixed; of: the scene, or its tangent."""
        out = self.vector(0)
        if ti.static(self.features.partly_fixed):
            u_prescribed, _ = self.sliding_supports.given(self.prescribed(i, scene), u, v, now, of)
            out = self.sliding_supports.held(i, u_prescribed - u, scene)
        return out

    @ti.func
    def driven(self, i, u, v, u_next, v_next, now: A, scene: A, of: A):
        """(u', v') where motion is prescribed, or their changes; of: the scene, or its tangent."""
        k = self.prescribed(i, scene)
        if ti.static(self.features.partly_fixed):
            u_prescribed, v_prescribed = self.sliding_supports.given(k, u, v, now, of)
            u_next = self.sliding_supports.end(i, k, u_next, u_prescribed, scene)
            v_next = self.sliding_supports.end(i, k, v_next, v_prescribed, scene)
        elif k >= 0:
            u_next, v_next = u, v
            if now.alpha > 0:
                change = of.motion[now.next, k] - of.motion[now.row, k]
                u_next = of.anchor[k] + of.motion[now.row, k] + now.end * change
                v_next = now.per_step * change
        return u_next, v_next

    # ---- the pass ----------------------------------------------------------------------------------------------------

    @ti.func
    def step(self, i, j, now: A, scene: A, state: A, plan: A):
        s = (j - plan.base) * plan.stride
        u, v = state.u[s, i], state.v[s, i]
        # forces
        f = self.element.gather(i, scene, scene.corner)
        if ti.static(len(self.features.pressing) > 0):
            if scene.surface[i] > 0:
                f = self.obstacles.add_force(i, f, u, v, now, scene)
        if ti.static(self.features.forces):
            f += self.given.force(i, now, scene, scene.forces)
        for part in ti.static(self.features.at_vertices):
            f += part.force(i, u, v, now, scene)
        if ti.static(self.features.reduced):
            if scene.body_of[i] < 0:
                self.go_on(i, j, u, v, f, now, scene, state, plan)
            else:  # the body's stage goes on (explicit.py)
                scene.body_force[0, i] = f
                if plan.stride > 0:
                    state.f[s, i] = f
        else:
            self.go_on(i, j, u, v, f, now, scene, state, plan)

    @ti.func
    def go_on(self, i, j, u, v, f, now: A, scene: A, state: A, plan: A):
        s, t = (j - plan.base) * plan.stride, (j - plan.base + 1) * plan.stride
        # kick, frame, kick
        v_mid, v_plus = self.kicked(i, v, f, now, scene)
        v_kicked = v_plus
        if now.frame >= 0:
            state.frames_u[now.frame, i] = u
            state.frames_v[now.frame, i] = v_mid
        u_next, v_next = self.drifted(i, u, v, v_plus, now, scene, state, plan)
        if ti.static(len(self.features.groups) > 0):
            if scene.surface[i] > 0:
                self.obstacles.note(i, u, u_next, now, scene, state)
        if ti.static(self.counts_work):
            add_work_of_pass(self, i, u, v, v_kicked, f, u_next, v_next, now, scene, state, plan)
        if ti.static(self.features.balanced):
            done = work_of_own_forces(self, i, v, v_kicked, f, v_next, now, scene, plan)
            state.own_work[i] = state.own_work[i] + done
        if ti.static(self.features.led):
            state.f[s, i] = f
        elif plan.stride > 0:
            state.f[s, i] = f
        state.u[t, i] = u_next
        state.v[t, i] = v_next

    @ti.func
    def drifted(self, i, u, v, v_plus, now: A, scene: A, state: A, plan: A):
        """(u', v') after the kick to v_plus: friction, drift, contact, damping."""
        if ti.static(len(self.features.rough) > 0):
            if now.alpha > 0 and scene.surface[i] > 0:
                v_plus = self.obstacles.slide_all(i, u, v_plus, now, scene)
        u_next, v_next = drift(u, v_plus, now)
        if ti.static(self.features.num_staged > 0):
            lead = self.lead(i, u, v, now, scene, scene)
            u_next, v_next = self.contact.advance(i, u, v_plus, lead, now, scene, state, plan)
        if ti.static(self.features.partly_fixed or self.features.motion):
            u_next, v_next = self.driven(i, u, v, u_next, v_next, now, scene, scene)
        return u_next, v_next

    @ti.func
    def press(self, i, now: A, scene: A, state: A, plan: A):
        """The pass again from slot 0 to slot 1, with the forces that are noted and obstacles that move in another way."""
        u, v = state.u[0, i], state.v[0, i]
        _, v_plus = self.kicked(i, v, state.f[0, i], now, scene)
        u_next, v_next = self.drifted(i, u, v, v_plus, now, scene, state, plan)
        state.u[1, i] = u_next
        state.v[1, i] = v_next

    # ---- its tangent -------------------------------------------------------------------------------------------------

    @ti.func
    def step_jvp(self, i, j, now: A, scene: A, state: A, tangent: A, plan: A):
        s = j - plan.base
        u, v, du, dv = state.u[s, i], state.v[s, i], tangent.u[0, i], tangent.v[0, i]
        # forces
        df = self.element.gather(i, scene, scene.corner)
        if ti.static(len(self.features.pressing) > 0):
            if scene.surface[i] > 0:
                df = self.obstacles.add_force_jvp(i, df, u, v, du, dv, now, scene, tangent)
        if ti.static(self.features.forces):
            df += self.given.force(i, now, scene, tangent.forces)
        for part in ti.static(self.features.at_vertices):
            df += part.force_jvp(i, u, v, du, dv, now, scene, tangent)
        if ti.static(self.features.reduced):
            if scene.body_of[i] < 0:
                self.go_on_jvp(i, j, df, now, scene, state, tangent, plan)
            else:
                tangent.body_force[0, i] = df
        else:
            self.go_on_jvp(i, j, df, now, scene, state, tangent, plan)

    @ti.func
    def go_on_jvp(self, i, j, df, now: A, scene: A, state: A, tangent: A, plan: A):
        """Its change for that of the force."""
        s, t = j - plan.base, j - plan.base + 1
        u, v, du, dv = state.u[s, i], state.v[s, i], tangent.u[0, i], tangent.v[0, i]
        inverse = scene.inverse_mass[i]
        da = acceleration_jvp(state.f[s, i], df, tangent.mass[i], inverse)
        if ti.static(self.features.gravity >= 0):
            if inverse > 0:
                da += self.gravity(tangent.parameters)
        if ti.static(self.features.partly_fixed):
            da = self.sliding_supports.free(i, da, scene)
        # kick, frame, kick
        dv_mid, dv_plus = kick(dv, da, now)
        if now.frame >= 0:
            tangent.frames_u[now.frame, i] = du
            tangent.frames_v[now.frame, i] = dv_mid
        v_plus = state.v[t, i] / now.decay
        if ti.static(len(self.features.rough) > 0):
            if now.alpha > 0 and scene.surface[i] > 0:
                _, before = self.kicked(i, v, state.f[s, i], now, scene)
                dv_plus = self.obstacles.slide_jvp(i, u, before, du, dv_plus, now, scene, tangent)
        # drift and damping
        du_next, dv_next = drift(du, dv_plus, now)
        du_next, dv_next = drift_by_rate(du_next, dv_next, v_plus, plan.rate_dot, now)
        if ti.static(self.features.num_staged > 0):
            _, before = self.kicked(i, v, state.f[s, i], now, scene)
            lead, dlead = self.lead(i, u, v, now, scene, scene), self.lead(i, du, dv, now, scene, tangent)
            du_next, dv_next = self.contact.advance_jvp(
                i, u, state.u[t, i] - u, before, du, dv_plus, lead, dlead, now, scene, state, tangent, plan
            )
        if ti.static(self.features.partly_fixed or self.features.motion):
            du_next, dv_next = self.driven(i, du, dv, du_next, dv_next, now, scene, tangent)
        tangent.u[0, i] = du_next
        tangent.v[0, i] = dv_next

    # ---- its adjoint -------------------------------------------------------------------------------------------------

    @ti.func
    def step_vjp(self, i, j, now: A, scene: A, state: A, adjoint: A, plan: A):
        """Complete the adjoint of the displacement after pass j, then go back through the vertex part of pass j."""
        if ti.static(self.features.reduced):
            if scene.body_of[i] < 0:
                self.go_on_vjp(i, j, now, scene, state, adjoint, plan)
            else:  # the body's stage is gone back through
                s, p, q = j - plan.base, adjoint.u[0, i], adjoint.v[0, i]
                self.forces_vjp(i, p, q, state.u[s, i], state.v[s, i], adjoint.w[0, i], now, scene, adjoint)
        else:
            self.go_on_vjp(i, j, now, scene, state, adjoint, plan)

    @ti.func
    def go_on_vjp(self, i, j, now: A, scene: A, state: A, adjoint: A, plan: A):
        s, t = j - plan.base, j - plan.base + 1
        u, v = state.u[s, i], state.v[s, i]
        p, q = adjoint.u[0, i] + self.element.gather(i, scene, adjoint.corner), adjoint.v[0, i]
        if ti.static(self.reads_rates):
            q += self.element.gather(i, scene, adjoint.rate_corner)
        # prescribed motion: the state after the pass comes from the motion alone
        k, by_u_prescribed, by_v_prescribed = self.prescribed(i, scene), self.vector(0), self.vector(0)
        if ti.static(self.features.partly_fixed):
            p, q, by_u_prescribed, by_v_prescribed = self.sliding_supports.end_vjp(i, k, p, q, now, scene, adjoint)
        elif ti.static(self.features.motion):
            if k >= 0 and now.alpha > 0:
                before, after = adjoint.motion[now.row, k], adjoint.motion[now.next, k]
                adjoint.motion[now.row, k] = before + (1 - now.end) * p - now.per_step * q
                adjoint.motion[now.next, k] = after + now.end * p + now.per_step * q
                adjoint.anchor[k] = adjoint.anchor[k] + p
                p, q = self.vector(0), self.vector(0)
        # drift and damping
        v_plus_adj = drift_vjp(p, q, now)
        if ti.static(not self.features.partly_fixed):
            if k >= 0:
                v_plus_adj = q
        if ti.static(self.features.num_staged > 0):
            _, before = self.kicked(i, v, state.f[s, i], now, scene)
            moved, lead = state.u[t, i] - u, self.lead(i, u, v, now, scene, scene)
            by_u, v_plus_adj, by_lead = self.contact.advance_vjp(
                i, u, moved, before, lead, p, q, now, scene, state, adjoint, plan
            )
            p += by_u
            if ti.static(self.features.partly_fixed):
                by_end, _ = self.sliding_supports.given_vjp(k, by_lead, self.vector(0), now, adjoint)
                p += by_end - by_lead
            elif k >= 0:
                v_plus_adj = q
        elif ti.static(self.features.drag >= 0):
            v_plus, row = state.v[t, i] / now.decay, ti.static(self.features.drag)
            by_rate = now.alpha_by_rate * p.dot(v_plus) + now.decay_by_rate * q.dot(v_plus)
            adjoint.sums[row, i] = adjoint.sums[row, i] + by_rate
        if ti.static(len(self.features.rough) > 0):
            if now.alpha > 0 and scene.surface[i] > 0:
                _, before = self.kicked(i, v, state.f[s, i], now, scene)
                by_u, v_plus_adj = self.obstacles.slide_vjp(i, u, before, v_plus_adj, now, scene, adjoint)
                p += by_u
        # kick, frame, kick
        v_mid_adj = v_plus_adj
        if now.frame >= 0:
            p += adjoint.frames_u[now.frame, i]
            v_mid_adj += adjoint.frames_v[now.frame, i]
        a_adj = kick_vjp(v_plus_adj, v_mid_adj, now)
        if ti.static(self.features.partly_fixed):
            a_adj = self.sliding_supports.free(i, a_adj, scene)
            p, v_mid_adj = p + by_u_prescribed, v_mid_adj + by_v_prescribed
        # forces
        inverse = scene.inverse_mass[i]
        f_adj, q = inverse * a_adj, v_mid_adj
        if ti.static(self.features.density):
            row = ti.static(self.features.sums().first("mass"))
            adjoint.sums[row, i] = adjoint.sums[row, i] - (inverse * f_adj.dot(state.f[s, i]))
        if ti.static(self.features.gravity >= 0):
            if inverse > 0:
                for d in ti.static(range(3)):
                    row = ti.static(self.features.gravity + d)
                    adjoint.sums[row, i] = adjoint.sums[row, i] + a_adj[d]
        self.forces_vjp(i, p, q, u, v, f_adj, now, scene, adjoint)

    @ti.func
    def forces_vjp(self, i, p, q, u, v, f_adj, now: A, scene: A, adjoint: A):
        """Back through the forces that are no element's; p and q: the adjoints of u and v so far."""
        if ti.static(self.features.forces):
            self.given.add_vjp(i, f_adj, now, scene, adjoint)
        for part in ti.static(self.features.at_vertices):
            by_u, by_v = part.force_vjp(i, u, v, f_adj, now, scene, adjoint)
            p += by_u
            q += by_v
        if ti.static(len(self.features.pressing) > 0):
            if scene.surface[i] > 0:
                p, q = self.obstacles.add_force_vjp(i, p, q, u, v, f_adj, now, scene, adjoint)
        adjoint.u[0, i] = p
        adjoint.v[0, i] = q
        adjoint.w[0, i] = f_adj
