"""What the filling of a chamber pushes with, as a function of the volume V inside: a gas, or what holds a volume."""

import numpy as np

from diffsim_ti.terms import FilledChamber
from diffsim_ti.terms.gas_law import gas_law


class Gas:
    """p = p_0 (V_0 / V)^n - p_out of numbers (p_0, p_out, V_0, n)."""

    count, holds = 4, False

    def __init__(self):
        self.numbers = np.array([1.0, 0.0, 1.0, 1.0])

    def at(self, numbers: np.ndarray, share: float) -> None:
        """Numbers of a pass; share: of the load."""
        self.numbers, self.share = numbers, share

    def _law(self, V: float) -> np.ndarray:
        """p and its derivatives by the numbers and V; infinite where no volume is left."""
        return self.share * np.array(gas_law(*self.numbers.tolist(), float(V))) if V > 0 else np.full(6, np.inf)

    def pressure(self, V: float) -> float:
        """p [Pa]."""
        return float(self._law(V)[0])

    def slope(self, V: float) -> float:
        """dp/dV [Pa/m^3]."""
        return float(self._law(V)[5])

    def by_numbers(self, V: float) -> np.ndarray:
        """Derivatives of p by the numbers."""
        return self._law(V)[1:5]

    def work(self, V: float, change: float) -> float:
        """Integral of p dV from V to V + change [J]; of a volume that vanishes, minus infinity."""
        if not V + change > 0:
            return -np.inf
        m, grown = 1 - self.numbers[3], np.log1p(change / V)
        per_V = grown if abs(m * grown) < 1e-12 else np.expm1(m * grown) / m
        p0, outside, V0, n = self.numbers.tolist()
        absolute = gas_law(p0, 0.0, V0, n, float(V))[0]
        return self.share * (absolute * V * per_V - outside * change)


class PrescribedVolume:
    """What holds V at a target, of numbers (target, V_0): p = multiplier - gamma (V - volume), a penalty about `volume` that
    makes what is stable under the constraint stable without it (multipliers.py).

    In derivatives the target has the slope gamma, so that V less the target counts.
    """

    count, holds = 2, True

    def __init__(self):
        self.multiplier, self.gamma, self.volume, self.target = 0.0, 0.0, 0.0, 0.0

    def at(self, numbers: np.ndarray, share: float) -> None:
        """Numbers of a pass; share: of the way from V_0 to the target."""
        target, rest = numbers
        self.share, self.target = share, share * target + (1 - share) * rest

    def pressure(self, V: float) -> float:
        """p [Pa]."""
        return self.multiplier - self.gamma * (V - self.volume)

    def slope(self, V: float) -> float:
        """dp/dV [Pa/m^3]."""
        return -self.gamma

    def target_by_numbers(self) -> np.ndarray:
        """Derivatives of the target."""
        return np.array([self.share, 1 - self.share])

    def by_numbers(self, V: float) -> np.ndarray:
        """Derivatives of p by the numbers, the target having the slope gamma."""
        return self.gamma * self.target_by_numbers()

    def work(self, V: float, change: float) -> float:
        """Integral of p dV from V to V + change [J]; of a volume that vanishes, minus infinity."""
        return change * (self.pressure(V) - 0.5 * self.gamma * change) if V + change > 0 else -np.inf


def law_of(chamber) -> Gas | PrescribedVolume:
    """The law of a term (terms/chambers.py)."""
    return PrescribedVolume() if isinstance(chamber, FilledChamber) else Gas()
