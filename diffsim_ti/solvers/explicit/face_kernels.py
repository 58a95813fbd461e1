"""Kernels over the faces of a surface before an explicit pass, whose forces surface vertices gather as one more corner.

Barriers are stiffer than a pass of length h can follow, and the pass takes of a vertex's force f what it can:

    f g(x),    x = h^2 D / m,    g(x) = (1 + x^4)^(-1/4)

D (face_forces.py) is no less than the stiffness of the points around the vertex, so that h^2 times the stiffness over the
mass that is left is at most 1: where the body alone may take 4, that lets it have 3. Where a pass resolves the contact
(x < 1/2) it feels the whole force to 2 %. Where it does not, the force is less, and what passes the barrier is noticed.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.runtime import Kernel
from diffsim_ti.solvers.explicit.face_forces import FaceForces
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT
from diffsim_ti.state.schedule import pass_at

A = ti.template()
FACES = dict.fromkeys(("corners", "own", "parts", "start", "entries", "vertices"), "ints") | dict.fromkeys(
    ("share", "whole", "seed", "before", "offsets"), "vectors"
)
FACES |= dict.fromkeys(("reach", "weight", "least", "energy", "done", "work"), "scalars")
NUMBERS = dict.fromkeys(
    ("slot", "first", "window", "num_vertices", "num_faces", "num_surface", "first_out", "between"), "int"
)
OF_FACES = dict(sums="scalars2", felt="vectors2", path="vectors2", rest_adj="vectors", by_areas="scalars")


@dataclass(frozen=True)
class FaceKernels(FaceForces):
    """Of all faces, at u[slot] of a state."""

    parallel: bool

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(scene=SCENE, faces=FACES, state=dict(u="vectors2"), table=dict(ints="ints", floats="scalars"))
        return Kernel("face_" + name, body, self.precision, own | arrays, NUMBERS | dict(h="float"))

    @ti.func
    def taken(self, x):
        """(g, g')"""
        y = x * x * x * x
        root = ti.sqrt(ti.sqrt(1 + y))
        g = ti.cast(1, self.fp) / root
        return g, 0 - x * x * x * g / (1 + y)

    @ti.func
    def load(self, i, D, scene: A, plan: A):
        """x of a vertex."""
        return plan.h * plan.h * D * scene.inverse_mass[i]

    @ti.func
    def direct(self, f):
        """Without the fourth component."""
        out = f
        out[3] = ti.cast(0, self.fp)
        return out

    @ti.func
    def gathered(self, s, faces: A):
        """Sum of what the faces around surface vertex s have for it, in a fixed order."""
        out = self.vector(0)
        for c in range(faces.start[s], faces.start[s + 1]):
            out += faces.share[faces.entries[c]]
        return out

    @ti.func
    def store(self, f, rows, faces: A):
        for a in ti.static(range(3)):
            x = self.vector(0)
            for m in ti.static(range(4)):
                x[m] = rows[a, m]
            faces.share[3 * f + a] = x

    # ---- forces ------------------------------------------------------------------------------------------------------

    @ti.func
    def force_of(self, f, now: A, scene: A, faces: A, state: A, plan: A):
        """Forces of a face's corners to `share`, its energy, and to `least` how near it is to each obstacle."""
        faces.energy[f], faces.done[f] = ti.cast(0, self.fp), ti.cast(0, self.fp)
        total, u = self.rows(0), self.rows_at(f, state.u, plan.slot, faces)
        for g in ti.static(self.groups):
            for k in range(g.count):
                X = self.rest_rows(f, scene.rest, self.where(g, k, now, scene, faces, plan), faces)
                rows, least = self.face("force", g, k, f, X, u, u, scene, faces, scene)
                total += rows
                if ti.static(g.path >= 0):
                    speed = self.speed(g, k, now, scene.path)
                    for a in ti.static(range(3)):
                        faces.done[f] = faces.done[f] + plan.h * self.dot3(self.row_of(rows, a), speed)
                faces.least[f * ti.static(self.num_obstacles) + g.number + k] = least
        self.store(f, total, faces)
        for a in ti.static(range(3)):
            faces.before[3 * f + a] = state.u[plan.slot, faces.corners[3 * f + a]]

    @ti.func
    def all_forces(self, scene: A, faces: A, state: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            self.force_of(f, pass_at(table, plan.first - plan.window), scene, faces, state, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            whole = self.gathered(s, faces)
            faces.whole[s] = whole
            g, _ = self.taken(self.load(faces.vertices[s], whole[3], scene, plan))
            scene.corner[plan.first_out + s] = g * self.direct(whole)

    @cached_property
    def forces(self) -> Kernel:
        return self._kernel("forces", self.all_forces)

    # ---- what happened in the pass -----------------------------------------------------------------------------------

    @ti.func
    def look_at(self, f, now: A, scene: A, faces: A, state: A, plan: A, watch: A):
        """Note how near a face in a barrier is, or one that went farther than it was away, and x (state/watch.py)."""
        u, load, column = self.rows_at(f, state.u, plan.slot, faces), ti.cast(0, self.fp), plan.num_vertices + f
        moved = self.rows(0)
        for a in ti.static(range(3)):
            i, before = faces.corners[3 * f + a], faces.before[3 * f + a]
            whole = faces.whole[faces.own[3 * f + a]]
            load = ti.max(load, self.load(i, whole[3], scene, plan))
            for m in ti.static(range(3)):
                moved[a, m] = u[a, m] - before[m]
        if ti.static(self.features.moving > 0):  # of moving obstacles, where the pass takes their force
            share, _ = self.taken(load)
            faces.work[f] = faces.work[f] + share * faces.done[f]
        for g in ti.static(self.groups):
            for k in range(g.count):
                n, place = g.number + k, self.place(g, k, now, scene.path)
                drift, move = self.place_at(g, k, now.end, now, scene.path) - place, moved
                for a in ti.static(range(3)):
                    for m in ti.static(range(3)):
                        move[a, m] -= drift[m]
                least, width = (
                    faces.least[f * ti.static(self.num_obstacles) + n],
                    g.force.width(scene.parameters, g.first + k * g.size),
                )
                felt = least < width
                if least < self.size_of_rows(move):
                    X = self.rest_rows(f, scene.rest, place + drift, faces)
                    least = self.nearest(g, k, f, X, u, move, scene, faces)
                elif felt:
                    least += faces.reach[f * ti.static(self.num_obstacles) + n]
                if felt or least < width:
                    watch.seen[3 * n, column] = ti.min(watch.seen[3 * n, column], least)
                    watch.seen[3 * n + 1, column] = ti.max(watch.seen[3 * n + 1, column], load)

    @ti.func
    def all_looks(self, scene: A, faces: A, state: A, table: A, watch: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            self.look_at(f, pass_at(table, plan.first - plan.window), scene, faces, state, plan, watch)

    @cached_property
    def looks(self) -> Kernel:
        """After a pass that led to u[slot]."""
        return self._kernel("looks", self.all_looks, watch=dict(seen="scalars2"))

    # ---- stiffness, between passes ---------------------------------------------------------------------------------------

    @ti.func
    def seed_rows(self, f, faces: A):
        out = self.rows(0)
        for a in ti.static(range(3)):
            x = faces.seed[faces.own[3 * f + a]]
            for m in ti.static(range(4)):
                out[a, m] = x[m]
        return out

    @ti.func
    def all_products(self, scene: A, faces: A, state: A, table: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i = faces.vertices[s]
            g, _ = self.taken(self.load(i, faces.whole[s][3], scene, plan))
            faces.seed[s] = ti.sqrt(g) * self.direct(at.w[0, i])
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            total, u, w = self.rows(0), self.rows_at(f, state.u, plan.slot, faces), self.seed_rows(f, faces)
            now = pass_at(table, plan.first - plan.window)
            for g in ti.static(self.groups):
                for k in range(g.count):
                    X = self.rest_rows(f, scene.rest, self.where(g, k, now, scene, faces, plan), faces)
                    rows, _ = self.face("product", g, k, f, X, u, w, scene, faces, scene)
                    total += rows
            self.store(f, total, faces)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i = faces.vertices[s]
            g, _ = self.taken(self.load(i, faces.whole[s][3], scene, plan))
            scene.corner[plan.first_out + s] = ti.sqrt(g) * self.gathered(s, faces)

    @cached_property
    def products(self) -> Kernel:
        """sqrt(g) df/du sqrt(g) w: what a pass takes of the stiffness, made symmetric; its eigenvalues are the same. As all
        below after `forces` at the same place."""
        return self._kernel("products", self.all_products, at=dict(w="vectors2"))

    # ---- tangent -----------------------------------------------------------------------------------------------------

    @ti.func
    def all_jvp(self, scene: A, faces: A, state: A, table: A, tangent: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            now, total = pass_at(table, plan.first - plan.window), self.rows(0)
            u, du = self.rows_at(f, state.u, plan.slot, faces), self.rows_at(f, tangent.u, 0, faces)
            for g in ti.static(self.groups):
                for k in range(g.count):
                    X = self.rest_rows(f, scene.rest, self.where(g, k, now, scene, faces, plan), faces)
                    w = du + self.rest_rows(f, tangent.rest, self.place(g, k, now, tangent.path), faces)
                    rows, _ = self.face("jvp", g, k, f, X, u, w, scene, faces, tangent)
                    total += rows
            self.store(f, total, faces)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i, whole, change = faces.vertices[s], faces.whole[s], self.gathered(s, faces)
            x, inverse = self.load(i, whole[3], scene, plan), scene.inverse_mass[i]
            g, slope = self.taken(x)
            dx = self.load(i, change[3], scene, plan) - x * inverse * tangent.mass[i]
            scene.corner[plan.first_out + s] = g * self.direct(change) + slope * dx * self.direct(whole)

    @cached_property
    def jvp(self) -> Kernel:
        """Change of the forces for changes of everything that they depend on."""
        return self._kernel("jvp", self.all_jvp, tangent=dict(u="vectors2") | TANGENT)

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    @ti.func
    def seed_vertex(self, s, scene: A, faces: A, adjoint: A, plan: A):
        """Adjoints of (f, D) at a surface vertex; adds that of its mass."""
        i, whole = faces.vertices[s], faces.whole[s]
        w, x, inverse = adjoint.w[0, i], self.load(i, whole[3], scene, plan), scene.inverse_mass[i]
        g, slope = self.taken(x)
        by_x, seed = slope * self.dot3(whole, w), g * self.direct(w)
        seed[3] = by_x * plan.h * plan.h * inverse
        faces.seed[s] = seed
        if ti.static(self.features.density):
            row = ti.static(self.features.sums().first("mass"))
            adjoint.sums[row, i] = adjoint.sums[row, i] - by_x * x * inverse

    @ti.func
    def all_vjp(self, scene: A, faces: A, state: A, table: A, adjoint: A, own: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            self.seed_vertex(s, scene, faces, adjoint, plan)
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            now, total = pass_at(table, plan.first - plan.window), self.rows(0)
            u, w = self.rows_at(f, state.u, plan.slot, faces), self.seed_rows(f, faces)
            for g in ti.static(self.groups):
                for k in range(g.count):
                    X = self.rest_rows(f, scene.rest, self.where(g, k, now, scene, faces, plan), faces)
                    rows, _ = self.face("vjp", g, k, f, X, u, w, scene, faces, own)
                    total += rows
                    by_X = self.row_of(rows, 0) + self.row_of(rows, 1) + self.row_of(rows, 2)
                    if ti.static(g.path >= 0):
                        c = 2 * (g.path + k)
                        own.felt[c, f] = own.felt[c, f] - (1 - now.begin) * by_X
                        own.felt[c + 1, f] = own.felt[c + 1, f] - now.begin * by_X
            self.store(f, total, faces)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            by_u = self.gathered(s, faces)
            adjoint.corner[plan.first_out + s] = by_u
            own.rest_adj[s] = own.rest_adj[s] + by_u
        for c in range(ti.static(self.features.moving)):
            self.fold_path(c, pass_at(table, plan.first - plan.window), plan.num_faces, own)

    @ti.func
    def fold_path(self, c, now: A, num_faces, own: A):
        """At the first pass of a step, the last to be gone back through: sum what all faces felt, in a fixed order."""
        if now.opens > 0:
            to_row, to_next = self.vector(0), self.vector(0)
            for f in range(num_faces):
                to_row += own.felt[2 * c, f]
                to_next += own.felt[2 * c + 1, f]
                own.felt[2 * c, f], own.felt[2 * c + 1, f] = self.vector(0), self.vector(0)
            own.path[now.row, c] = own.path[now.row, c] + to_row
            own.path[now.next, c] = own.path[now.next, c] + to_next

    @cached_property
    def vjp(self) -> Kernel:
        """Adjoints of u to the corners that vertices gather, for the adjoint w of the forces; adds those of all else."""
        adjoint = dict(w="vectors2", corner="vectors", sums=ADJOINT["sums"])
        return self._kernel("vjp", self.all_vjp, adjoint=adjoint, own=OF_FACES)


@lru_cache(maxsize=None)
def face_kernels(features: Features, precision: str, parallel: bool) -> FaceKernels:
    """Kernels for a scene's features."""
    return FaceKernels(features, precision, parallel)
