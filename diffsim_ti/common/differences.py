"""Derivatives along a line by differences that know how far off they are, and Taylor tests of those that are claimed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.public import Public, public


@dataclass
class TaylorResult:
    """Remainders |f(x + eps d) - f(x) - eps g.d| for eps halved again and again, or made smaller by another factor, and
    their orders from one to the next."""

    epsilons: np.ndarray
    remainders: np.ndarray
    floor: float = 0.0

    @property
    def rates(self) -> np.ndarray:
        """Orders of successive remainders: 2 where the gradient is right, 1 where it is wrong."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(self.remainders[:-1] / self.remainders[1:]) / np.log(self.epsilons[:-1] / self.epsilons[1:])

    @property
    def rate(self) -> float:
        """The worst of the middle three halvings; infinite where the remainder is round-off (f is linear along d)."""
        if np.all(self.remainders <= self.floor):
            return float("inf")
        usable = self.rates[self.remainders[1:] > self.floor]
        middle = usable[len(usable) // 2 - 1 : len(usable) // 2 + 2] if len(usable) > 3 else usable
        return float(np.min(middle)) if len(middle) else float("inf")

    @property
    def best_rate(self) -> float:
        """The worst of three neighbouring rates, where that is best: large steps see kinks, small ones rounding."""
        if np.all(self.remainders <= self.floor):
            return float("inf")
        rates = np.where(self.remainders[1:] > self.floor, self.rates, -np.inf)
        return float(max(np.min(rates[k : k + 3]) for k in range(max(len(rates) - 2, 1))))


@public
def taylor_test(
    f: Callable[[np.ndarray], float],
    x: ArrayLike,
    gradient: ArrayLike,
    direction: ArrayLike | None = None,
    epsilon: float = 1e-2,
    halvings: int = 6,
    seed: int = 0,
) -> TaylorResult:
    """Second-order remainders of f along a direction: they fall as eps^2 if and only if `gradient` is f's gradient at x.

    direction: default random, of the size of x; epsilon: the first step along it, and how many halvings follow.
    Griewank, Walther 2008; Farrell et al. 2013, doi:10.1137/120873558.

    >>> import diffsim_ti as ds
    >>> import numpy as np
    >>> round(ds.taylor_test(lambda x: float(np.sin(x).sum()), np.ones(3), np.cos(np.ones(3))).rate)
    2
    >>> round(ds.taylor_test(lambda x: float(np.sin(x).sum()), np.ones(3), 1.1 * np.cos(np.ones(3))).rate)
    1
    """
    x, gradient = np.asarray(x, np.float64), np.asarray(gradient, np.float64)
    if direction is None:
        direction = np.random.default_rng(seed).standard_normal(x.shape) * (np.abs(x).max() or 1.0)
    f0, slope = float(f(x)), float(np.sum(gradient * direction))
    epsilons = epsilon / 2.0 ** np.arange(halvings)
    return _taylor(epsilons, [float(f(x + eps * direction)) for eps in epsilons], f0, slope)


def _taylor(epsilons: np.ndarray, values: list[float], f0: float, slope: float) -> TaylorResult:
    remainders = np.array([abs(value - f0 - eps * slope) for value, eps in zip(values, epsilons)])
    floor = 50 * np.finfo(np.float64).eps * max(abs(f0), *map(abs, values), 1e-300)
    return TaylorResult(np.asarray(epsilons), remainders, floor)


class CentralDifferences(metaclass=Public):
    """f'(0) by central differences extrapolated in the square of their steps, and how far off the value may be.

    uncertainty: the sum of `spread`, the largest distance of the value to its three neighbours in Neville's table, where the
    sum is least; `rounding`, what the noise of f leaves of it; and `jump`, half of what f' jumps by at 0, from one-sided
    differences. The noise of f is a unit of its last place until `measure` has taken it from third differences.
    at_zero: f(0), if it is known. Steps at which f raises one of `failures` are left out; `failure` is the last of these.
    Ridders 1982, doi:10.1016/S0141-1195(82)80057-0; More, Wild 2011, Estimating Computational Noise, doi:10.1137/100786125.
    """

    first = 10.0 ** np.array([-2.0, -2.5, -3.0])  # shares of the scale
    smaller = 10.0 ** np.array([-3.5, -4.0, -4.5, -5.0, -5.5, -6.0])
    larger = 10.0 ** np.array([-1.5, -1.0])
    close = 1e-7  # distance of the values that noise is measured from

    def __init__(
        self,
        f: Callable[[float], float],
        scale: float = 1.0,
        at_zero: float | None = None,
        failures: tuple = (ValueError,),
    ):
        self.f, self.scale, self.failures, self.failure = f, scale, failures, None
        self.known = {0.0: float(f(0.0)) if at_zero is None else float(at_zero)}
        self.measured: float | None = None
        self.value, self.spread, self.rounding, self.jump = 0.0, np.inf, 0.0, 0.0

    @property
    def uncertainty(self) -> float:
        return self.spread + self.rounding + self.jump

    @property
    def noise(self) -> float:
        """Standard deviation of f's rounding."""
        unit = np.finfo(np.float64).eps * max(map(abs, self.known.values()))
        return unit if self.measured is None else max(unit, self.measured)

    @property
    def steps(self) -> list[float]:
        """Those that were taken on both sides, the largest first."""
        close = 10 * self.close * self.scale
        return sorted((t for t in self.known if t > close * (1 - 1e-9) and -t in self.known), reverse=True)

    def take(self, share: float) -> bool:
        """Take the step of that share of the scale, both ways; False where f fails there."""
        step = float(share * self.scale)
        try:
            self.known |= {t: float(self.f(t)) for t in (step, -step)}
        except self.failures as error:
            self.failure = error
            return False
        self._evaluate()
        return True

    def begin(self) -> None:
        """Take three steps, or as many as the failures of f leave."""
        for share in (*self.first, *self.smaller):
            if self.take(share) and len(self.steps) == 3:
                return

    def improve(self, enough: float) -> None:
        """Measure the noise, and take steps until the uncertainty is so small: larger ones where noise prevails, smaller
        ones where it lets them tell more."""
        if self.uncertainty <= enough or not self.steps:
            return
        self.measure()
        larger, smaller = list(self.larger), self.left
        while self.uncertainty > enough:
            if self.rounding > self.spread + self.jump and larger:
                self.take(larger.pop(0))
            elif smaller and 4 * self.noise / smaller[0] < self.uncertainty:
                self.take(smaller.pop(0) / self.scale)
            else:
                return

    @property
    def left(self) -> list[float]:
        """Steps smaller than all that were taken."""
        return [step for step in self.smaller * self.scale if step < min(self.steps, default=np.inf)]

    def settles_off(self, slope: float, least: float) -> bool:
        """Whether differences settle on something that is off `slope` by more than `least`.

        They agree with each other to a factor of two over the smallest three steps that noise leaves, a decade, and are
        further off than the derivatives of both sides are from each other: of the right slope they would come nearer at
        least in proportion to the step, whatever kinks f' has. Takes smaller steps as far as noise leaves them.
        """
        if self.measured is None:
            self.measure()
        while self.left and 16 * self.noise / self.left[0] <= abs(self.value - slope):
            if not self.take(self.left[0] / self.scale):
                break
        last = []
        for h in self.steps:
            right, left = ((self.known[t] - self.known[0.0]) / t for t in (h, -h))
            off = (right + left) / 2 - slope
            if abs(off) >= 16 * self.noise / h:
                last = [*last[-2:], (off, abs(right - left))]
        offs, jumps = np.array(last).reshape(-1, 2).T
        alike = len(last) == 3 and abs(np.sign(offs).sum()) == 3 and 2 * np.abs(offs).min() > np.abs(offs).max()
        return bool(alike and np.all(np.abs(offs) > least + jumps))

    def measure(self) -> None:
        """Measure the noise of f by third differences of seven neighbouring values, whose smooth part is rounding."""
        near = [float(k * self.close * self.scale) for k in (-3, -2, -1, 1, 2, 3)]
        try:
            self.known |= {t: float(self.f(t)) for t in near}
        except self.failures as error:
            self.failure = error
            return
        third = np.diff([self.known[t] for t in sorted([0.0, *near])], 3)
        self.measured = float(np.sqrt((third**2).mean() / 20))  # whose variance is twenty times that of a value
        self._evaluate()

    def _evaluate(self) -> None:
        """The best entry of Neville's table."""
        s, known, noise = np.array(self.steps), self.known, self.noise
        rows, best = [], (np.inf, 0.0, np.inf, np.inf)
        for k, h in enumerate(s):
            row = [(known[h] - known[-h]) / (2 * h)]
            for m in range(min(k, 3)):
                row.append(row[m] + (row[m] - rows[-1][m]) / ((s[k - m - 1] / h) ** 2 - 1))
            rows.append(row)
            for m in range(1, len(row)):
                before = rows[k - 1]
                spread = max(abs(row[m] - x) for x in (row[m - 1], before[m - 1], before[min(m, len(before) - 1)]))
                best = min(best, (spread + 4 * noise / h, row[m], spread, 4 * noise / h))
        if len(s) == 1:
            best = 0.0, rows[0][0], np.inf, 0.0
        _, self.value, self.spread, self.rounding = best
        sides = np.array([(known[h] + known[-h] - 2 * known[0.0]) / h for h in s])  # what f' jumps by, and s f''
        ratio = s[:-1] / s[1:]
        jumps = np.abs((ratio * sides[1:] - sides[:-1]) / (ratio - 1))
        self.jump = float(jumps.min(initial=np.inf)) / 2 if len(s) > 1 else 0.0

    def taylor_rate(self, slope: float) -> float:
        """The best order of f's remainders along the steps taken: 2 where `slope` is f'(0), infinite where f is linear."""
        steps = self.steps
        if len(steps) < 2:
            return float("nan")
        found = _taylor(np.array(steps), [self.known[t] for t in steps], self.known[0.0], slope)
        is_linear = np.all(found.remainders <= found.floor + self.uncertainty * found.epsilons)
        return float("inf") if is_linear else found.best_rate


@public
def central_difference(f: Callable[[float], float], scale: float = 1.0) -> tuple[float, float]:
    """(f'(0), how far off it may be): central differences, extrapolated, until they are known to 1e-9.

    Steps so large that f refuses its argument (ValueError: a body that starts in an obstacle) are left out.
    """
    of = CentralDifferences(f, scale)
    of.begin()
    of.improve(1e-9 * abs(of.value))
    if not of.steps:
        raise of.failure
    return of.value, of.uncertainty
