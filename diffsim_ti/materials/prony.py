"""Relaxation: springs with dashpots in series beside a material (the generalised Maxwell model)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import shape_of
from diffsim_ti.differentiation import exp
from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.green import PAIRS, SIX
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.law import Law
from diffsim_ti.materials.material import Material, check_range
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class BranchesLaw(EnergyLaw):
    """psi = sum_i g_i (mu |E - z_i|^2 + lam/2 tr(E - z_i)^2); dz_i/dt = (E - z_i) / tau_i, solved exactly for a held E."""

    terms: int = 1

    @property
    def coefficient_names(self):
        names = range(1, self.terms + 1)
        return (*(f"g_{k}" for k in names), *(f"tau_{k}" for k in names), "mu", "lam")

    @property
    def state_names(self):
        return tuple(f"z_{k}_{pair}" for k in range(1, self.terms + 1) for pair in SIX)

    def _strain(self, H):
        G = H + H.transpose() + H.transpose() @ H
        return [G[i, j] * 0.5 for i, j in PAIRS]

    def psi(self, H, p, z):
        mu, lam, E, total = p[-2], p[-1], self._strain(H), 0
        for k in range(self.terms):
            e = [a - b for a, b in zip(E, z[6 * k : 6 * k + 6])]
            trace, size = sum(e[:3]), sum(x * x for x in e[:3]) + 2 * sum(x * x for x in e[3:])
            total = p[k] * (mu * size + lam / 2 * trace * trace) + total
        return total

    def next_state(self, H, p, z, h):
        E, out = self._strain(H), []
        for k in range(self.terms):
            share = 1 - exp(-h / p[self.terms + k])
            out += [b + share * (a - b) for a, b in zip(E, z[6 * k : 6 * k + 6])]
        return out


@dataclass(frozen=True)
class PronyLaw(Law):
    """The sum of a law and of branches, whose coefficients come first."""

    base: Law | None = None
    terms: int = 1

    @property
    def branches(self) -> BranchesLaw:
        return BranchesLaw(self.precision, terms=self.terms)

    @property
    def coefficient_names(self):
        return (*self.branches.coefficient_names, *self.base.coefficient_names)

    @property
    def state_names(self):
        return self.branches.state_names

    @property
    def lanes(self):
        return self.base.lanes

    @traced
    def _parts(self, q):
        """(what the branches take, what the base takes)"""
        first, last = 2 * self.terms + 2, len(self.coefficient_names)
        return [*q[:first], *q[last:]], q[first:last]

    @traced
    def _joined(self, of_branches, of_base):
        first = 2 * self.terms + 2
        return [*of_branches[:first], *of_base, *of_branches[first:]]

    @traced
    def energy_density(self, H, q):
        own, p = self._parts(q)
        return self.branches.energy_density(H, own) + self.base.energy_density(H, p)

    @traced
    def energy_by_coefficients(self, H, q):
        own, p = self._parts(q)
        return self._joined(self.branches.energy_by_coefficients(H, own), self.base.energy_by_coefficients(H, p))

    @traced
    def stress(self, H, q):
        own, p = self._parts(q)
        return self.branches.stress(H, own) + self.base.stress(H, p)

    @traced
    def stress_differential(self, H, dH, q):
        own, p = self._parts(q)
        return self.branches.stress_differential(H, dH, own) + self.base.stress_differential(H, dH, p)

    @traced
    def stress_change(self, H, q, dq):
        (own, p), (d_own, dp) = self._parts(q), self._parts(dq)
        return self.branches.stress_change(H, own, d_own) + self.base.stress_change(H, p, dp)

    @traced
    def stress_differential_and_products(self, H, dH, q):
        own, p = self._parts(q)
        of_branches, by_branches = self.branches.stress_differential_and_products(H, dH, own)
        of_base, by_base = self.base.stress_differential_and_products(H, dH, p)
        return of_branches + of_base, self._joined(by_branches, by_base)

    @traced
    def next_state_at(self, H, q, h):
        return self.branches.next_state_at(H, self._parts(q)[0], h)

    @traced
    def next_state_jvp(self, H, dH, q, dq, h):
        return self.branches.next_state_jvp(H, dH, self._parts(q)[0], self._parts(dq)[0], h)

    @traced
    def next_state_vjp(self, H, q, h, z_adj):
        by_H, by_branches = self.branches.next_state_vjp(H, self._parts(q)[0], h, z_adj)
        zero = let(H[0, 0] * 0)
        return by_H, self._joined(by_branches, [zero] * len(self.base.coefficient_names))


class Prony(Around):
    """Any elastic material beside N Maxwell branches, a spring and a dashpot in series each (a Prony series):

        S = S_material(F) + sum_i g_i C : (E - z_i) [Pa],  dz_i/dt = (E - z_i) / tau_i,  z_i = 0 at the start,

    S the second Piola-Kirchhoff stress, E Green's strain, C : E = 2 mu E + lam tr(E) 1 with the moduli of small strains of
    the isotropic part. `Prony(material, shares, times)`: g_i >= 0 [-], of the moduli that last, which are the material's,
    and tau_i > 0 [s], N numbers for all or of shape (num_tetrahedra, N); inputs with gradient, prony_shares and
    prony_times. At once the body is 1 + sum g_i times as stiff, and a held strain relaxes by exp(-t / tau_i). A series given
    as shares a_i of what is stiff at once has g_i = a_i / (1 - sum a).

    z_i are numbers of each tetrahedron that a run keeps with its state, moved on exactly for the strain of each substep
    (law.py: of first order in its length). The stress has an energy, and what is lost [W/m^3],
    sum g_i / tau_i (E - z_i) : C : (E - z_i), is never negative; crushed elements have it too. Viscosity goes around it:
    `KelvinVoigt(Prony(...), time=...)`.
    Static solves and volume="patches" do not support it.
    Simo, Hughes, Computational Inelasticity, 1998, ch. 10.3, doi:10.1007/b98904.
    Raises ValueError for numbers out of range, and a material that has a state or a viscosity.
    """

    units = {"prony_shares": "-", "prony_times": "s"}

    def __init__(self, material: Material, shares: ArrayLike | dict, times: ArrayLike | dict):
        firsts = [next(iter(x.values())) if isinstance(x, dict) and x else x for x in (shares, times)]
        of_terms = [shape_of(name, x) for name, x in zip(("shares", "times"), firsts)]
        if not all(of_terms) or of_terms[0][-1] != of_terms[1][-1] or not of_terms[0][-1]:
            raise ValueError(
                f"Prony: shares and times need one number for each branch, got shapes {of_terms[0]} and {of_terms[1]}"
            )
        self.terms = of_terms[0][-1]
        self.shapes = {"prony_shares": (self.terms,), "prony_times": (self.terms,)}
        self._surround(material, dict(prony_shares=shares, prony_times=times))

    def check(self, values):
        super().check(values)
        check_range("prony_shares", values["prony_shares"], 0, np.inf, True, "a share of the moduli that last")
        check_range("prony_times", values["prony_times"], 0, np.inf, False, "a time [s]")

    def lame(self, values):
        mu, lam = self.material.lame(self.inner(values))
        own_mu, own_lam = self.isotropic.lame(self._moduli_values(values))
        shares = np.asarray(values["prony_shares"]).sum(-1)
        return mu + shares * own_mu, lam + shares * own_lam

    def own_coefficients(self, *numbers):
        g, tau, mu, lam = numbers
        return [*(g[..., k] for k in range(self.terms)), *(tau[..., k] for k in range(self.terms)), mu, lam]

    def own_jvp(self, numbers, changes):
        return self.own_coefficients(*changes)

    def own_vjp(self, numbers, by_columns):
        n = self.terms
        return [np.stack(by_columns[:n], -1), np.stack(by_columns[n : 2 * n], -1), *by_columns[2 * n :]]

    def law(self, precision):
        return PronyLaw(precision, self.material.law(precision), self.terms)
