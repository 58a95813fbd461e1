"""Ogden's rubber: a sum of powers of the principal stretches."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import expm1_minus_x
from diffsim_ti.differentiation.arrays import as_array
from diffsim_ti.materials.calculus.stretches import sum_over_stretches
from diffsim_ti.materials.calculus.tensor import invariants, isochoric
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron, check_range, number_of_terms


@dataclass(frozen=True)
class OgdenLaw(EnergyLaw):
    """psi = sum_k mu_k/a_k (sum_i l_i^a_k - 3) + K/2 (J - 1)^2, l_i = J^(-1/3) lambda_i, k = 1 .. terms"""

    terms: int = 1

    @property
    def coefficient_names(self):
        names = range(1, self.terms + 1)
        return (*(f"mu_{k}" for k in names), *(f"a_{k}" for k in names), "bulk_modulus")

    def psi(self, H, p):
        pairs = list(zip(p[: self.terms], p[self.terms : 2 * self.terms]))
        _, j, log = isochoric(H)

        def of_stretch(l):  # logarithms of l_i add up to zero: what is linear in them drops out
            return sum(mu / a * expm1_minus_x(a * (l - log / 3)) for mu, a in pairs)

        return sum_over_stretches(H, of_stretch) + p[-1] / 2 * j * j

    def theta(self, H):
        return invariants(H)[1]


class Ogden(Material):
    """psi = sum_k mu_k/a_k (sum_i l_i^a_k - 3) + K/2 (J - 1)^2 [J/m^3], l_i = J^(-1/3) lambda_i.

    `Ogden(moduli, exponents, bulk_modulus)`: mu_k [Pa] and a_k [-], one for each term, and K [Pa].
    Vectors are for all tetrahedra, or of shape (num_tetrahedra, terms). Small strains have the shear modulus
    sum_k mu_k a_k / 2, which must be above 0, and the bulk modulus K; a term with mu_k a_k < 0 may make large strains
    unstable. (mu, 2) is neo-Hookean, (2 c10, 2) with (-2 c01, -2) Mooney's. Others write mu_k a_k / 2 for the modulus of a
    term: theirs times 2 / a_k are these. J must stay above 0.
    Ogden 1972, Large deformation isotropic elasticity, doi:10.1098/rspa.1972.0026.
    """

    spellings = (("moduli", "exponents", "bulk_modulus"),)
    units = {"exponents": "-"}
    positive = {"bulk_modulus": "a stiffness [Pa]"}

    def __init__(self, moduli: PerTetrahedron, exponents: PerTetrahedron, bulk_modulus: PerTetrahedron):
        self.terms = number_of_terms("Ogden", "term", moduli=moduli, exponents=exponents)
        self.shapes = {"moduli": (self.terms,), "exponents": (self.terms,)}
        super().__init__(moduli=moduli, exponents=exponents, bulk_modulus=bulk_modulus)

    def check(self, values):
        super().check(values)
        mu, a = values["moduli"], values["exponents"]
        if mu.shape == a.shape or 1 in (mu.ndim, a.ndim):  # else of sets, not on a mesh yet
            shear = (mu * a).sum(-1) / 2
            check_range(
                "sum of moduli * exponents / 2", shear, 0, np.inf, False, "the shear modulus [Pa] of small strains"
            )

    def lame(self, values):
        mu = (as_array(values["moduli"]) * values["exponents"]).sum(-1) / 2
        return mu, values["bulk_modulus"] - 2 / 3 * mu

    def law(self, precision):
        return OgdenLaw(precision, terms=self.terms)
