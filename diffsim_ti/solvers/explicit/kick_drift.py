"""Kernels of the explicit solvers. Every one of them is a chain of the same pass, a kick and a drift:

    a      = f(u) / m + g                       forces at displacement u
    v_mid  = v + pre a                          the velocity at this time (what frames show)
    v+     = v_mid + post a
    vs     = friction of the obstacles on v+    implicit, in closed form (friction.py), over the time h
    u'     = u + alpha vs
    v'     = decay vs                           damping, a stage of its own after the forces

Symplectic Euler: pre = 0, post = h, alpha = h decay. Velocity Verlet: pre = post = h / 2 (the two half kicks that meet at a
time share one force evaluation), alpha = h (1 + decay) / 2. Friction acts where there is a drift, so that
it acts for the whole time of a run. Below each pass stand its tangent and its mirror.

A run's slot j holds the state before pass j. With stride 0 everything happens in slot 0 (forward only); with stride 1
each pass writes the next slot, which is what the mirror reads.
"""

from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.elements.patched_tetrahedron import functions_of
from diffsim_ti.elements.tetrahedron import A
from diffsim_ti.rows import Rows
from diffsim_ti.runtime import Bundle
from diffsim_ti.solvers.explicit.contact_stages import contact_functions


@dataclass(frozen=True)
class Features:
    """What the scene contains, known when kernels compile: an absent feature leaves no code."""

    contacts: tuple = ()  # compile-time twins of the terms that act on surface vertices
    gravity: int = -1  # where it starts in the parameter array, -1: none
    drag: int = -1
    forces: bool = False
    forces_per_step: bool = False
    motion: bool = False
    moving: int = 0  # obstacles that follow a path
    num_parameters: int = 0  # numbers of all terms
    uniform: bool = True  # one set of coefficients for all tetrahedra
    density: bool = False  # the last two: adjoints that cost extra, only if asked for
    shape: bool = False

    def sums(self) -> Rows:
        """Rows of the per-vertex adjoint sums: those of the parameters stand as the parameters do."""
        return Rows({"parameters": self.num_parameters, "mass": int(self.density), "rest": 3 * self.shape})


@lru_cache(maxsize=None)
def kick_drift_kernels(law, features: Features, parallel: bool, lanes: bool) -> SimpleNamespace:
    """Compiled passes for a law and a scene's features; `parallel`: one launch per pass, else one for many passes."""
    el = functions_of(law, features.uniform, lanes)
    t = el.types
    fp, vector = t.fp, t.vector
    contacts, has_contacts = features.contacts, len(features.contacts) > 0
    touching = contact_functions(features, fp)
    rough, place_of, gravity = touching.rough, touching.place_of, touching.gravity
    sums = features.sums()
    mass_row, rest_row = sums.first("mass"), sums.first("rest")

    @ti.func
    def half():
        return ti.cast(0.5, fp)  # dividing by 2 would compute in f64

    @ti.func
    def force_at(i, j, scene: A, forces: A, plan: A):
        """External force on vertex i in pass j: of the present step, or half of each of the two that share a kick."""
        f = vector(0)
        k = scene.force_slot[i]
        if k >= 0:
            f = forces[0, k]
            if ti.static(features.forces_per_step):
                f = half() * (forces[(j - plan.lag0) // plan.substeps, k] + forces[(j - plan.lag1) // plan.substeps, k])
        return f

    @ti.func
    def moved(i, scene: A):
        """Place of vertex i among those whose motion is prescribed, or -1."""
        k = -1
        if ti.static(features.motion):
            k = scene.motion_slot[i]
        return k

    @ti.func
    def fraction(j, plan: A):
        """Share of the step that has gone at the end of pass j."""
        return ti.cast(j % plan.substeps + 1, fp) / ti.cast(plan.substeps, fp)

    @ti.func
    def is_saved(j, plan: A):
        saved = False
        if plan.save_every > 0:
            saved = j % plan.save_every == 0
        return saved

    # ---- one pass ---------------------------------------------------------------------------------------------------

    @ti.func
    def vertex(i, j, scene: A, state: A, plan: A):
        s, t = (j - plan.base) * plan.stride, (j - plan.base + 1) * plan.stride
        u, v = state.u[s, i], state.v[s, i]
        # forces
        f = el.gather(i, scene, scene.corner)
        if ti.static(has_contacts):
            if scene.surface[i] > 0:
                for k in ti.static(range(len(contacts))):
                    f += contacts[k].force(scene.parameters, scene.rest[i] - place_of(k, j, scene.path, plan), u, v)
        if ti.static(features.forces):
            f += force_at(i, j, scene, scene.forces, plan)
        a = scene.inverse_mass[i] * f
        if ti.static(features.gravity >= 0):
            if scene.inverse_mass[i] > 0:
                a += gravity(scene.parameters)
        # kick, frame, kick
        v_mid = v + plan.pre * a
        if is_saved(j, plan):
            state.frames_u[j // plan.save_every, i] = u
            state.frames_v[j // plan.save_every, i] = v_mid
        v_plus = v_mid + plan.post * a
        if ti.static(len(rough) > 0):
            if plan.alpha > 0 and scene.surface[i] > 0:
                v_plus = touching.slow(i, j, u, v_plus, scene, plan)
        # drift and damping
        u_next, v_next = u + plan.alpha * v_plus, plan.decay * v_plus
        # prescribed motion
        if ti.static(features.motion):
            k = moved(i, scene)
            if k >= 0:
                u_next, v_next = u, v
                if plan.alpha > 0:
                    r = j // plan.substeps
                    change = scene.motion[r + 1, k] - scene.motion[r, k]
                    u_next = scene.anchor[k] + scene.motion[r, k] + fraction(j, plan) * change
                    v_next = plan.inverse_dt * change
        if ti.static(has_contacts):
            if scene.surface[i] > 0:
                touching.look(i, j, u, u_next, scene, state, plan)
        if plan.stride > 0:
            state.f[s, i] = f
        state.u[t, i] = u_next
        state.v[t, i] = v_next

    @ti.kernel
    def step(
        tets: t.ints,
        gradients: t.blocks,
        volumes: t.blocks,
        coefficients: t.blocks,
        start: t.ints,
        corner_of: t.ints,
        inverse_mass: t.scalars,
        parameters: t.scalars,
        rest: t.vectors,
        surface: t.ints,
        force_slot: t.ints,
        motion_slot: t.ints,
        forces: t.vectors2,
        motion: t.vectors2,
        anchor: t.vectors,
        path: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        v: t.vectors2,
        f: t.vectors2,
        frames_u: t.vectors2,
        frames_v: t.vectors2,
        watch: t.scalars2,
        num_items: ti.i32,
        num_vertices: ti.i32,
        first: ti.i32,
        count: ti.i32,
        base: ti.i32,
        stride: ti.i32,
        substeps: ti.i32,
        save_every: ti.i32,
        lag0: ti.i32,
        lag1: ti.i32,
        pre: fp,
        post: fp,
        alpha: fp,
        decay: fp,
        inverse_dt: fp,
        h: fp,
    ):
        """`count` passes. Slot 0 holds the state before pass `base`; with stride 1 forces are recorded too."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            inverse_mass=inverse_mass,
            parameters=parameters,
            rest=rest,
            surface=surface,
            force_slot=force_slot,
            motion_slot=motion_slot,
            forces=forces,
            motion=motion,
            anchor=anchor,
            path=path,
            corner=corner,
        )
        state = Bundle(u=u, v=v, f=f, frames_u=frames_u, frames_v=frames_v, watch=watch)
        plan = Bundle(
            base=base,
            stride=stride,
            substeps=substeps,
            save_every=save_every,
            lag0=lag0,
            lag1=lag1,
            pre=pre,
            post=post,
            alpha=alpha,
            decay=decay,
            inverse_dt=inverse_dt,
            h=h,
        )
        if ti.static(parallel):
            for e in range(num_items):
                el.forces(e, scene, u, (first - base) * stride, corner)
            for i in range(num_vertices):
                vertex(i, first, scene, state, plan)
        else:
            ti.loop_config(serialize=True)
            for j in range(first, first + count):
                for e in range(num_items):
                    el.forces(e, scene, u, (j - base) * stride, corner)
                for i in range(num_vertices):
                    vertex(i, j, scene, state, plan)

    # ---- its tangent ------------------------------------------------------------------------------------------------

    @ti.func
    def vertex_jvp(i, j, scene: A, state: A, dots: A, plan: A):
        s, t = j - plan.base, j - plan.base + 1
        u, v, du, dv = state.u[s, i], state.v[s, i], dots.u[0, i], dots.v[0, i]
        df = el.gather(i, scene, scene.corner)
        if ti.static(has_contacts):
            if scene.surface[i] > 0:
                for k in ti.static(range(len(contacts))):
                    X = scene.rest[i] - place_of(k, j, scene.path, plan)
                    dX = dots.rest[i] - place_of(k, j, dots.path, plan)
                    df += contacts[k].force_jvp(scene.parameters, X, u, v, du + dX, dv)
                    by = contacts[k].parameter_derivatives(scene.parameters, X, u, v)
                    for m in ti.static(range(contacts[k].size)):
                        df += by[m] * dots.parameters[contacts[k].first + m]
        if ti.static(features.forces):
            df += force_at(i, j, scene, dots.forces, plan)
        inverse = scene.inverse_mass[i]
        da = inverse * (df - inverse * dots.mass[i] * state.f[s, i])
        if ti.static(features.gravity >= 0):
            if inverse > 0:
                da += gravity(dots.parameters)
        dv_mid = dv + plan.pre * da
        if is_saved(j, plan):
            dots.frames_u[j // plan.save_every, i] = du
            dots.frames_v[j // plan.save_every, i] = dv_mid
        dv_plus, v_plus = dv_mid + plan.post * da, state.v[t, i] / plan.decay
        if ti.static(len(rough) > 0):
            if plan.alpha > 0 and scene.surface[i] > 0:
                dv_plus = touching.slow_jvp(i, j, u, v, du, dv_plus, scene, state, dots, plan)
        du_next = du + plan.alpha * dv_plus + dots.alpha * v_plus
        dv_next = plan.decay * dv_plus + dots.decay * v_plus
        if ti.static(features.motion):
            k = moved(i, scene)
            if k >= 0:
                du_next, dv_next = du, dv
                if plan.alpha > 0:
                    r = j // plan.substeps
                    change = dots.motion[r + 1, k] - dots.motion[r, k]
                    du_next = dots.anchor[k] + dots.motion[r, k] + fraction(j, plan) * change
                    dv_next = plan.inverse_dt * change
        dots.u[0, i] = du_next
        dots.v[0, i] = dv_next

    @ti.kernel
    def step_jvp(
        tets: t.ints,
        gradients: t.blocks,
        volumes: t.blocks,
        coefficients: t.blocks,
        start: t.ints,
        corner_of: t.ints,
        inverse_mass: t.scalars,
        parameters: t.scalars,
        rest: t.vectors,
        surface: t.ints,
        force_slot: t.ints,
        motion_slot: t.ints,
        path: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        v: t.vectors2,
        f: t.vectors2,
        du: t.vectors2,
        dv: t.vectors2,
        coefficients_dot: t.blocks,
        mass_dot: t.scalars,
        parameters_dot: t.scalars,
        rest_dot: t.vectors,
        forces_dot: t.vectors2,
        motion_dot: t.vectors2,
        anchor_dot: t.vectors,
        path_dot: t.vectors2,
        gradients_dot: t.blocks,
        volumes_dot: t.blocks,
        frames_du: t.vectors2,
        frames_dv: t.vectors2,
        num_items: ti.i32,
        num_vertices: ti.i32,
        j: ti.i32,
        base: ti.i32,
        substeps: ti.i32,
        save_every: ti.i32,
        lag0: ti.i32,
        lag1: ti.i32,
        pre: fp,
        post: fp,
        alpha: fp,
        decay: fp,
        inverse_dt: fp,
        h: fp,
        alpha_dot: fp,
        decay_dot: fp,
    ):
        """The tangent of pass j along recorded slots; du, dv are advanced in place."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            inverse_mass=inverse_mass,
            parameters=parameters,
            rest=rest,
            surface=surface,
            force_slot=force_slot,
            motion_slot=motion_slot,
            path=path,
            corner=corner,
        )
        state = Bundle(u=u, v=v, f=f)
        dots = Bundle(
            u=du,
            v=dv,
            coefficients=coefficients_dot,
            mass=mass_dot,
            parameters=parameters_dot,
            rest=rest_dot,
            forces=forces_dot,
            motion=motion_dot,
            anchor=anchor_dot,
            path=path_dot,
            gradients=gradients_dot,
            volumes=volumes_dot,
            frames_u=frames_du,
            frames_v=frames_dv,
            alpha=alpha_dot,
            decay=decay_dot,
        )
        plan = Bundle(
            base=base,
            substeps=substeps,
            save_every=save_every,
            lag0=lag0,
            lag1=lag1,
            pre=pre,
            post=post,
            alpha=alpha,
            decay=decay,
            inverse_dt=inverse_dt,
            h=h,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.forces_jvp(e, scene, u, j - base, du, corner, dots)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            vertex_jvp(i, j, scene, state, dots, plan)

    # ---- its mirror -------------------------------------------------------------------------------------------------

    @ti.func
    def vertex_vjp(i, j, scene: A, state: A, adjoint: A, plan: A):
        """Complete the adjoint of the displacement after pass j, then hand back through the vertex part of pass j."""
        s, t = j - plan.base, j - plan.base + 1
        u, v = state.u[s, i], state.v[s, i]
        p, q = adjoint.u[0, i], adjoint.v[0, i]
        if j < plan.end - 1:
            p += el.gather(i, scene, adjoint.corner)
        # prescribed motion: the state after the pass comes from the motion alone
        k = moved(i, scene)
        if ti.static(features.motion):
            if k >= 0 and plan.alpha > 0:
                r = j // plan.substeps
                adjoint.motion[r, k] = adjoint.motion[r, k] + (1 - fraction(j, plan)) * p - plan.inverse_dt * q
                adjoint.motion[r + 1, k] = adjoint.motion[r + 1, k] + fraction(j, plan) * p + plan.inverse_dt * q
                adjoint.anchor[k] = adjoint.anchor[k] + p
                p, q = vector(0), vector(0)
        # drift and damping
        v_plus_adj = plan.alpha * p + plan.decay * q
        if k >= 0:
            v_plus_adj = q
        if ti.static(features.drag >= 0):
            v_plus = state.v[t, i] / plan.decay
            by_rate = plan.alpha_by_rate * p.dot(v_plus) + plan.decay_by_rate * q.dot(v_plus)
            adjoint.sums[features.drag, i] = adjoint.sums[features.drag, i] + by_rate
        if ti.static(len(rough) > 0):
            if plan.alpha > 0 and scene.surface[i] > 0:
                by_u, v_plus_adj = touching.slow_vjp(i, j, u, v, v_plus_adj, scene, state, adjoint, plan)
                p += by_u
        # kick, frame, kick
        v_mid_adj = v_plus_adj
        if is_saved(j, plan):
            p += adjoint.frames_u[j // plan.save_every, i]
            v_mid_adj += adjoint.frames_v[j // plan.save_every, i]
        a_adj = plan.post * v_plus_adj + plan.pre * v_mid_adj
        # forces
        inverse = scene.inverse_mass[i]
        f_adj, q = inverse * a_adj, v_mid_adj
        if ti.static(features.density):
            adjoint.sums[mass_row, i] = adjoint.sums[mass_row, i] - (inverse * f_adj.dot(state.f[s, i]))
        if ti.static(features.gravity >= 0):
            if inverse > 0:
                for d in ti.static(range(3)):
                    adjoint.sums[features.gravity + d, i] = adjoint.sums[features.gravity + d, i] + (a_adj[d])
        if ti.static(features.forces):
            slot = scene.force_slot[i]
            if slot >= 0:
                if ti.static(features.forces_per_step):
                    r0, r1 = (j - plan.lag0) // plan.substeps, (j - plan.lag1) // plan.substeps
                    adjoint.forces[r0, slot] = adjoint.forces[r0, slot] + half() * f_adj
                    adjoint.forces[r1, slot] = adjoint.forces[r1, slot] + half() * f_adj
                else:
                    adjoint.forces[0, slot] = adjoint.forces[0, slot] + f_adj
        if ti.static(has_contacts):
            if scene.surface[i] > 0:
                for c in ti.static(range(len(contacts))):
                    X = scene.rest[i] - place_of(c, j, scene.path, plan)
                    by_u, by_v = contacts[c].force_vjp(scene.parameters, X, u, v, f_adj)
                    p += by_u
                    q += by_v
                    touching.hand_to_path(c, i, j, by_u, vector(0), adjoint, plan)
                    by = contacts[c].parameter_derivatives(scene.parameters, X, u, v)
                    for m in ti.static(range(contacts[c].size)):
                        at = ti.static(contacts[c].first + m)
                        adjoint.sums[at, i] = adjoint.sums[at, i] + (by[m].dot(f_adj))
                    if ti.static(features.shape):
                        for d in ti.static(range(3)):
                            adjoint.sums[rest_row + d, i] = adjoint.sums[rest_row + d, i] + (by_u[d])
        adjoint.u[0, i] = p
        adjoint.v[0, i] = q
        adjoint.w[0, i] = f_adj

    @ti.func
    def tetrahedron_vjp(e, j, scene: A, state: A, adjoint: A, plan: A):
        el.forces_vjp(e, scene, state.u, j - plan.base, adjoint.w, adjoint.corner, adjoint)
        if ti.static(features.shape):
            el.shape_vjp(e, scene, state.u, j - plan.base, adjoint.w, adjoint)

    @ti.kernel
    def step_vjp(
        tets: t.ints,
        gradients: t.blocks,
        volumes: t.blocks,
        coefficients: t.blocks,
        start: t.ints,
        corner_of: t.ints,
        inverse_mass: t.scalars,
        parameters: t.scalars,
        rest: t.vectors,
        surface: t.ints,
        force_slot: t.ints,
        motion_slot: t.ints,
        path: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        v: t.vectors2,
        f: t.vectors2,
        u_adj: t.vectors2,
        v_adj: t.vectors2,
        w: t.vectors2,
        coefficients_adj: t.blocks,
        sums: t.scalars2,
        forces_adj: t.vectors2,
        motion_adj: t.vectors2,
        anchor_adj: t.vectors,
        path_adj: t.vectors2,
        felt: t.vectors2,
        gradients_adj: t.blocks,
        volumes_adj: t.blocks,
        frames_u_adj: t.vectors2,
        frames_v_adj: t.vectors2,
        num_items: ti.i32,
        num_vertices: ti.i32,
        first: ti.i32,
        count: ti.i32,
        base: ti.i32,
        end: ti.i32,
        substeps: ti.i32,
        save_every: ti.i32,
        lag0: ti.i32,
        lag1: ti.i32,
        pre: fp,
        post: fp,
        alpha: fp,
        decay: fp,
        inverse_dt: fp,
        h: fp,
        alpha_by_rate: fp,
        decay_by_rate: fp,
    ):
        """The mirror of passes first + count - 1 .. first; `end` is the run's number of passes.

        The gather of K w is left to the next call (or to `finish_vjp`), so that each pass has two loops, as `step` has.
        """
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            inverse_mass=inverse_mass,
            parameters=parameters,
            rest=rest,
            surface=surface,
            force_slot=force_slot,
            motion_slot=motion_slot,
            path=path,
        )
        state = Bundle(u=u, v=v, f=f)
        adjoint = Bundle(
            u=u_adj,
            v=v_adj,
            w=w,
            corner=corner,
            coefficients=coefficients_adj,
            sums=sums,
            forces=forces_adj,
            motion=motion_adj,
            anchor=anchor_adj,
            path=path_adj,
            felt=felt,
            gradients=gradients_adj,
            volumes=volumes_adj,
            frames_u=frames_u_adj,
            frames_v=frames_v_adj,
        )
        plan = Bundle(
            base=base,
            end=end,
            substeps=substeps,
            save_every=save_every,
            lag0=lag0,
            lag1=lag1,
            pre=pre,
            post=post,
            alpha=alpha,
            decay=decay,
            inverse_dt=inverse_dt,
            h=h,
            alpha_by_rate=alpha_by_rate,
            decay_by_rate=decay_by_rate,
        )
        if ti.static(parallel):
            for i in range(num_vertices):
                vertex_vjp(i, first, scene, state, adjoint, plan)
            for e in range(num_items):
                tetrahedron_vjp(e, first, scene, state, adjoint, plan)
            for c in range(features.moving):
                touching.fold_path(c, first, num_vertices, adjoint, plan)
        else:
            ti.loop_config(serialize=True)
            for k in range(count):
                for i in range(num_vertices):
                    vertex_vjp(i, first + count - 1 - k, scene, state, adjoint, plan)
                for e in range(num_items):
                    tetrahedron_vjp(e, first + count - 1 - k, scene, state, adjoint, plan)
                for c in range(features.moving):
                    touching.fold_path(c, first + count - 1 - k, num_vertices, adjoint, plan)

    @ti.kernel
    def finish_vjp(start: t.ints, corner_of: t.ints, corner: t.vectors, u_adj: t.vectors2, num_vertices: ti.i32):
        """Add the gather that the first pass of the run has left."""
        scene = Bundle(start=start, corner_of=corner_of)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            u_adj[0, i] = u_adj[0, i] + el.gather(i, scene, corner)

    return SimpleNamespace(step=step, step_jvp=step_jvp, step_vjp=step_vjp, finish_vjp=finish_vjp)
