"""Tensor calculus of laws in the strain eps = sym(R^T F) - I, written once."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.law import Law
from diffsim_ti.materials.polar import polar, spin
from diffsim_ti.materials.tensor import add_to_diagonal, inner


@dataclass(frozen=True)
class StrainLaw(Law):
    """psi(t, q) of t = tr eps and q = |eps|^2, where eps = sym(R^T F) - I.

    `rotates = True`: R is the polar rotation of F, so that eps = S - I; False: R = I and eps = sym H.
    A law writes `psi`, `slopes` (psi_t, psi_q) and `curvature` (psi_tt).
    Contract: linear in the coefficients p, and psi_q depends on nothing but p.
    The differential of R needs two stretches not to sum to zero, which happens in inverted or rank-one states only; there
    it is finite but means nothing (see `polar.spin`).
    """

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

    @ti.func
    def rotation_and_strain(self, H):
        """(R, eps); without rotation R is H and not used."""
        R, eps = H, self.real(0.5) * (H + H.transpose())
        if ti.static(self.rotates):
            R, eps = polar(H, self.fp)
        return R, eps

    @ti.func
    def energy_density(self, H, p):
        _, eps = self.rotation_and_strain(H)
        return self.psi(eps.trace(), inner(eps, eps), p)

    @ti.func
    def stress(self, H, p):
        R, eps = self.rotation_and_strain(H)
        psi_t, psi_q = self.slopes(eps.trace(), inner(eps, eps), p)
        P = add_to_diagonal(2 * psi_q * eps, psi_t)
        if ti.static(self.rotates):
            P = R @ P
        return P

    @ti.func
    def stress_differential_and_products(self, H, dH, p):
        R, eps = self.rotation_and_strain(H)
        t, q = eps.trace(), inner(eps, eps)
        psi_t, psi_q = self.slopes(t, q, p)
        B = dH
        if ti.static(self.rotates):
            B = R.transpose() @ dH
        dt, dq = B.trace(), 2 * inner(eps, B)
        dpsi_t = self.curvature(t, q, p) * dt
        dP = H
        if ti.static(self.rotates):
            dP = 2 * psi_q * dH + R @ add_to_diagonal((psi_t - 2 * psi_q) * spin(eps, B, self.fp), dpsi_t)
        else:
            dP = add_to_diagonal(psi_q * (dH + dH.transpose()), dpsi_t)
        products = self.unit(0)
        for k in ti.static(range(len(self.coefficient_names))):
            psi_t_k, psi_q_k = self.slopes(t, q, self.unit(k))
            products[k] = psi_t_k * dt + psi_q_k * dq
        return dP, products
