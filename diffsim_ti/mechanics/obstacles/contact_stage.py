"""Contact with obstacles as a stage of explicit passes, which no step is too large for.

After the kick by all other forces, a vertex of mass m moves by

    u' - u = alpha w,    v' = vs + delta - (1 - decay) w,    w = vs + (1 + c) / 2 delta,    delta = (h / m) sum_k P_k n_k

P_k is the push of obstacle k's barrier for the distance d_k at the pass's begin and the one it leads to (secant.py),
y_k = d_k + n_k . (z - h v_k), v_k its velocity; z = alpha v+ + alpha (1 + c) / 2 delta is solved for all obstacles of a
vertex together, the minimum of a convex function, so there is one. vs is v+ after the friction of each obstacle with
normal force P_k.

c is the solver's `contact_damping`: 1 is backward Euler of the barriers alone, 0 their discrete gradients, which keep the
energy. The kinetic and the barriers' energy together never grow but by obstacles that move: where obstacles are flat
they fall by c m |delta|^2 / 2 or more. The distance to a curved obstacle is that to its tangent plane, the safe side if
it is convex. A vertex that is fixed in some directions goes the way `lead` there, and is subject to contact and
friction only in the others.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.obstacles.contact_friction import ContactFriction
from diffsim_ti.mechanics.obstacles.contact_impulses import note_impulses, note_pushes_jvp, seed_impulses
from diffsim_ti.mechanics.obstacles.obstacle_stages import NUMBERS, PLANE, PUSH, ROWS, SEED, VELOCITY, ObstacleStages
from diffsim_ti.mechanics.obstacles.outside_work import add_work, work_of_lead, work_of_stage
from diffsim_ti.runtime import A
from diffsim_ti.terms.obstacles import secant, stage

MOST_ROUNDS = 60


@dataclass(frozen=True)
class ContactStage(ObstacleStages):
    """Taichi functions of one vertex; `now` is the pass (state/schedule.py), g a group of obstacles, k a place in it.

    Obstacles of all kinds are gone through in one loop, over what `look` records of them.
    """

    @cached_property
    def friction(self) -> ContactFriction:
        return ContactFriction(self.features, self.precision)

    @property
    def epsilon(self) -> float:
        return 2.0**-52 if self.precision == "f64" else 2.0**-23

    @ti.func
    def blend(self, plan: A):
        """(1 + c) / 2"""
        half = ti.cast(0.5, self.fp)
        return half + half * plan.contact_damping

    # ---- where obstacles are, and what they push ---------------------------------------------------------------------

    @ti.func
    def look(self, i, u, move, now: A, scene: A, state: A):
        """Does an obstacle act, now or after `move`? If so, note what all of them are."""
        near = False
        for turn in range(2):
            if turn == 0 or near:
                for g in ti.static(self.features.staged):
                    for k in range(g.count):
                        first, X = g.first + k * g.size, self.seen_now(g, k, scene.rest[i], now, scene)
                        v_obstacle = self.v_obstacle(g, k, X, u, now, scene)
                        plane = g.force.contact_plane(scene.parameters, first, X, u)
                        width = g.force.width(scene.parameters, first)
                        if turn == 0:
                            y = plane.w + self.normal(plane).dot(move - now.h * v_obstacle)
                            near = near or ti.min(plane.w, y) < width
                        else:
                            row = ROWS * (g.number + k)
                            state.stage[row + PLANE, i] = plane
                            law = stage.numbers(g.force, scene.parameters, first)
                            law.x = self.on_area(g, i, law.x, scene)
                            state.stage[row + NUMBERS, i] = law
                            state.stage[row + VELOCITY, i] = v_obstacle
        return near

    @ti.func
    def push(self, o, i, z, now: A, state: A, plan: A):
        """Note the push of an obstacle for the move z; returns (n, P, -dP/dy, the smaller one of d and y)."""
        plane, law = state.stage[ROWS * o + PLANE, i], state.stage[ROWS * o + NUMBERS, i]
        n, width = self.normal(plane), law.y
        y = plane.w + n.dot(z - now.h * state.stage[ROWS * o + VELOCITY, i])
        p, by_t = secant.push_by_end(plane.w / width, y / width, plan.contact_damping, self.fp)
        P, K, zero = law.x * width * p, law.x * by_t, ti.cast(0, self.fp)
        state.stage[ROWS * o + PUSH, i] = self.vector(P, K, zero, zero)
        return n, P, K, ti.min(plane.w, y)

    # ---- the move that all obstacles of a vertex agree on -------------------------------------------------------------

    @ti.func
    def solve(self, i, start, free, a, now: A, scene: A, state: A, plan: A):
        """z = free + a sum P n by Newton's method from `start`, shorter where the slope along its step changes sign; n: of
        the normals, what vertex i may do. What is held is that of `start` and `free` alike.

        Returns z, sum P n, and the entries of sum K n (x) n there. It ends where z changes by no more than the round-off of
        itself or of a distance, which no push can see.
        """
        z, step, trial = start, self.vector(0), start
        total, xyz, mixed = self.vector(0), self.vector(0), self.vector(0)
        before, share, half = ti.cast(0, self.fp), ti.cast(1, self.fp), ti.cast(0.5, self.fp)
        tiny = ti.cast((4 * self.epsilon) ** 2, self.fp)
        for turn in range(MOST_ROUNDS):
            total, xyz, mixed, least = self.vector(0), self.vector(0), self.vector(0), ti.cast(1e30, self.fp)
            for o in range(ti.static(self.features.num_staged)):
                normal, P, K, gap = self.push(ti.static(self.features.first_staged) + o, i, trial, now, state, plan)
                n = self.may(i, normal, scene)
                total += P * n
                least = ti.min(least, gap)
                xyz += K * n * n
                mixed += K * self.vector(n.y * n.z, n.z * n.x, n.x * n.y, ti.cast(0, self.fp))
            r = trial - free - a * total
            if turn > 0 and r.dot(step) > half * before:
                share = half * share
            else:
                z, share = trial, ti.cast(1, self.fp)
                step = self.vector(0) - stage.solve_linear(self.features.num_staged, a, xyz, mixed, r)
                before = -r.dot(step)
                if step.dot(step) <= tiny * ti.max(z.dot(z), least * least):  # norm() would compute in f64
                    break
            trial = z + share * step
        return z, total, xyz, mixed

    # ---- the stage -----------------------------------------------------------------------------------------------------

    @ti.func
    def acts(self, i, ratio, now: A, scene: A):
        return now.alpha > 0 and scene.surface[i] > 0 and ratio > 0

    @ti.func
    def free_displacement(self, i, v_plus, lead, now: A, scene: A):
        """The displacement without obstacles; lead: that in directions in which the vertex is held."""
        return (
            self.may(i, now.alpha * v_plus, scene) + lead
            if ti.static(self.features.partly_fixed)
            else now.alpha * v_plus
        )

    @ti.func
    def advance(self, i, u, v_plus, lead, now: A, scene: A, state: A, plan: A):
        """(u', v') for the velocity v+ after the kick; what is held of them is left to the caller."""
        v, delta, ratio = v_plus, self.vector(0), now.h * scene.inverse_mass[i]
        free = self.free_displacement(i, v_plus, lead, now, scene)
        if self.acts(i, ratio, now, scene):
            if self.look(i, u, free, now, scene, state):
                a = now.alpha * self.blend(plan) * ratio
                z, total, _, _ = self.solve(i, lead, free, a, now, scene, state, plan)
                delta, v = ratio * total, self.friction.after_friction(i, v_plus, z, ratio, now, scene, state)
                if ti.static(self.features.recorded):
                    note_impulses(self.friction, i, v_plus, z, ratio, now, scene, state)
                if ti.static(self.features.moving > 0):
                    add_work(self, i, work_of_stage(self.friction, i, v_plus, now, scene, state), state, plan)
                if ti.static(self.features.partly_fixed and self.features.motion):
                    add_work(self, i, work_of_lead(self, i, lead, state), state, plan)
        pressed = self.blend(plan) * delta
        return u + now.alpha * (v + pressed), now.decay * v + delta - (1 - now.decay) * pressed

    # ---- its tangent ---------------------------------------------------------------------------------------------------

    @ti.func
    def advance_jvp(
        self, i, u, moved, v_plus, du, dv_plus, lead, dlead, now: A, scene: A, state: A, tangent: A, plan: A
    ):
        """Changes of u' and v'; moved: u' - u, where the move is looked for."""
        v, dv, delta, ddelta = v_plus, dv_plus, self.vector(0), self.vector(0)
        inverse = scene.inverse_mass[i]
        ratio, blend, free = now.h * inverse, self.blend(plan), self.free_displacement(i, v_plus, lead, now, scene)
        dalpha = now.alpha_by_rate * plan.rate_dot
        if self.acts(i, ratio, now, scene):
            if self.look(i, u, free, now, scene, state):
                a, dratio = now.alpha * blend * ratio, -ratio * inverse * tangent.mass[i]
                z, total, xyz, mixed = self.solve(i, moved, free, a, now, scene, state, plan)
                dtotal = self.note_changes(i, u, du, z, dlead, now, scene, state, tangent, plan)
                b = self.may(i, dalpha * v_plus + now.alpha * dv_plus, scene)
                b += blend * (dalpha * ratio + now.alpha * dratio) * total
                dz = stage.solve_linear(self.features.num_staged, a, xyz, mixed, b + a * dtotal)
                dtotal += self.add_change(i, dz, scene, state)
                if ti.static(self.features.partly_fixed):
                    dz += dlead
                delta, ddelta = ratio * total, dratio * total + ratio * dtotal
                if ti.static(self.features.recorded):
                    note_pushes_jvp(self, i, now, state, tangent)
                v, dv = self.friction.after_friction_jvp(
                    i, u, du, v, dv, z, dz, ratio, dratio, dalpha, now, scene, state, tangent
                )
        w, dw = v + blend * delta, dv + blend * ddelta
        du_next = du + dalpha * w + now.alpha * dw
        dv_next = now.decay * dv + ddelta - (1 - now.decay) * blend * ddelta
        return du_next, dv_next + now.decay_by_rate * plan.rate_dot * w

    @ti.func
    def note_changes(self, i, u, du, z, dlead, now: A, scene: A, state: A, tangent: A, plan: A):
        """Note the change of (n, P) of each obstacle for the move z as it is, but for what is held of it; returns that of
        sum P n."""
        total = self.vector(0)
        for g in ti.static(self.features.staged):
            for k in range(g.count):
                row, first = ROWS * (g.number + k), g.first + k * g.size
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                moved = self.moved(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                dv_obstacle = self.obstacle_velocity_jvp(g, k, X, u, du + tangent.rest[i], now, scene, tangent)
                own, dmove = z - now.h * state.stage[row + VELOCITY, i], -now.h * dv_obstacle
                if ti.static(self.features.partly_fixed):
                    dmove += dlead
                change = stage.push_jvp(
                    g.force, scene.parameters, first, X, u, own, plan.contact_damping, tangent.parameters, moved, dmove
                )
                pushed = state.stage[row + PUSH, i]
                change.w = self.on_area(g, i, change.w, scene)
                if ti.static(g.force.per_area):
                    change.w = change.w + pushed.x / scene.surface[i] * tangent.surface[i]
                state.stage[row + SEED, i] = change
                total += pushed.x * self.normal(change) + change.w * self.normal(state.stage[row + PLANE, i])
        return self.may(i, total, scene)

    @ti.func
    def add_change(self, i, dz, scene: A, state: A):
        """Add what the change dz of the move does to the noted pushes; returns the change of sum P n by it."""
        total = self.vector(0)
        for c in range(ti.static(self.features.num_staged)):
            row = ROWS * (ti.static(self.features.first_staged) + c)
            n = self.normal(state.stage[row + PLANE, i])
            pushed, change = state.stage[row + PUSH, i], state.stage[row + SEED, i]
            more = -pushed.y * n.dot(dz)
            change.w = change.w + more
            state.stage[row + SEED, i] = change
            total += more * n
        return self.may(i, total, scene)

    # ---- its adjoint ---------------------------------------------------------------------------------------------------

    @ti.func
    def advance_vjp(self, i, u, moved, v_plus, lead, p, q, now: A, scene: A, state: A, adjoint: A, plan: A):
        """(adjoint of u besides p, adjoints of v+ and lead) for adjoints p and q of u' and v'; adds those of all else.

        moved: u' - u, where the move is looked for. p and q have nothing in directions in which vertex i is held.
        """
        free, w = self.free_displacement(i, v_plus, lead, now, scene), v_plus
        u_adj, lead_adj = self.vector(0), self.vector(0)
        inverse, blend = scene.inverse_mass[i], self.blend(plan)
        ratio, w_adj = now.h * inverse, now.alpha * p - (1 - now.decay) * q
        v_adj, by_alpha = now.alpha * p + now.decay * q, p.dot(v_plus)
        if self.acts(i, ratio, now, scene):
            if self.look(i, u, free, now, scene, state):
                a = now.alpha * blend * ratio
                z, total, xyz, mixed = self.solve(i, moved, free, a, now, scene, state, plan)
                w = self.friction.after_friction(i, v_plus, z, ratio, now, scene, state) + blend * ratio * total
                delta_adj = q + blend * w_adj
                by_alpha, by_ratio = p.dot(w), delta_adj.dot(total)
                self.seed_all(i, ratio * delta_adj, state)
                if ti.static(self.features.recorded):
                    seed_impulses(self, i, now, state, adjoint)
                by_z = self.vector(0)
                if ti.static(len(self.features.staged_rough) > 0):
                    v_adj, more, of_z, of_alpha, of_u = self.friction.after_friction_vjp(
                        i, u, v_plus, v_adj, z, ratio, now, scene, state, adjoint
                    )
                    by_ratio += more
                    by_alpha += of_alpha
                    by_z += of_z
                    u_adj += of_u
                z_adj = self.may(i, self.by_move(i, state) + by_z, scene)
                z_adj = stage.solve_linear(self.features.num_staged, a, xyz, mixed, z_adj)
                v_adj += now.alpha * z_adj
                by_alpha += z_adj.dot(v_plus + blend * ratio * total)
                by_ratio += blend * now.alpha * z_adj.dot(total)
                by_u, by_lead = self.push_all_vjp(i, u, z, a * z_adj, now, scene, state, adjoint, plan)
                u_adj += by_u
                if ti.static(self.features.partly_fixed):
                    lead_adj = self.sliding_supports.held(i, by_lead + by_z, scene)
                if ti.static(self.features.density):
                    row = ti.static(self.features.sums().first("mass"))
                    adjoint.sums[row, i] = adjoint.sums[row, i] - ratio * inverse * by_ratio
        if ti.static(self.features.drag >= 0):
            row = ti.static(self.features.drag)
            by_rate = now.alpha_by_rate * by_alpha + now.decay_by_rate * q.dot(w)
            adjoint.sums[row, i] = adjoint.sums[row, i] + by_rate
        return u_adj, v_adj, lead_adj

    @ti.func
    def seed_all(self, i, total_adj, state: A):
        """Note the adjoints of (n, P) of each obstacle for that of sum P n."""
        for c in range(ti.static(self.features.num_staged)):
            row = ROWS * (ti.static(self.features.first_staged) + c)
            pushed = state.stage[row + PUSH, i]
            seed = pushed.x * total_adj
            seed.w = self.normal(state.stage[row + PLANE, i]).dot(total_adj)
            state.stage[row + SEED, i] = seed

    @ti.func
    def by_move(self, i, state: A):
        """Adjoint of the move z, from the noted adjoints of the pushes."""
        out = self.vector(0)
        for c in range(ti.static(self.features.num_staged)):
            row = ROWS * (ti.static(self.features.first_staged) + c)
            pushed, seed = state.stage[row + PUSH, i], state.stage[row + SEED, i]
            out += -pushed.y * seed.w * self.normal(state.stage[row + PLANE, i])
        return out  # Taichi 1.7.4 knows no -= and no minus sign of vectors

    @ti.func
    def push_all_vjp(self, i, u, z, total_adj, now: A, scene: A, state: A, adjoint: A, plan: A):
        """(adjoint of u, of the move), from the noted adjoints and that of sum P n in the equation of the move; adds those
        of all else."""
        u_adj, move_adj = self.vector(0), self.vector(0)
        for g in ti.static(self.features.staged):
            for k in range(g.count):
                row, first = ROWS * (g.number + k), g.first + k * g.size
                pushed, seed = state.stage[row + PUSH, i], state.stage[row + SEED, i]
                X = self.seen_now(g, k, scene.rest[i], now, scene)
                own = z - now.h * self.v_obstacle(g, k, X, u, now, scene)
                by_n = self.normal(seed) + pushed.x * total_adj
                by_push = seed.w + self.normal(state.stage[row + PLANE, i]).dot(total_adj)
                if ti.static(g.force.per_area):
                    self.add_to_area(g, i, by_push * pushed.x / scene.surface[i], adjoint)
                by_push = self.on_area(g, i, by_push, scene)
                by_place, by_own, by = stage.push_vjp(
                    g.force, scene.parameters, first, X, u, own, plan.contact_damping, by_n, by_push
                )
                for m in ti.static(range(g.force.index.width + 1)):
                    adjoint.sums[first + m, i] = adjoint.sums[first + m, i] + by[m]
                self.add_to_corners(g, g.size, i, by, adjoint)
                by_v_obstacle = -now.h * by_own
                move_adj += by_own
                if ti.static(g.force.friction):
                    at_mu, at_eps = first + g.force.index.friction, first + g.force.index.friction_speed
                    adjoint.sums[at_mu, i] = adjoint.sums[at_mu, i] + pushed.z
                    adjoint.sums[at_eps, i] = adjoint.sums[at_eps, i] + pushed.w
                    by_v_obstacle += state.stage[row + VELOCITY, i]
                by_u = self.spread(g, k, i, X, u, by_place, by_v_obstacle, now, scene, adjoint, adjoint)
                u_adj += by_u
                self.add_to_rest(i, by_u, adjoint)
        return u_adj, move_adj
