"""Mooney-Rivlin material for rubber, compressible."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.materials.calculus import logarithm
from diffsim_ti.materials.calculus.invariants import InvariantLaw
from diffsim_ti.materials.material import Material, PerTetrahedron


@dataclass(frozen=True)
class MooneyRivlinLaw(InvariantLaw):
    """psi = c10 (s + 2 (j - log(1 + j))) + c01 (q + 2 s) + lam/2 j^2"""

    J_floor: float = 0.01

    coefficient_names = ("c10", "c01", "lam")
    uses_q = True
    couples_s = False

    @ti.func
    def psi(self, j, s, q, p):
        log_part = logarithm.value(j, self.floor(), self.fp)
        return p[0] * (s + 2 * log_part) + p[1] * (q + 2 * s) + self.real(0.5) * p[2] * j * j

    @ti.func
    def slopes(self, j, s, q, p):
        return 2 * p[0] * logarithm.slope(j, self.floor(), self.fp) + p[2] * j, p[0] + 2 * p[1], p[1]

    @ti.func
    def curvatures(self, j, s, q, p):
        return 2 * p[0] * logarithm.curvature(j, self.floor(), self.fp) + p[2], 0, 0

    @ti.func
    def floor(self):
        return self.real(self.J_floor - 1)


class MooneyRivlin(Material):
    """psi = c10 (I_C - 3 - 2 log J) + c01 (II_C - 3 - 4 (J - 1)) + lam/2 (J - 1)^2 [J/m^3], II_C = |cof F|^2.

    The volumetric parts make rest free of stress and keep small strains at mu = 2 (c10 + c01) and lam, with
    bulk modulus lam + 2/3 mu; polyconvex for lam >= 0. c01 = 0 is `StableNeoHookean`. Below `J_floor` the logarithm is
    continued as there, with the same promise.

    Arguments: see `Material`, with `c01_share` = c01 / (c10 + c01) in [0, 1), default 0.2; or the material's own
    c10 > 0, c01 >= 0 and bulk_modulus [Pa], larger than 4/3 (c10 + c01) if lateral contraction is to be positive.
    Ciarlet, Geymonat 1982, Sur les lois de comportement en elasticite non lineaire compressible.
    """

    spellings = (*Material.spellings, ("c10", "c01", "bulk_modulus"))
    to_lame = np.array([[2.0, 2, 0], [0, 0, 1]])
    positive, not_negative = dict.fromkeys(("c10", "bulk_modulus"), "a stiffness [Pa]"), {"c01": "a stiffness [Pa]"}

    def __init__(
        self,
        youngs_modulus: PerTetrahedron | None = None,
        poissons_ratio: PerTetrahedron | None = None,
        *,
        E: PerTetrahedron | None = None,
        nu: PerTetrahedron | None = None,
        mu: PerTetrahedron | None = None,
        lam: PerTetrahedron | None = None,
        c10: PerTetrahedron | None = None,
        c01: PerTetrahedron | None = None,
        bulk_modulus: PerTetrahedron | None = None,
        c01_share: float | None = None,
        J_floor: float = 0.01,
    ):
        self.c01_share = 0.2 if c01_share is None else float(c01_share)
        if not 0 <= self.c01_share < 1:
            raise ValueError(f"c01_share must lie in [0, 1), got {c01_share}: 0 is neo-Hookean, rubber has 0.1 to 0.3")
        numbers = dict(E=E, nu=nu, mu=mu, lam=lam, c10=c10, c01=c01, bulk_modulus=bulk_modulus)
        super().__init__(youngs_modulus, poissons_ratio, **numbers, J_floor=J_floor)
        own = self.inputs == self.spellings[-1]
        if own and c01_share is not None:
            raise ValueError("c01_share goes with E and nu or mu and lam; c10 and c01 already say it: leave it out")
        self._extra = "" if own else f", c01_share={self.c01_share:g}"

    @property
    def from_lame(self) -> np.ndarray:
        return np.array([[(1 - self.c01_share) / 2, 0], [self.c01_share / 2, 0], [0, 1]])

    @property
    def from_own(self) -> np.ndarray:
        """From (c10, c01, bulk_modulus) to the coefficients (c10, c01, lam), lam = K - 4/3 (c10 + c01)."""
        return np.array([[1, 0, 0], [0, 1, 0], [-4 / 3, -4 / 3, 1]])

    def law(self, precision: str) -> MooneyRivlinLaw:
        return MooneyRivlinLaw(precision, self.J_floor)
