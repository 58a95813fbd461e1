"""Tangent and adjoint of contact within faces in an explicit pass (explicit_face_kernels.py), along its recorded parts."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.mechanics.obstacles.explicit_face_kernels import FaceKernels
from diffsim_ti.runtime import Bundle, Kernel, traced
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, TANGENT
from diffsim_ti.state.pass_table import pass_at

A = ti.template()
# of surface vertices: changes, or adjoints, of e and v; what a part is given; those of u0
OWN = dict.fromkeys(("shift_dot", "speed_dot", "seed", "begin_dot"), "vectors")
RUBBED = dict(impulse_dot="vectors")  # changes, or adjoints, of what rough obstacles push the nodes of each face with
OF_FACES = dict(sums="scalars2", path_adjoint="vectors2", path="vectors2", rest_adj="vectors", by_areas="scalars")


@dataclass(frozen=True)
class FaceDerivatives(FaceKernels):
    """After `begins` and `parts_of_pass` with the same number of parts; what a part takes of forces is held."""

    @property
    def own(self) -> dict:
        return OWN | (RUBBED if self.rough else {})

    # ---- tangent -----------------------------------------------------------------------------------------------------

    @ti.func
    def put_change(self, s, k, now: A, faces: A, tangent: A, own: A, plan: A):
        """Change of where part k takes its forces."""
        i, half = faces.vertices[s], ti.cast(0.5, self.fp)
        if k == 0:
            own.shift_dot[s], own.speed_dot[s] = self.vector(0), self.vector(0)
        change = own.begin_dot[s] + self.share_of(k, plan) * (tangent.u[0, i] - own.begin_dot[s])
        own.seed[s] = change + own.shift_dot[s] + half * self.part_length(now, plan) * own.speed_dot[s]

    @ti.func
    def push_jvp(self, f, k, now: A, scene: A, faces: A, tangent: A, own: A, plan: A):
        if faces.near[f] > 0:
            then, total = self.when(now, self.share_of(k, plan)), self.rows(0)
            u, du = self.rows_of(f, faces.place, k, faces), self.seed_rows(f, own, faces)
            for g in ti.static(self.groups):
                for o in range(g.count):
                    rows = self.rows(0)
                    if ti.static(g.force.turns):
                        rows = self.turned_jvp(g, o, f, u, du, then, scene, faces, tangent)
                    else:
                        X = self.rest_rows(f, scene.rest, self.place(g, o, then, scene.path), faces)
                        w = du + self.rest_rows(f, tangent.rest, self.place(g, o, then, tangent.path), faces)
                        rows, _ = self.face("jvp", g, o, f, X, u, w, scene, faces, tangent)
                    total += rows
                    if ti.static(g.force.friction):
                        for a in ti.static(range(self.nodes)):
                            at, length = self.pushed_row(f, g.number + o, a), self.part_length(now, plan)
                            own.impulse_dot[at] = own.impulse_dot[at] + length * self.direct(self.row_of(rows, a))
            self.store(f, total, faces)

    # ---- of an obstacle that turns, with which forces turn: theta adds theta x f, and its adjoint f x w ---------------

    @ti.func
    def turned_jvp(self, g: A, o, f, u, du, then: A, scene: A, faces: A, tangent: A):
        place, w, theta = self.place(g, o, then, scene.path), self.rows(0), ti.Vector.zero(self.fp, 3)
        for a in ti.static(range(self.nodes)):
            i = faces.corners[self.nodes * f + a]
            X, dr = self.seen(g, scene.rest[i], place), self.row_of(du, a) + tangent.rest[i]
            moved = self.moved(g, o, X, self.row_of(u, a), dr, then, scene, tangent)
            theta = self.turned.short(moved, 3)
            for m in ti.static(range(3)):
                w[a, m] = moved[m]
        X, made = self.made_rows(g, o, f, place, scene, faces), self.turned_rows(g, place, -1, u)
        w, placed = self.turned_rows(g, place, -1, w), self.placed(tangent, place)
        change, _ = self.face("jvp", g, o, f, X, made, w, scene, faces, placed)
        push, _ = self.face("push", g, o, f, X, made, made, scene, faces, scene)
        rows, pushes = self.turned_rows(g, place, 1, change), self.turned_rows(g, place, 1, push)
        for a in ti.static(range(self.nodes)):
            x = theta.cross(self.turned.short(self.row_of(pushes, a)))
            for m in ti.static(range(3)):
                rows[a, m] += x[m]
        return rows

    @traced
    def placed(self, tangent, place):
        """The changes of a scene's numbers, and where the obstacle is."""
        return Bundle(**vars(tangent), place=place)

    @ti.func
    def turned_vjp(self, g: A, o, f, u, w, then: A, scene: A, faces: A, out: A):
        place = self.place(g, o, then, scene.path)
        X, made = self.made_rows(g, o, f, place, scene, faces), self.turned_rows(g, place, -1, u)
        found, _ = self.face("vjp", g, o, f, X, made, self.turned_rows(g, place, -1, w), scene, faces, out)
        push, _ = self.face("push", g, o, f, X, made, made, scene, faces, scene)
        rows, pushes = self.turned_rows(g, place, 1, found), self.turned_rows(g, place, 1, push)
        for a in ti.static(range(self.nodes)):
            turned = self.turned.short(self.row_of(pushes, a)).cross(self.turned.short(self.row_of(w, a)))
            by, seen = (
                self.turned.joined(self.row_of(rows, a), turned),
                self.seen(g, scene.rest[faces.corners[self.nodes * f + a]], place),
            )
            self.spread(g, o, f, seen, self.row_of(u, a), by, self.vector(0), then, scene, out, out)
        return rows

    @ti.func
    def go_on_jvp(self, s, k, now: A, scene: A, faces: A, state: A, tangent: A, own: A, plan: A):
        i, length, half = faces.vertices[s], self.part_length(now, plan), ti.cast(0.5, self.fp)
        inverse, before = scene.inverse_mass[i], own.speed_dot[s]
        gained = faces.speed[k + 1, s] - faces.speed[k, s]
        change = faces.taken[k, s] * length * inverse * self.may(i, self.direct(self.gathered(s, faces)), scene)
        after = before + change - inverse * tangent.mass[i] * gained
        own.shift_dot[s] = own.shift_dot[s] + half * length * (before + after)
        own.speed_dot[s] = after
        if k == plan.n - 1:
            u, du, end = faces.begin[0, i], own.begin_dot[s], tangent.u[0, i]
            z, dz, e, de = state.u[plan.slot, i] - u, end - du, faces.shift[s], own.shift_dot[s]
            tangent.u[0, i] = end + self.taken_jvp(i, u, du, z, dz, e, de, now, scene, tangent)
            tangent.v[0, i] = tangent.v[0, i] + after

    @ti.func
    def all_jvp(self, scene: A, faces: A, state: A, table: A, tangent: A, own: A, plan: A):
        if ti.static(self.parallel):
            for s in range(plan.num_surface):
                self.put_change(s, plan.k, pass_at(table, plan.first - plan.window), faces, tangent, own, plan)
            for f in range(plan.num_faces):
                self.push_jvp(f, plan.k, pass_at(table, plan.first - plan.window), scene, faces, tangent, own, plan)
            for s in range(plan.num_surface):
                now = pass_at(table, plan.first - plan.window)
                self.go_on_jvp(s, plan.k, now, scene, faces, state, tangent, own, plan)
        else:
            ti.loop_config(serialize=True)
            for k in range(plan.n):
                now = pass_at(table, plan.first - plan.window)
                for s in range(plan.num_surface):
                    self.put_change(s, k, now, faces, tangent, own, plan)
                for f in range(plan.num_faces):
                    self.push_jvp(f, k, now, scene, faces, tangent, own, plan)
                for s in range(plan.num_surface):
                    self.go_on_jvp(s, k, now, scene, faces, state, tangent, own, plan)

    @cached_property
    def jvp(self) -> Kernel:
        """Change of the state at the end of a pass, where that without contact within faces stands in `tangent`."""
        arrays = dict(tangent=dict(u="vectors2", v="vectors2") | TANGENT, own=self.own)
        return self._kernel("jvp", self.all_jvp, **arrays)

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    @ti.func
    def seed_rows(self, f, own: A, faces: A):
        out = self.rows(0)
        for a in ti.static(range(self.nodes)):
            x = own.seed[faces.own[self.nodes * f + a]]
            for m in ti.static(range(4)):
                out[a, m] = x[m]
        return out

    @ti.func
    def seed_force(self, s, k, now: A, scene: A, faces: A, state: A, adjoint: A, out: A, own: A, plan: A):
        """Adjoint of the force of part k at a surface vertex; adds that of its mass."""
        i, half, length = faces.vertices[s], ti.cast(0.5, self.fp), self.part_length(now, plan)
        if k == plan.n - 1:
            p, u, noted = self.direct(adjoint.u[0, i]), faces.begin[0, i], self.noting(now, plan)
            z = state.u[plan.slot, i] - u
            by_e, by_z, by_u = self.taken_vjp(i, s, u, z, faces.shift[s], p, noted, scene, adjoint, out)
            adjoint.u[0, i] = adjoint.u[0, i] + by_z
            own.shift_dot[s], own.speed_dot[s] = by_e, self.direct(adjoint.v[0, i])
            own.begin_dot[s] = by_u - by_z
        q, inverse = own.speed_dot[s] + half * length * own.shift_dot[s], scene.inverse_mass[i]
        own.speed_dot[s] = q
        own.seed[s] = faces.taken[k, s] * length * inverse * self.may(i, q, scene)
        if ti.static(self.features.density):
            row, gained = ti.static(self.features.sums().first("mass")), faces.speed[k + 1, s] - faces.speed[k, s]
            adjoint.sums[row, i] = adjoint.sums[row, i] - inverse * self.dot3(q, gained)

    @ti.func
    def push_vjp(self, f, k, now: A, scene: A, faces: A, out: A, own: A, plan: A):
        if faces.near[f] > 0:
            then, total = self.noting(self.when(now, self.share_of(k, plan)), plan), self.rows(0)
            u, w = self.rows_of(f, faces.place, k, faces), self.seed_rows(f, own, faces)
            for g in ti.static(self.groups):
                for o in range(g.count):
                    felt = w
                    if ti.static(g.force.friction):  # friction depends on the impulses, too
                        for a in ti.static(range(self.nodes)):
                            by = self.part_length(now, plan) * own.impulse_dot[self.pushed_row(f, g.number + o, a)]
                            for m in ti.static(range(3)):
                                felt[a, m] += by[m]
                    if ti.static(g.force.turns):
                        total += self.turned_vjp(g, o, f, u, felt, then, scene, faces, out)
                    else:
                        X = self.rest_rows(f, scene.rest, self.place(g, o, then, scene.path), faces)
                        rows, _ = self.face("vjp", g, o, f, X, u, felt, scene, faces, out)
                        total += rows
                        by_X = self.row_of(rows, 0) + self.row_of(rows, 1) + self.row_of(rows, 2)
                        for a in ti.static(range(3, self.nodes)):
                            by_X += self.row_of(rows, a)
                        self.add_to_path(g, o, f, then, by_X, self.vector(0), out)
            self.store(f, total, faces)

    @ti.func
    def go_back(self, s, k, now: A, faces: A, adjoint: A, out: A, own: A, plan: A):
        i, share, by_u = faces.vertices[s], self.share_of(k, plan), self.direct(self.gathered(s, faces))
        half = ti.cast(0.5, self.fp) * self.part_length(now, plan)
        own.speed_dot[s] = own.speed_dot[s] + half * (own.shift_dot[s] + by_u)
        own.shift_dot[s] = own.shift_dot[s] + by_u
        own.begin_dot[s] = own.begin_dot[s] + (1 - share) * by_u
        out.rest_adj[s] = out.rest_adj[s] + by_u
        adjoint.u[0, i] = adjoint.u[0, i] + share * by_u

    @ti.func
    def all_vjp(self, scene: A, faces: A, state: A, table: A, adjoint: A, out: A, own: A, plan: A):
        if ti.static(self.parallel):
            for s in range(plan.num_surface):
                now = pass_at(table, plan.first - plan.window)
                self.seed_force(s, plan.k, now, scene, faces, state, adjoint, out, own, plan)
            for f in range(plan.num_faces):
                self.push_vjp(f, plan.k, pass_at(table, plan.first - plan.window), scene, faces, out, own, plan)
            for s in range(plan.num_surface):
                self.go_back(s, plan.k, pass_at(table, plan.first - plan.window), faces, adjoint, out, own, plan)
        else:
            ti.loop_config(serialize=True)
            for back in range(plan.n):
                k, now = plan.n - 1 - back, pass_at(table, plan.first - plan.window)
                for s in range(plan.num_surface):
                    self.seed_force(s, k, now, scene, faces, state, adjoint, out, own, plan)
                for f in range(plan.num_faces):
                    self.push_vjp(f, k, now, scene, faces, out, own, plan)
                for s in range(plan.num_surface):
                    self.go_back(s, k, now, faces, adjoint, out, own, plan)
        if ti.static(self.features.moving > 0):
            for p in range(ti.static(self.features.moving) * plan.num_parts):
                # not each pass of a step comes here: each is folded by itself
                now = pass_at(table, plan.first - plan.window)
                self.fold_row(p, plan.num_faces, now.row, now.next, out, plan)

    @cached_property
    def vjp(self) -> Kernel:
        """Adjoint of the state at the end of a pass without contact within faces, in place, and of u0; adds those of all
        else."""
        arrays = dict(adjoint=dict(u="vectors2", v="vectors2", sums=ADJOINT["sums"]), out=OF_FACES, own=self.own)
        return self._kernel("vjp", self.all_vjp, ("steps", "num_parts"), **arrays)

    @ti.func
    def all_begin_vjp(self, scene: A, faces: A, state: A, table: A, adjoint: A, own: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i = faces.vertices[s]
            adjoint.u[0, i] = adjoint.u[0, i] + own.begin_dot[s]

    @cached_property
    def begin_vjp(self) -> Kernel:
        """Add the adjoint of u0, once the rest of the pass is reversed."""
        return self._kernel("begin_vjp", self.all_begin_vjp, adjoint=dict(u="vectors2"), own=self.own)

    @ti.func
    def all_begin_jvp(self, scene: A, faces: A, state: A, table: A, tangent: A, own: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            own.begin_dot[s] = tangent.u[0, faces.vertices[s]]

    @cached_property
    def begin_jvp(self) -> Kernel:
        """Keep the change of u0."""
        return self._kernel("begin_jvp", self.all_begin_jvp, tangent=dict(u="vectors2"), own=self.own)


@lru_cache(maxsize=None)
def face_derivatives(features: Features, precision: str, parallel: bool) -> FaceDerivatives:
    """Kernels for a scene's features."""
    return FaceDerivatives(features, precision, parallel)
