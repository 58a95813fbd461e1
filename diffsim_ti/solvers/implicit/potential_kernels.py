"""Kernels of the potential energy of a displacement: elasticity of all tetrahedra and contact of surface vertices.

Contact is looked at where obstacles are in the pass: `walls` holds three vectors for each, its displacement where the pass
takes its forces, its displacement where the pass begins, and its velocity. `lag` holds two rows, the displacement of the
body where the pass begins, from which friction takes its normal force, and x, so that (u - x) per_gamma is the velocity.
"""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.elements.patched_tetrahedron import functions_of
from diffsim_ti.elements.tetrahedron import A
from diffsim_ti.materials.calculus.tensor import Tensor, sum_of
from diffsim_ti.runtime import Bundle, let, traced


@lru_cache(maxsize=None)
def potential_kernels(law, features, parallel: bool, lanes: bool) -> SimpleNamespace:
    """Kernels for a law and a scene's features: energy, forces, products of their derivatives, block diagonal."""
    el, single = functions_of(law, features.uniform, lanes), functions_of(law, features.uniform, False)
    t, contacts = el.types, features.contacts
    fp, vector = t.fp, t.vector

    @ti.kernel
    def energy(
        tets: t.ints,
        gradients: t.blocks,
        volumes: t.blocks,
        coefficients: t.blocks,
        parameters: t.scalars,
        rest: t.vectors,
        surface: t.ints,
        walls: t.vectors,
        lag: t.vectors2,
        u: t.vectors2,
        elastic: t.scalars,
        J: t.scalars,
        contact: t.scalars,
        num_tetrahedra: ti.i32,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """Energy [J] and volume ratio of each tetrahedron, energy of contact and friction [J] of each vertex."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            parameters=parameters,
            rest=rest,
            walls=walls,
            lag=lag,
            per_gamma=per_gamma,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_tetrahedra):
            H = single.edges(e, scene, u, 0).dot(single.gradients_of(e, gradients))
            psi = law.energy_density(H, single.coefficients_at(e, scene, u, 0))
            elastic[e] = psi * single.volume_of(e, volumes)
            J[e] = volume_ratio(H)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            value = ti.cast(0, fp)
            if ti.static(len(contacts) > 0):
                if surface[i] > 0:
                    for k in ti.static(range(len(contacts))):
                        value += contacts[k].energy(parameters, rest[i] - walls[3 * k], u[0, i])
                        if ti.static(contacts[k].friction):
                            if rubs(k, i, scene):
                                v = velocity(i, scene, u[0, i])
                                lost = contacts[k].dissipation(
                                    parameters, X_of(k, i, scene), lag[0, i], v, walls[3 * k + 2]
                                )
                                value += lost / per_gamma
            contact[i] = value

    @ti.func
    def length(v):
        return ti.sqrt(v.norm_sqr())  # `norm` adds a float64 zero

    @ti.func
    def volume_ratio(H):
        return (H.matrix() + ti.Matrix.identity(fp, 3)).determinant()

    # ---- contact of a vertex ----------------------------------------------------------------------------------------

    @ti.func
    def velocity(i, scene: A, u):
        return scene.per_gamma * (u - scene.lag[1, i])

    @ti.func
    def X_of(k: A, i, scene: A):
        """Rest position relative to obstacle k where the pass begins."""
        return scene.rest[i] - scene.walls[3 * k + 1]

    @ti.func
    def rubs(k: A, i, scene: A):
        """Whether friction of obstacle k is felt."""
        return contacts[k].touches(scene.parameters, X_of(k, i, scene), scene.lag[0, i])

    @ti.func
    def contact_force(i, scene: A, u):
        f = vector(0)
        if ti.static(len(contacts) > 0):
            if scene.surface[i] > 0:
                for k in ti.static(range(len(contacts))):
                    f += contacts[k].force(scene.parameters, scene.rest[i] - scene.walls[3 * k], u, vector(0))
                    if ti.static(contacts[k].friction):
                        if rubs(k, i, scene):
                            v, wall = velocity(i, scene, u), scene.walls[3 * k + 2]
                            f += contacts[k].rub(scene.parameters, X_of(k, i, scene), scene.lag[0, i], v, wall)
        return f

    @ti.func
    def contact_product(i, scene: A, u, w):
        """Change of the contact force for a change w of the displacement."""
        f = vector(0)
        if ti.static(len(contacts) > 0):
            if scene.surface[i] > 0:
                for k in ti.static(range(len(contacts))):
                    X = scene.rest[i] - scene.walls[3 * k]
                    f += contacts[k].force_jvp(scene.parameters, X, u, vector(0), w, vector(0))
                    if ti.static(contacts[k].friction):
                        if rubs(k, i, scene):
                            v, wall = velocity(i, scene, u), scene.walls[3 * k + 2]
                            f += contacts[k].rub_product(
                                scene.parameters, X_of(k, i, scene), scene.lag[0, i], v, wall, scene.per_gamma * w
                            )
        return f

    @ti.kernel
    def forces(
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
        walls: t.vectors,
        lag: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        f: t.vectors2,
        size: t.scalars,
        num_items: ti.i32,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """Forces, and the sum of the sizes of what meets at a vertex, against which a rest is measured."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            parameters=parameters,
            rest=rest,
            surface=surface,
            walls=walls,
            lag=lag,
            per_gamma=per_gamma,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.forces(e, scene, u, 0, corner)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            pushed, total = contact_force(i, scene, u[0, i]), vector(0)
            norm = length(pushed)
            for c in range(start[i], start[i + 1]):
                part = corner[corner_of[c]]
                total += part
                norm += length(part)
            f[0, i] = total + pushed
            size[i] = norm

    @ti.kernel
    def product(
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
        walls: t.vectors,
        lag: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        w: t.vectors2,
        y: t.vectors2,
        num_items: ti.i32,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """y = df/du w"""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            parameters=parameters,
            rest=rest,
            surface=surface,
            walls=walls,
            lag=lag,
            per_gamma=per_gamma,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.stiffness(e, scene, u, 0, w, corner)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            y[0, i] = el.gather(i, scene, corner) + contact_product(i, scene, u[0, i], w[0, i])

    # ---- block diagonal ---------------------------------------------------------------------------------------------

    @traced
    def tangent_column(e, scene, u, c, tangent):
        """Column c of d2psi/dF2, nine numbers, to rows 9 c .. 9 c + 8 of its block."""
        H = el.edges(e, scene, u, 0) @ el.gradients_of(e, scene.gradients)
        dH = Tensor(el.broadcast(ti.cast(c == k, fp)) for k in range(9))
        dP = law.stress_differential(H, dH, el.coefficients_at(e, scene, u, 0))
        el.put(tangent, 81, e, 9 * c, dP.numbers)

    @traced
    def corner_blocks(e, scene, tangent, columns):
        """The 3x3 block of -df_a/du_a of each corner a, by columns."""
        B, volume = el.gradients_of(e, scene.gradients), el.volume_of(e, scene.volumes)
        zero = ti.cast(0, fp)
        N = [[let(sum_of(B[a, j] for a in range(3)) * ti.cast(-1, fp)) for j in range(3)]]
        N += [[B[a, j] for j in range(3)] for a in range(3)]
        for d in range(3):  # column d: the displacement e_d of the corner
            C = [el.numbers(tangent, 9 * (3 * d + k), 9, 81, e) for k in range(3)]
            forces = []
            for a in range(4):
                dP = [let(sum_of(C[k][m] * N[a][k] for k in range(3)) * volume) for m in range(9)]
                forces.append([let(sum_of(dP[3 * i + j] * N[a][j] for j in range(3))) for i in range(3)])
            el.store_corners(columns[d], e, forces, zero)

    @ti.kernel
    def blocks(
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
        walls: t.vectors,
        lag: t.vectors2,
        corner0: t.vectors,
        corner1: t.vectors,
        corner2: t.vectors,
        tangent: t.blocks,
        u: t.vectors2,
        out: t.vectors2,
        num_items: ti.i32,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """d2psi/dF2 of each tetrahedron, and the 3x3 diagonal blocks of -df/du, rows 0..2 of `out`."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            parameters=parameters,
            rest=rest,
            surface=surface,
            walls=walls,
            lag=lag,
            per_gamma=per_gamma,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            for c in range(9):
                tangent_column(e, scene, u, c, tangent)
            corner_blocks(e, scene, tangent, (corner0, corner1, corner2))
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            out[0, i] = el.gather(i, scene, corner0) - contact_product(i, scene, u[0, i], vector(1, 0, 0, 0))
            out[1, i] = el.gather(i, scene, corner1) - contact_product(i, scene, u[0, i], vector(0, 1, 0, 0))
            out[2, i] = el.gather(i, scene, corner2) - contact_product(i, scene, u[0, i], vector(0, 0, 1, 0))

    @ti.kernel
    def pressure_forces(
        tets: t.ints,
        gradients: t.blocks,
        volumes: t.blocks,
        coefficients: t.blocks,
        u: t.vectors2,
        corner: t.vectors,
        num_items: ti.i32,
        per_gamma: fp,
    ):
        """Corner forces of a unit pressure in every patch."""
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients)
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.pressure_forces(e, scene, u, 0, corner)

    @ti.kernel
    def contact_blocks(
        parameters: t.scalars,
        rest: t.vectors,
        surface: t.ints,
        walls: t.vectors,
        lag: t.vectors2,
        u: t.vectors2,
        out: t.vectors2,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """The part of contact in `blocks`."""
        scene = Bundle(parameters=parameters, rest=rest, surface=surface, walls=walls, lag=lag, per_gamma=per_gamma)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            out[0, i] = 0 - contact_product(i, scene, u[0, i], vector(1, 0, 0, 0))
            out[1, i] = 0 - contact_product(i, scene, u[0, i], vector(0, 1, 0, 0))
            out[2, i] = 0 - contact_product(i, scene, u[0, i], vector(0, 0, 1, 0))

    # ---- derivatives by everything else -----------------------------------------------------------------------------

    rest_row = features.sums().first("rest")

    @ti.kernel
    def vjp(
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
        walls: t.vectors,
        lag: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        w: t.vectors2,
        y: t.vectors2,
        coefficients_adj: t.blocks,
        gradients_adj: t.blocks,
        volumes_adj: t.blocks,
        sums: t.scalars2,
        lag_adj: t.vectors2,
        walls_adj: t.vectors2,
        num_items: ti.i32,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """y = df/du w (it is symmetric), lag_adj, walls_adj; adds the adjoints of all else that the forces depend on."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            parameters=parameters,
            rest=rest,
            surface=surface,
            walls=walls,
            lag=lag,
            per_gamma=per_gamma,
        )
        adjoint = Bundle(
            coefficients=coefficients_adj,
            gradients=gradients_adj,
            volumes=volumes_adj,
            sums=sums,
            lag=lag_adj,
            walls=walls_adj,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.forces_vjp(e, scene, u, 0, w, corner, adjoint)
            if ti.static(features.shape):
                el.shape_vjp(e, scene, u, 0, w, adjoint)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            f = el.gather(i, scene, corner)
            if ti.static(len(contacts) > 0):
                if surface[i] > 0:
                    for k in ti.static(range(len(contacts))):
                        f += contact_vjp(k, i, scene, u[0, i], w[0, i], adjoint)
            y[0, i] = f

    @ti.func
    def add_to_sums(k: A, i, by, adjoint: A):
        """Adjoints of the numbers of obstacle k, a tuple."""
        for m in ti.static(range(contacts[k].size)):
            to = ti.static(contacts[k].first + m)
            adjoint.sums[to, i] = adjoint.sums[to, i] + by[m]

    @ti.func
    def add_to_rest(i, by_X, adjoint: A):
        if ti.static(features.shape):
            for d in ti.static(range(3)):
                adjoint.sums[rest_row + d, i] = adjoint.sums[rest_row + d, i] + by_X[d]

    @ti.func
    def contact_vjp(k: A, i, scene: A, u, w, adjoint: A):
        X, zero = scene.rest[i] - scene.walls[3 * k], vector(0)
        by_u, _ = contacts[k].force_vjp(scene.parameters, X, u, zero, w)
        by = contacts[k].parameter_derivatives(scene.parameters, X, u, zero)
        for m in ti.static(range(contacts[k].size)):
            to = ti.static(contacts[k].first + m)
            adjoint.sums[to, i] = adjoint.sums[to, i] + by[m].dot(w)
        add_to_rest(i, by_u, adjoint)
        adjoint.walls[3 * k, i] = zero - by_u
        adjoint.walls[3 * k + 1, i] = zero
        adjoint.walls[3 * k + 2, i] = zero
        if ti.static(contacts[k].friction):
            if rubs(k, i, scene):
                v, wall = velocity(i, scene, u), scene.walls[3 * k + 2]
                by_lag, by_v, by_wall, by_numbers = contacts[k].rub_vjp(
                    scene.parameters, X_of(k, i, scene), scene.lag[0, i], v, wall, w
                )
                add_to_sums(k, i, by_numbers, adjoint)
                add_to_rest(i, by_lag, adjoint)
                by_u += scene.per_gamma * by_v
                adjoint.lag[0, i] = adjoint.lag[0, i] + by_lag
                adjoint.lag[1, i] = adjoint.lag[1, i] - scene.per_gamma * by_v
                adjoint.walls[3 * k + 1, i] = zero - by_lag
                adjoint.walls[3 * k + 2, i] = by_wall
        return by_u

    @ti.kernel
    def jvp(
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
        walls: t.vectors,
        lag: t.vectors2,
        corner: t.vectors,
        u: t.vectors2,
        du: t.vectors2,
        df: t.vectors2,
        coefficients_dot: t.blocks,
        parameters_dot: t.scalars,
        rest_dot: t.vectors,
        gradients_dot: t.blocks,
        volumes_dot: t.blocks,
        lag_dot: t.vectors2,
        walls_dot: t.vectors,
        num_items: ti.i32,
        num_vertices: ti.i32,
        per_gamma: fp,
    ):
        """Change of the forces for changes of everything that they depend on."""
        scene = Bundle(
            tets=tets,
            gradients=gradients,
            volumes=volumes,
            coefficients=coefficients,
            start=start,
            corner_of=corner_of,
            parameters=parameters,
            rest=rest,
            surface=surface,
            walls=walls,
            lag=lag,
            per_gamma=per_gamma,
        )
        dots = Bundle(
            coefficients=coefficients_dot,
            gradients=gradients_dot,
            volumes=volumes_dot,
            parameters=parameters_dot,
            rest=rest_dot,
            lag=lag_dot,
            walls=walls_dot,
        )
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.forces_jvp(e, scene, u, 0, du, corner, dots)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            f = el.gather(i, scene, corner)
            if ti.static(len(contacts) > 0):
                if surface[i] > 0:
                    for k in ti.static(range(len(contacts))):
                        f += contact_jvp(k, i, scene, u[0, i], du[0, i], dots)
            df[0, i] = f

    @ti.func
    def contact_jvp(k: A, i, scene: A, u, du, dots: A):
        X, zero = scene.rest[i] - scene.walls[3 * k], vector(0)
        moved = du + dots.rest[i] - dots.walls[3 * k]
        f = contacts[k].force_jvp(scene.parameters, X, u, zero, moved, zero)
        by = contacts[k].parameter_derivatives(scene.parameters, X, u, zero)
        for m in ti.static(range(contacts[k].size)):
            f += by[m] * dots.parameters[contacts[k].first + m]
        if ti.static(contacts[k].friction):
            if rubs(k, i, scene):
                v, wall = velocity(i, scene, u), scene.walls[3 * k + 2]
                before = dots.lag[0, i] + dots.rest[i] - dots.walls[3 * k + 1]
                f += contacts[k].rub_jvp(
                    scene.parameters,
                    X_of(k, i, scene),
                    scene.lag[0, i],
                    v,
                    wall,
                    dots.parameters,
                    before,
                    scene.per_gamma * (du - dots.lag[1, i]),
                    dots.walls[3 * k + 2],
                )
        return f

    return SimpleNamespace(
        energy=energy,
        forces=forces,
        product=product,
        blocks=blocks,
        vjp=vjp,
        jvp=jvp,
        contact_blocks=contact_blocks,
        pressure_forces=pressure_forces,
    )
