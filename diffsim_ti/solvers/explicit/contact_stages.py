"""Stages of a pass that contacts add: where moving obstacles are, friction with its tangent and mirror, what is noted.

Obstacles follow paths: rows of displacements at the steps, linear within each. Functions of a shape take positions relative
to the obstacle, so that a displaced obstacle is a vertex whose rest position X is displaced the other way.
"""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.elements.tetrahedron import A


@lru_cache(maxsize=None)
def contact_functions(features, fp) -> SimpleNamespace:
    """Taichi functions of one vertex for a scene's features."""
    vector, contacts, sums = ti.types.vector(4, fp), features.contacts, features.sums()
    mass_row, rest_row = sums.first("mass"), sums.first("rest")
    rough = tuple(k for k, contact in enumerate(contacts) if contact.friction)
    num_rough = max(len(rough), 1)

    @ti.func
    def gravity(parameters: A):
        g = ti.static(features.gravity)
        return vector(parameters[g], parameters[g + 1], parameters[g + 2], ti.cast(0, fp))

    @ti.func
    def row_of(j, path: A, plan: A):
        """The step that pass j begins in; the last row of a path has no step."""
        return ti.min(j // plan.substeps, path.shape[0] - 1)

    @ti.func
    def place_of(k: A, j, path: A, plan: A):
        """Displacement of obstacle k when pass j begins."""
        place = vector(0)
        if ti.static(contacts[k].path >= 0):
            c, r = ti.static(contacts[k].path), row_of(j, path, plan)
            change = path[ti.min(r + 1, path.shape[0] - 1), c] - path[r, c]
            place = path[r, c] + ti.cast(j % plan.substeps, fp) / ti.cast(plan.substeps, fp) * change
        return place

    @ti.func
    def speed_of(k: A, j, path: A, plan: A):
        """Velocity of obstacle k in pass j."""
        speed = vector(0)
        if ti.static(contacts[k].path >= 0):
            c, r = ti.static(contacts[k].path), row_of(j, path, plan)
            speed = plan.inverse_dt * (path[ti.min(r + 1, path.shape[0] - 1), c] - path[r, c])
        return speed

    @ti.func
    def look_at(k: A, i, j, u, u_next, scene: A, state: A, plan: A):
        """Note how near vertex i comes to obstacle k in pass j, and how well the pass resolves it (state/watch.py)."""
        place = place_of(k, j, scene.path, plan)
        X, move = scene.rest[i] - place, u_next - u - (place_of(k, j + 1, scene.path, plan) - place)
        d, width = contacts[k].gap(scene.parameters, X, u), contacts[k].width(scene.parameters)
        if d < width or move.dot(move) >= d * d:
            approach = contacts[k].approach(scene.parameters, X, u, move)
            reached = ti.min(d, d + approach)
            if reached < width:
                omega2 = scene.inverse_mass[i] * contacts[k].rigidity(scene.parameters, X, u)
                state.watch[3 * k, i] = ti.min(state.watch[3 * k, i], reached)
                state.watch[3 * k + 1, i] = ti.max(state.watch[3 * k + 1, i], plan.h * plan.h * omega2)
                state.watch[3 * k + 2, i] = ti.max(state.watch[3 * k + 2, i], ti.abs(approach) / width)

    @ti.func
    def look(i, j, u, u_next, scene: A, state: A, plan: A):
        """`look_at` of all obstacles."""
        for k in ti.static(range(len(contacts))):
            if ti.static(contacts[k].watched):
                look_at(k, i, j, u, u_next, scene, state, plan)

    # ---- adjoints of paths ------------------------------------------------------------------------------------------

    @ti.func
    def hand_to_path(k: A, i, j, by_X, by_wall, adjoint: A, plan: A):
        """Adjoints of the rows of the path that vertex i felt; `fold_path` sums them over the vertices."""
        if ti.static(contacts[k].path >= 0):
            c, share = ti.static(2 * contacts[k].path), ti.cast(j % plan.substeps, fp) / ti.cast(plan.substeps, fp)
            to_now, to_next = (1 - share) * by_X + plan.inverse_dt * by_wall, share * by_X - plan.inverse_dt * by_wall
            adjoint.felt[c, i] = adjoint.felt[c, i] - to_now
            adjoint.felt[c + 1, i] = adjoint.felt[c + 1, i] - to_next

    @ti.func
    def fold_path(c, j, num_vertices, adjoint: A, plan: A):
        """At the first pass of a step, the last to be mirrored: sum what all vertices felt in it, in a fixed order."""
        if j % plan.substeps == 0:
            now, following = vector(0), vector(0)
            for i in range(num_vertices):
                now += adjoint.felt[2 * c, i]
                following += adjoint.felt[2 * c + 1, i]
                adjoint.felt[2 * c, i] = vector(0)
                adjoint.felt[2 * c + 1, i] = vector(0)
            r = row_of(j, adjoint.path, plan)
            after = ti.min(r + 1, adjoint.path.shape[0] - 1)
            adjoint.path[r, c] = adjoint.path[r, c] + now
            adjoint.path[after, c] = adjoint.path[after, c] + following

    # ---- friction, its tangent and its mirror -----------------------------------------------------------------------

    @ti.func
    def slow(i, j, u, v_plus, scene: A, plan: A):
        """Velocity of vertex i after the friction of all obstacles, one after the other."""
        for k in ti.static(rough):
            X = scene.rest[i] - place_of(k, j, scene.path, plan)
            if contacts[k].touches(scene.parameters, X, u):
                wall, h_over_m = speed_of(k, j, scene.path, plan), plan.h * scene.inverse_mass[i]
                v_plus = contacts[k].slide(scene.parameters, X, u, v_plus, wall, h_over_m)
        return v_plus

    @ti.func
    def kicked(i, u, v, s, scene: A, state: A, plan: A):
        """v+ again, before friction."""
        a = scene.inverse_mass[i] * state.f[s, i]
        if ti.static(features.gravity >= 0):
            if scene.inverse_mass[i] > 0:
                a += gravity(scene.parameters)
        return v + plan.pre * a + plan.post * a

    @ti.func
    def slow_jvp(i, j, u, v, du, dv_plus, scene: A, state: A, dots: A, plan: A):
        """Its change."""
        inverse, before = scene.inverse_mass[i], kicked(i, u, v, j - plan.base, scene, state, plan)
        h_over_m = plan.h * inverse
        for k in ti.static(rough):
            X = scene.rest[i] - place_of(k, j, scene.path, plan)
            if contacts[k].touches(scene.parameters, X, u):
                moved = du + dots.rest[i] - place_of(k, j, dots.path, plan)
                wall, dwall = speed_of(k, j, scene.path, plan), speed_of(k, j, dots.path, plan)
                dv_plus = contacts[k].slide_jvp(
                    scene.parameters,
                    X,
                    u,
                    before,
                    wall,
                    h_over_m,
                    dots.parameters,
                    moved,
                    dv_plus,
                    dwall,
                    -h_over_m * inverse * dots.mass[i],
                )
                before = contacts[k].slide(scene.parameters, X, u, before, wall, h_over_m)
        return dv_plus

    @ti.func
    def slow_vjp(i, j, u, v, w, scene: A, state: A, adjoint: A, plan: A):
        """Adjoints of u and of v+ before friction, for the adjoint w of v+ after it; adds those of all else."""
        inverse, by_u_sum = scene.inverse_mass[i], vector(0)
        h_over_m = plan.h * inverse
        before = ti.Matrix.zero(fp, num_rough, 4)  # velocity before each obstacle's friction
        now = kicked(i, u, v, j - plan.base, scene, state, plan)
        for m in ti.static(range(len(rough))):
            for d in ti.static(range(4)):
                before[m, d] = now[d]
            X = scene.rest[i] - place_of(rough[m], j, scene.path, plan)
            if contacts[rough[m]].touches(scene.parameters, X, u):
                wall = speed_of(rough[m], j, scene.path, plan)
                now = contacts[rough[m]].slide(scene.parameters, X, u, now, wall, h_over_m)
        for back in ti.static(range(len(rough))):
            m = ti.static(len(rough) - 1 - back)
            k = ti.static(rough[m])
            X = scene.rest[i] - place_of(k, j, scene.path, plan)
            if contacts[k].touches(scene.parameters, X, u):
                start, wall = vector(0), speed_of(k, j, scene.path, plan)
                for d in ti.static(range(4)):
                    start[d] = before[m, d]
                by_u, by_v, by_wall, by_ratio, by = contacts[k].slide_vjp(
                    scene.parameters, X, u, start, wall, h_over_m, w
                )
                w = by_v
                by_u_sum += by_u
                for q in ti.static(range(contacts[k].size)):
                    at = ti.static(contacts[k].first + q)
                    adjoint.sums[at, i] = adjoint.sums[at, i] + by[q]
                if ti.static(features.density):
                    adjoint.sums[mass_row, i] = adjoint.sums[mass_row, i] - h_over_m * inverse * by_ratio
                if ti.static(features.shape):
                    for d in ti.static(range(3)):
                        adjoint.sums[rest_row + d, i] = adjoint.sums[rest_row + d, i] + by_u[d]
                hand_to_path(k, i, j, by_u, by_wall, adjoint, plan)
        return by_u_sum, w

    return SimpleNamespace(
        rough=rough,
        gravity=gravity,
        place_of=place_of,
        look=look,
        slow=slow,
        slow_jvp=slow_jvp,
        slow_vjp=slow_vjp,
        hand_to_path=hand_to_path,
        fold_path=fold_path,
    )
