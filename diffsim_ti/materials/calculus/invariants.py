"""Tensor calculus of isotropic laws in invariants, written once."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.calculus.tensor import add_to_diagonal, cofactor_differential, inner, invariants
from diffsim_ti.materials.law import Law
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class InvariantLaw(Law):
    """psi(j, s, q), a function of the invariants in a form that is first or second order in the strain:

        j = J - 1,    s = I_C - 3 - 2 j,    q = II_C - 3 - 2 (I_C - 3),    so that I_C - 3 = s + 2 j

    with C = F^T F, I_C = tr C, II_C = |cof F|^2, J = det F. Their gradients cof F, 2 (F - cof F), 2 N with
    N = I_C F - F C - 2 F, leave rest free of stress exactly if psi_j = 0 there, and s, q, F - cof F, N are computed from
    H without cancellation, so that float32 keeps its digits near rest. In small strains e
    s = 2 |e|^2 - tr(e)^2 and q = 2 tr(e)^2 - 2 |e|^2: mu = 2 (psi_s - psi_q), lam = psi_jj - 2 psi_s + 4 psi_q.

    A law writes three scalar functions: `psi`, `slopes` (psi_j, psi_s, psi_q) and `curvatures` (psi_jj, psi_js, psi_ss).
    Contract: linear in the coefficients p, and psi_q depends on nothing but p.
    `uses_q = False`: no II_C; `couples_s = False`: psi_s depends on p only. What is not used is not computed.

    Bonet, Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, ch. 6.
    """

    short = True

    uses_q = False
    couples_s = True

    @ti.func
    def psi(self, j, s, q, p):
        """psi [J/m^3]"""

    @ti.func
    def slopes(self, j, s, q, p):
        """psi_j, psi_s, psi_q"""

    @ti.func
    def curvatures(self, j, s, q, p):
        """psi_jj, psi_js, psi_ss"""

    @traced
    def second_invariant(self, H, i1):
        """(q, G, N) with C = I + G, i1 = tr G: q = (i1^2 - |G|^2) / 2, N = i1 F - F G; no II_C: zero, None."""
        if not self.uses_q:
            return let(0 * i1), None, None
        G = H + H.transpose() + H.transpose() @ H
        return let(self.real(0.5) * (i1 * i1 - inner(G, G))), G, add_to_diagonal(H * i1 - G - H @ G, i1)

    @traced
    def dilatation(self, H):
        """J - 1"""
        return invariants(H)[1]

    @traced
    def dilatation_gradient(self, H):
        return add_to_diagonal(invariants(H)[0], 1)

    @traced
    def dilatation_gradient_differential(self, H, dH):
        return cofactor_differential(add_to_diagonal(H, 1), dH)

    @traced
    def energy_density(self, H, p):
        _, j, s = invariants(H)
        q, _, _ = self.second_invariant(H, let(s + 2 * j))
        return self.psi(j, s, q, p)

    @traced
    def stress(self, H, p):
        K, j, s = invariants(H)
        q, _, N = self.second_invariant(H, let(s + 2 * j))
        psi_j, psi_s, psi_q = map(let, self.slopes(j, s, q, p))
        a = let(2 * psi_s)
        P = add_to_diagonal(H * a + K * let(psi_j - a), psi_j)
        return P + N * let(2 * psi_q) if self.uses_q else P

    @traced
    def stress_differential_and_products(self, H, dH, p):
        K, j, s = invariants(H)
        i1 = let(s + 2 * j)
        q, G, N = self.second_invariant(H, i1)
        psi_j, psi_s, psi_q = map(let, self.slopes(j, s, q, p))
        psi_jj, psi_js, psi_ss = map(let, self.curvatures(j, s, q, p))
        F, KdH = add_to_diagonal(H, 1), inner(K, dH)
        dj = let(dH.trace() + KdH)
        ds = let(2 * (inner(H, dH) - KdH))

        a = let(2 * psi_s)
        dP = dH * a + cofactor_differential(F, dH) * let(psi_j - a)
        if self.couples_s:
            da = let(2 * (psi_js * dj + psi_ss * ds))
            dpsi_j = let(psi_jj * dj + psi_js * ds)
            dP = dP + add_to_diagonal(H * da + K * let(dpsi_j - da), dpsi_j)
        else:
            dP = dP + add_to_diagonal(K, 1) * let(psi_jj * dj)
        dq = None
        if self.uses_q:
            dq = let(2 * inner(N, dH))
            dG = F.transpose() @ dH
            change = F * let(ds + 2 * dj) + dH * i1 - dH @ G - F @ (dG + dG.transpose())
            dP = dP + change * let(2 * psi_q)

        products = []
        for k in range(len(self.coefficient_names)):  # linear in p: the work of the stress for p = e_k
            psi_j, psi_s, psi_q = self.slopes(j, s, q, self.unit(k))
            work = psi_j * dj + psi_s * ds
            products.append(let(work + psi_q * dq if self.uses_q else work))
        return dP, products
