"""Knowles' power law, with an exponent n that observations may identify; n = 1 is neo-Hookean."""

from dataclasses import dataclass

from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import invariants


@dataclass(frozen=True)
class PowerLaw(EnergyLaw):
    """psi = mu/(2 b) ((1 + b/n (I_1 - 3))^n - 1) + lam/2 (J - 1)^2, I_1 - 3 = I_C - 3 - 2 (J - 1)"""

    coefficient_names = ("mu", "lam", "b", "n")

    def psi(self, H, p):
        mu, lam, b, n = p
        _, j, s = invariants(H)
        return mu / (2 * b) * ((1 + b / n * s) ** n - 1) + lam / 2 * j * j


class Knowles(Material):
    """youngs_modulus [Pa], poissons_ratio, b, n [-]. Knowles 1977, doi:10.1007/BF00017296."""

    spellings = (("youngs_modulus", "poissons_ratio", "b", "n"),)
    units = {"b": "-", "n": "-"}

    def law(self, precision):
        return PowerLaw(precision)
