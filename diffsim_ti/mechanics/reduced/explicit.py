"""Bodies of few numbers in explicit passes: a stage after the vertices', with its tangent; body_adjoint.py has the adjoint.

A vertex of a body only gathers its force. The body then goes on as its vertices would on average: with the fields nearest to
displacements u, velocities v and forces f (body_sums.py),

    v+ = v + (pre + post) f,    v+ += what friction of obstacles does (terms/obstacles/grip.py),
    u' = u + alpha v+,    v' = decay v+,

of an affine body, and of a rigid one with the rotation that body_motion.py says and velocities v' that are rigid there, with
the momentum of v+. Frames show v + pre f, of a rigid body its rigid part: velocity Verlet is SHAKE, with the velocities of
RATTLE. Sums m v and m x x v change by the loads alone, to round-off.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.obstacles.outside_work import add_work_of_pass
from diffsim_ti.mechanics.reduced import body_motion as motion
from diffsim_ti.mechanics.reduced.body_friction import BodyFriction
from diffsim_ti.mechanics.reduced.body_motion import VECTOR
from diffsim_ti.mechanics.reduced.body_sums import INVERSE, MOMENTS, BodySums
from diffsim_ti.runtime import A, Bundle, at, let, traced
from diffsim_ti.state.bodies import NUMBERS, PAIRS


@dataclass(frozen=True)
class Bodies(BodySums):
    """Taichi functions of body b in pass j, whose numbers are `now`."""

    @cached_property
    def friction(self) -> BodyFriction:
        return BodyFriction(self.vertex.features, self.vertex.law.precision)

    @property
    def rough(self) -> bool:
        return len(self.vertex.features.rough) > 0

    @property
    def rigid(self) -> bool:
        """Whether there are rigid ones."""
        return self.vertex.features.rigid

    @traced
    def placed(self, b, u, scene):
        """Displacements with R and J (body_motion.py), where there are rigid bodies."""
        if not self.rigid:
            return u
        return Bundle(**vars(u), R=motion.rotation(u), J=self.J(b, scene))

    # ---- what a rigid body makes of a field ----------------------------------------------------------------------------

    @traced
    def spun(self, b, u, v, scene, pre=1):
        """Of velocities those that are rigid, where pre > 0."""
        return self.field(v.o, *self.spun_columns(b, u, v, pre, scene))

    @ti.func
    def spun_columns(self, b, u: A, v: A, pre, scene: A):
        x, y, z = v.x, v.y, v.z
        if ti.static(self.rigid):
            if pre > 0 and scene.body_kind[b] > 0:
                w = motion.spin(u.R, v, u.J)
                x, y, z = motion.cross(w, u.R.x), motion.cross(w, u.R.y), motion.cross(w, u.R.z)
        return x, y, z

    @traced
    def shown(self, b, u, v, f, pre, scene):
        """Velocities at the time of the displacements, whose kick took `pre`; before it they are those of the state."""
        return self.spun(b, u, self.kicked(v, pre, f), scene, pre)

    @traced
    def turn(self, b, u, v, now, scene):
        """Of a pass with velocities v+: momentum l, f, R f, what columns of R gain, N = R F, and the spin in both axes."""
        if not self.rigid:
            return None
        momentum = let(motion.momentum(u.R, v, u.J))
        f = let(self.half_turn(b, u, momentum, let(self.double(now.alpha)), scene))
        phi = let(motion.times(u.R, f))
        c = motion.columns(*(motion.gained(phi, k) for k in (u.R.x, u.R.y, u.R.z)))
        N = motion.columns(u.R.x + c.x, u.R.y + c.y, u.R.z + c.z)
        omega = let(motion.solved(motion.inertia(u.J), motion.back(N, momentum)))
        return Bundle(l=momentum, f=f, phi=phi, c=c, N=N, omega=omega, w=let(motion.times(N, omega)))

    @ti.func
    def half_turn(self, b, u: A, momentum, alpha, scene: A):
        f = VECTOR(0, 0, 0, 0)
        if alpha > 0 and scene.body_kind[b] > 0:
            f = motion.half_turn(u.J, alpha * motion.back(u.R, momentum))
        return f

    @traced
    def moved(self, b, u, v, turn, now, scene):
        """(displacements, velocities) after the pass, for velocities v+."""
        alpha, decay = let(self.double(now.alpha)), let(self.double(now.decay))
        x = self.moved_columns(b, u, v, turn, alpha, decay, scene)
        return self.field(u.o + alpha * v.o, *x[:3]), self.field(decay * v.o, *x[3:])

    @ti.func
    def moved_columns(self, b, u: A, v: A, turn: A, alpha, decay, scene: A):
        x, y, z = u.x + alpha * v.x, u.y + alpha * v.y, u.z + alpha * v.z
        p, q, r = decay * v.x, decay * v.y, decay * v.z
        if ti.static(self.rigid):
            if scene.body_kind[b] > 0:
                x, y, z = turn.N.x, turn.N.y, turn.N.z
                p, q, r = motion.cross(turn.w, x), motion.cross(turn.w, y), motion.cross(turn.w, z)
                p, q, r = decay * p, decay * q, decay * r
                x[0] += -1
                y[1] += -1
                z[2] += -1
        return x, y, z, p, q, r

    # ---- friction ------------------------------------------------------------------------------------------------------

    @ti.func
    def reach(self, b, y, scene: A):
        """w = 1 / M + y . J^-1 y [1/kg]: what an impulse does at a vertex, of a rigid body at the most."""
        z = self.solve_arm(b, y, scene)
        return 1 / scene.body_numbers[NUMBERS * b] + z.dot(y)

    @traced
    def solve_arm(self, b, y, scene):
        """J^-1 y"""
        K = self.matrix(b, INVERSE, scene)
        parts = [let(at(y, k)) for k in range(3)]
        rows = [K[k][0] * parts[0] + K[k][1] * parts[1] + K[k][2] * parts[2] for k in range(3)]
        return let(VECTOR(*rows, ti.cast(0, ti.f64)))

    @ti.func
    def total(self, b, source: A, s, now: A, scene: A):
        """C [m/s]"""
        out = ti.cast(0, ti.f64)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i = scene.body_vertex[m]
            if scene.surface[i] > 0:
                load = self.double(self.friction.load(i, source[s, i], now, scene))
                out += load * self.reach(b, self.arm(m, b, scene), scene)
        return out

    @ti.func
    def pushes(self, b, source: A, s, w: A, total, now: A, scene: A):
        """Sums of the impulses of friction, for velocities w before it."""
        o, p, q, r = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        if total > 0 and now.alpha > 0:
            for m in range(scene.body_first[b], scene.body_first[b + 1]):
                i = scene.body_vertex[m]
                if scene.surface[i] > 0:
                    y, small = self.arm(m, b, scene), ti.cast(total, self.fp)
                    v = self.narrow(self.at_arm(w, y))
                    x = self.wide(self.friction.impulse(i, source[s, i], v, small, now, scene))
                    o += x
                    p += y.x * x
                    q += y.y * x
                    r += y.z * x
        return o, p, q, r

    @traced
    def sum_of(self, a, b):
        return self.field(a.o + b.o, a.x + b.x, a.y + b.y, a.z + b.z)

    @traced
    def apply_friction(self, b, u, v, source, s, now, scene):
        """Velocities after friction, with C, the velocities w that it sees, and what it adds, p."""
        if not self.rough:
            return Bundle(after=v)
        total, w = let(self.total(b, source, s, now, scene)), self.spun(b, u, v, scene)
        p = self.solved(b, self.pushes(b, source, s, w, total, now, scene), scene)
        return Bundle(after=self.sum_of(v, p), total=total, w=w, p=p)

    # ---- the pass ------------------------------------------------------------------------------------------------------

    @ti.func
    def step(self, b, j, now: A, scene: A, state: A, plan: A):
        s, t = (j - plan.base) * plan.stride, (j - plan.base + 1) * plan.stride
        plain_u, v, plain = self.nearest(b, state, s, scene.body_force, 0, scene)
        u = self.placed(b, plain_u, scene)
        f = self.with_gravity(plain, scene.parameters)
        if now.frame >= 0:
            seen = self.shown(b, u, v, f, now.pre, scene)
            for m in range(scene.body_first[b], scene.body_first[b + 1]):
                i = scene.body_vertex[m]
                state.frames_u[now.frame, i] = state.u[s, i]
                state.frames_v[now.frame, i] = self.narrow(self.at_arm(seen, self.arm(m, b, scene)))
        slip = self.apply_friction(b, u, self.kicked(v, now.pre + now.post, f), state.u, s, now, scene)
        displaced, moving = self.moved(b, u, slip.after, self.turn(b, u, slip.after, now, scene), now, scene)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            self.go(m, b, displaced, moving, s, t, now, scene, state, plan)

    @ti.func
    def go(self, m, b, displaced: A, moving: A, s, t, now: A, scene: A, state: A, plan: A):
        """Vertex m of all bodies to where the body takes it."""
        i, y = scene.body_vertex[m], self.arm(m, b, scene)
        u, v = state.u[s, i], state.v[s, i]
        u_next, v_next = self.narrow(self.at_arm(displaced, y)), self.narrow(self.at_arm(moving, y))
        if now.alpha <= 0:
            u_next = u
        if ti.static(len(self.vertex.features.groups) > 0):
            if scene.surface[i] > 0:
                self.vertex.obstacles.note(i, u, u_next, now, scene, state)
        if ti.static(self.vertex.counts_work):
            kicked = v_next / now.decay
            force = (kicked - v) / ((now.pre + now.post) * scene.inverse_mass[i])  # with what holds it
            if ti.static(self.vertex.features.gravity >= 0):
                force += -1 * self.vertex.gravity(scene.parameters) / scene.inverse_mass[i]
            add_work_of_pass(self.vertex, i, u, v, kicked, force, u_next, v_next, now, scene, state, plan)
        state.u[t, i] = u_next
        state.v[t, i] = v_next

    # ---- tangent, along recorded passes ------------------------------------------------------------------------------

    @traced
    def spun_jvp(self, b, u, v, du, dv, scene, tangent, pre=1):
        """Change of the rigid part of velocities."""
        return self.field(dv.o, *self.spun_columns_jvp(b, u, v, du, dv, pre, scene, tangent))

    @ti.func
    def spun_columns_jvp(self, b, u: A, v: A, du: A, dv: A, pre, scene: A, tangent: A):
        x, y, z = dv.x, dv.y, dv.z
        if ti.static(self.rigid):
            if pre > 0 and scene.body_kind[b] > 0:
                theta = motion.turning(u.R, du)
                x, y, z = motion.spin_jvp(u.R, v, u.J, theta, dv, self.J(b, tangent))
        return x, y, z

    @traced
    def shown_jvp(self, b, u, v, f, du, dv, df, pre, scene, tangent):
        return self.spun_jvp(b, u, self.kicked(v, pre, f), du, self.kicked(dv, pre, df), scene, tangent, pre)

    @traced
    def moved_jvp(self, b, u, v, turn, du, dv, dalpha, ddecay, now, scene, tangent):
        """Changes of the displacements and velocities after the pass."""
        alpha, decay = let(self.double(now.alpha)), let(self.double(now.decay))
        dalpha, ddecay = let(self.double(dalpha)), let(self.double(ddecay))
        x = self.moved_columns_jvp(b, u, v, turn, du, dv, alpha, decay, dalpha, ddecay, scene, tangent)
        displaced = du.o + alpha * dv.o + dalpha * v.o
        return self.field(displaced, *x[:3]), self.field(decay * dv.o + ddecay * v.o, *x[3:])

    @ti.func
    def moved_columns_jvp(self, b, u: A, v: A, turn: A, du: A, dv: A, alpha, decay, da, dd, scene: A, tangent: A):
        x, y, z = du.x + alpha * dv.x + da * v.x, du.y + alpha * dv.y + da * v.y, du.z + alpha * dv.z + da * v.z
        p, q, r = decay * dv.x + dd * v.x, decay * dv.y + dd * v.y, decay * dv.z + dd * v.z
        if ti.static(self.rigid):
            if scene.body_kind[b] > 0:
                theta, dJ = motion.turning(u.R, du), self.J(b, tangent)
                dl = motion.momentum_jvp(u.R, v, u.J, theta, dv, dJ)
                L, dL = motion.back(u.R, turn.l), motion.back(u.R, dl - motion.cross(theta, turn.l))
                df = motion.half_turn_jvp(u.J, turn.f, alpha * L, alpha * dL + da * L, dJ)
                dphi = motion.times(u.R, df)
                x = motion.cross(theta, turn.N.x) + motion.gained_jvp(turn.phi, dphi, u.R.x, turn.c.x)
                y = motion.cross(theta, turn.N.y) + motion.gained_jvp(turn.phi, dphi, u.R.y, turn.c.y)
                z = motion.cross(theta, turn.N.z) + motion.gained_jvp(turn.phi, dphi, u.R.z, turn.c.z)
                after = 0.5 * (motion.cross(turn.N.x, x) + motion.cross(turn.N.y, y) + motion.cross(turn.N.z, z))
                own = motion.back(turn.N, dl - motion.cross(after, turn.l)) - motion.inertia_times(dJ, turn.omega)
                change = motion.times(turn.N, motion.solved(motion.inertia(u.J), own))
                p = self.swept_jvp(turn.N.x, turn.w, after, change, decay, dd)
                q = self.swept_jvp(turn.N.y, turn.w, after, change, decay, dd)
                r = self.swept_jvp(turn.N.z, turn.w, after, change, decay, dd)
        return x, y, z, p, q, r

    @ti.func
    def swept_jvp(self, k, w, theta, change, decay, dd):
        """Change of decay w x k, all of which turns by theta, and w by a change besides."""
        way = motion.cross(w, k)
        return decay * (motion.cross(theta, way) + motion.cross(change, k)) + dd * way

    @ti.func
    def reach_jvp(self, b, y, dy, scene: A, tangent: A):
        z, mass = self.solve_arm(b, y, scene), scene.body_numbers[b * NUMBERS]
        out = 2 * z.dot(dy) - tangent.body_numbers[b * NUMBERS] / (mass * mass)
        for k in ti.static(range(6)):
            r = ti.static(PAIRS[k][0])
            c = ti.static(PAIRS[k][1])
            out += -ti.static(1.0 if r == c else 2.0) * z[r] * z[c] * tangent.body_numbers[b * NUMBERS + MOMENTS + k]
        return out

    @ti.func
    def total_jvp(self, b, source: A, s, now: A, scene: A, tangent: A):
        out = ti.cast(0, ti.f64)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i = scene.body_vertex[m]
            if scene.surface[i] > 0:
                y, u = self.arm(m, b, scene), source[s, i]
                load = self.double(self.friction.load(i, u, now, scene))
                dload = self.double(self.friction.load_jvp(i, u, tangent.u[0, i], now, scene, tangent))
                dy = self.wide(tangent.body_place[m])
                out += dload * self.reach(b, y, scene) + load * self.reach_jvp(b, y, dy, scene, tangent)
        return out

    @ti.func
    def pushes_jvp(self, b, source: A, s, w: A, dw: A, total, dtotal, now: A, scene: A, tangent: A):
        o, p, q, r = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        if total > 0 and now.alpha > 0:
            small, dsmall = ti.cast(total, self.fp), ti.cast(dtotal, self.fp)
            for m in range(scene.body_first[b], scene.body_first[b + 1]):
                i = scene.body_vertex[m]
                if scene.surface[i] > 0:
                    y, dy, u = self.arm(m, b, scene), self.wide(tangent.body_place[m]), source[s, i]
                    v, dv = self.narrow(self.at_arm(w, y)), self.narrow(self.at_arm(dw, y) + self.slope_at(w, dy))
                    x = self.wide(self.friction.impulse(i, u, v, small, now, scene))
                    du = tangent.u[0, i]
                    dx = self.wide(self.friction.impulse_jvp(i, u, v, small, du, dv, dsmall, now, scene, tangent))
                    o += dx
                    p += y.x * dx + dy.x * x
                    q += y.y * dx + dy.y * x
                    r += y.z * dx + dy.z * x
        return o, p, q, r

    @traced
    def apply_friction_jvp(self, b, slip, u, v, du, dv, source, s, now, scene, tangent):
        """Change of the velocities after friction."""
        if not self.rough:
            return dv
        dtotal = let(self.total_jvp(b, source, s, now, scene, tangent))
        dw = self.spun_jvp(b, u, v, du, dv, scene, tangent)
        sums = self.pushes_jvp(b, source, s, slip.w, dw, slip.total, dtotal, now, scene, tangent)
        return self.sum_of(dv, self.solved_jvp(b, slip.p, sums, scene, tangent))

    @ti.func
    def step_jvp(self, b, j, now: A, scene: A, state: A, tangent: A, plan: A):
        s = j - plan.base
        plain_u, v, plain = self.nearest(b, state, s, state.f, s, scene)
        u = self.placed(b, plain_u, scene)
        du, dv, df = self.nearest_jvp(b, u, v, plain, state, s, scene, tangent)
        f, pulled = self.with_gravity(plain, scene.parameters), self.with_gravity(df, tangent.parameters)
        if now.frame >= 0:
            seen = self.shown(b, u, v, f, now.pre, scene)
            dseen = self.shown_jvp(b, u, v, f, du, dv, pulled, now.pre, scene, tangent)
            for m in range(scene.body_first[b], scene.body_first[b + 1]):
                i, y, dy = scene.body_vertex[m], self.arm(m, b, scene), self.wide(tangent.body_place[m])
                tangent.frames_u[now.frame, i] = tangent.u[0, i]
                tangent.frames_v[now.frame, i] = self.narrow(self.at_arm(dseen, y) + self.slope_at(seen, dy))
        share = now.pre + now.post
        kicked, dkicked = self.kicked(v, share, f), self.kicked(dv, share, pulled)
        slip = self.apply_friction(b, u, kicked, state.u, s, now, scene)
        dafter = self.apply_friction_jvp(b, slip, u, kicked, du, dkicked, state.u, s, now, scene, tangent)
        turn = self.turn(b, u, slip.after, now, scene)
        displaced, moving = self.moved(b, u, slip.after, turn, now, scene)
        dalpha, ddecay = now.alpha_by_rate * plan.rate_dot, now.decay_by_rate * plan.rate_dot
        ddisplaced, dmoving = self.moved_jvp(b, u, slip.after, turn, du, dafter, dalpha, ddecay, now, scene, tangent)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i, y, dy = scene.body_vertex[m], self.arm(m, b, scene), self.wide(tangent.body_place[m])
            if now.alpha > 0:
                tangent.u[0, i] = self.narrow(self.at_arm(ddisplaced, y) + self.slope_at(displaced, dy))
            tangent.v[0, i] = self.narrow(self.at_arm(dmoving, y) + self.slope_at(moving, dy))
