"""The linear tetrahedron: what each one adds to forces, to their differential and to the adjoint.

H = sum_a (u_a - u_0) (x) grad N_a, a = 1..3, is the displacement gradient; `gradients[e]` holds grad N_1..3 as rows.
Corner forces f_a = -V P grad N_a go to `corner[4 e + a]`; vertices gather them, so no atomics and the same bits every run.
`scene` is a Bundle of tets, gradients, volumes, coefficients, start, corner_of.
"""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.runtime import PRECISIONS

A = ti.template()  # an array or Bundle handed to a Taichi function


@lru_cache(maxsize=None)
def element_functions(law, uniform: bool) -> SimpleNamespace:
    """Taichi functions of one tetrahedron for a law; `uniform`: one set of coefficients serves all tetrahedra."""
    fp = PRECISIONS[law.precision]
    vec3, mat3 = ti.types.vector(3, fp), ti.types.matrix(3, 3, fp)
    coefficient = ti.types.vector(len(law.coefficient_names), fp)

    @ti.func
    def edges(e, scene: A, u: A, s):
        """Columns u_a - u_0 of slot s."""
        tet = scene.tets[e]
        u0 = u[s, tet[0]]
        return ti.Matrix.cols([u[s, tet[1]] - u0, u[s, tet[2]] - u0, u[s, tet[3]] - u0])

    @ti.func
    def coefficients_of(e, coefficients: A):
        p = coefficients[0]
        if ti.static(not uniform):
            p = coefficients[e]
        return p

    @ti.func
    def store(e, corner: A, Q):
        """Columns of Q are the forces of corners 1..3; corner 0 balances them."""
        f1, f2, f3 = vec3(Q[0, 0], Q[1, 0], Q[2, 0]), vec3(Q[0, 1], Q[1, 1], Q[2, 1]), vec3(Q[0, 2], Q[1, 2], Q[2, 2])
        corner[4 * e] = -(f1 + f2 + f3)
        corner[4 * e + 1] = f1
        corner[4 * e + 2] = f2
        corner[4 * e + 3] = f3

    @ti.func
    def gather(i, scene: A, corner: A):
        """Sum of the corners that meet at vertex i, in a fixed order."""
        f = vec3(0)
        for c in range(scene.start[i], scene.start[i + 1]):
            f += corner[scene.corner_of[c]]
        return f

    @ti.func
    def forces(e, scene: A, u: A, s, corner: A):
        """Elastic corner forces at slot s."""
        B = scene.gradients[e]
        P = law.stress(edges(e, scene, u, s) @ B, coefficients_of(e, scene.coefficients))
        store(e, corner, -scene.volumes[e] * (P @ B.transpose()))

    @ti.func
    def stiffness(e, scene: A, u: A, s, w: A, corner: A):
        """Corner products of the derivative of the elastic force with w (negative semi-definite at rest)."""
        B = scene.gradients[e]
        H, dH = edges(e, scene, u, s) @ B, edges(e, scene, w, 0) @ B
        dP = law.stress_differential(H, dH, coefficients_of(e, scene.coefficients))
        store(e, corner, -scene.volumes[e] * (dP @ B.transpose()))

    @ti.func
    def forces_jvp(e, scene: A, u: A, s, du: A, corner: A, dots: A):
        """Change of the corner forces for changes of displacements, coefficients and rest shape."""
        B, p, volume = scene.gradients[e], coefficients_of(e, scene.coefficients), scene.volumes[e]
        D, B_dot = edges(e, scene, u, s), dots.gradients[e]
        H, dH = D @ B, edges(e, scene, du, 0) @ B + D @ B_dot
        P = law.stress(H, p)
        # energies are linear in their coefficients, so the stress of the change is the change of the stress
        dP = law.stress_differential(H, dH, p) + law.stress(H, coefficients_of(e, dots.coefficients))
        Q = volume * (dP @ B.transpose()) + P @ (dots.volumes[e] * B + volume * B_dot).transpose()
        store(e, corner, -Q)

    @ti.func
    def forces_vjp(e, scene: A, u: A, s, w: A, corner: A, adjoint: A):
        """Corner products K w of the symmetric stiffness; adds the adjoint of the coefficients.

        The work of the forces on w is -V P(H) : dH, with dH the displacement gradient of w.
        """
        B, volume = scene.gradients[e], scene.volumes[e]
        H, dH = edges(e, scene, u, s) @ B, edges(e, scene, w, 0) @ B
        dP, products = law.stress_differential_and_products(H, dH, coefficients_of(e, scene.coefficients))
        store(e, corner, -volume * (dP @ B.transpose()))
        adjoint.coefficients[e] -= volume * products

    @ti.func
    def shape_vjp(e, scene: A, u: A, s, w: A, adjoint: A):
        """Adds the adjoints of grad N and V: the work is -V P(D B) : (W B)."""
        B, p = scene.gradients[e], coefficients_of(e, scene.coefficients)
        D, W = edges(e, scene, u, s), edges(e, scene, w, 0)
        H, dH = D @ B, W @ B
        P, dP = law.stress(H, p), law.stress_differential(H, dH, p)
        adjoint.gradients[e] -= scene.volumes[e] * (D.transpose() @ dP + W.transpose() @ P)
        adjoint.volumes[e] -= (P * dH).sum()

    types = SimpleNamespace(
        fp=fp, vec3=vec3, scalars=ti.types.ndarray(fp, 1), scalars2=ti.types.ndarray(fp, 2),
        vectors=ti.types.ndarray(vec3, 1), vectors2=ti.types.ndarray(vec3, 2), matrices=ti.types.ndarray(mat3, 1),
        coefficients=ti.types.ndarray(coefficient, 1), ints=ti.types.ndarray(ti.i32, 1),
        tets=ti.types.ndarray(ti.types.vector(4, ti.i32), 1),
    )  # fmt: skip
    return SimpleNamespace(
        types=types, edges=edges, coefficients_of=coefficients_of, gather=gather, forces=forces, stiffness=stiffness,
        forces_jvp=forces_jvp, forces_vjp=forces_vjp, shape_vjp=shape_vjp,
    )  # fmt: skip
