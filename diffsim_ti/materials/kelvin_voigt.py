"""Viscosity beside elasticity: a stress that resists the rate of strain, whichever way a body turns."""

from dataclasses import dataclass, replace

from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.tensor import SIX, green_strain, green_strain_differential, hooke, six
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.law import Law, as_of
from diffsim_ti.materials.material import Material, PerTetrahedron
from diffsim_ti.materials.sum_law import SumLaw
from diffsim_ti.runtime import traced


@dataclass(frozen=True)
class ViscousLaw(EnergyLaw):
    """S = 2 eta R + lam_v tr(R) 1, with the rate R of Green's strain.

    In explicit passes R = sym(F^T F_dot), and phi = eta |R|^2 + lam_v/2 tr(R)^2. In implicit ones (`in_step`) R is
    rate (E - Z), Z the strain held: then S has the potential phi / rate, whose Hessian is symmetric, and a rigid turn from
    one state to the next has no rate.
    """

    in_step: bool = False

    coefficient_names = ("eta", "lam_v")

    @property
    def reads(self):
        return ("H",) if self.in_step else ("H", "H_dot")

    @property
    def frozen_names(self):
        return SIX if self.in_step else ()

    def psi(self, H, p):
        if self.in_step:
            eta, lam, *held, rate = p
            return hooke([a - b for a, b in zip(six(green_strain(H, 0.5)), held)], eta, lam) * rate

    def dissipation(self, H, H_dot, p):
        return hooke(six(green_strain_differential(H, H_dot, 0.5)), *p)


@dataclass(frozen=True)
class KelvinVoigtLaw(SumLaw):
    """P = P_base + F S. Who looks at a state, where nothing is held, sees the base alone."""

    viscous, title, in_step = True, Law.title, as_of("added", "in_step")
    state_names, initial_state = as_of("base", "state_names"), as_of("base", "initial_state")
    plastic, reads, frozen_names = as_of("base", "plastic"), as_of("added", "reads"), as_of("added", "frozen_names")

    @property
    def stored(self):
        return replace(self, base=self.base.stored)

    @property
    def dissipated(self):
        return self.base.dissipated and replace(self, base=self.base.dissipated)

    def in_steps(self):
        return replace(self, added=replace(self.added, in_step=True))

    @traced
    def _parts(self, q):
        n = 2 + len(self.base.coefficient_names) + len(self.base.state_names)
        return [*q[:2], *q[n:]], q[2:n]

    @traced
    def _terms(self, q):
        terms = super()._terms(q)
        return terms if len(terms[0][1]) > 2 else terms[1:]

    @traced
    def viscous_differential(self, H, dH, q):
        return replace(self.added, in_step=False).stress_at([H, dH], q[:2])

    # ---- of the velocity's gradient too ------------------------------------------------------------------------------

    @traced
    def stress_at(self, x, q):
        if self.in_step:
            return super().stress_at(x, q)
        own, p = self._parts(q)
        return self.base.stress(x[0], p) + self.added.stress_at(x, own)

    @traced
    def stress_jvp_at(self, x, dx, q, dq):
        if self.in_step:
            return super().stress_jvp_at(x, dx, q, dq)
        (own, p), (d_own, dp) = self._parts(q), self._parts(dq)
        return self.base.stress_jvp(x[0], dx[0], p, dp) + self.added.stress_jvp_at(x, dx, own, d_own)

    @traced
    def stress_vjp_at(self, x, W, q):
        if self.in_step:
            return super().stress_vjp_at(x, W, q)
        own, p = self._parts(q)
        dP, by_base = self.base.stress_differential_and_products(x[0], W, p)
        (by_H, by_rate), by_own = self.added.stress_vjp_at(x, W, own)
        return [dP + by_H, by_rate], self._joined(x[0], by_own, by_base)


class KelvinVoigt(Around):
    """Any material with viscosity: the second Piola-Kirchhoff stress has, besides the material's own,

        S = 2 eta E_dot + (zeta - 2/3 eta) tr(E_dot) 1 [Pa],  E_dot = sym(F^T F_dot) the rate of Green's strain.

    `KelvinVoigt(material, time=tau)` [s]: eta = tau mu, zeta = tau (lam + 2/3 mu) of the moduli of small strains, those of
    the isotropic part; so small vibrations of frequency omega have the damping ratio tau omega / 2 (Rayleigh's
    stiffness-proportional damping). Or `KelvinVoigt(material, shear_viscosity=eta, bulk_viscosity=zeta)` [Pa s]. Each is one
    number, one per tetrahedron or by sets, an input with gradient: viscous_time, or shear_viscosity and bulk_viscosity.

    S is free of any rigid motion, S : E_dot is never negative, and nothing in it is divided by, so that crushed elements
    have it too. What shows stresses and energies shows those of the material; static solves leave it out. Explicit
    steps take the velocity before the kick, which is of first order; their limit is (2 / omega) (sqrt(1 + xi^2) - xi),
    xi = tau omega / 2. Where xi is above 2, `SemiImplicitSolver(..., viscous_stages=)` goes further with less work.
    Implicit steps take (E - E_before) / h, a potential of the step: symmetric, zero for a rigid turn; the midpoint's, whose
    middle is no rigid turn, sees tau h omega^2 / 4 of strain in a spin, which does no work. In float32 such a difference has
    lost digits: gradients by viscosity are then good to 1e-3.
    volume="patches" does not support it.
    Simo, Hughes, Computational Inelasticity, 1998, ch. 10, doi:10.1007/b98904.
    Raises ValueError for negative numbers, both spellings together, and a material with a viscosity of its own.
    """

    units = {"viscous_time": "s", "shear_viscosity": "Pa s", "bulk_viscosity": "Pa s"}
    not_negative = dict.fromkeys(units, "viscosity takes energy away")
    remembers = False

    def __init__(
        self,
        material: Material,
        time: PerTetrahedron | None = None,
        shear_viscosity: PerTetrahedron | None = None,
        bulk_viscosity: PerTetrahedron | None = None,
    ):
        given = dict(viscous_time=time, shear_viscosity=shear_viscosity, bulk_viscosity=bulk_viscosity)
        given = {name: number for name, number in given.items() if number is not None}
        if tuple(given) not in (("viscous_time",), ("shear_viscosity", "bulk_viscosity")):
            raise ValueError(
                f"KelvinVoigt: needs time, or shear_viscosity and bulk_viscosity, got ({', '.join(given) or 'nothing'})"
            )
        self._surround(material, given)

    def lame(self, values):
        return self.material.lame(self.inner(values))

    def viscosities(self, values):
        return tuple(self.own_coefficients(self._numbers_of(values)))

    def own_coefficients(self, numbers):
        *own, mu, lam = numbers
        if len(own) == 1:
            return [own[0] * mu, own[0] * lam]
        return [own[0], own[1] - 2 / 3 * own[0]]

    def law(self, precision):
        return KelvinVoigtLaw(precision, self.material.law(precision), ViscousLaw(precision))
