"""Kernels of friction between the pairs of a surface, a stage of explicit passes: forward, tangent and adjoint.

A pair that presses with N slides with the velocity t = T sum_i w_i v_i across its normal n, T = I - n n^T. Friction gives
its corners the impulses w_i r,

    r = -h mu N f(s / eps) t / |t|,   s + c f(s / eps) = |t|,   c = h sum_i (|w_i| / m_i) S_i,   S_i = sum |w_i| mu N

the last sum over all pairs of vertex i; f(y) = 2 y - y^2 for y < 1, 1 beyond (terms/obstacles/friction.py). c / (h mu N) is
a bound W of the inverse mass that the pair meets while all others rub too: by Cauchy and Schwarz |sum_p r_p w_p|^2 / m is
at most sum_p W_p |r_p|^2. With r_p = -(1 - s / |t|) t / W_p all frictions together change the kinetic energy by no more than

    sum_p (r_p . t_p + W_p |r_p|^2 / 2) = -sum_p (|t|^2 - s^2) / 2 W_p <= 0

for any h, N, mu and eps, and no vertex depends on the order of the pairs. Where a patch slides as a whole W is no bound
but the value, and s the speed of sliding at the end of the stage: it creeps no faster than eps.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import three
from diffsim_ti.mechanics.surfaces.pressed_pair import PressedPair
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE
from diffsim_ti.runtime import Kernel
from diffsim_ti.terms.self_contact import SelfContact

A = ti.template()
SIGNS = ((1, -1, -1, -1), (1, 1, -1, -1))  # of the weights of the corners
OWN = dict(weights="vectors", pressing="vectors", load="scalars", rubs="ints", label="ints", row_of="ints", any="ints")
STATE = dict(u="vectors2", v="vectors2", inverse_mass="scalars", kept_u="vectors2", kept_v="vectors2")
PASS = dict(keep="int", h="float", ratio="float")


@dataclass(frozen=True)
class FrictionKernels(PressedPair):
    """`weights` and `pressing`, (n, mu N), of each pair, 0 where it does not press; `load`: S of each surface vertex.

    A pass has led to u', v' in a slot, of which `kept` has a copy; the stage changes v' and, by `ratio` times that, u'.
    Parameters after stiffness and width: friction speed, coefficients. `row_of` has that of two labels of vertices, or -1.
    """

    guided: bool
    num_labels: int

    @property
    def state(self) -> dict:
        return STATE | (dict(guide_slot="ints", guides="vectors") if self.guided else {})

    @ti.func
    def may(self, i, x, at: A):
        """What vertex i may do of x: all but what is held of it (mechanics/supports/guides.py)."""
        out = x
        if ti.static(self.guided):
            if at.guide_slot[i] >= 0:
                for d in ti.static(range(3)):
                    out[d] = x[d] - at.guides[3 * at.guide_slot[i] + d].dot(x)
        return out

    @ti.func
    def row(self, p, scene: A):
        """Which coefficient pair p has, or -1."""
        a, b = scene.label[scene.place[scene.pairs[4 * p]]], scene.label[scene.place[scene.pairs[4 * p + 2]]]
        return scene.row_of[a * self.num_labels + b]

    @ti.func
    def mu(self, p, scene: A):
        k, out = self.row(p, scene), ti.cast(0, self.fp)
        if k >= 0:
            out = scene.parameters[self.first + SelfContact.index.friction + k]
        return out

    @ti.func
    def speed(self, scene: A):
        return scene.parameters[self.first + SelfContact.index.friction_speed]

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
        """What the pairs of surface vertex s that rub have stored for it."""
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
        if self.is_felt(p, scene) and mu > 0:
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w, n, N = self.pressed(kind, p, y1, y2, y3, scene, plan)
            pressing = self.vec4(n[0], n[1], n[2], mu * N)
            scene.weights[p] = w
            if mu * N > 0:
                scene.any[0] = 1
                for k in ti.static(range(4)):
                    scene.rubs[scene.place[scene.pairs[4 * p + k]]] = 1
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
            if scene.rubs[s] > 0:
                scene.load[s] = self.sum_sizes(s, scene.pressing, scene)

    @cached_property
    def measure(self) -> Kernel:
        """Weights, normals and loads at u[slot], after `forces` there."""
        return self.kernel("measure", self.measure_all, dict(u="vectors2"), OWN)

    # ---- the stage ---------------------------------------------------------------------------------------------------

    @ti.func
    def slip(self, s, c, eps):
        """(f / |t|, f, y, B) for |t| = s, with df = B (ds - f dc - y d eps)."""
        one, zero = ti.cast(1, self.fp), ti.cast(0, self.fp)
        kappa, f, y, B = one / ti.max(s, ti.cast(self.tiny, self.fp)), one, one, zero
        if s < eps + c:
            both = eps + 2 * c
            keep = 2 * eps / (both + ti.sqrt(ti.max(both * both - 4 * c * s, zero)))
            y = keep * s / eps
            kappa, f = keep / eps * (2 - y), y * (2 - y)
            B = 2 * (one - y) / (eps + 2 * c * (one - y))
        return kappa, f, y, B

    @ti.func
    def sliding(self, kind: A, p, scene: A, at: A, plan: A):
        """(relative velocity, t, |t|, c, f / |t|, f, y, B) of a pair that presses."""
        v1, v2, v3 = self.changes(p, scene, at.v, plan.slot)
        w, n = scene.weights[p], three(scene.pressing[p])
        v = w[1] * v1 + w[2] * v2 + w[3] * v3
        t = v - n.dot(v) * n
        loads, lightness = self.at_corners(p, scene, scene.load), self.of_corners(p, scene, at.inverse_mass)
        c, s = plan.h * (self.size(kind, w) * loads).dot(lightness), ti.sqrt(t.norm_sqr())
        kappa, f, y, B = self.slip(s, c, self.speed(scene))
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
            if scene.rubs[s] > 0:
                scene.rubs[s] = 0
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
