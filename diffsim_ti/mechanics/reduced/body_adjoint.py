"""The adjoint of the stage of bodies of few numbers (explicit.py), along recorded passes."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.reduced import body_motion as motion
from diffsim_ti.mechanics.reduced.body_motion import VECTOR
from diffsim_ti.mechanics.reduced.explicit import Bodies
from diffsim_ti.runtime import A, let, traced
from diffsim_ti.state.bodies import NUMBERS, PAIRS, SUMS


@dataclass(frozen=True)
class BodyStage(Bodies):
    """Taichi functions of body b in pass j."""

    @ti.func
    def add_J(self, b, p, q, adjoint: A):
        """Add p q^T + q p^T to the adjoint of J."""
        for k in ti.static(range(6)):
            r = ti.static(PAIRS[k][0])
            c = ti.static(PAIRS[k][1])
            if ti.static(r == c):
                self.add(adjoint.body_sums, b * SUMS + 1 + k, 2 * p[r] * q[r])
            else:
                self.add(adjoint.body_sums, b * SUMS + 1 + k, 2 * (p[r] * q[c] + q[r] * p[c]))

    @ti.func
    def add_trace(self, b, t, adjoint: A):
        """Add t times the unit matrix."""
        for k in ti.static(range(3)):
            self.add(adjoint.body_sums, b * SUMS + 1 + k, t)

    @ti.func
    def momentum_vjp(self, b, R: A, v: A, J: A, by, scene: A, adjoint: A):
        """(adjoint of theta, columns of that of v) for that of l; adds that of J."""
        theta, x, y, z = motion.momentum_vjp(R, v, J, by)
        for k in ti.static(range(6)):
            r = ti.static(PAIRS[k][0])
            c = ti.static(PAIRS[k][1])
            both = self.column(v, r).dot(self.pick(c, x, y, z))
            if ti.static(r != c):
                both += self.column(v, c).dot(self.pick(r, x, y, z))
            self.add(adjoint.body_sums, b * SUMS + 1 + k, both)
        return theta, self.mixed(J.x, x, y, z), self.mixed(J.y, x, y, z), self.mixed(J.z, x, y, z)

    @traced
    def pick(self, k, x, y, z):
        return (x, y, z)[k]

    @traced
    def column(self, q, k):
        return (q.x, q.y, q.z)[k]

    @ti.func
    def mixed(self, a, x, y, z):
        return a.x * x + a.y * y + a.z * z

    @traced
    def spun_vjp(self, b, pre, u, v, by, scene, adjoint):
        """(adjoint of u, of v) as fields, for that of the rigid part of velocities v, where pre > 0; adds that of J."""
        x = self.spun_columns_vjp(b, pre, u, v, by, scene, adjoint)
        return self.field(VECTOR(0, 0, 0, 0), *x[:3]), self.field(by.o, *x[3:])

    @ti.func
    def spun_columns_vjp(self, b, pre, u: A, v: A, by: A, scene: A, adjoint: A):
        x, y, z, p, q, r = 0 * by.x, 0 * by.x, 0 * by.x, by.x, by.y, by.z
        if ti.static(self.rigid):
            if pre > 0 and scene.body_kind[b] > 0:
                l = motion.momentum(u.R, v, u.J)
                omega = motion.solved(motion.inertia(u.J), motion.back(u.R, l))
                theta, of_l = self.swept_vjp(b, u.R, u.J, motion.times(u.R, omega), omega, l, by, adjoint)
                more, p_, q_, r_ = self.momentum_vjp(b, u.R, v, u.J, of_l, scene, adjoint)
                p, q, r = p_, q_, r_
                x, y, z = self.turning_vjp(u.R, theta + more)
        return x, y, z, p, q, r

    @ti.func
    def swept_vjp(self, b, R: A, J: A, w, omega, l, by: A, adjoint: A):
        """(adjoint of theta, of l) for those of columns w x R_k of the spin R omega; adds that of J."""
        s = motion.cross(R.x, by.x) + motion.cross(R.y, by.y) + motion.cross(R.z, by.z)
        theta = motion.cross(motion.cross(w, R.x), by.x) + motion.cross(motion.cross(w, R.y), by.y)
        theta += motion.cross(motion.cross(w, R.z), by.z)
        own = motion.solved(motion.inertia(J), motion.back(R, s))
        self.add_trace(b, -own.dot(omega), adjoint)
        self.add_J(b, 0.5 * own, omega, adjoint)
        of_l = motion.times(R, own)
        return theta + motion.cross(of_l, l), of_l

    @ti.func
    def turning_vjp(self, R: A, theta):
        """Columns of the adjoint of the displacement's gradient."""
        return 0.5 * motion.cross(theta, R.x), 0.5 * motion.cross(theta, R.y), 0.5 * motion.cross(theta, R.z)

    @traced
    def moved_vjp(self, b, u, v, turn, by_u, by_v, now, scene, adjoint):
        """(adjoint of u, of v+) for those of the displacements and velocities after the pass; adds those of all else."""
        alpha, decay = let(self.double(now.alpha)), let(self.double(now.decay))
        x = self.moved_columns_vjp(b, u, v, turn, by_u, by_v, alpha, decay, scene, adjoint)
        if self.vertex.features.drag >= 0:
            by_alpha, by_decay = let(x[6] + self.dot(by_u.o, v.o)), let(x[7] + self.dot(by_v.o, v.o))
            self.add_rate(b, by_alpha, by_decay, now, scene, adjoint)
        return self.field(by_u.o, *x[:3]), self.field(alpha * by_u.o + decay * by_v.o, *x[3:6])

    @ti.func
    def add_rate(self, b, by_alpha, by_decay, now: A, scene: A, adjoint: A):
        row, i = ti.static(self.vertex.features.drag), scene.body_vertex[scene.body_first[b]]
        by_rate = now.alpha_by_rate * by_alpha + now.decay_by_rate * by_decay
        adjoint.sums[row, i] = adjoint.sums[row, i] + ti.cast(by_rate, self.fp)

    @ti.func
    def moved_columns_vjp(self, b, u: A, v: A, turn: A, by_u: A, by_v: A, alpha, decay, scene: A, adjoint: A):
        x, y, z = by_u.x, by_u.y, by_u.z
        p, q, r = alpha * x + decay * by_v.x, alpha * y + decay * by_v.y, alpha * z + decay * by_v.z
        by_alpha = x.dot(v.x) + y.dot(v.y) + z.dot(v.z)
        by_decay = by_v.x.dot(v.x) + by_v.y.dot(v.y) + by_v.z.dot(v.z)
        if ti.static(self.rigid):
            if scene.body_kind[b] > 0:
                swept = motion.columns(decay * by_v.x, decay * by_v.y, decay * by_v.z)
                after, of_l = self.swept_vjp(b, turn.N, u.J, turn.w, turn.omega, turn.l, swept, adjoint)
                theta, of_phi = 0 * x, 0 * x
                by_decay = ti.cast(0, ti.f64)
                for k in ti.static(range(3)):
                    own, c, N = self.column(u.R, k), self.column(turn.c, k), self.column(turn.N, k)
                    of_N = self.column(by_u, k) + 0.5 * motion.cross(after, N)
                    theta += motion.cross(N, of_N)
                    of_phi += motion.gained_vjp(turn.phi, own, c, of_N)
                    by_decay += self.column(by_v, k).dot(motion.cross(turn.w, N))
                L = motion.back(u.R, turn.l)
                mu = motion.half_turn_vjp(u.J, turn.f, alpha * L, motion.back(u.R, of_phi))
                of_a, nu = 0.5 * (1 + turn.f.dot(turn.f)) * mu, mu + motion.cross(mu, turn.f)
                self.add_trace(b, -nu.dot(turn.f), adjoint)
                self.add_J(b, 0.5 * nu, turn.f, adjoint)
                by_alpha = of_a.dot(L)
                of_L = alpha * motion.times(u.R, of_a)
                theta += motion.cross(of_L, turn.l)
                more, p_, q_, r_ = self.momentum_vjp(b, u.R, v, u.J, of_L + of_l, scene, adjoint)
                p, q, r = p_, q_, r_
                x, y, z = self.turning_vjp(u.R, theta + more)
        return x, y, z, p, q, r, by_alpha, by_decay

    # ---- friction ------------------------------------------------------------------------------------------------------

    @ti.func
    def add_reach(self, m, b, y, by_reach, scene: A, adjoint: A):
        """Add what the adjoint of w at vertex m of all bodies says of y, M and J."""
        z, mass = self.solve_arm(b, y, scene), scene.body_numbers[b * NUMBERS]
        self.add_adjoint(m, 2 * by_reach * z, ti.cast(0, ti.f64), adjoint)
        self.add(adjoint.body_sums, b * SUMS, -by_reach / (mass * mass))
        for k in ti.static(range(6)):
            r = ti.static(PAIRS[k][0])
            c = ti.static(PAIRS[k][1])
            self.add(adjoint.body_sums, b * SUMS + 1 + k, -ti.static(1.0 if r == c else 2.0) * by_reach * z[r] * z[c])

    @ti.func
    def total_of_pushes(self, b, source: A, s, w: A, total, by: A, now: A, scene: A):
        """Adjoint of C for those of the sums of impulses."""
        out = ti.cast(0, ti.f64)
        if total > 0 and now.alpha > 0:
            small = ti.cast(total, self.fp)
            for m in range(scene.body_first[b], scene.body_first[b + 1]):
                i = scene.body_vertex[m]
                if scene.surface[i] > 0:
                    y = self.arm(m, b, scene)
                    v, p_adj = self.narrow(self.at_arm(w, y)), self.narrow(self.at_arm(by, y))
                    out += self.double(self.friction.total_vjp(i, source[s, i], v, small, p_adj, now, scene))
        return out

    @ti.func
    def pushes_vjp(self, b, source: A, s, w: A, total, by_total, by: A, now: A, scene: A, adjoint: A):
        """Sums of the adjoints of w; adds those of all else, of u to adjoint.u."""
        o, p, q, r = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        if total > 0 and now.alpha > 0:
            small = ti.cast(total, self.fp)
            for m in range(scene.body_first[b], scene.body_first[b + 1]):
                i = scene.body_vertex[m]
                if scene.surface[i] > 0:
                    y, u = self.arm(m, b, scene), source[s, i]
                    v, p_adj = self.narrow(self.at_arm(w, y)), self.narrow(self.at_arm(by, y))
                    by_load = ti.cast(by_total * self.reach(b, y, scene), self.fp)
                    by_u, by_v, impulse = self.friction.vjp(i, u, v, small, p_adj, by_load, now, scene, adjoint)
                    adjoint.u[0, i] = adjoint.u[0, i] + by_u
                    wide = self.wide(by_v)
                    o += wide
                    p += y.x * wide
                    q += y.y * wide
                    r += y.z * wide
                    by_y = self.along(by, self.wide(impulse)) + self.along(w, wide)
                    self.add_adjoint(m, by_y, ti.cast(0, ti.f64), adjoint)
                    self.add_reach(m, b, y, self.double(impulse.w) * by_total, scene, adjoint)
        return o, p, q, r

    @traced
    def apply_friction_vjp(self, b, slip, u, v, by_after, source, s, now, scene, adjoint):
        """(adjoint of u, of v) for that of the velocities after friction."""
        if not self.rough:
            return self.field(*[VECTOR(0, 0, 0, 0)] * 4), by_after
        by = self.solved_vjp(b, slip.p, by_after, scene, adjoint)
        by_total = let(self.total_of_pushes(b, source, s, slip.w, slip.total, by, now, scene))
        sums = self.pushes_vjp(b, source, s, slip.w, slip.total, by_total, by, now, scene, adjoint)
        by_u, by_v = self.spun_vjp(b, 1, u, v, self.field(*sums), scene, adjoint)
        return by_u, self.sum_of(by_after, by_v)

    # ---- the pass ------------------------------------------------------------------------------------------------------

    @ti.func
    def gather(self, b, scene: A, adjoint: A):
        """What the pass after this one has left at corners of tetrahedra."""
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i = scene.body_vertex[m]
            adjoint.u[0, i] = adjoint.u[0, i] + self.vertex.element.gather(i, scene, adjoint.corner)
            if ti.static(self.vertex.reads_rates):
                of_rates = self.vertex.element.gather(i, scene, adjoint.rate_corner)
                adjoint.v[0, i] = adjoint.v[0, i] + of_rates

    @ti.func
    def spread_vjp(self, b, slot, source: A, q: A, scene: A, adjoint: A):
        """Sums of the adjoints of a field at the vertices, source[slot]; adds those of y."""
        o, x, y, z = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            arm, by = self.arm(m, b, scene), self.wide(source[slot, scene.body_vertex[m]])
            o += by
            x += arm.x * by
            y += arm.y * by
            z += arm.z * by
            self.add_adjoint(m, self.along(q, by), ti.cast(0, ti.f64), adjoint)
        return o, x, y, z

    @ti.func
    def leave(self, b, s, by_u: A, by_v: A, by_f: A, seen: A, halts, state: A, scene: A, adjoint: A):
        """Adjoints of each vertex, for those of the sums over displacements, velocities and forces."""
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i, y, mass = scene.body_vertex[m], self.arm(m, b, scene), self.double(scene.body_mass[m])
            u, v, f = self.wide(state.u[s, i]), self.wide(state.v[s, i]), self.wide(state.f[s, i])
            if halts:
                v = self.at_arm(seen, y)
            of_u, of_v, of_f = self.at_arm(by_u, y), self.at_arm(by_v, y), self.at_arm(by_f, y)
            by_y = mass * (self.along(by_u, u) + self.along(by_v, v)) + self.along(by_f, f)
            self.add_adjoint(m, by_y, u.dot(of_u) + v.dot(of_v), adjoint)
            adjoint.u[0, i] = adjoint.u[0, i] + self.narrow(mass * of_u)
            adjoint.v[0, i] = self.narrow(mass * of_v)
            adjoint.w[0, i] = self.narrow(of_f)

    @ti.func
    def start_u(self, b, now: A, scene: A, adjoint: A):
        """What of adjoint.u is of the displacements before the pass themselves."""
        for m in range(scene.body_first[b], scene.body_first[b + 1]):
            i = scene.body_vertex[m]
            if now.alpha > 0:
                adjoint.u[0, i] = self.vertex.vector(0)
            if now.frame >= 0:
                adjoint.u[0, i] = adjoint.u[0, i] + adjoint.frames_u[now.frame, i]

    @ti.func
    def add_gravity(self, b, by_f: A, scene: A, adjoint: A):
        if ti.static(self.vertex.features.gravity >= 0):
            i = scene.body_vertex[scene.body_first[b]]
            for d in ti.static(range(3)):
                row = ti.static(self.vertex.features.gravity + d)
                adjoint.sums[row, i] = adjoint.sums[row, i] + ti.cast(by_f.o[d], self.fp)

    @traced
    def times(self, share, q):
        s = let(self.double(share))
        return self.field(s * q.o, s * q.x, s * q.y, s * q.z)

    @ti.func
    def either(self, condition, a, b):
        out = a
        if not condition:
            out = b
        return out

    @traced
    def chosen(self, condition, p, q):
        """p where the condition holds, else q."""
        return self.field(*(self.either(condition, getattr(p, k), getattr(q, k)) for k in "oxyz"))

    @ti.func
    def step_vjp(self, b, j, now: A, scene: A, state: A, adjoint: A, plan: A):
        """Back through the stage: leaves adjoints of u and v before the pass and of forces in adjoint.u, .v and .w."""
        s = j - plan.base
        self.gather(b, scene, adjoint)
        plain_u, v, plain = self.nearest(b, state, s, state.f, s, scene)
        u = self.placed(b, plain_u, scene)
        f = self.with_gravity(plain, scene.parameters)
        halts = now.pre_adj < now.pre  # at the state that the pass shows
        seen = self.shown(b, u, v, f, now.pre, scene)
        start, share = self.chosen(halts, seen, v), now.pre_adj + now.post
        kicked = self.kicked(start, share, f)
        slip = self.apply_friction(b, u, kicked, state.u, s, now, scene)
        turn = self.turn(b, u, slip.after, now, scene)
        displaced, moving = self.moved(b, u, slip.after, turn, now, scene)
        by_v = self.field_of(self.spread_vjp(b, 0, adjoint.v, moving, scene, adjoint))
        by_u = self.field_of(self.spread_if(now.alpha > 0, b, 0, adjoint.u, displaced, scene, adjoint))
        self.start_u(b, now, scene, adjoint)
        of_u, of_after = self.moved_vjp(b, u, slip.after, turn, by_u, by_v, now, scene, adjoint)
        more_u, of_kicked = self.apply_friction_vjp(b, slip, u, kicked, of_after, state.u, s, now, scene, adjoint)
        of_seen = self.field_of(self.spread_if(now.frame >= 0, b, now.frame, adjoint.frames_v, seen, scene, adjoint))
        w = self.kicked(v, now.pre, f)
        shown_u, of_w = self.spun_vjp(b, self.unless(halts, now.pre), u, w, of_seen, scene, adjoint)
        by_field_v, by_field_u = self.sum_of(of_kicked, of_w), self.sum_of(self.sum_of(of_u, more_u), shown_u)
        of_f = self.sum_of(self.times(share, of_kicked), self.times(self.unless(halts, now.pre), of_w))
        self.add_gravity(b, of_f, scene, adjoint)
        sums_u = self.solved_vjp(b, u, by_field_u, scene, adjoint)
        sums_v = self.solved_vjp(b, start, by_field_v, scene, adjoint)
        sums_f = self.solved_vjp(b, plain, of_f, scene, adjoint)
        self.leave(b, s, sums_u, sums_v, sums_f, seen, halts, state, scene, adjoint)

    @traced
    def field_of(self, sums):
        return self.field(*sums)

    @ti.func
    def unless(self, condition, x):
        out = x
        if condition:
            out = 0 * x
        return out

    @ti.func
    def spread_if(self, condition, b, slot, source: A, q: A, scene: A, adjoint: A):
        """`spread_vjp` where a condition holds: of displacements, which a pass that only kicks leaves as they are, and of
        what a frame shows."""
        o, x, y, z = VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0), VECTOR(0, 0, 0, 0)
        if condition:
            o, x, y, z = self.spread_vjp(b, slot, source, q, scene, adjoint)
        return o, x, y, z
