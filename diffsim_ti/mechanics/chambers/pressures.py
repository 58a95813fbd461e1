"""Pressures of chambers, as functions of the volume V inside: of a gas, or of what holds a volume."""

import numpy as np

from diffsim_ti.differentiation.arrays import value_of, with_slopes
from diffsim_ti.mechanics.pressure.follower_pressure import FollowerPressure, Tangent, pressures_at
from diffsim_ti.terms import Chamber, FilledChamber, Pressure
from diffsim_ti.terms.chambers import gas_law


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
        self.share = share
        self.target = self.goal(numbers)

    def pressure(self, V: float) -> float:
        """p [Pa]."""
        return self.multiplier - self.gamma * (V - self.volume)

    def slope(self, V: float) -> float:
        """dp/dV [Pa/m^3]."""
        return -self.gamma

    def goal(self, numbers: np.ndarray) -> np.ndarray:
        """The target; of numbers that record, too."""
        return self.share * numbers[0] + (1 - self.share) * numbers[1]

    def by_numbers(self, V: float) -> np.ndarray:
        """Derivatives of p by the numbers, the target having the slope gamma."""
        return self.gamma * np.array([self.share, 1 - self.share])

    def work(self, V: float, change: float) -> float:
        """Integral of p dV from V to V + change [J]; of a volume that vanishes, minus infinity."""
        return change * (self.pressure(V) - 0.5 * self.gamma * change) if V + change > 0 else -np.inf


def law_of(chamber) -> Gas | PrescribedVolume:
    """The law of a term (terms/chambers.py)."""
    return PrescribedVolume() if isinstance(chamber, FilledChamber) else Gas()


def rows_of(scene, chambers) -> list[slice]:
    """Rows of the numbers of some of a scene's chambers in `Derived.follower`, in which those of pressures come first."""
    every = scene.terms_of(Pressure, Chamber)
    ends = np.cumsum([0, *(len(term.rows_in_time("")) for term in every)]).tolist()
    return [slice(*ends[k : k + 2]) for k in map(every.index, chambers)]


class ChamberPressure(FollowerPressure):
    """Of some of a scene's chambers.

    The force of a chamber is p(V) g, g = dV/dx of what is free; its tangent is that of the pressure p and p'(V) g (x) dV/dx.
    """

    def __init__(self, scene, chambers):
        faces = [chamber.enclosure.faces for chamber in chambers]
        load_of = np.repeat(np.arange(len(faces)), [len(rows) for rows in faces])
        super().__init__(np.concatenate(faces), load_of, scene.mesh.num_vertices)
        self.enclosures = [chamber.enclosure for chamber in chambers]
        self.laws = [law_of(chamber) for chamber in chambers]
        self.places = [scene.terms_of(Chamber).index(chamber) for chamber in chambers]
        self.rows = rows_of(scene, chambers)

    def restrict(self, free, rest):
        """Chambers are closed."""

    def at(self, numbers: np.ndarray, share: float = 1.0) -> "ChamberPressure":
        """With a share of what the numbers of all pressures and chambers say."""
        self.numbers = [numbers[rows] for rows in self.rows]
        for law, own in zip(self.laws, self.numbers):
            law.at(np.asarray(value_of(own), np.float64), share)
        return self

    def take(self, values, instant):
        self.values, self.instant, self.rest = values, instant, values.rest
        return self.at(pressures_at(values.follower, instant), instant.load)

    def volumes(self, x: np.ndarray) -> np.ndarray:
        """V of each chamber [m^3]."""
        return np.array([enclosure.volume(x) for enclosure in self.enclosures])

    def pressures(self, x):
        out = []
        for law, enclosure, numbers in zip(self.laws, self.enclosures, self.numbers):
            volume = enclosure.recorded(x)
            V = float(value_of(volume))
            slopes = (volume, lambda law=law, V=V: law.slope(V)), (numbers, lambda law=law, V=V: law.by_numbers(V))
            out.append(with_slopes(law.pressure(V), *slopes))
        return np.stack(out)

    def unit_forces(self, u: np.ndarray, k: int) -> np.ndarray:
        """Forces of 1 Pa in chamber k [N / Pa]."""
        return self._to_vertices(self._pushed(np.eye(len(self.laws))[k], self.rest + u))

    def tangent(self, u, transposed=False):
        x = self.rest + u
        slopes = [law.slope(V) for law, V in zip(self.laws, self.volumes(x))]
        pairs = [
            (slope * self.unit_forces(u, k), enclosure.gradient(x))
            for k, (slope, enclosure) in enumerate(zip(slopes, self.enclosures))
            if slope
        ]
        out = Tangent(self._tangent(x).K, pairs)
        return out.T if transposed else out

    def work(self, u, step):
        """Minus infinity where a chamber would vanish."""
        x = self.rest + u
        parts = zip(self.laws, self.enclosures)
        return sum(law.work(enclosure.volume(x), enclosure.change(x, step)) for law, enclosure in parts)
