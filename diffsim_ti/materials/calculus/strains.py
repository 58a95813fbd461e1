"""Tensor calculus of laws in the strain eps = sym(R^T F) - I, written once."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.calculus.polar import polar, spin
from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner
from diffsim_ti.materials.law import Law
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class StrainLaw(Law):
    """psi(t, q) of t = tr eps and q = |eps|^2, where eps = sym(R^T F) - I.

    `rotates = True`: R is the polar rotation of F, so that eps = S - I; False: R = I and eps = sym H.
    A law writes `psi`, `slopes` (psi_t, psi_q) and `curvature` (psi_tt).
    Contract: linear in the coefficients p, and psi_q depends on nothing but p.
    The differential of R needs two stretches not to sum to zero, which happens in inverted or rank-one states only; there
    it is finite but means nothing (see `polar.spin`).
    """

    short = True

    rotates = False

    @ti.func
    def psi(self, t, q, p):
        """psi [J/m^3]"""

    @ti.func
    def slopes(self, t, q, p):
        """psi_t, psi_q"""

    @ti.func
    def curvature(self, t, q, p):
        """psi_tt"""

    @property
    def lanes(self) -> bool:
        return not self.rotates  # the polar rotation is found by a loop

    @traced
    def rotation_and_strain(self, H):
        """(R, eps), found once for each Tensor; R is None without rotation."""
        if self.rotates:
            if "polar" not in H.known:
                H.known["polar"] = polar(H, self.fp)
            return H.known["polar"]
        return None, (H + H.transpose()) * self.real(0.5)

    @traced
    def dilatation(self, H):
        """tr eps"""
        return self.rotation_and_strain(H)[1].trace()

    @traced
    def dilatation_gradient(self, H):
        """R"""
        R = self.rotation_and_strain(H)[0] if self.rotates else H * 0
        return R if self.rotates else add_to_diagonal(R, 1)

    @traced
    def dilatation_gradient_differential(self, H, dH):
        if not self.rotates:
            return H * 0
        R, eps = self.rotation_and_strain(H)
        return R @ spin(eps, R.transpose() @ dH, self.fp)

    @traced
    def energy_density(self, H, p):
        _, eps = self.rotation_and_strain(H)
        return self.psi(eps.trace(), inner(eps, eps), p)

    @traced
    def stress(self, H, p):
        R, eps = self.rotation_and_strain(H)
        psi_t, psi_q = map(let, self.slopes(eps.trace(), inner(eps, eps), p))
        P = add_to_diagonal(eps * let(2 * psi_q), psi_t)
        return R @ P if self.rotates else P

    @traced
    def stress_differential_and_products(self, H, dH, p):
        R, eps = self.rotation_and_strain(H)
        t, q = eps.trace(), inner(eps, eps)
        psi_t, psi_q = map(let, self.slopes(t, q, p))
        B = R.transpose() @ dH if self.rotates else dH
        dt, dq = B.trace(), let(2 * inner(eps, B))
        dpsi_t = let(self.curvature(t, q, p) * dt)
        if self.rotates:
            W = spin(eps, B, self.fp)
            dP = dH * let(2 * psi_q) + R @ add_to_diagonal(W * let(psi_t - 2 * psi_q), dpsi_t)
        else:
            dP = add_to_diagonal((dH + dH.transpose()) * psi_q, dpsi_t)

        products = []
        for k in range(len(self.coefficient_names)):  # linear in p: the work of the stress for p = e_k
            psi_t, psi_q = self.slopes(t, q, self.unit(k))
            products.append(let(psi_t * dt + psi_q * dq))
        return dP, products
