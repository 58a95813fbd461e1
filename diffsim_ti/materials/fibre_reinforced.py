"""Fibres in a material: a direction for each tetrahedron in which it stiffens as it is stretched."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import exp, where
from diffsim_ti.materials.around import Around
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron, check_range
from diffsim_ti.materials.sum_law import SumLaw

UNITS = {"k1": "Pa", "k2": "-", "fibre": "-"}


@dataclass(frozen=True)
class FibreReinforcedLaw(EnergyLaw):
    """What fibres add: psi = k1/(2 k2) (exp(k2 e^2) - 1), e = max(a . C a / |a|^2 - 1, 0)

    Where fibres are just slack, as in a body at rest, the stiffness is the mean of both sides, for any change of shape.
    """

    coefficient_names = ("k1", "k2", "a_x", "a_y", "a_z")

    def psi(self, H, p):
        k1, k2, *a = p
        G = H + H.transpose() + H.transpose() @ H  # C - I
        along = sum(a[i] * G[i, k] * a[k] for i in range(3) for k in range(3))
        e = along / sum(x * x for x in a)
        taut = where(e > 0, e, where(e < 0, 0, e / 2))
        return k1 / (2 * k2) * (exp(k2 * e * taut) - 1)


class FibreReinforced(Around):
    """`FibreReinforced(matrix, k1, k2, fibre)`: psi of the matrix, any material, plus that of fibres,

        k1/(2 k2) (exp(k2 e^2) - 1) [J/m^3],  e = max(a . C a / |a|^2 - 1, 0),

    which resist being stretched alone. k1 [Pa], k2 [-], fibre: the direction a at rest, of any length, shape (3,) or
    (num_tetrahedra, 3). A second family of fibres is one more `FibreReinforced` around the first; its inputs are k1_2,
    k2_2 and fibre_2. Small strains along stretched fibres have 4 k1 more of Young's modulus.
    e^2 has a kink of second order at e = 0, where a body at rest begins: its stiffness is there the mean of both sides, so
    that gradients of a substep from rest are what central differences give.
    Holzapfel, Gasser, Ogden 2000, A new constitutive framework for arterial wall mechanics, doi:10.1023/A:1010835316564.
    Raises ValueError for numbers out of range, and for a matrix that has a state or depends on the velocity.
    """

    takes_moduli = False

    def __init__(self, matrix: Material, k1: PerTetrahedron, k2: PerTetrahedron, fibre: PerTetrahedron):
        families = sum(name.split("_")[0] == "k1" for name in getattr(matrix, "inputs", ()))
        names = [f"{name}_{families + 1}" if families else name for name in UNITS]
        self.units, self.shapes = dict(zip(names, UNITS.values())), {names[2]: (3,)}
        self.positive = {names[1]: "an exponent; 1e-6 makes fibres quadratic"}
        self.not_negative = {names[0]: "a stiffness [Pa]"}
        self._surround(matrix, dict(zip(names, (k1, k2, fibre))))

    def check(self, values):
        super().check(values)
        length = np.linalg.norm(values[self.own[2]], axis=-1)
        check_range(f"length of {self.own[2]}", length, 0, np.inf, False, "a direction needs a length")

    def lame(self, values):
        mu, lam = self.material.lame(self.inner(values))
        return mu + 2 * np.asarray(values[self.own[0]]), lam

    def law(self, precision):
        return SumLaw(precision, self.material.law(precision), FibreReinforcedLaw(precision))
