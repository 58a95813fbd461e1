"""Rubber that relaxes: a spring beside a spring and a dashpot in series (Zener), in the strain of Green."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import exp
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import invariants
from diffsim_ti.materials.material import check_range

PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # of a symmetric tensor


def green_strain(H) -> list:
    """Six numbers of E = (H + H^T + H^T H) / 2."""
    G = H + H.transpose() + H.transpose() @ H
    return [G[i, j] * 0.5 for i, j in PAIRS]


@dataclass(frozen=True)
class RelaxingLaw(EnergyLaw):
    """psi = mu/2 (I_C - 3 - 2 (J - 1)) + lam/2 (J - 1)^2 + g |E - z|^2; z, the dashpot's strain, follows E within tau:

    dz/dt = (E - z) / tau, so that z' = z + (1 - exp(-h / tau)) (E - z) while E is held.
    """

    coefficient_names = ("mu", "lam", "g", "tau")
    state_names = ("z_xx", "z_yy", "z_zz", "z_yz", "z_xz", "z_xy")

    def psi(self, H, p, z):
        mu, lam, g, _ = p
        _, j, s = invariants(H)
        e = [a - b for a, b in zip(green_strain(H), z)]
        size = sum(x * x for x in e[:3]) + 2 * sum(x * x for x in e[3:])
        return mu / 2 * s + lam / 2 * j * j + g * size

    def next_state(self, H, p, z, h):
        share = 1 - exp(-h / p[3])
        return [b + share * (a - b) for a, b in zip(green_strain(H), z)]


class RelaxingRubber(Material):
    """mu, lam [Pa] of what lasts, g [Pa] of what relaxes, within the time tau [s].

    Simo 1987, On a fully three-dimensional finite-strain viscoelastic damage model, doi:10.1016/0045-7825(87)90107-1.
    """

    spellings = (("mu", "lam", "g", "tau"),)
    units = {"tau": "s"}

    def law(self, precision):
        return RelaxingLaw(precision)

    def check(self, values):
        super().check(values)
        check_range("g", values["g"], 0, np.inf, True, "a stiffness [Pa]")
        check_range("tau", values["tau"], 0, np.inf, False, "a time [s]")

    def lame(self, values):
        return np.asarray(values["mu"]) + values["g"], np.asarray(values["lam"]) + 0 * values["g"]
