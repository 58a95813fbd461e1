"""Kernels of the potential energy of a displacement: elasticity of all tetrahedra and contact of surface vertices."""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.materials.tensor import Tensor, sum_of
from diffsim_ti.runtime import Bundle, let, traced
from diffsim_ti.tetrahedron import A, element_functions


@lru_cache(maxsize=None)
def potential_kernels(law, features, parallel: bool, lanes: bool) -> SimpleNamespace:
    """Kernels for a law and a scene's features: energy, forces, products of their derivatives, block diagonal."""
    el, single = element_functions(law, features.uniform, lanes), element_functions(law, features.uniform, False)
    t, contacts = el.types, features.contacts
    fp, vector = t.fp, t.vector

    @ti.kernel
    def energy(tets: t.ints, gradients: t.blocks, volumes: t.blocks, coefficients: t.blocks, parameters: t.scalars,
               rest: t.vectors, surface: t.ints, u: t.vectors2, elastic: t.scalars, J: t.scalars, contact: t.scalars,
               num_tetrahedra: ti.i32, num_vertices: ti.i32):  # fmt: skip
        """Energy [J] and volume ratio of each tetrahedron, contact energy [J] of each vertex."""
        scene = Bundle(tets=tets)
        ti.loop_config(serialize=not parallel)
        for e in range(num_tetrahedra):
            H = single.edges(e, scene, u, 0).dot(single.gradients_of(e, gradients))
            psi = law.energy_density(H, single.coefficients_of(e, coefficients))
            elastic[e] = psi * single.volume_of(e, volumes)
            J[e] = volume_ratio(H)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            value = ti.cast(0, fp)
            if ti.static(len(contacts) > 0):
                if surface[i] > 0:
                    for k in ti.static(range(len(contacts))):
                        value += contacts[k].energy(parameters, rest[i], u[0, i])
            contact[i] = value

    @ti.func
    def volume_ratio(H):
        return (H.matrix() + ti.Matrix.identity(fp, 3)).determinant()

    @ti.func
    def contact_force(i, scene: A, u):
        f = vector(0)
        if ti.static(len(contacts) > 0):
            if scene.surface[i] > 0:
                for k in ti.static(range(len(contacts))):
                    f += contacts[k].force(scene.parameters, scene.rest[i], u, vector(0))
        return f

    @ti.func
    def contact_product(i, scene: A, u, w):
        f = vector(0)
        if ti.static(len(contacts) > 0):
            if scene.surface[i] > 0:
                for k in ti.static(range(len(contacts))):
                    f += contacts[k].force_jvp(scene.parameters, scene.rest[i], u, vector(0), w, vector(0))
        return f

    @ti.kernel
    def forces(tets: t.ints, gradients: t.blocks, volumes: t.blocks, coefficients: t.blocks, start: t.ints,
               corner_of: t.ints, inverse_mass: t.scalars, parameters: t.scalars, rest: t.vectors, surface: t.ints,
               corner: t.vectors, u: t.vectors2, f: t.vectors2, size: t.scalars, num_items: ti.i32,
               num_vertices: ti.i32):  # fmt: skip
        """Forces, and the sum of the sizes of what meets at a vertex, against which a rest is measured."""
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients, start=start,
                       corner_of=corner_of, parameters=parameters, rest=rest, surface=surface)  # fmt: skip
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.forces(e, scene, u, 0, corner)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            pushed, total = contact_force(i, scene, u[0, i]), vector(0)
            norm = pushed.norm()
            for c in range(start[i], start[i + 1]):
                part = corner[corner_of[c]]
                total += part
                norm += part.norm()
            f[0, i] = total + pushed
            size[i] = norm

    @ti.kernel
    def product(tets: t.ints, gradients: t.blocks, volumes: t.blocks, coefficients: t.blocks, start: t.ints,
                corner_of: t.ints, inverse_mass: t.scalars, parameters: t.scalars, rest: t.vectors, surface: t.ints,
                corner: t.vectors, u: t.vectors2, w: t.vectors2, y: t.vectors2, num_items: ti.i32,
                num_vertices: ti.i32):  # fmt: skip
        """y = df/du w"""
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients, start=start,
                       corner_of=corner_of, parameters=parameters, rest=rest, surface=surface)  # fmt: skip
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
        dP = law.stress_differential(H, dH, el.coefficients_of(e, scene.coefficients))
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
    def blocks(tets: t.ints, gradients: t.blocks, volumes: t.blocks, coefficients: t.blocks, start: t.ints,
               corner_of: t.ints, inverse_mass: t.scalars, parameters: t.scalars, rest: t.vectors, surface: t.ints,
               corner0: t.vectors, corner1: t.vectors, corner2: t.vectors, tangent: t.blocks, u: t.vectors2,
               out: t.vectors2, num_items: ti.i32, num_vertices: ti.i32):  # fmt: skip
        """d2psi/dF2 of each tetrahedron, and the 3x3 diagonal blocks of -df/du, rows 0..2 of `out`."""
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients, start=start,
                       corner_of=corner_of, parameters=parameters, rest=rest, surface=surface)  # fmt: skip
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
    def contact_blocks(parameters: t.scalars, rest: t.vectors, surface: t.ints, u: t.vectors2, out: t.vectors2,
                       num_vertices: ti.i32):  # fmt: skip
        """The part of contact in `blocks`."""
        scene = Bundle(parameters=parameters, rest=rest, surface=surface)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            out[0, i] = 0 - contact_product(i, scene, u[0, i], vector(1, 0, 0, 0))
            out[1, i] = 0 - contact_product(i, scene, u[0, i], vector(0, 1, 0, 0))
            out[2, i] = 0 - contact_product(i, scene, u[0, i], vector(0, 0, 1, 0))

    # ---- derivatives by everything else -----------------------------------------------------------------------------

    row = features.sums()

    @ti.kernel
    def vjp(tets: t.ints, gradients: t.blocks, volumes: t.blocks, coefficients: t.blocks, start: t.ints,
            corner_of: t.ints, inverse_mass: t.scalars, parameters: t.scalars, rest: t.vectors, surface: t.ints,
            corner: t.vectors, u: t.vectors2, w: t.vectors2, y: t.vectors2, coefficients_adj: t.blocks,
            gradients_adj: t.blocks, volumes_adj: t.blocks, sums: t.scalars2, num_items: ti.i32,
            num_vertices: ti.i32):  # fmt: skip
        """y = df/du w (it is symmetric), and adds the adjoints of all that the forces depend on."""
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients, start=start,
                       corner_of=corner_of, parameters=parameters, rest=rest, surface=surface)  # fmt: skip
        adjoint = Bundle(coefficients=coefficients_adj, gradients=gradients_adj, volumes=volumes_adj)
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
                        X, x, zero = rest[i], u[0, i], vector(0)
                        by_u, _ = contacts[k].force_vjp(parameters, X, x, zero, w[0, i])
                        f += by_u
                        by = contacts[k].parameter_derivatives(parameters, X, x, zero)
                        for m in ti.static(range(contacts[k].size)):
                            to = ti.static(row["contacts"] + contacts[k].first - contacts[0].first + m)
                            sums[to, i] = sums[to, i] + by[m].dot(w[0, i])
                        if ti.static(features.shape):
                            for d in ti.static(range(3)):
                                sums[row["rest"] + d, i] = sums[row["rest"] + d, i] + by_u[d]
            y[0, i] = f

    @ti.kernel
    def jvp(tets: t.ints, gradients: t.blocks, volumes: t.blocks, coefficients: t.blocks, start: t.ints,
            corner_of: t.ints, inverse_mass: t.scalars, parameters: t.scalars, rest: t.vectors, surface: t.ints,
            corner: t.vectors, u: t.vectors2, du: t.vectors2, df: t.vectors2, coefficients_dot: t.blocks,
            parameters_dot: t.scalars, rest_dot: t.vectors, gradients_dot: t.blocks, volumes_dot: t.blocks,
            num_items: ti.i32, num_vertices: ti.i32):  # fmt: skip
        """Change of the forces for changes of everything that they depend on."""
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients, start=start,
                       corner_of=corner_of, parameters=parameters, rest=rest, surface=surface)  # fmt: skip
        dots = Bundle(coefficients=coefficients_dot, gradients=gradients_dot, volumes=volumes_dot)
        ti.loop_config(serialize=not parallel)
        for e in range(num_items):
            el.forces_jvp(e, scene, u, 0, du, corner, dots)
        ti.loop_config(serialize=not parallel)
        for i in range(num_vertices):
            f = el.gather(i, scene, corner) + contact_product(i, scene, u[0, i], du[0, i] + rest_dot[i])
            if ti.static(len(contacts) > 0):
                if surface[i] > 0:
                    for k in ti.static(range(len(contacts))):
                        by = contacts[k].parameter_derivatives(parameters, rest[i], u[0, i], vector(0))
                        for m in ti.static(range(contacts[k].size)):
                            f += by[m] * parameters_dot[contacts[k].first + m]
            df[0, i] = f

    return SimpleNamespace(energy=energy, forces=forces, product=product, blocks=blocks, vjp=vjp, jvp=jvp,
                           contact_blocks=contact_blocks)  # fmt: skip
