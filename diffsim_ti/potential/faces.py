"""What points within a face feel of an obstacle that its corners do not speak for.

    E = c k w^2 beta((d - r) / w) phi(e / w),    e = sum_a s_a d_a - d

d [m]: distance of the point, whose shares of the corners are s_a; d_a: those of the corners; k, w, beta: the obstacle's
stiffness, width and barrier (terms/obstacles/barrier.py); r: how far what lies between the points is from them; c: the
square of their distance in widths, so that the points in a square of one width are together as stiff as a vertex. e is how
much nearer the point is than its corners let expect: nothing before what is flat, hollow or far larger than the face, so
that it costs nothing there; before a needle, an edge or a corner the point feels the obstacle as a vertex does. phi rises
from 0 to 1 between e / w = FLAT and BENT and is C2.
The points of a face lie on a lattice, a quarter of a width apart or closer, but for its largest number; corners are none of
them.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.potential.face_lattice import FLAT, fade, fade_curvature, fade_slope
from diffsim_ti.runtime import Kernel
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT
from diffsim_ti.state.obstacle_functions import ObstacleFunctions
from diffsim_ti.terms.obstacles import barrier

A = ti.template()
PASS = dict(
    walls="vectors", face_start="ints", face_next="ints", face_parts="ints", face_reach="scalars", face_weight="scalars"
)


@dataclass(frozen=True)
class FacePoints(ObstacleFunctions):
    """Sums over the points of the faces around vertex i, each with what it says of that vertex."""

    parallel: bool

    @property
    def rows(self):
        return ti.types.matrix(3, 4, self.fp)

    @property
    def num_obstacles(self) -> int:
        return sum(group.count for group in self.features.groups)

    @ti.func
    def change_at(self, what: A, i, n, at: A, more: A):
        """How vertex i moves, relative to obstacle n."""
        w = self.vector(0)
        if ti.static(what in ("product", "numbers")):
            w = at.w[0, i]
        if ti.static(what == "jvp"):
            w = at.w[0, i] + more.rest[i] - more.walls[3 * n]
        return w

    @ti.func
    def turn(self, what: A, g: A, first, X, u, w, scene: A, more: A):
        """Change of (normal, distance) at a point that moves by w."""
        out = self.vector(0)
        if ti.static(what == "jvp"):
            out = g.force.outlook_jvp(scene.parameters, first, X, u, w, more.parameters)
        elif ti.static(what in ("product", "column")):
            out = g.force.outlook_jvp(scene.parameters, first, X, u, w)
        return out

    @ti.func
    def around(self, what: A, i, scene: A, pass_: A, at: A, more: A):
        """The sum over the points around vertex i of: "energy" (in the first component), "force", "product" with at.w;
        "column" `more` of the product's matrix; "jvp" for changes `more` besides."""
        out = self.vector(0)
        for g in ti.static(self.features.groups):
            if ti.static(not g.force.hollow):
                for k in range(g.count):
                    out += self.around_one(what, g, k, i, scene, pass_, at, more)
        return out

    @ti.func
    def around_one(self, what: A, g: A, k, i, scene: A, pass_: A, at: A, more: A):
        """The same of obstacle k of group g alone; of "numbers" nothing, but their adjoints for the adjoint at.w of the
        force go to `more`."""
        out, first, n = self.vector(0), g.first + k * g.size, g.number + k
        wall, width = pass_.walls[3 * n], g.force.width(scene.parameters, first)
        own = g.force.gap(scene.parameters, first, scene.rest[i] - wall, at.u[0, i])
        for c in range(pass_.face_start[i], pass_.face_start[i + 1]):
            row = c * ti.static(self.num_obstacles) + n
            reach, size, i3 = pass_.face_reach[row], ti.cast(0, self.fp), ti.Vector([i, 0, 0])
            X, u, w = self.rows(0), self.rows(0), self.rows(0)
            for a in ti.static(range(3)):
                if ti.static(a > 0):
                    i3[a] = pass_.face_next[2 * c + a - 1]
                x, y, z = scene.rest[i3[a]] - wall, at.u[0, i3[a]], self.change_at(what, i3[a], n, at, more)
                if ti.static(what == "column"):
                    z = self.unit(more, a)
                edge = (x - (scene.rest[i] - wall)) + (y - at.u[0, i])
                size = ti.max(size, edge.norm_sqr())
                for m in ti.static(range(4)):
                    X[a, m], u[a, m], w[a, m] = x[m], y[m], z[m]
            if own - ti.sqrt(size) < width + reach:
                out += self.points_of_face(
                    what, g, first, X, u, w, reach, pass_.face_weight[row], pass_.face_parts[row], i, scene, more
                )
        return out

    @ti.func
    def unit(self, d, a: A):
        """Component d of the first corner (a = 0) moves by 1, others by nothing."""
        out = self.vector(0)
        for m in ti.static(range(3)):
            out[m] = ti.select(d == m and a == 0, ti.cast(1, self.fp), ti.cast(0, self.fp))
        return out

    @ti.func
    def row_of(self, M, a):
        """Row a of a matrix of three."""
        out = self.vector(0)
        for m in ti.static(range(4)):
            out[m] = ti.select(a == 0, M[0, m], ti.select(a == 1, M[1, m], M[2, m]))
        return out

    @ti.func
    def mix(self, s0, s1, s2, M):
        """Rows of a matrix of three, weighted."""
        out = self.vector(0)
        for m in ti.static(range(4)):
            out[m] = s0 * M[0, m] + s1 * M[1, m] + s2 * M[2, m]
        return out

    @ti.func
    def points_of_face(self, what: A, g: A, first, X, u, w, reach, weight, parts, i, scene: A, more: A):
        """The sum over the points of a face whose first corner is vertex i; X, u, w: rows of its corners."""
        out, per, third = self.vector(0), ti.cast(1, self.fp) / ti.cast(parts, self.fp), ti.cast(1 / 3, self.fp)
        stiffness, width = scene.parameters[first + g.force.count], g.force.width(scene.parameters, first)
        corners, turns, middle = self.rows(0), self.rows(0), self.vector(0)  # (normal, distance) there, and its change
        for a in range(4):
            x, y = self.row_of(X, a), self.row_of(u, a)
            if a == 3:
                x = self.mix(third, third, third, X)
                y = self.mix(third, third, third, u)
            seen = g.force.outlook(scene.parameters, first, x, y)
            for m in ti.static(range(4)):
                middle[m] = seen[m]
                for b in ti.static(range(3)):
                    corners[b, m] = ti.select(a == b, seen[m], corners[b, m])
        # a convex obstacle is never nearer than the tangent plane at the middle says
        bent = ti.cast(1e30, self.fp)
        if ti.static(g.force.convex):
            bent = ti.cast(0, self.fp)
            for a in ti.static(range(3)):
                along = ti.cast(0, self.fp)
                for m in ti.static(range(3)):
                    mean = third * (X[0, m] + X[1, m] + X[2, m]) + third * (u[0, m] + u[1, m] + u[2, m])
                    along += middle[m] * (X[a, m] + u[a, m] - mean)
                bent = ti.max(bent, corners[a, 3] - middle[3] - along)
        if bent > ti.cast(FLAT, self.fp) * width:
            if ti.static(what in ("product", "column", "jvp")):
                for a in range(3):
                    t = self.turn(what, g, first, self.row_of(X, a), self.row_of(u, a), self.row_of(w, a), scene, more)
                    for m in ti.static(range(4)):
                        for b in ti.static(range(3)):
                            turns[b, m] = ti.select(a == b, t[m], turns[b, m])
            out = self.points_that_feel(
                what, g, first, X, u, w, corners, turns, stiffness, weight, width, reach, parts, per, i, scene, more
            )
        return out

    @ti.func
    def points_that_feel(
        self,
        what: A,
        g: A,
        first,
        X,
        u,
        w,
        corners,
        turns,
        stiffness,
        weight,
        width,
        reach,
        parts,
        per,
        i,
        scene: A,
        more: A,
    ):
        out, c0, t0, w0 = self.vector(0), self.row_of(corners, 0), self.row_of(turns, 0), self.row_of(w, 0)
        by = self.rows(0)  # adjoints of `corners`
        for x in range(parts):
            for y in range(parts - x):
                s1, s2 = x * per, y * per
                s0 = 1 - s1 - s2
                Xs, us = self.mix(s0, s1, s2, X), self.mix(s0, s1, s2, u)
                now = g.force.outlook(scene.parameters, first, Xs, us)
                s = (now[3] - reach) / width
                t = (s0 * corners[0, 3] + s1 * corners[1, 3] + s2 * corners[2, 3] - now[3]) / width
                if x + y > 0 and s < 1 and t > ti.cast(FLAT, self.fp):
                    b = barrier.value(s, self.fp)
                    b1 = barrier.slope(s, self.fp)
                    b2 = barrier.curvature(s, self.fp)
                    p, p1, p2 = fade(t, self.fp), fade_slope(t, self.fp), fade_curvature(t, self.fp)
                    scale = 0 - s0 * weight * stiffness * width
                    if ti.static(what == "energy"):
                        out[0] += s0 * weight * stiffness * width * width * b * p
                    elif ti.static(what == "force"):
                        out += scale * (b1 * p * now + b * p1 * (c0 - now))
                    elif ti.static(what == "numbers"):
                        along, across = now.dot(w0), (c0 - now).dot(w0)  # w0 has no fourth component
                        by_s = scale * (b2 * p * along + b1 * p1 * across)
                        by_t = scale * (b1 * p1 * along + b * p2 * across)
                        f = scale * (b1 * p * along + b * p1 * across)
                        by_now = scale * (b1 * p - b * p1) * w0
                        by_now[3] = (by_s - by_t) / width
                        g.force.outlook_vjp(scene.parameters, first, Xs, us, by_now, more.sums, i)
                        for m in ti.static(range(3)):
                            by[0, m] += scale * b * p1 * w0[m]
                        by[0, 3] += s0 * by_t / width
                        by[1, 3] += s1 * by_t / width
                        by[2, 3] += s2 * by_t / width
                        at_k, at_w = first + g.force.count, first + g.force.count + 1
                        more.sums[at_k, i] = more.sums[at_k, i] + f / stiffness
                        more.sums[at_w, i] = more.sums[at_w, i] + (f - s * by_s - t * by_t) / width
                    else:
                        dn = self.turn(what, g, first, Xs, us, self.mix(s0, s1, s2, w), scene, more)
                        ds = dn[3] / width
                        dt = (s0 * turns[0, 3] + s1 * turns[1, 3] + s2 * turns[2, 3] - dn[3]) / width
                        grown = ti.cast(0, self.fp)
                        if ti.static(what == "jvp"):
                            dwidth = more.parameters[first + g.force.count + 1] / width
                            ds, dt = ds - s * dwidth, dt - t * dwidth
                            grown = more.parameters[first + g.force.count] / stiffness + dwidth
                        out += scale * (
                            (b2 * p * ds + b1 * p1 * dt) * now
                            + b1 * p * dn
                            + (b1 * p1 * ds + b * p2 * dt) * (c0 - now)
                            + b * p1 * (t0 - dn)
                            + grown * (b1 * p * now + b * p1 * (c0 - now))
                        )
        if ti.static(what == "numbers"):
            for a in range(3):
                g.force.outlook_vjp(
                    scene.parameters, first, self.row_of(X, a), self.row_of(u, a), self.row_of(by, a), more.sums, i
                )
        if ti.static(what != "energy"):
            out[3] = 0
        return out

    # ---- kernels -----------------------------------------------------------------------------------------------------

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(scene=SCENE, pass_=PASS, at=dict(u="vectors2", w="vectors2")) | arrays
        return Kernel(name, body, self.precision, own, dict(num_vertices="int"))

    @ti.func
    def all_energies(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.contact[i] = self.around("energy", i, scene, pass_, at, at)[0]

    @cached_property
    def energy(self) -> Kernel:
        """Energy [J], each vertex with its share of the points around."""
        return self._kernel("face_energy", self.all_energies, out=dict(contact="scalars"))

    @ti.func
    def all_forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around("force", i, scene, pass_, at, at)

    @cached_property
    def forces(self) -> Kernel:
        return self._kernel("face_forces", self.all_forces, out=dict(y="vectors2"))

    @ti.func
    def all_products(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around("product", i, scene, pass_, at, at)

    @cached_property
    def product(self) -> Kernel:
        """y = df/du w"""
        return self._kernel("face_product", self.all_products, out=dict(y="vectors2"))

    @ti.func
    def all_blocks(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            for d in range(3):
                out.blocks[d, i] = 0 - self.around("column", i, scene, pass_, at, d)

    @cached_property
    def blocks(self) -> Kernel:
        """The 3x3 diagonal blocks of -df/du, by columns."""
        return self._kernel("face_blocks", self.all_blocks, out=dict(blocks="vectors2"))

    @ti.func
    def all_jvp(self, scene: A, pass_: A, at: A, out: A, tangent: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around("jvp", i, scene, pass_, at, tangent)

    @cached_property
    def jvp(self) -> Kernel:
        """Change y of the forces for changes w of the displacement and of everything else that they depend on."""
        own = dict(out=dict(y="vectors2"), tangent=TANGENT | dict(walls="vectors"))
        return self._kernel("face_jvp", self.all_jvp, **own)

    @ti.func
    def all_vjp(self, scene: A, pass_: A, at: A, out: A, adjoint: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.vector(0)
            for g in ti.static(self.features.groups):
                if ti.static(not g.force.hollow):
                    for k in range(g.count):
                        by_u, n = self.around_one("product", g, k, i, scene, pass_, at, at), 3 * (g.number + k)
                        self.around_one("numbers", g, k, i, scene, pass_, at, adjoint)
                        adjoint.walls[n, i] = adjoint.walls[n, i] - by_u
                        self.add_to_rest(i, by_u, adjoint)
                        out.y[0, i] = out.y[0, i] + by_u

    @cached_property
    def vjp(self) -> Kernel:
        """y = df/du w; adds the adjoints of all else that forces depend on."""
        own = dict(out=dict(y="vectors2"), adjoint=ADJOINT | dict(walls="vectors2"))
        return self._kernel("face_vjp", self.all_vjp, **own)


@lru_cache(maxsize=None)
def face_points(features: Features, precision: str, parallel: bool) -> FacePoints:
    """Kernels for a scene's features."""
    return FacePoints(features, precision, parallel)
