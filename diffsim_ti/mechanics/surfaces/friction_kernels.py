"""Kernels of friction between the pairs of a surface, a stage of explicit passes: forward, tangent and adjoint.

A pair that presses with N slides with the velocity t = T sum_i w_i v_i across its normal n, T = I - n n^T. Friction gives
its corners the impulses w_i r,

    r = -h mu N f(s / eps) t / |t|,   s + c f(s / eps) = |t|,   c = h sum_i (|w_i| / m_i) S_i,   S_i = sum |w_i| mu N

the last sum over all pairs of vertex i; f(y) = 2 y - y^2 for y < 1, 1 beyond (terms/obstacles/friction.py). c / (h mu N) is
a bound W of the inverse mass that the pair meets while all others have friction, too: by Cauchy and Schwarz |sum_p r_p
w_p|^2 / m is at most sum_p W_p |r_p|^2. With r_p = -(1 - s / |t|) t / W_p all frictions together change the kinetic
energy by no more than

    sum_p (r_p . t_p + W_p |r_p|^2 / 2) = -sum_p (|t|^2 - s^2) / 2 W_p <= 0

for any h, N, mu and eps, and no vertex depends on the order of the pairs. Where a patch slides as a whole W is no bound
but the value, and s the speed of sliding at the end of the stage: it creeps no faster than eps.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import ListedPair, behind, first_of, three
from diffsim_ti.mechanics.surfaces.pressed_pair import PressedPair
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE
from diffsim_ti.runtime import Kernel
from diffsim_ti.terms.obstacles.friction import KERNELS, slip_in_kernels
from diffsim_ti.terms.self_contact import SelfContact

A = ti.template()
SIGNS = ((1, -1, -1, -1), (1, 1, -1, -1))  # of the weights of the corners
OWN = dict(
    weights="vectors", pressing="vectors", load="scalars", in_friction="ints", label="ints", row_of="ints", any="ints"
)
STATE = dict(u="vectors2", v="vectors2", inverse_mass="scalars", kept_u="vectors2", kept_v="vectors2")
PASS = dict(keep="int", h="float", ratio="float")
DOT = dict(weights_dot="vectors", pressing_dot="vectors", load_dot="scalars")
SUMS = dict(numbers="vectors", mu_adj="scalars", sums="vectors", rest_adj="vectors")
ADJ = dict(weights_adj="vectors", pressing_adj="vectors", load_adj="scalars", pulled="vectors")


@dataclass(frozen=True)
class FrictionKernels(ListedPair):
    """`weights` and `pressing`, (n, mu N), of each pair, 0 where it does not press; `load`: S of each surface vertex.

    A pass has led to u', v' in a slot, of which `kept` has a copy; the stage changes v' and, by `ratio` times that, u'.
    Parameters after stiffness and width: friction speed, coefficients. `row_of` has that of two labels of vertices, or -1.
    `weights_dot` and `pressing_dot`, `weights_adj` and `pressing_adj` are changes and adjoints of `weights` and `pressing`;
    derivatives take the state in the slot as it is before the stage.
    """

    partly_fixed: bool
    num_labels: int

    @cached_property
    def pair(self) -> PressedPair:
        return PressedPair(self.precision, self.first, self.parallel)

    @property
    def state(self) -> dict:
        return STATE | (dict(sliding_slot="ints", sliding_supports="vectors") if self.partly_fixed else {})

    @ti.func
    def may(self, i, x, at: A):
        """The admissible part of x for vertex i: all but what is held of it (mechanics/supports/sliding_supports.py)."""
        out = x
        if ti.static(self.partly_fixed):
            if at.sliding_slot[i] >= 0:
                for d in ti.static(range(3)):
                    out[d] = x[d] - at.sliding_supports[3 * at.sliding_slot[i] + d].dot(x)
        return out

    @ti.func
    def row(self, p, scene: A):
        """Which coefficient pair p has, or -1; of contacts of obstacles they follow those of bodies."""
        of_obstacle = -1
        if ti.static(self.mixed):
            of_obstacle = self.contact_of(p, scene) - 1
        a, b = scene.label[scene.place[scene.pairs[4 * p]]], scene.label[scene.place[scene.pairs[4 * p + 2]]]
        out = scene.row_of[a * self.num_labels + b]
        if of_obstacle >= 0:
            out = scene.row_of[self.num_labels * self.num_labels + of_obstacle]
        return out

    @ti.func
    def at_mu(self, row, scene: A):
        """Where among the parameters a coefficient stands."""
        out = self.first + SelfContact.index.friction + row
        if ti.static(self.mixed):
            out = scene.at_row[row]
        return out

    @ti.func
    def mu(self, p, scene: A):
        k, out = self.row(p, scene), ti.cast(0, self.fp)
        if k >= 0:
            out = scene.parameters[self.at_mu(k, scene)]
        return out

    @ti.func
    def speed(self, p, scene: A, parameters: A):
        """The friction speed of pair p among all parameters, or its change."""
        number = self.first + SelfContact.index.friction_speed
        if ti.static(self.mixed):
            number = scene.at_number[3 * self.contact_of(p, scene) + 2]
        return parameters[number]

    @ti.func
    def size(self, kind: A, w):
        """|w_i|"""
        out = w
        for k in ti.static(range(4)):
            if ti.static(SIGNS[kind][k] < 0):
                out[k] = 0 - w[k]
        return out

    @ti.func
    def at_corners(self, p, scene: A, x: A):
        """A number of each surface vertex at the corners of pair p."""
        out = self.vec4(0)
        for k in ti.static(range(4)):
            out[k] = x[scene.place[scene.pairs[4 * p + k]]]
        return out

    @ti.func
    def of_corners(self, p, scene: A, x: A):
        """A number of each vertex at the corners of pair p."""
        out = self.vec4(0)
        for k in ti.static(range(4)):
            out[k] = x[scene.pairs[4 * p + k]]
        return out

    @ti.func
    def entry(self, x, k):
        """x[k], k known when the kernel runs."""
        out = x[0]
        for a in ti.static(range(1, 4)):
            if k == a:
                out = x[a]
        return out

    @ti.func
    def sum_sizes(self, s, of: A, scene: A):
        """sum |w_i| x over the pairs of surface vertex s, x of each pair being the last entry of `of`."""
        total = ti.cast(0, self.fp)
        for k in range(scene.row[s], scene.row[s + 1]):
            p = scene.corner_of[k] >> 2
            if scene.pressing[p][3] > 0:
                total += ti.abs(self.entry(scene.weights[p], scene.corner_of[k] & 3)) * of[p][3]
        return total

    @ti.func
    def sum_of_corners(self, s, scene: A):
        """What the pairs of surface vertex s with friction have stored for it."""
        total = self.vec4(0)
        for k in range(scene.row[s], scene.row[s + 1]):
            if scene.pressing[scene.corner_of[k] >> 2][3] > 0:
                total += scene.corner[scene.corner_of[k]]
        return total

    # ---- what presses where a pass begins ----------------------------------------------------------------------------

    @ti.func
    def measure_pair(self, kind: A, p, scene: A, at: A, plan: A):
        pressing = self.vec4(0)
        mu = self.mu(p, scene)
        if self.is_active(p, scene) and mu > 0:
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w, n, N = self.pair.pressed(kind, p, y1, y2, y3, scene, plan)
            pressing = self.vec4(n[0], n[1], n[2], mu * N)
            scene.weights[p] = w
            if mu * N > 0:
                scene.any[0] = 1
                for k in ti.static(range(4)):
                    scene.in_friction[scene.place[scene.pairs[4 * p + k]]] = 1
        scene.pressing[p] = pressing

    @ti.func
    def measure_all(self, scene: A, at: A, plan: A):
        scene.any[0] = 0
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_pairs):  # of both kinds: each loop takes time to start
            if p < plan.num_vt:
                self.measure_pair(VERTEX_TRIANGLE, p, scene, at, plan)
            else:
                self.measure_pair(EDGE_EDGE, p, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            if scene.in_friction[s] > 0:
                scene.load[s] = self.sum_sizes(s, scene.pressing, scene)

    @cached_property
    def measure(self) -> Kernel:
        """Weights, normals and loads at u[slot], after `forces` there."""
        return self.kernel("measure", self.measure_all, dict(u="vectors2"), OWN)

    # ---- the stage ---------------------------------------------------------------------------------------------------

    @ti.func
    def sliding(self, kind: A, p, scene: A, at: A, plan: A):
        """(relative velocity, t, |t|, c, f / |t|, f, y, B) of a pair that presses."""
        v1, v2, v3 = self.changes(p, scene, at.v, plan.slot)
        w, n = scene.weights[p], three(scene.pressing[p])
        v = w[1] * v1 + w[2] * v2 + w[3] * v3
        t = v - n.dot(v) * n
        loads, lightness = self.at_corners(p, scene, scene.load), self.of_corners(p, scene, at.inverse_mass)
        c, s = plan.h * (self.size(kind, w) * loads).dot(lightness), ti.sqrt(t.norm_sqr())
        kappa, f, y, B = slip_in_kernels(
            s, c, self.speed(p, scene, scene.parameters), ti.cast(self.tiny, self.fp), KERNELS
        )
        return v, t, s, c, kappa, f, y, B

    @ti.func
    def slide_pair(self, kind: A, p, scene: A, at: A, plan: A):
        _, t, _, _, kappa, _, _, _ = self.sliding(kind, p, scene, at, plan)
        r, w = (plan.h * scene.pressing[p][3] * kappa) * t, scene.weights[p]  # less the impulse
        self.store(p, scene, w[1] * r, w[2] * r, w[3] * r)

    @ti.func
    def slide_all(self, scene: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_pairs):
            if scene.pressing[p][3] > 0:
                if p < plan.num_vt:
                    self.slide_pair(VERTEX_TRIANGLE, p, scene, at, plan)
                else:
                    self.slide_pair(EDGE_EDGE, p, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i = scene.surface[s]
            if plan.keep >= 0:
                at.kept_u[plan.keep, s], at.kept_v[plan.keep, s] = at.u[plan.slot, i], at.v[plan.slot, i]
            if scene.in_friction[s] > 0:
                scene.in_friction[s] = 0
                gained = at.inverse_mass[i] * self.may(i, self.sum_of_corners(s, scene), at)
                at.v[plan.slot, i] = at.v[plan.slot, i] + gained
                at.u[plan.slot, i] = at.u[plan.slot, i] + plan.ratio * gained

    @cached_property
    def slide(self) -> Kernel:
        """The stage, on the state in a slot; keep: the row of `kept` for what was there, -1 for none."""
        return self.kernel("slide", self.slide_all, self.state, OWN, **PASS)

    @ti.func
    def swap_all(self, scene: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i = scene.surface[s]
            u, v = at.u[plan.slot, i], at.v[plan.slot, i]
            at.u[plan.slot, i], at.v[plan.slot, i] = at.kept_u[plan.keep, s], at.kept_v[plan.keep, s]
            at.kept_u[plan.keep, s], at.kept_v[plan.keep, s] = u, v

    @cached_property
    def swap(self) -> Kernel:
        """The state in a slot and that in a row of `kept`."""
        return self.kernel("swap", self.swap_all, STATE, keep="int")

    @ti.func
    def each_pressing(self, act: A, scene: A, at: A, plan: A):
        """act(kind, p, scene, at, plan) of all pairs that press."""
        for kind in ti.static((VERTEX_TRIANGLE, EDGE_EDGE)):
            ti.loop_config(serialize=not self.parallel)
            for p in range(first_of(kind, plan), behind(kind, plan)):
                if scene.pressing[p][3] > 0:
                    act(kind, p, scene, at, plan)

    # ---- derivatives of what presses ---------------------------------------------------------------------------------

    @ti.func
    def measure_pair_jvp(self, kind: A, p, scene: A, at: A, plan: A):
        y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
        dy1, dy2, dy3 = self.changes(p, scene, at.w, 0)
        r1, r2, r3 = self.changes_at_rest(p, scene, at.rest_dot)
        rest = scene.rest_weights[p]
        d_rest = three(scene.rest_plane[p]).dot(rest[1] * r1 + rest[2] * r2 + rest[3] * r3)
        d_stiffness, d_width = self.of_term(p, scene, at.parameters_dot)
        d_radius = ti.cast(0, self.fp)
        if ti.static(self.mixed):
            d_radius = at.numbers_dot[self.contact_of(p, scene)][2]
        dk, dw = self.numbers_jvp(p, scene, d_stiffness, d_width, d_rest)
        d_weights, dn, dN = self.pair.pressed_jvp(
            kind, p, y1, y2, y3, dy1 + r1, dy2 + r2, dy3 + r3, dk, dw, d_radius, scene, plan
        )
        mu = self.mu(p, scene)
        d_mu = at.parameters_dot[self.at_mu(self.row(p, scene), scene)]
        scene.weights_dot[p] = d_weights
        scene.pressing_dot[p] = self.vec4(dn[0], dn[1], dn[2], mu * dN + d_mu / mu * scene.pressing[p][3])

    @ti.func
    def measure_all_jvp(self, scene: A, at: A, plan: A):
        self.each_pressing(self.measure_pair_jvp, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            if scene.in_friction[s] > 0:
                total = self.sum_sizes(s, scene.pressing_dot, scene)
                for k in range(scene.row[s], scene.row[s + 1]):
                    p, corner = scene.corner_of[k] >> 2, scene.corner_of[k] & 3
                    if scene.pressing[p][3] > 0:
                        change = self.entry(scene.weights_dot[p], corner) * scene.pressing[p][3]
                        total += ti.select(self.is_negative(p, corner, plan), 0 - change, change)
                scene.load_dot[s] = total

    @ti.func
    def is_negative(self, p, corner, plan: A):
        """Whether the weight of a corner is at most 0."""
        return (corner > 1) | ((corner == 1) & (p < plan.num_vt))

    @cached_property
    def measure_jvp(self) -> Kernel:
        """Changes for those w of the displacements u[slot], of the rest shape and of the numbers."""
        at = dict(u="vectors2", w="vectors2", rest_dot="vectors", parameters_dot="scalars")
        at |= dict(numbers_dot="vectors") if self.mixed else {}
        return self.kernel("measure_jvp", self.measure_all_jvp, at, OWN | DOT)

    # ---- of the stage ------------------------------------------------------------------------------------------------

    @ti.func
    def slide_pair_jvp(self, kind: A, p, scene: A, at: A, plan: A):
        v, t, s, c, kappa, f, y, B = self.sliding(kind, p, scene, at, plan)
        v1, v2, v3 = self.changes(p, scene, at.v, plan.slot)
        dv1, dv2, dv3 = self.changes(p, scene, at.dv, 0)
        w, dw, n, dn = scene.weights[p], scene.weights_dot[p], three(scene.pressing[p]), three(scene.pressing_dot[p])
        dv = w[1] * dv1 + w[2] * dv2 + w[3] * dv3 + dw[1] * v1 + dw[2] * v2 + dw[3] * v3
        dt = dv - n.dot(dv) * n - dn.dot(v) * n - n.dot(v) * dn
        e = t / ti.max(s, ti.cast(self.tiny, self.fp))
        ds, sizes, changes = e.dot(dt), self.size(kind, w), self.size(kind, dw)
        loads, lightness = self.at_corners(p, scene, scene.load), self.of_corners(p, scene, at.inverse_mass)
        d_loads, d_mass = self.at_corners(p, scene, scene.load_dot), self.of_corners(p, scene, at.mass_dot)
        d_lightness = 0 - lightness * lightness * d_mass
        dc = plan.h * ((changes * loads + sizes * d_loads).dot(lightness) + (sizes * loads).dot(d_lightness))
        df = B * (ds - f * dc - y * self.speed(p, scene, at.parameters_dot))
        L, dL = plan.h * scene.pressing[p][3], plan.h * scene.pressing_dot[p][3]
        r = (L * kappa) * t
        dr = (dL * kappa) * t + L * ((df - kappa * ds) * e + kappa * dt)
        self.store(p, scene, w[1] * dr + dw[1] * r, w[2] * dr + dw[2] * r, w[3] * dr + dw[3] * r)

    @ti.func
    def slide_all_jvp(self, scene: A, at: A, plan: A):
        self.each_pressing(self.slide_pair_jvp, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            if scene.in_friction[s] > 0:
                i = scene.surface[s]
                inverse, gained = at.inverse_mass[i], at.kept_v[plan.keep, s] - at.v[plan.slot, i]
                change = inverse * self.may(i, self.sum_of_corners(s, scene), at) + -inverse * at.mass_dot[i] * gained
                at.dv[0, i] = at.dv[0, i] + change
                at.du[0, i] = at.du[0, i] + plan.ratio * change + plan.ratio_dot * gained

    @cached_property
    def slide_jvp(self) -> Kernel:
        """Adds to the changes du, dv of the state; `kept` has the state after the stage."""
        at = self.state | dict(du="vectors2", dv="vectors2", mass_dot="scalars", parameters_dot="scalars")
        return self.kernel("slide_jvp", self.slide_all_jvp, at, OWN | DOT, **PASS, ratio_dot="float")

    # ---- adjoint of the stage ----------------------------------------------------------------------------------------

    @ti.func
    def gathered(self, i, of: A, at: A):
        total = self.vec4(0)
        for k in range(at.start[i], at.start[i + 1]):
            total += of[at.corners[k]]
        return total

    @ti.func
    def pull(self, s, scene: A, at: A, plan: A):
        """Adjoint of the impulse on surface vertex s; adds that of its mass and of the drag."""
        i = scene.surface[s]
        p, q = at.u_adj[0, i] + self.gathered(i, at.corner_adj, at), at.v_adj[0, i]
        if plan.rates > 0:
            q += self.gathered(i, at.rate_corner, at)
        inverse, gained = at.inverse_mass[i], at.kept_v[plan.keep, s] - at.v[plan.slot, i]
        by_gained = q + plan.ratio * p
        at.by_rate[s] = at.by_rate[s] + plan.ratio_by_rate * p.dot(gained)
        at.by_mass[s] = at.by_mass[s] + -inverse * by_gained.dot(gained)
        scene.pulled[s] = inverse * self.may(i, by_gained, at)

    @ti.func
    def slide_pair_vjp(self, kind: A, p, scene: A, at: A, plan: A):
        v, t, s, c, kappa, f, y, B = self.sliding(kind, p, scene, at, plan)
        v1, v2, v3 = self.changes(p, scene, at.v, plan.slot)
        w, n, zero = scene.weights[p], three(scene.pressing[p]), ti.cast(0, self.fp)
        g = self.at_corners_of(p, scene)
        r_adj = w[1] * g[0] + w[2] * g[1] + w[3] * g[2]
        e = t / ti.max(s, ti.cast(self.tiny, self.fp))
        L = plan.h * scene.pressing[p][3]
        r, G = (0 - L * kappa) * t, 0 - L * e.dot(r_adj)
        by_load, by_c = 0 - plan.h * kappa * t.dot(r_adj), 0 - G * B * f
        t_adj = (0 - L * kappa) * r_adj + (G * (B - kappa)) * e
        across = n.dot(t_adj)
        v_adj, n_adj = t_adj - across * n, (0 - n.dot(v)) * t_adj - across * v
        w_adj = self.vec4(zero, v1.dot(v_adj) + r.dot(g[0]), v2.dot(v_adj) + r.dot(g[1]), v3.dot(v_adj) + r.dot(g[2]))
        loads, lightness = self.at_corners(p, scene, scene.load), self.of_corners(p, scene, at.inverse_mass)
        scene.weights_adj[p] = w_adj + self.size(kind, (plan.h * by_c) * loads * lightness)
        scene.pressing_adj[p] = self.vec4(n_adj[0], n_adj[1], n_adj[2], by_load)
        scene.numbers[p] = self.vec4(0 - G * B * y, plan.h * by_c, zero, zero)
        h1, h2, h3 = (0 - w[1]) * v_adj, (0 - w[2]) * v_adj, (0 - w[3]) * v_adj
        self.store(p, scene, h1, h2, h3)

    @ti.func
    def at_corners_of(self, p, scene: A):
        """`pulled` of corners 1 to 3 less that of corner 0."""
        g0 = three(scene.pulled[scene.place[scene.pairs[4 * p]]])
        g1 = three(scene.pulled[scene.place[scene.pairs[4 * p + 1]]])
        g2 = three(scene.pulled[scene.place[scene.pairs[4 * p + 2]]])
        g3 = three(scene.pulled[scene.place[scene.pairs[4 * p + 3]]])
        return g1 - g0, g2 - g0, g3 - g0

    @ti.func
    def end_vertex(self, s, scene: A, at: A, plan: A):
        """Adjoint of the velocity before the stage, and of S."""
        i, by_load = scene.surface[s], ti.cast(0, self.fp)
        inverse = at.inverse_mass[i]
        for k in range(scene.row[s], scene.row[s + 1]):
            p, corner = scene.corner_of[k] >> 2, scene.corner_of[k] & 3
            if scene.pressing[p][3] > 0:
                by_load += inverse * ti.abs(self.entry(scene.weights[p], corner)) * scene.numbers[p][1]
                if corner == self.corner_of_contact(p, scene):
                    at.by_speed[s] = at.by_speed[s] + scene.numbers[p][0]
        scene.load_adj[s] = by_load
        at.by_mass[s] = at.by_mass[s] + -inverse * by_load * scene.load[s]
        at.v_adj[0, i] = at.v_adj[0, i] + self.sum_of_corners(s, scene)

    @ti.func
    def measure_pair_vjp(self, kind: A, p, scene: A, at: A, plan: A):
        w, pressing = scene.weights[p], scene.pressing[p]
        by_loads, of_pressing = self.at_corners(p, scene, scene.load_adj), scene.pressing_adj[p]
        w_adj = scene.weights_adj[p] + self.size(kind, pressing[3] * by_loads)
        by_load = of_pressing[3] + self.size(kind, w).dot(by_loads)
        mu = self.mu(p, scene)
        y1, y2, y3 = self.corners(p, scene, at.place, plan.begin)
        h1, h2, h3, by_k, by_width, by_radius = self.pair.pressed_vjp(
            kind, p, y1, y2, y3, w_adj, three(of_pressing), mu * by_load, scene, plan
        )
        by_stiffness, by_W, by_D = self.numbers_vjp(p, scene, by_k, by_width)
        scene.numbers[p] = self.vec4(by_stiffness, by_W, by_D, by_radius)
        scene.mu_adj[p] = by_load * pressing[3] / mu
        self.store(p, scene, 0 - h1, 0 - h2, 0 - h3)

    @ti.func
    def collect_vertex(self, s, scene: A, at: A, plan: A):
        by_place = self.sum_of_corners(s, scene)
        at.by_place[s] = by_place
        total, by_rest = self.vec4(0), by_place
        for k in range(scene.row[s], scene.row[s + 1]):
            p, corner = scene.corner_of[k] >> 2, scene.corner_of[k] & 3
            if scene.pressing[p][3] > 0:
                numbers = scene.numbers[p]
                if corner == self.corner_of_contact(p, scene):
                    total += numbers
                    at_mu = s * plan.num_rows + self.row(p, scene)
                    at.by_mu[at_mu] = at.by_mu[at_mu] + scene.mu_adj[p]
                if numbers[2] != 0:
                    weight = numbers[2] * self.entry(scene.rest_weights[p], corner)
                    by_rest += self.four(weight * three(scene.rest_plane[p]))
        scene.sums[s] = scene.sums[s] + total
        scene.rest_adj[s] = scene.rest_adj[s] + by_rest

    @ti.func
    def measure_all_vjp(self, scene: A, at: A, plan: A):
        self.each_pressing(self.measure_pair_vjp, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            at.by_place[s] = self.vec4(0)
            if scene.in_friction[s] > 0:
                self.collect_vertex(s, scene, at, plan)

    @cached_property
    def measure_vjp(self) -> Kernel:
        """Adjoint of the displacement place[begin] (`by_place`) for `weights_adj` and `pressing_adj`; adds those of the
        numbers and of the rest shape."""
        at = dict(place="vectors2", by_place="vectors", by_mu="scalars")
        return self.kernel("measure_vjp", self.measure_all_vjp, at, OWN | ADJ | SUMS, begin="int", num_rows="int")

    @ti.func
    def all_pairs_vjp(self, scene: A, at: A, plan: A):
        self.each_pressing(self.slide_pair_vjp, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            if scene.in_friction[s] > 0:
                self.end_vertex(s, scene, at, plan)

    @cached_property
    def pairs_vjp(self) -> Kernel:
        """From `pulled`, adjoints of the impulses, to those of the velocities before the stage, to v_adj, of loads, weights
        and what presses."""
        at = self.state | dict(v_adj="vectors2", by_place="vectors")
        at |= dict.fromkeys(("by_rate", "by_mass", "by_speed", "by_mu"), "scalars")
        return self.kernel("pairs_vjp", self.all_pairs_vjp, at, OWN | ADJ | SUMS, **PASS)

    @ti.func
    def slide_all_vjp(self, scene: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            if scene.in_friction[s] > 0:
                self.pull(s, scene, at, plan)
        self.all_pairs_vjp(scene, at, plan)
        self.measure_all_vjp(scene, at, plan)

    @cached_property
    def slide_vjp(self) -> Kernel:
        """Adjoint of the velocity before the stage, of the displacement `place[begin]` where the pass began (`by_place`);
        adds those of all else. Corners still hold a part of the adjoints u_adj, v_adj after it."""
        at = self.state | dict(place="vectors2", u_adj="vectors2", v_adj="vectors2", start="ints", corners="ints")
        at |= dict(corner_adj="vectors", rate_corner="vectors", by_place="vectors")
        at |= dict.fromkeys(("by_rate", "by_mass", "by_speed", "by_mu"), "scalars")
        numbers = dict.fromkeys(("begin", "rates", "num_rows"), "int") | dict(ratio_by_rate="float")
        return self.kernel("slide_vjp", self.slide_all_vjp, at, OWN | ADJ | SUMS, **PASS, **numbers)
