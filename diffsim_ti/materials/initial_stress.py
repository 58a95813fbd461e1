"""A stress at rest: press fits, residual stress, pre-tensioned membranes."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.tensor import green_strain, inner, of_six
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron
from diffsim_ti.materials.sum_law import SumLaw


@dataclass(frozen=True)
class InitialStressLaw(EnergyLaw):
    """psi = S : E of a constant second Piola-Kirchhoff stress S and Green's strain E."""

    coefficient_names = ("S_xx", "S_yy", "S_zz", "S_yz", "S_xz", "S_xy")

    def psi(self, H, p):
        return inner(of_six(p), green_strain(H, 0.5))


class InitialStress(Around):
    """`InitialStress(material, stress)`: any elastic material with a stress at rest, which turns with the body:

        psi = psi_material + S : E [J/m^3], P = P_material + F S [Pa],  E = (F^T F - I) / 2.

    stress: S = (xx, yy, zz, yz, xz, xy) [Pa], tension positive: the second Piola-Kirchhoff stress, and Cauchy's at rest; of
    shape (6,), or (num_tetrahedra, 6), or by sets; an input with gradient, "initial_stress". A `StaticSolver` finds the
    equilibrium of the unloaded body; other solvers begin with what is out of balance, unless S balances itself. Tension
    stiffens, also what `modes` take at rest, and enough compression makes the body buckle.
    A stretch at rest is `Grown(material, strain=e)`; for small e its stress is -C : e. Energies are those above, negative
    where a body has relaxed.
    Holzapfel, Nonlinear Solid Mechanics, 2000, ch. 6.
    Raises ValueError for other shapes, and a material that has a state or a viscosity: these go around this one.
    """

    takes_moduli = False
    shapes = {"initial_stress": (6,)}
    units = {"initial_stress": "Pa"}

    def __init__(self, material: Material, stress: PerTetrahedron):
        if "initial_stress" in getattr(material, "inputs", ()):
            raise ValueError(f"InitialStress: {material.name} has a stress at rest already; add both up in one")
        self._surround(material, dict(initial_stress=stress))

    def lame(self, values):
        mu, lam = self.material.lame(self.inner(values))
        S = values["initial_stress"] * np.sqrt([1, 1, 1, 2, 2, 2])
        return mu + np.linalg.norm(S, axis=-1) / 2, lam  # at least its largest principal value

    def law(self, precision):
        return SumLaw(precision, self.material.law(precision), InitialStressLaw(precision))
