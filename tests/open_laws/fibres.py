"""Tissue with fibres (Holzapfel, Gasser, Ogden): a direction for each tetrahedron, felt where fibres are stretched."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation import exp, maximum, x_minus_log1p
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import invariants
from diffsim_ti.materials.material import check_range


@dataclass(frozen=True)
class FibreLaw(EnergyLaw):
    """psi = mu/2 (I_C - 3) - mu log J + lam/2 (J - 1)^2 + k1/(2 k2) (exp(k2 e^2) - 1), e = max(a . C a - 1, 0)"""

    coefficient_names = ("mu", "lam", "k1", "k2", "a_x", "a_y", "a_z")

    def psi(self, H, p):
        mu, lam, k1, k2, *a = p
        _, j, s = invariants(H)
        G = H + H.transpose() + H.transpose() @ H  # C - I
        along = sum(a[i] * G[i, k] * a[k] for i in range(3) for k in range(3))
        e = maximum(along / sum(x * x for x in a), 0)
        return mu / 2 * s + mu * x_minus_log1p(j) + lam / 2 * j * j + k1 / (2 * k2) * (exp(k2 * e * e) - 1)

    def theta(self, H):
        return invariants(H)[1]


class FibreTissue(Material):
    """mu, lam, k1 [Pa], k2 [-], fibre: a direction of any length, shape (3,) or (num_tetrahedra, 3).

    Holzapfel, Gasser, Ogden 2000, A new constitutive framework for arterial wall mechanics, doi:10.1023/A:1010835316564.
    """

    spellings = (("mu", "lam", "k1", "k2", "fibre"),)
    units = {"k2": "-", "fibre": "-"}
    shapes = {"fibre": (3,)}

    def law(self, precision):
        return FibreLaw(precision)

    def check(self, values):
        super().check(values)
        length = np.linalg.norm(values["fibre"], axis=-1)
        check_range("length of fibre", length, 0, np.inf, False, "a direction needs a length")

    def lame(self, values):
        return values["mu"] + 2 * values["k1"], values["lam"]
