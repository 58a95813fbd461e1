"""Ogden's rubber, a sum of powers of the principal stretches, with exponents that observations may identify."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import expm1_minus_x
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.stretches import sum_over_stretches
from diffsim_ti.materials.calculus.tensor import invariants
from diffsim_ti.materials.material import check_range


@dataclass(frozen=True)
class OgdenLaw(EnergyLaw):
    """psi = sum_k mu_k/a_k (sum_i lambda_i^a_k - 3 - a_k log J) + lam/2 (J - 1)^2, k = 1, 2"""

    coefficient_names = ("mu_1", "a_1", "mu_2", "a_2", "lam")

    def psi(self, H, p):
        terms, lam = ((p[0], p[1]), (p[2], p[3])), p[4]
        _, j, _ = invariants(H)
        powers = sum_over_stretches(H, lambda l: sum(mu / a * expm1_minus_x(a * l) for mu, a in terms))
        return powers + lam / 2 * j * j

    def theta(self, H):
        return invariants(H)[1]


class Ogden(Material):
    """mu_1, mu_2 [Pa] with exponents a_1, a_2, each mu_k a_k > 0, and lam [Pa].

    Ogden 1972, Large deformation isotropic elasticity, doi:10.1098/rspa.1972.0026.
    """

    spellings = (("mu_1", "a_1", "mu_2", "a_2", "lam"),)
    units = {"a_1": "-", "a_2": "-"}

    def law(self, precision):
        return OgdenLaw(precision)

    def check(self, values):
        super().check(values)
        for k in (1, 2):
            stiffness = np.asarray(values[f"mu_{k}"]) * values[f"a_{k}"]
            check_range(f"mu_{k} a_{k}", stiffness, 0, np.inf, False, "each term must stiffen the body")

    def lame(self, values):
        return (values["mu_1"] * values["a_1"] + values["mu_2"] * values["a_2"]) / 2, values["lam"]
