"""Viscosity beside elasticity: a stress that resists the rate of strain, whichever way a body turns."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.green import (
    SIX,
    adjoint_of_six,
    green_strain,
    green_strain_differential,
    of_six,
    symmetric,
)
from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner
from diffsim_ti.materials.law import Law
from diffsim_ti.materials.material import Material, check_range
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class KelvinVoigtLaw(Law):
    """P = P_base + F S, S = 2 eta R + lam_v tr(R) 1, with the rate R of Green's strain.

    In explicit passes R = sym(F^T F_dot). In implicit ones (`in_step`) R = rate (E - Z), Z the strain held: then S has the
    potential 1 / (2 rate) R : S, whose Hessian is symmetric, and a rigid turn from one state to the next has no rate.
    """

    base: Law | None = None
    in_step: bool = False

    viscous = True

    @property
    def coefficient_names(self):
        return ("eta", "lam_v", *self.base.coefficient_names)

    @property
    def state_names(self):
        return self.base.state_names

    @property
    def initial_state(self):
        return self.base.initial_state

    @property
    def reads(self):
        return ("H",) if self.in_step else ("H", "H_dot")

    @property
    def held_names(self):
        return SIX if self.in_step else ()

    @property
    def lanes(self):
        return self.base.lanes

    def in_steps(self):
        return replace(self, in_step=True)

    # ---- parts -------------------------------------------------------------------------------------------------------

    @traced
    def _parts(self, q):
        """((eta, lam_v), what the base takes, what is held in a pass and the rate: none for who looks at a state)"""
        n = 2 + len(self.base.coefficient_names) + len(self.base.state_names)
        return q[:2], q[2:n], q[n:]

    @traced
    def _viscous(self, R, c):
        """S"""
        return add_to_diagonal(R * let(2 * c[0]), let(c[1] * R.trace()))

    @traced
    def _rate_in_step(self, H, held):
        return (green_strain(H, self.real(0.5)) - of_six(held[:6])) * held[6]

    @traced
    def _rate(self, H, H_dot):
        return green_strain_differential(H, H_dot, self.real(0.5))

    @traced
    def _push(self, H, S):
        """F S"""
        return add_to_diagonal(H, 1) @ S

    @traced
    def _by_viscosities(self, A, R):
        """A : dS/d(eta, lam_v), A being symmetric"""
        return [let(2 * inner(A, R)), let(A.trace() * R.trace())]

    # ---- of the displacement gradient, and of what is held -----------------------------------------------------------

    @traced
    def energy_density(self, H, q):
        c, own, held = self._parts(q)
        psi = self.base.energy_density(H, own)
        if not held:
            return psi
        E = green_strain(H, self.real(0.5)) - of_six(held[:6])
        return psi + self.real(0.5) * inner(E, self._viscous(E * held[6], c))

    @traced
    def energy_by_coefficients(self, H, q):
        zero = let(H[0, 0] * 0)
        return [zero, zero, *self.base.energy_by_coefficients(H, self._parts(q)[1])]

    @traced
    def stress(self, H, q):
        c, own, held = self._parts(q)
        P = self.base.stress(H, own)
        return P + self._push(H, self._viscous(self._rate_in_step(H, held), c)) if held else P

    @traced
    def stress_differential(self, H, dH, q):
        c, own, held = self._parts(q)
        dP = self.base.stress_differential(H, dH, own)
        if not held:
            return dP
        S = self._viscous(self._rate_in_step(H, held), c)
        return dP + dH @ S + self.viscous_differential(H, dH, q) * held[6]

    @traced
    def stress_change(self, H, q, dq):
        (c, own, held), (dc, d_own, d_held) = self._parts(q), self._parts(dq)
        dP = self.base.stress_change(H, own, d_own)
        if not held:
            return dP
        dS = self._viscous(self._rate_in_step(H, held), dc) - self._viscous(of_six(d_held[:6]) * held[6], c)
        return dP + self._push(H, dS)

    @traced
    def stress_differential_and_products(self, H, dH, q):
        c, own, held = self._parts(q)
        dP, products = self.base.stress_differential_and_products(H, dH, own)
        zero = let(H[0, 0] * 0)
        if not held:
            return dP, [zero, zero, *products]
        R, A = self._rate_in_step(H, held), self._rate(H, dH)
        CA = self._viscous(A, c) * held[6]
        dP = dP + dH @ self._viscous(R, c) + self._push(H, CA)
        by_held = adjoint_of_six(CA * self.real(-1))
        return dP, [*self._by_viscosities(A, R), *products, *by_held, zero]

    @traced
    def viscous_differential(self, H, dH, q):
        return self._push(H, self._viscous(self._rate(H, dH), q[:2]))

    # ---- of the velocity's gradient too ------------------------------------------------------------------------------

    @traced
    def stress_at(self, x, q):
        return self.stress(*x, q) if self.in_step else self.stress(x[0], q) + self.viscous_differential(*x, q)

    @traced
    def stress_jvp_at(self, x, dx, q, dq):
        dP = self.stress_jvp(x[0], dx[0], q, dq)
        if self.in_step:
            return dP
        (H, H_dot), (dH, dH_dot) = x, dx
        R = self._rate(H, H_dot)
        dR = self._rate(H, dH_dot) + symmetric(dH.transpose() @ H_dot, self.real(0.5))
        dS = self._viscous(dR, q[:2]) + self._viscous(R, dq[:2])
        return dP + dH @ self._viscous(R, q[:2]) + self._push(H, dS)

    @traced
    def stress_vjp_at(self, x, W, q):
        dP, products = self.stress_differential_and_products(x[0], W, q)
        if self.in_step:
            return [dP], products
        H, H_dot = x
        R, A = self._rate(H, H_dot), self._rate(H, W)
        CA = self._viscous(A, q[:2])
        by_H = dP + W @ self._viscous(R, q[:2]) + H_dot @ CA
        return [by_H, self._push(H, CA)], [*self._by_viscosities(A, R), *products[2:]]

    # ---- the state of the base ---------------------------------------------------------------------------------------

    @traced
    def next_state_at(self, H, q, h):
        return self.base.next_state_at(H, q[2:], h)

    @traced
    def next_state_jvp(self, H, dH, q, dq, h):
        return self.base.next_state_jvp(H, dH, q[2:], dq[2:], h)

    @traced
    def next_state_vjp(self, H, q, h, z_adj):
        by_H, by_q = self.base.next_state_vjp(H, q[2:], h, z_adj)
        zero = let(H[0, 0] * 0)
        return by_H, [zero, zero, *by_q]


class KelvinVoigt(Around):
    """Any material with viscosity: the second Piola-Kirchhoff stress has, besides the material's own,

        S = 2 eta E_dot + (zeta - 2/3 eta) tr(E_dot) 1 [Pa],  E_dot = sym(F^T F_dot) the rate of Green's strain.

    `KelvinVoigt(material, time=tau)` [s]: eta = tau mu, zeta = tau (lam + 2/3 mu) of the moduli of small strains, those of
    the isotropic part; so small vibrations of frequency omega have the damping ratio tau omega / 2 (Rayleigh's
    stiffness-proportional damping). Or `KelvinVoigt(material, shear_viscosity=eta, bulk_viscosity=zeta)` [Pa s]. Each is one
    number, one per tetrahedron or by sets, an input with gradient: viscous_time, or shear_viscosity and bulk_viscosity.

    S is free of any rigid motion, S : E_dot is never negative, and nothing in it is divided by, so that crushed elements
    have it too. What shows stresses and energies shows those of the material; statics leave it out. Explicit steps take the
    velocity before the kick, which is of first order; their limit is (2 / omega) (sqrt(1 + xi^2) - xi), xi = tau omega / 2.
    Where xi is above 2, `SemiImplicitSolver(..., viscous_stages=)` goes further with less work.
    Implicit steps take (E - E_before) / h, a potential of the step: symmetric, zero for a rigid turn; the midpoint's, whose
    middle is no rigid turn, sees tau h omega^2 / 4 of strain in a spin, which does no work. In float32 such a difference has
    lost digits: gradients by viscosity are then good to 1e-3.
    volume="patches" does not support it.
    Simo, Hughes, Computational Inelasticity, 1998, ch. 10, doi:10.1007/b98904.
    Raises ValueError for negative numbers, both spellings at once, and a material with a viscosity of its own.
    """

    units = {"viscous_time": "s", "shear_viscosity": "Pa s", "bulk_viscosity": "Pa s"}
    remembers = False

    def __init__(
        self,
        material: Material,
        time: ArrayLike | dict | None = None,
        shear_viscosity: ArrayLike | dict | None = None,
        bulk_viscosity: ArrayLike | dict | None = None,
    ):
        given = dict(viscous_time=time, shear_viscosity=shear_viscosity, bulk_viscosity=bulk_viscosity)
        given = {name: number for name, number in given.items() if number is not None}
        if tuple(given) not in (("viscous_time",), ("shear_viscosity", "bulk_viscosity")):
            raise ValueError(
                f"KelvinVoigt: needs time, or shear_viscosity and bulk_viscosity, got ({', '.join(given) or 'nothing'})"
            )
        self._surround(material, given)

    def check(self, values):
        super().check(values)
        for name in self.own:
            check_range(name, values[name], 0, np.inf, True, "viscosity takes energy away")

    def lame(self, values):
        return self.material.lame(self.inner(values))

    def viscosities(self, values):
        return tuple(self.own_coefficients(*self._numbers_of(values)))

    def own_coefficients(self, *numbers):
        *own, mu, lam = numbers
        if len(own) == 1:
            return [own[0] * mu, own[0] * lam]
        return [own[0], own[1] - 2 / 3 * own[0]]

    def own_jvp(self, numbers, changes):
        (*own, mu, lam), (*d_own, dmu, dlam) = numbers, changes
        if len(own) == 1:
            return [d_own[0] * mu + own[0] * dmu, d_own[0] * lam + own[0] * dlam]
        return self.own_coefficients(*changes)

    def own_vjp(self, numbers, by_columns):
        *own, mu, lam = numbers
        by_eta, by_lam = by_columns
        if len(own) == 1:
            return [by_eta * mu + by_lam * lam, own[0] * by_eta, own[0] * by_lam]
        return [by_eta - 2 / 3 * by_lam, by_lam, 0 * by_eta, 0 * by_lam]

    def law(self, precision):
        return KelvinVoigtLaw(precision, self.material.law(precision))
