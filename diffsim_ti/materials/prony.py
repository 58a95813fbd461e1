"""Relaxation: springs with dashpots in series beside a material (the generalised Maxwell model)."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import exp
from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.tensor import SIX, green_strain, hooke, six
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron, number_of_terms
from diffsim_ti.materials.sum_law import SumLaw


@dataclass(frozen=True)
class PronyLaw(EnergyLaw):
    """Of branches: psi = sum_i g_i (mu |E - z_i|^2 + lam/2 tr(E - z_i)^2); dz_i/dt = (E - z_i) / tau_i, solved
    exactly for a frozen E."""

    terms: int = 1

    @property
    def coefficient_names(self):
        names = range(1, self.terms + 1)
        return (*(f"g_{k}" for k in names), *(f"tau_{k}" for k in names), "mu", "lam")

    @property
    def state_names(self):
        return tuple(f"z_{k}_{pair}" for k in range(1, self.terms + 1) for pair in SIX)

    def psi(self, H, p, z):
        E, total = six(green_strain(H, 0.5)), 0
        for k in range(self.terms):
            total = p[k] * hooke([a - b for a, b in zip(E, z[6 * k : 6 * k + 6])], p[-2], p[-1]) + total
        return total

    def next_state(self, H, p, z, h):
        E, out = six(green_strain(H, 0.5)), []
        for k in range(self.terms):
            share = 1 - exp(-h / p[self.terms + k])
            out += [b + share * (a - b) for a, b in zip(E, z[6 * k : 6 * k + 6])]
        return out


class Prony(Around):
    """Any elastic material beside N Maxwell branches, a spring and a dashpot in series each (a Prony series):

        S = S_material(F) + sum_i g_i C : (E - z_i) [Pa],  dz_i/dt = (E - z_i) / tau_i,  z_i = 0 at the start,

    S the second Piola-Kirchhoff stress, E Green's strain, C : E = 2 mu E + lam tr(E) 1 with the moduli of small strains of
    the isotropic part. `Prony(material, shares, times)`: g_i >= 0 [-], of the moduli that last, which are the material's,
    and tau_i > 0 [s], N numbers for all or of shape (num_tetrahedra, N); inputs with gradient, prony_shares and
    prony_times. At once the body is 1 + sum g_i times as stiff, and at constant strain the stress relaxes by exp(-t /
    tau_i). A series given as shares a_i of the instantaneous modulus E_0 has g_i = a_i / (1 - sum a), and the material E
    = (1 - sum a) E_0.

    z_i are numbers of each tetrahedron that a run keeps with its state, moved on exactly for the strain of each substep
    (law.py: of first order in its length). The stress has an energy, and what is lost [W/m^3],
    sum g_i / tau_i (E - z_i) : C : (E - z_i), is never negative; crushed elements have it too. Viscosity goes around it:
    `KelvinVoigt(Prony(...), time=...)`.
    `Stress`, `Reaction` and `ElasticEnergy` take the state of each frame. Static solves and volume="patches" do not support
    it: what lasts is the material inside.
    Simo, Hughes, Computational Inelasticity, 1998, ch. 10.3, doi:10.1007/b98904.
    Raises ValueError for numbers out of range, and a material that has a state or a viscosity.
    """

    units = {"prony_shares": "-", "prony_times": "s"}
    positive, not_negative = {"prony_times": "a time [s]"}, {"prony_shares": "a share of the moduli that last"}

    def __init__(self, material: Material, shares: PerTetrahedron, times: PerTetrahedron):
        self.terms = number_of_terms("Prony", "branch", shares=shares, times=times)
        self.shapes = {"prony_shares": (self.terms,), "prony_times": (self.terms,)}
        self._surround(material, dict(prony_shares=shares, prony_times=times))

    def lame(self, values):
        mu, lam = self.material.lame(self.inner(values))
        own_mu, own_lam = self.isotropic.lame(self._moduli_values(values))
        shares = np.asarray(values["prony_shares"]).sum(-1)
        return mu + shares * own_mu, lam + shares * own_lam

    def law(self, precision):
        return SumLaw(precision, self.material.law(precision), PronyLaw(precision, self.terms))
