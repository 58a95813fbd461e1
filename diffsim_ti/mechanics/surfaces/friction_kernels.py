"""Kernels of friction between the pairs of a surface in implicit passes: what presses where a pass begins."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import ListedPair, behind, first_of, three
from diffsim_ti.mechanics.surfaces.pressed_pair import PressedPair
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE
from diffsim_ti.runtime import as_kernel
from diffsim_ti.terms.self_contact import SelfContact

A = ti.template()
OWN = dict(weights="vectors", pressing="vectors", label="ints", row_of="ints")
DOT = dict(weights_dot="vectors", pressing_dot="vectors")
SUMS = dict(numbers="vectors", mu_adj="scalars", sums="vectors", rest_adj="vectors")
CHANGED = dict(u="vectors2", w="vectors2", rest_dot="vectors", parameters_dot="scalars")
ADJ = dict(weights_adj="vectors", pressing_adj="vectors")


@dataclass(frozen=True)
class FrictionKernels(ListedPair):
    """`weights` and `pressing`, (n, mu N), of each pair, 0 where it does not press.

    Parameters after stiffness and width: friction speed, coefficients. `row_of` has that of two labels of vertices, or -1.
    `weights_dot` and `pressing_dot`, `weights_adj` and `pressing_adj` are changes and adjoints of `weights` and `pressing`.
    """

    num_labels: int

    @cached_property
    def pair(self) -> PressedPair:
        return PressedPair(self.precision, self.first, self.parallel)

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
    def sum_of_corners(self, s, scene: A):
        """What the pairs of surface vertex s with friction have stored for it."""
        total = self.vec4(0)
        for k in range(scene.row[s], scene.row[s + 1]):
            if scene.pressing[scene.corner_of[k] >> 2][3] > 0:
                total += scene.corner[scene.corner_of[k]]
        return total

    # ---- what presses ------------------------------------------------------------------------------------------------

    @ti.func
    def measure_pair(self, kind: A, p, scene: A, at: A, plan: A):
        pressing = self.vec4(0)
        mu = self.mu(p, scene)
        if self.is_active(p, scene) and mu > 0:
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            w, n, N = self.pair.pressed(kind, p, y1, y2, y3, scene, plan)
            pressing = self.vec4(n[0], n[1], n[2], mu * N)
            scene.weights[p] = w
        scene.pressing[p] = pressing

    @as_kernel("measure", dict(u="vectors2"), OWN)
    def measure(self, scene: A, at: A, plan: A):
        """Weights, normals and forces at u[slot], after `forces` there."""
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_pairs):  # of both kinds: each loop takes time to start
            if p < plan.num_vt:
                self.measure_pair(VERTEX_TRIANGLE, p, scene, at, plan)
            else:
                self.measure_pair(EDGE_EDGE, p, scene, at, plan)

    @ti.func
    def each_pressing(self, act: A, scene: A, at: A, plan: A):
        """act(kind, p, scene, at, plan) of all pairs that press."""
        for kind in ti.static((VERTEX_TRIANGLE, EDGE_EDGE)):
            ti.loop_config(serialize=not self.parallel)
            for p in range(first_of(kind, plan), behind(kind, plan)):
                if scene.pressing[p][3] > 0:
                    act(kind, p, scene, at, plan)

    # ---- derivatives -------------------------------------------------------------------------------------------------

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

    @as_kernel("measure_jvp", lambda self: CHANGED | (dict(numbers_dot="vectors") if self.mixed else {}), OWN | DOT)
    def measure_jvp(self, scene: A, at: A, plan: A):
        """Changes for those w of the displacements u[slot], of the rest shape and of the numbers."""
        self.each_pressing(self.measure_pair_jvp, scene, at, plan)

    @ti.func
    def measure_pair_vjp(self, kind: A, p, scene: A, at: A, plan: A):
        pressing = scene.pressing[p]
        w_adj, of_pressing, mu = scene.weights_adj[p], scene.pressing_adj[p], self.mu(p, scene)
        by_load = of_pressing[3]
        y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
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

    @as_kernel("measure_vjp", dict(u="vectors2", by_place="vectors", by_mu="scalars"), OWN | ADJ | SUMS, num_rows="int")
    def measure_vjp(self, scene: A, at: A, plan: A):
        """Adjoint of the displacement u[slot] (`by_place`) for `weights_adj` and `pressing_adj`; adds those of the
        numbers and of the rest shape."""
        self.each_pressing(self.measure_pair_vjp, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            self.collect_vertex(s, scene, at, plan)
