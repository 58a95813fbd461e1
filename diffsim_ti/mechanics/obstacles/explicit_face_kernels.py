"""Contact of points within faces as a stage of explicit passes: their forces along the displacement that a pass has found.

A pass leads a surface vertex of mass m from u0 to u1. Barriers of points are stiffer than it can follow, and narrower than
it is long, so that the pass is integrated again in n equal parts of length d = h / n, with their forces f (face_forces.py):

    u  = u0 + (k + 1/2) / n (u1 - u0) + e + d v / 2        where forces of part k are taken
    v' = v + d f(u) / m,    e' = e + d (v + v') / 2,       from v = e = 0; at the end e (limited_face_contact.py) and v
    are added

It is leapfrog in the moving frame of the pass, and keeps the energy as that does. n is a power of two
(face_contact_points.py): in a part no face goes farther than a share of the width, and d^2 D / m is at most LOAD at
each vertex. D, which comes with f, is no less than the stiffness of the points around it. The step of the body need not
know of this stiffness. Where more parts would be needed than there may be, a part takes of f what it can follow, f /
max(1, d^2 D / m), and a warning says so. Tuckerman, Berne, Martyna 1992, Reversible multiple time scale molecular
dynamics, doi:10.1063/1.463137.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.mechanics.obstacles.face_lattice import FLAT
from diffsim_ti.mechanics.obstacles.limited_face_contact import LimitedFaceContact
from diffsim_ti.mechanics.supports.sliding_supports import SLIDING_SUPPORTS
from diffsim_ti.runtime import Bundle, Kernel, let, traced
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import SCENE, needed
from diffsim_ti.state.pass_table import pass_at

A = ti.template()
FACES = dict.fromkeys(("corners", "own", "parts", "start", "entries", "vertices", "near"), "ints")
PUSHED = dict(impulse="vectors")  # of rough obstacles on the nodes of each face, in a pass
FACES |= dict.fromkeys(("share", "whole", "shift", "offsets"), "vectors") | dict.fromkeys(
    ("begin", "place", "speed"), "vectors2"
)
FACES |= dict(taken="scalars2") | dict.fromkeys(
    ("reach", "weight", "least", "energy", "done", "work", "need", "load", "pushed"), "scalars"
)
NUMBERS = dict.fromkeys(("slot", "first", "window", "num_vertices", "num_faces", "num_surface", "between"), "int")
NUMBERS |= dict(n="int", k="int", h="float")


@dataclass(frozen=True)
class FaceKernels(LimitedFaceContact):
    """Of all faces; u[slot] of a state is where the pass ends, faces.begin[0] where it begins."""

    parallel: bool

    def _kernel(self, name: str, body, more=(), **arrays) -> Kernel:
        own = dict(
            scene=needed(SCENE, self.features) | (SLIDING_SUPPORTS if self.features.partly_fixed else {}),
            faces=FACES | (PUSHED if self.rough else {}),
            state=dict(u="vectors2", v="vectors2"),
            table=dict(ints="ints", floats="scalars"),
        )
        return Kernel("face_" + name, body, self.precision, own | arrays, NUMBERS | dict.fromkeys(more, "int"))

    @ti.func
    def gathered(self, s, faces: A):
        """Sum of what the faces around surface vertex s have for it, in a fixed order."""
        out = self.vector(0)
        for c in range(faces.start[s], faces.start[s + 1]):
            out += faces.share[faces.entries[c]]
        return out

    @ti.func
    def share_of(self, k, plan: A):
        """Share of the pass at which forces of part k are taken."""
        return (ti.cast(k, self.fp) + ti.cast(0.5, self.fp)) / ti.cast(plan.n, self.fp)

    @traced
    def when(self, now, share):
        """The pass, as if it began at a share of it: obstacles are there then."""
        return Bundle(**(dict(vars(now)) | dict(begin=let(now.begin + share * (now.end - now.begin)))))

    @ti.func
    def part_length(self, now: A, plan: A):
        return now.h / ti.cast(plan.n, self.fp)

    # ---- which faces come near ---------------------------------------------------------------------------------------

    @ti.func
    def bent(self, g: A, first, f, X, u, scene: A):
        """How much nearer than its corners a point of the face may be [m]."""
        out = ti.cast(1e30, self.fp)
        if ti.static(g.force.hollow):
            out = self.arch(X + u, self.inner(f))
        elif ti.static(g.force.convex):
            Xm, um = self.middle_of(f, X), self.middle_of(f, u)
            middle, out = g.force.contact_plane(scene.parameters, first, Xm, um), self.arch(X + u, self.inner(f))
            for a in range(3):
                Xa, ua = self.row_of(X, a), self.row_of(u, a)
                edge = (Xa - Xm) + (ua - um)
                out = ti.max(out, g.force.gap(scene.parameters, first, Xa, ua) - middle[3] - self.dot3(middle, edge))
        return out

    @ti.func
    def bound(self, g: A, k, f, X, u, travel, scene: A, faces: A):
        """What the distance of a face's points less r is not below, before they have moved by `travel` or after."""
        Xm, um, around = self.middle_of(f, X), self.middle_of(f, u), self.rows(0)
        for a in ti.static(range(self.nodes)):
            for m in ti.static(range(3)):
                around[a, m] = (X[a, m] - Xm[m]) + (u[a, m] - um[m])
        middle = g.force.clearance(scene.parameters, g.first + k * g.size, Xm, um)
        reach = faces.reach[f * ti.static(self.num_obstacles) + g.number + k]
        return middle[3] - self.size_of_rows(f, around) - reach - travel

    @ti.func
    def way_of(self, g: A, k, f, u0, begin, u1, end, now: A, scene: A, faces: A):
        """Rows of the corners' moves from u0 to u1 as the obstacle sees them, at shares of the step."""
        move = u1 - u0
        if ti.static(g.force.turns):
            move = self.way_between(g, k, f, u0, begin, u1, end, now, scene, faces)
        else:
            drift = self.place_at(g, k, end, now, scene.path) - self.place_at(g, k, begin, now, scene.path)
            for a in ti.static(range(self.nodes)):
                for m in ti.static(range(3)):
                    move[a, m] -= drift[m]
        return move

    @ti.func
    def comes_near(self, f, now: A, scene: A, faces: A, state: A, plan: A):
        near, need = 0, ti.cast(0, self.fp)
        u0, u1 = self.rows_at(f, faces.begin, 0, faces), self.rows_at(f, state.u, plan.slot, faces)
        for g in ti.static(self.groups):
            for k in range(g.count):
                first = g.first + k * g.size
                move, place = (
                    self.way_of(g, k, f, u0, now.begin, u1, now.end, now, scene, faces),
                    self.place(g, k, now, scene.path),
                )
                X, width = self.made_rows(g, k, f, place, scene, faces), g.force.width(scene.parameters, first)
                travel, u = self.size_of_rows(f, move), self.turned_rows(g, place, -1, u0)
                if self.bound(g, k, f, X, u, travel, scene, faces) < width:
                    bent = ti.cast(0, self.fp)
                    for c in range(3):
                        bent = ti.max(bent, self.bent(g, first, f, X, u + ti.cast(0.5, self.fp) * c * move, scene))
                    if bent > ti.cast(0 if g.force.hollow else FLAT, self.fp) * width:
                        near, need = 1, ti.max(need, travel / width)
        if now.alpha <= 0:
            near = 0
        faces.near[f], faces.need[f] = near, need
        faces.energy[f], faces.done[f] = ti.cast(0, self.fp), ti.cast(0, self.fp)
        self.store(f, self.rows(0), faces)

    @ti.func
    def all_approaches(self, scene: A, faces: A, state: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            self.comes_near(f, pass_at(table, plan.first - plan.window), scene, faces, state, plan)

    @cached_property
    def approaches(self) -> Kernel:
        """Notes faces that come near an obstacle in the pass, and how many widths they move."""
        return self._kernel("approaches", self.all_approaches)

    # ---- forces ------------------------------------------------------------------------------------------------------

    @ti.func
    def force_of(self, f, u, length, now: A, scene: A, faces: A, plan: A):
        """Forces of a face's corners to `share`, its energy, and to `least` how near it is to each obstacle."""
        faces.energy[f] = ti.cast(0, self.fp)
        total = self.rows(0)
        for g in ti.static(self.groups):
            for k in range(g.count):
                place = self.where(g, k, now, scene, faces, plan)
                X, made = self.made_rows(g, k, f, place, scene, faces), self.turned_rows(g, place, -1, u)
                found, least = self.face("force", g, k, f, X, made, made, scene, faces, scene)
                rows = self.turned_rows(g, place, 1, found)
                total += rows
                if ti.static(g.force.turns):
                    for a in ti.static(range(self.nodes)):
                        x, i = self.row_of(u, a), faces.corners[self.nodes * f + a]
                        speed = self.v_obstacle(g, k, self.seen(g, scene.rest[i], place), x, now, scene)
                        faces.done[f] = faces.done[f] + length * self.dot3(self.row_of(rows, a), speed)
                elif ti.static(g.path >= 0):
                    speed = self.speed(g, k, now, scene.path)
                    for a in ti.static(range(self.nodes)):
                        faces.done[f] = faces.done[f] + length * self.dot3(self.row_of(rows, a), speed)
                if ti.static(g.force.friction):
                    for a in ti.static(range(self.nodes)):
                        at = self.pushed_row(f, g.number + k, a)
                        faces.impulse[at] = faces.impulse[at] + length * self.direct(self.row_of(rows, a))
                row = f * ti.static(self.num_obstacles) + g.number + k
                faces.least[row] = least
                for a in ti.static(range(self.nodes)):
                    for m in ti.static(range(3)):
                        faces.pushed[row] = faces.pushed[row] + ti.abs(rows[a, m])
        self.store(f, total, faces)

    @ti.func
    def clear_pushed(self, f, faces: A):
        for o in range(ti.static(self.num_obstacles)):
            faces.pushed[f * ti.static(self.num_obstacles) + o] = ti.cast(0, self.fp)
            if ti.static(self.rough):
                for a in range(ti.static(self.nodes)):
                    faces.impulse[self.pushed_row(f, o, a)] = self.vector(0)

    @ti.func
    def all_forces(self, scene: A, faces: A, state: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            now, u = pass_at(table, plan.first - plan.window), self.rows_at(f, state.u, plan.slot, faces)
            self.clear_pushed(f, faces)
            self.force_of(f, u, ti.cast(0, self.fp), now, scene, faces, plan)
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            faces.whole[s] = self.gathered(s, faces)

    @cached_property
    def forces(self) -> Kernel:
        """Contact forces of faces at u[slot], between passes."""
        return self._kernel("forces", self.all_forces)

    # ---- the parts of a pass -----------------------------------------------------------------------------------------

    @ti.func
    def put(self, s, k, scene: A, faces: A, state: A, now: A, plan: A):
        """Where part k takes its forces."""
        i, half = faces.vertices[s], ti.cast(0.5, self.fp)
        u0 = faces.begin[0, i]
        moved = self.share_of(k, plan) * (state.u[plan.slot, i] - u0)
        faces.place[k, s] = u0 + moved + faces.shift[s] + half * self.part_length(now, plan) * faces.speed[k, s]

    @ti.func
    def all_begins(self, scene: A, faces: A, state: A, table: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            faces.shift[s], faces.speed[0, s], faces.load[s] = self.vector(0), self.vector(0), ti.cast(0, self.fp)
            self.put(s, 0, scene, faces, state, pass_at(table, plan.first - plan.window), plan)
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            faces.done[f] = ti.cast(0, self.fp)
            self.clear_pushed(f, faces)

    @cached_property
    def begins(self) -> Kernel:
        return self._kernel("begins", self.all_begins)

    @ti.func
    def push(self, f, k, now: A, scene: A, faces: A, plan: A):
        if faces.near[f] > 0:
            then = self.when(now, self.share_of(k, plan))
            self.force_of(
                f, self.rows_of(f, faces.place, k, faces), self.part_length(now, plan), then, scene, faces, plan
            )

    @ti.func
    def go_on(self, s, k, now: A, scene: A, faces: A, state: A, plan: A):
        length, inverse, whole = (
            self.part_length(now, plan),
            scene.inverse_mass[faces.vertices[s]],
            self.gathered(s, faces),
        )
        before, load = faces.speed[k, s], length * length * whole[3] * inverse
        taken = ti.cast(1, self.fp) / ti.max(load, ti.cast(1, self.fp))
        after = before + taken * length * inverse * self.may(faces.vertices[s], self.direct(whole), scene)
        faces.taken[k, s] = taken
        faces.shift[s] = faces.shift[s] + ti.cast(0.5, self.fp) * length * (before + after)
        faces.speed[k + 1, s] = after
        faces.load[s] = ti.max(faces.load[s], load)
        if k + 1 < plan.n:
            self.put(s, k + 1, scene, faces, state, now, plan)

    @ti.func
    def all_parts(self, scene: A, faces: A, state: A, table: A, plan: A):
        if ti.static(self.parallel):
            for f in range(plan.num_faces):
                self.push(f, plan.k, pass_at(table, plan.first - plan.window), scene, faces, plan)
            for s in range(plan.num_surface):
                self.go_on(s, plan.k, pass_at(table, plan.first - plan.window), scene, faces, state, plan)
        else:
            ti.loop_config(serialize=True)
            for k in range(plan.n):
                now = pass_at(table, plan.first - plan.window)
                for f in range(plan.num_faces):
                    self.push(f, k, now, scene, faces, plan)
                for s in range(plan.num_surface):
                    self.go_on(s, k, now, scene, faces, state, plan)

    @cached_property
    def parts_of_pass(self) -> Kernel:
        """All parts, or on all threads part k alone."""
        return self._kernel("parts", self.all_parts)

    # ---- the end, and what happened ----------------------------------------------------------------------------------

    @ti.func
    def look_at(self, f, now: A, scene: A, faces: A, state: A, plan: A, watch: A):
        """Note how near a face came in each part, and d^2 D / m (state/watch.py)."""
        load, column, before = ti.cast(0, self.fp), plan.num_vertices + f, self.rows_at(f, faces.begin, 0, faces)
        for a in ti.static(range(self.nodes)):
            load = ti.max(load, faces.load[faces.own[self.nodes * f + a]])
        began, count = now.begin + ti.cast(0, self.fp), ti.static(self.num_obstacles)
        for k in range(plan.n + 1):
            end, u = now.end + ti.cast(0, self.fp), self.rows_at(f, state.u, plan.slot, faces)
            if k < plan.n:
                end, u = (
                    now.begin + self.share_of(k, plan) * (now.end - now.begin),
                    self.rows_of(f, faces.place, k, faces),
                )
            for g in ti.static(self.groups):
                for o in range(g.count):
                    n, place = g.number + o, self.place_at(g, o, end, now, scene.path)
                    move = self.way_of(g, o, f, before, began, u, end, now, scene, faces)
                    X, width = (
                        self.made_rows(g, o, f, place, scene, faces),
                        g.force.width(scene.parameters, g.first + o * g.size),
                    )
                    made = self.turned_rows(g, place, -1, u)
                    if self.bound(g, o, f, X, made, self.size_of_rows(f, move), scene, faces) < width:
                        least, reach = self.nearest(g, o, f, X, made, move, scene, faces), faces.reach[f * count + n]
                        if least < width + reach:
                            watch.seen[3 * n, column] = ti.min(watch.seen[3 * n, column], least)
                            watch.seen[3 * n + 1, column] = ti.max(watch.seen[3 * n + 1, column], load)
            before, began = u, end

    @ti.func
    def all_ends(self, scene: A, faces: A, state: A, table: A, watch: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            i, now = faces.vertices[s], pass_at(table, plan.first - plan.window)
            u, end = faces.begin[0, i], state.u[plan.slot, i]
            state.u[plan.slot, i] = end + self.taken(i, u, end - u, faces.shift[s], now, scene)
            state.v[plan.slot, i] = state.v[plan.slot, i] + faces.speed[plan.n, s]
        ti.loop_config(serialize=not self.parallel)
        for f in range(plan.num_faces):
            faces.work[f] = faces.work[f] + faces.done[f]
            if faces.near[f] > 0:
                self.look_at(f, pass_at(table, plan.first - plan.window), scene, faces, state, plan, watch)

    @cached_property
    def ends(self) -> Kernel:
        """Add to the state what the parts did, and note how near faces came."""
        return self._kernel("ends", self.all_ends, watch=dict(seen="scalars2"))


@lru_cache(maxsize=None)
def face_kernels(features: Features, precision: str, parallel: bool) -> FaceKernels:
    """Kernels for a scene's features."""
    return FaceKernels(features, precision, parallel)
