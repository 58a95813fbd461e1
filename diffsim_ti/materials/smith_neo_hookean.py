"""Neo-Hookean material without a singularity."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.differentiation.functions import x_minus_log1p_value
from diffsim_ti.materials.calculus.invariants import InvariantLaw
from diffsim_ti.materials.material import TwoModuli


@dataclass(frozen=True)
class SmithNeoHookeanLaw(InvariantLaw):
    """psi = m/2 (3/4 s + x - log(1 + x)) + l/2 j^2 with x = (I_C - 3) / 4 = (s + 2 j) / 4."""

    coefficient_names = ("m", "l")
    last_without_lam = (5 / 8,)

    @ti.func
    def psi(self, j, s, q, p):
        x = self.real(0.25) * (s + 2 * j)
        return self.real(0.5) * (p[0] * (self.real(0.75) * s + x_minus_log1p_value(x, self.fp)) + p[1] * j * j)

    @ti.func
    def slopes(self, j, s, q, p):
        i1 = s + 2 * j
        h = p[0] * i1 / (4 + i1)
        return self.real(0.25) * h + p[1] * j, self.real(0.125) * (3 * p[0] + h), 0

    @ti.func
    def curvatures(self, j, s, q, p):
        inverse = self.real(1) / (4 + s + 2 * j)
        h = self.real(0.5) * p[0] * inverse * inverse
        return 4 * h + p[1], 2 * h, h


class SmithNeoHookean(TwoModuli):
    """psi = m/2 (I_C - 3) + l/2 (J - alpha)^2 - m/2 log(I_C + 1) + constant, alpha = 1 + 3 m / (4 l), psi(I) = 0 [J/m^3];
    P = m (1 - 1/(I_C + 1)) F + (l (J - 1) - 3/4 m) cof F [Pa].

    Smooth for every F, and recovers from point, line and random collapse and from inversion; a body pressed exactly flat
    comes back as well. m = 4/3 mu and l = lam + 5/6 mu, so that E and nu are those of small strains.

    Arguments: see `Material`.
    Smith, De Goes, Kim 2018, Stable neo-Hookean flesh simulation, doi:10.1145/3180491.
    """

    from_lame = np.array([[4 / 3, 0], [5 / 6, 1]])
    to_lame = np.array([[3 / 4, 0], [-5 / 8, 1]])

    def law(self, precision: str) -> SmithNeoHookeanLaw:
        return SmithNeoHookeanLaw(precision)
