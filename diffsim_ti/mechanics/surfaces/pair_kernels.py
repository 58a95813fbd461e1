"""Kernels over the pairs of a surface: forces, and their derivatives.

Most pairs of a list are beyond the width: they write nothing but their plane, and vertices with no other pairs sum nothing.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.surfaces.listed_pair import MARGIN, OPPOSITE, ListedPair, three
from diffsim_ti.mechanics.surfaces.proximity import VERTEX_TRIANGLE
from diffsim_ti.runtime import A, Kernel, as_kernel


@dataclass(frozen=True)
class PairKernels(ListedPair):
    """Forces at u[slot], products of their derivatives, and adjoints of stiffness, width and rest shape.

    keeps: whether forces leave the weights of what is nearest, and G (proximity.py).
    """

    keeps: bool = False

    # ---- planes that part pairs --------------------------------------------------------------------------------------

    @ti.func
    def apart(self, kind: A, n, y1, y2, y3):
        """How far apart along n all corners of the two primitives are: their distance is at least that, whatever n."""
        y, d = (0 * y1, y1, y2, y3), ti.cast(1e30, self.fp)
        for a, b in ti.static(OPPOSITE[kind]):
            d = ti.min(d, n.dot(y[a] - y[b]))
        return d

    @ti.func
    def unit(self, v):
        return v / ti.max(ti.sqrt(v.norm_sqr()), ti.cast(1e-30, self.fp))

    @ti.func
    def guess(self, kind: A, y1, y2, y3):
        """A normal along which the two primitives are likely to be apart: across both, or from one middle to the other."""
        across, between = y1.cross(y3 - y2), ti.cast(0.5, self.fp) * (y1 - y2 - y3)
        if ti.static(kind == VERTEX_TRIANGLE):
            across, between = (y2 - y1).cross(y3 - y1), 0 - (y1 + y2 + y3)
        if across.dot(between) < 0:
            across = 0 - across
        n, other = self.unit(across), self.unit(between)
        if self.apart(kind, other, y1, y2, y3) > self.apart(kind, n, y1, y2, y3):
            n = other
        return n

    # ---- forces ------------------------------------------------------------------------------------------------------

    @ti.func
    def force(self, kind: A, p, scene: A, at: A, plan: A):
        stiffness, width = self.numbers(p, scene)
        radius = self.radius_of(p, scene)
        y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
        last = scene.plane[p]
        n, energy, g1, g2, g3 = three(last), ti.cast(0, self.fp), self.vec3(0), self.vec3(0), self.vec3(0)
        if last[0] == 0 and last[1] == 0 and last[2] == 0:  # a new list
            n = self.guess(kind, y1, y2, y3)
        d = self.apart(kind, n, y1, y2, y3) - radius
        # the plane of the pass before spares most pairs the search; the margin is for rounding
        if not d > ti.cast(MARGIN, self.fp) * width or plan.exact > 0:
            scale = self.scale_of(kind, p, scene, plan)
            w, r, g = self.nearest(kind, y1, y2, y3)
            energy, n, d, g1, g2, g3 = self.gradient(kind, w, r, y1, y2, y3, scale, stiffness, width, radius)
            if ti.static(self.keeps):
                scene.nearest[p], scene.inverse[p] = w, self.four(g)
        scene.plane[p] = self.vec4(n[0], n[1], n[2], d)
        scene.energy[p] = energy
        if not d > width:
            self.store(p, scene, g1, g2, g3)
            for k in ti.static(range(4)):
                scene.touched[scene.place[scene.pairs[4 * p + k]]] = 1

    @as_kernel(
        "forces",
        dict(u="vectors2", out="vectors"),
        dict(energy="scalars", touched="ints", before="vectors"),
        exact="int",
    )
    def forces(self, scene: A, at: A, plan: A):
        """Forces; keeps a plane (n, d) that parts each pair, and where the surface was.

        d is the distance of a pair that is nearer than the width or if `exact`, else a lower bound of it.
        """
        self.each_pair(self.force, scene, at, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total = self.vec4(0)
            if scene.touched[s] > 0:
                scene.touched[s] = 0
                for k in range(scene.row[s], scene.row[s + 1]):
                    if self.is_active(scene.corner_of[k] >> 2, scene):
                        total += scene.corner[scene.corner_of[k]]
            at.out[plan.first_out + s] = total
            scene.before[s] = at.u[plan.slot, scene.surface[s]]

    # ---- derivatives -------------------------------------------------------------------------------------------------

    @ti.func
    def product(self, kind: A, p, scene: A, at: A, plan: A):
        h1, h2, h3, numbers = self.vec3(0), self.vec3(0), self.vec3(0), self.vec4(0)
        wanted = True
        if ti.static(self.mixed):
            wanted = plan.only < 0 or plan.only == self.contact_of(p, scene)
        if wanted:
            y1, y2, y3 = self.corners(p, scene, at.u, plan.slot)
            dy1, dy2, dy3 = self.changes(p, scene, at.w, 0)
            d_rest = ti.cast(0, self.fp)
            if plan.by_rest > 0:
                r1, r2, r3 = self.changes_at_rest(p, scene, at.rest_dot)
                dy1, dy2, dy3 = dy1 + r1, dy2 + r2, dy3 + r3
                w = scene.rest_weights[p]
                d_rest = three(scene.rest_plane[p]).dot(w[1] * r1 + w[2] * r2 + w[3] * r3)
            scale = self.scale_of(kind, p, scene, plan)
            stiffness, width = self.numbers(p, scene)
            d_stiffness, d_width, d_radius = self.changes_of_numbers(p, scene, at, plan)
            dk, dw = self.numbers_jvp(p, scene, d_stiffness, d_width, d_rest)
            radius = self.radius_of(p, scene)
            w, r, g = self.nearest(kind, y1, y2, y3)
            h1, h2, h3, by_stiffness, by_width, by_radius = self.gradient_jvp(
                kind, w, r, g, (y1, y2, y3), (dy1, dy2, dy3), (scale, stiffness, width, radius), (dk, dw, d_radius)
            )
            by_k, by_W, by_D = self.numbers_vjp(p, scene, by_stiffness, by_width)
            numbers = self.vec4(0 - by_k, 0 - by_W, 0 - by_D, 0 - by_radius)  # the force is minus the gradient
        self.store(p, scene, h1, h2, h3)
        scene.numbers[p] = numbers

    @ti.func
    def changes_of_numbers(self, p, scene: A, at: A, plan: A):
        """Those of (stiffness, width, radius) of the contact of pair p."""
        dk, dw, d_radius = plan.d_stiffness, plan.d_width, ti.cast(0, self.fp)
        if ti.static(self.mixed):
            change = at.numbers_dot[self.contact_of(p, scene)]
            dk, dw, d_radius = scene.area[p] * change[0], change[1], change[2]
        return dk, dw, d_radius

    @cached_property
    def products(self) -> Kernel:
        """Change of the forces for changes w of the positions (and of rest shape, stiffness and width)."""
        at = dict(u="vectors2", w="vectors2", rest_dot="vectors", out="vectors")
        at |= dict(numbers_dot="vectors") if self.mixed else {}
        numbers = dict(by_rest="int", d_stiffness="float", d_width="float")
        numbers |= dict(only="int") if self.mixed else {}
        return self._kernel("products", self.all_products, at, dict(numbers="vectors"), **numbers)

    @as_kernel("add_sums", dict(out="vectors"), dict.fromkeys(("numbers", "sums", "rest_adj"), "vectors"))
    def add_sums(self, scene: A, at: A, plan: A):
        """Adjoints of stiffness, width and radius, each pair at one corner, and of the rest shape, after `products`.

        The rest shape moves the corners, and makes the widths of pairs that are near in it.
        """
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total, by_rest = self.vec4(0), at.out[plan.first_out + s]
            for k in range(scene.row[s], scene.row[s + 1]):
                p, corner = scene.corner_of[k] >> 2, scene.corner_of[k] & 3
                numbers = scene.numbers[p]
                if corner == self.corner_of_contact(p, scene):
                    total += numbers
                if numbers[2] != 0:
                    weight = numbers[2] * self.entry(scene.rest_weights[p], corner)
                    by_rest += self.four(weight * three(scene.rest_plane[p]))
            scene.sums[s] = scene.sums[s] + total
            scene.rest_adj[s] = scene.rest_adj[s] + by_rest
