"""Derivatives along a line by differences, and Taylor tests of those that are claimed."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


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
        """The worst of three neighbouring rates, where that is best; beside differences that agree it is enough."""
        if np.all(self.remainders <= self.floor):
            return float("inf")
        rates = np.where(self.remainders[1:] > self.floor, self.rates, -np.inf)
        return float(max(np.min(rates[k : k + 3]) for k in range(max(len(rates) - 2, 1))))


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


def taylor_rate(along: Callable[[float], float], known: dict[float, float], slope: float) -> float:
    """The best rate, for large steps see curvature and kinks, small ones rounding: of the differences' own steps, which are
    known, and of smaller and larger ones if that is not enough."""
    steps = sorted((t for t in known if t > 0), reverse=True)
    while len(steps) < 4:
        steps.append(steps[-1] / math.sqrt(10))
    rate = _taylor(np.array(steps), [along(t) for t in steps], known[0.0], slope).best_rate
    for epsilon in 10.0 ** -np.arange(1, 6):
        if rate >= 1.9:
            break
        try:  # four halvings lead to the next step
            rate = max(rate, taylor_test(along, 0.0, slope, 1.0, epsilon, halvings=4).best_rate)
        except ValueError:  # so far the body starts in an obstacle
            if epsilon < 0.002:
                raise
    return rate


def central_difference(f: Callable[[float], float], scale: float = 1.0) -> tuple[float, float]:
    """(f'(0), error estimate): central differences extrapolated once, at the step where two neighbours agree best.

    Steps so large that f refuses its argument (ValueError: a body that starts in an obstacle) are left out, and smaller ones
    where two neighbours agree to 1e-9.
    """
    raw, better, best, error = [], [], 0.0, np.inf
    for s in scale * 10.0 ** -np.arange(2.0, 7.0, 0.5):
        try:
            raw.append((f(s) - f(-s)) / (2 * s))
        except ValueError:
            if raw or s < 1e-4 * scale:
                raise
            continue
        if len(raw) > 1:  # steps fall by sqrt(10): the error of second order by 10
            better.append((10 * raw[-1] - raw[-2]) / 9)
        if len(better) > 1 and abs(better[-1] - better[-2]) < error:
            best, error = better[-1], abs(better[-1] - better[-2])
        if error <= 1e-9 * abs(best):
            break
    return float(best), float(error)
