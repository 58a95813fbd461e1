"""Gent's rubber, whose chains have a greatest length: the stress grows without bound as stretches near it."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import x_minus_log1p
from diffsim_ti.materials.calculus.tensor import invariants, isochoric
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron


@dataclass(frozen=True)
class GentLaw(EnergyLaw):
    """psi = -mu/2 limit log(1 - i / limit) + K/2 (J - 1)^2, i = J^(-2/3) I_C - 3"""

    coefficient_names = ("mu", "limit", "bulk_modulus")

    def psi(self, H, p):
        mu, limit, bulk = p
        i, j, _ = isochoric(H)
        return mu / 2 * (i + limit * x_minus_log1p(-i / limit)) + bulk / 2 * j * j

    def theta(self, H):
        return invariants(H)[1]


class Gent(Material):
    """psi = -mu/2 limit log(1 - i / limit) + K/2 (J - 1)^2 [J/m^3], i = J^(-2/3) I_C - 3 < limit.

    `Gent(mu, limit, bulk_modulus)`: mu and K [Pa] are those of small strains, limit [-] is the i at which chains are
    stretched out (30 to 100 for rubber); limit = infinity is neo-Hookean. J must stay above 0 and i below the limit.
    Gent 1996, A new constitutive relation for rubber, doi:10.5254/1.3538357.
    """

    spellings = (("mu", "limit", "bulk_modulus"),)
    units = {"limit": "-"}
    positive = {"limit": "of J^(-2/3) I_C - 3 [-], 30 to 100 for rubber", "bulk_modulus": "a stiffness [Pa]"}
    to_lame = np.array([[1.0, 0, 0], [-2 / 3, 0, 1]])

    def __init__(self, mu: PerTetrahedron, limit: PerTetrahedron, bulk_modulus: PerTetrahedron):
        super().__init__(mu, limit, bulk_modulus)

    def law(self, precision):
        return GentLaw(precision)
