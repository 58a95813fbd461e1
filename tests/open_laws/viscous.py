"""Rubber with viscosity: a stress that depends on how fast it deforms, whichever way it turns."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner, invariants
from diffsim_ti.materials.material import check_range


@dataclass(frozen=True)
class ViscousLaw(EnergyLaw):
    """psi = mu/2 (I_C - 3 - 2 (J - 1)) + lam/2 (J - 1)^2, phi = eta |E_dot|^2, E_dot = sym(F^T F_dot)"""

    coefficient_names = ("mu", "lam", "eta")
    reads = ("H", "H_dot")

    def psi(self, H, p):
        _, j, s = invariants(H)
        return p[0] / 2 * s + p[1] / 2 * j * j

    def dissipation(self, H, H_dot, p):
        half = add_to_diagonal(H, 1).transpose() @ H_dot
        E_dot = (half + half.transpose()) * 0.5
        return p[2] * inner(E_dot, E_dot)


class ViscousRubber(Material):
    """youngs_modulus [Pa], poissons_ratio [-], viscosity eta [Pa s]: Kelvin, Voigt."""

    spellings = (("youngs_modulus", "poissons_ratio", "viscosity"),)
    units = {"viscosity": "Pa s"}

    def law(self, precision):
        return ViscousLaw(precision)

    def check(self, values):
        super().check(values)
        check_range("viscosity", values["viscosity"], 0, np.inf, True, "a fluid's [Pa s]")
