"""Kicks of a substep that let viscosity be stiffer than the substep is short."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

LEFT = 0.3  # |P| where it swings: smaller ones cost stages, larger ones cost length of the substep
MOST = 32


@dataclass(frozen=True)
class ViscousStages:
    """A kick of a whole substep h in `stages` kicks h t_k, sum t_k = 1, at one displacement, before one drift.

    The velocity's motion C v at a rate c has then gone on by P(h c), and elastic forces by Q(h c),

        P(z) = prod_k (1 - t_k z) = LEFT T_s(w - (1 + w) z / beta),   Q(z) = (1 - P(z)) / z,   T_s(w) = 1 / LEFT,

    T_s the polynomial of Chebyshev, so that |P| <= 1 up to z = beta, which grows with the square of `stages`. A motion
    multiplied by m in a substep has m^2 - m (1 + P - h^2 Q K) + P = 0, whose roots are within the unit circle where
    |P| <= 1 and h^2 K <= 2 (1 + P) / Q. So a substep is stable, whatever stiffness and damping are to each other, for

        h <= beta / c_max,   h <= 2 share / omega_max,   share^2 = min over z of z / 2 (1 + P) / (1 - P).

    One stage is an ordinary kick: h <= (2 / omega) (sqrt(1 + xi^2) - xi), xi = c / (2 omega).
    Alexiades, Amiez, Gremaud 1996, Super-time-stepping acceleration of explicit schemes for parabolic problems,
    doi:10.1002/(SICI)1099-0887(199601)12:1<31::AID-CNM950>3.0.CO;2-5.
    """

    stages: int = 1

    @cached_property
    def _w(self) -> float:
        return float(np.cosh(np.arccosh(1 / LEFT) / self.stages))

    @cached_property
    def beta(self) -> float:
        """The largest h c."""
        slope = self.stages * np.sinh(self.stages * np.arccosh(self._w)) / np.sinh(np.arccosh(self._w))
        return float((1 + self._w) * LEFT * slope)

    @cached_property
    def kicks(self) -> np.ndarray:
        """t_k, in an order in which no part of the product grows much (that of Leja)."""
        if self.stages == 1:
            return np.ones(1)
        x = np.cos((2 * np.arange(self.stages) + 1) * np.pi / (2 * self.stages))
        roots = list((self._w - x) / (1 + self._w) * self.beta)
        order = [roots.pop(int(np.argmax(roots)))]
        while roots:
            far = [np.sum(np.log(np.abs(root - np.array(order)))) for root in roots]
            order.append(roots.pop(int(np.argmax(far))))
        return 1 / np.array(order)

    @cached_property
    def share(self) -> float:
        """Of the elastic limit."""
        z = np.linspace(0, self.beta, 4001)[1:]
        left = self.left(z)
        return float(np.sqrt(np.min(z / 2 * (1 + left) / (1 - left)))) * 0.999  # between the points looked at

    def left(self, z: np.ndarray) -> np.ndarray:
        """P(z)."""
        return np.prod(1 - self.kicks * np.asarray(z)[..., None], -1)

    def squared_rate(self, omega2, c):
        """(2 / h)^2 of the longest stable substep h of stiffness omega2 [1/s^2] and damping c [1/s]."""
        if self.stages == 1:
            return (0.5 * (c + np.sqrt(c * c + 4 * omega2))) ** 2
        return np.maximum(omega2 / self.share**2, (2 * c / self.beta) ** 2)
