"""Hooke's law in Green's strain."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.calculus.invariants import InvariantLaw
from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner
from diffsim_ti.materials.material import TwoModuli
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class StVenantKirchhoffLaw(InvariantLaw):
    """psi = mu/4 (i1^2 - 2 q) + lam/8 i1^2 with i1 = I_C - 3 = s + 2 j and |C - I|^2 = i1^2 - 2 q."""

    coefficient_names = ("mu", "lam")
    uses_q = True

    @traced
    def dilatation(self, H):
        """tr E"""
        return let(H.trace() + inner(H, H) * self.real(0.5))

    @traced
    def dilatation_gradient(self, H):
        return add_to_diagonal(H, 1)

    @traced
    def dilatation_gradient_differential(self, H, dH):
        return dH

    @ti.func
    def psi(self, j, s, q, p):
        i1 = s + 2 * j
        return self.real(0.25) * p[0] * (i1 * i1 - 2 * q) + self.real(0.125) * p[1] * i1 * i1

    @ti.func
    def slopes(self, j, s, q, p):
        psi_i1 = self.real(0.25) * (2 * p[0] + p[1]) * (s + 2 * j)
        return 2 * psi_i1, psi_i1, self.real(-0.5) * p[0]

    @ti.func
    def curvatures(self, j, s, q, p):
        k = self.real(0.25) * (2 * p[0] + p[1])
        return 4 * k, 2 * k, k


class StVenantKirchhoff(TwoModuli):
    """psi = mu |E|^2 + lam/2 tr(E)^2 with E = (F^T F - I) / 2 [J/m^3]; P = F (2 mu E + lam tr(E) I) [Pa].

    Good for large rotations with small strains. Under compression it softens and gives way (at 58 % of its length in one
    direction), and its energy is that of the mirror image, too: take a neo-Hookean material for large compression.

    Arguments: see `Material`.
    Ciarlet, Mathematical Elasticity I, 1988, sec. 3.9.
    """

    def law(self, precision: str) -> StVenantKirchhoffLaw:
        return StVenantKirchhoffLaw(precision)
