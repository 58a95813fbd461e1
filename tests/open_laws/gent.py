"""Gent's rubber, whose chains have a greatest length: the stress grows without bound as I_C - 3 nears `limit`."""

from dataclasses import dataclass

from diffsim_ti.differentiation import x_minus_log1p
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import invariants


@dataclass(frozen=True)
class GentLaw(EnergyLaw):
    """psi = -mu/2 limit log(1 - (I_C - 3) / limit) - mu log J + lam/2 (J - 1)^2"""

    coefficient_names = ("mu", "limit", "lam")

    def psi(self, H, p):
        mu, limit, lam = p
        _, j, s = invariants(H)  # j = J - 1, s = I_C - 3 - 2 j
        chains = limit * x_minus_log1p(-(s + 2 * j) / limit)  # = -limit log(1 - (I_C - 3) / limit) - (I_C - 3)
        return mu / 2 * (s + chains) + mu * x_minus_log1p(j) + lam / 2 * j * j

    def theta(self, H):
        return invariants(H)[1]


class Gent(Material):
    """mu [Pa], limit [-], lam [Pa]. Gent 1996, A new constitutive relation for rubber, doi:10.5254/1.3538357."""

    spellings = (("mu", "limit", "lam"),)
    units = {"limit": "-"}

    def law(self, precision):
        return GentLaw(precision)
