"""The tangent of the stage of bodies of few numbers (explicit.py), along recorded passes."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.reduced import body_motion as motion
from diffsim_ti.mechanics.reduced.body_motion import VECTOR
from diffsim_ti.mechanics.reduced.explicit import Bodies
from diffsim_ti.runtime import let, traced
from diffsim_ti.state.bodies import NUMBERS, PAIRS

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class BodyTangent(Bodies):
    """Taichi functions of body b in pass j."""

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
            out += -ti.static(1.0 if r == c else 2.0) * z[r] * z[c] * tangent.body_numbers[b * NUMBERS + 10 + k]
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
    def rub_jvp(self, b, rub, u, v, du, dv, source, s, now, scene, tangent):
        """Change of the velocities after friction."""
        if not self.rough:
            return dv
        dtotal = let(self.total_jvp(b, source, s, now, scene, tangent))
        dw = self.spun_jvp(b, u, v, du, dv, scene, tangent)
        sums = self.pushes_jvp(b, source, s, rub.w, dw, rub.total, dtotal, now, scene, tangent)
        return self.sum_of(dv, self.solved_jvp(b, rub.p, sums, scene, tangent))

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
        rub = self.rub(b, u, kicked, state.u, s, now, scene)
        dafter = self.rub_jvp(b, rub, u, kicked, du, dkicked, state.u, s, now, scene, tangent)
        turn = self.turn(b, u, rub.after, now, scene)
        displaced, moving = self.moved(b, u, rub.after, turn, now, scene)
        dalpha, ddecay = now.alpha_by_rate * plan.rate_dot, now.decay_by_rate * plan.rate_dot
        ddisplaced, dmoving = self.moved_jvp(b, u, rub.after, turn, du, dafter, dalpha, ddecay, now, scene, tangent)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i, y, dy = scene.body_vertex[m], self.arm(m, b, scene), self.wide(tangent.body_place[m])
            if now.alpha > 0:
                tangent.u[0, i] = self.narrow(self.at_arm(ddisplaced, y) + self.slope_at(displaced, dy))
            tangent.v[0, i] = self.narrow(self.at_arm(dmoving, y) + self.slope_at(moving, dy))
