"""Linear elasticity: small strains and small rotations."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.calculus.strains import StrainLaw
from diffsim_ti.materials.material import TwoModuli


@dataclass(frozen=True)
class LinearElasticLaw(StrainLaw):
    """psi = mu q + lam/2 t^2"""

    coefficient_names = ("mu", "lam")
    linear = True

    @ti.func
    def psi(self, t, q, p):
        return p[0] * q + self.real(0.5) * p[1] * t * t

    @ti.func
    def slopes(self, t, q, p):
        return p[1] * t, p[0]

    @ti.func
    def curvature(self, t, q, p):
        return p[1]


class LinearElastic(TwoModuli):
    """psi = mu |e|^2 + lam/2 tr(e)^2 with e = sym(grad u) [J/m^3]; P = 2 mu e + lam tr(e) I [Pa].

    Not frame indifferent: a rotation of the body strains it. For rotations use any of the other materials.

    Arguments: see `Material`.
    Landau, Lifshitz, Theory of Elasticity, section 4.
    """

    def law(self, precision: str) -> LinearElasticLaw:
        return LinearElasticLaw(precision)
