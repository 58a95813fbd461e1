"""A law of rubber for tensile tests: chosen by what it predicts of parts that were not fitted, with intervals."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from diffsim_ti.materials.tensile_test import TensileTest

NUMBERS = {  # of each law, as its material has them, but for what resists a change of volume
    "StableNeoHookean": ("mu",),
    "MooneyRivlin": ("c10", "c01"),
    "Yeoh": ("c10", "c20", "c30"),
    "Gent": ("mu", "limit"),
    "Ogden": ("moduli", "exponents"),
}
LAWS = [(law, k) for law, counts in zip(NUMBERS, ([1], [2], [2, 3], [2], [2, 4, 6])) for k in counts]  # with how many
LOW = 3.0  # the stretch to which soft machines work
TARGETS = dict(low=0.03, all=0.06)  # held-out errors that a law must keep, of the largest stress to LOW and of all
PENALTY = 1.1  # by which another number must lessen the held-out error
POINTS, BLOCKS, HALVES = 200, 10, 8  # of a curve; that alternate in held-out fits; that intervals leave out half of
QUANTILE = 2.776  # Student's, 95 %, of HALVES / 2 degrees of freedom
# of Ogden's terms, from which the best are refined
EXPONENTS = (-8.0, -5.0, -3.0, -2.0, -1.0, -0.5, 0.3, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 8.0, 10.0)


def principal_stretches(stretch, kind: str) -> np.ndarray:
    """Those of an incompressible body, the largest first, shape (3, ...)."""
    one = np.ones_like(stretch)
    other = {
        "uniaxial": (stretch**-0.5, stretch**-0.5),
        "equibiaxial": (stretch, stretch**-2.0),
        "planar": (one, 1 / stretch),
    }
    return np.stack([stretch, *other[kind]])


def kirchhoff(law: str, p: np.ndarray, stretches: np.ndarray) -> np.ndarray:
    """lambda_i dpsi/dlambda_i [Pa] of an incompressible body, up to a pressure; p: the law's numbers, in a row."""
    if law == "Ogden":
        return sum(mu * stretches**a for mu, a in p.reshape(2, -1).T)
    if law == "StableNeoHookean":
        return p[0] * stretches**2
    if law == "MooneyRivlin":
        return 2 * (p[0] * stretches**2 - p[1] / stretches**2)
    i = (stretches**2).sum(0) - 3
    if law == "Gent":
        return np.where(i < p[1], p[0] / (1 - i / p[1]), np.nan) * stretches**2
    return 2 * sum((k + 1) * c * i**k for k, c in enumerate(p)) * stretches**2


def nominal_stress(law: str, p: np.ndarray, stretch: np.ndarray, kind: str = "uniaxial") -> np.ndarray:
    """Force over the area at rest [Pa] where the sides are free."""
    tau = kirchhoff(law, p, principal_stretches(stretch, kind))
    return (tau[0] - tau[2]) / stretch


def is_stable(law: str, p: np.ndarray, valid_to: float) -> bool:
    """Whether the energy is convex in logarithms of the stretches (Hill's condition, which implies Drucker's) in every state
    whose stretches stay below: uniaxial, equibiaxial, planar and what lies between, in tension and compression.

    Hill 1970, Constitutive inequalities for isotropic elastic solids under finite strain, doi:10.1098/rspa.1970.0018.
    """
    first = np.linspace(0, np.log(valid_to), 40)[:, None]
    logs = np.stack([first + np.zeros(13), first * np.linspace(-0.5, 1, 13)])

    def slopes(e):
        tau = kirchhoff(law, p, np.exp([e[0], e[1], -e[0] - e[1]]))
        return np.stack([tau[0] - tau[2], tau[1] - tau[2]])

    h = 1e-4
    by = [(slopes(logs + d) - slopes(logs - d)) / (2 * h) for d in h * np.eye(2)[:, :, None, None]]
    return bool(np.all(by[0][0] > 0) and np.all(by[0][0] * by[1][1] > by[0][1] ** 2))


@dataclass
class Curve:
    """Points of a test, evenly in stretch, and their weights: as many of all, and of those below LOW, as of the others."""

    kind: str
    stretch: np.ndarray
    stress: np.ndarray

    def __post_init__(self):
        low = self.stretch <= LOW
        below = 1 / self.stress[low].max() ** 2 / low.sum() if low.any() else 0.0
        self.weight = np.sqrt(0.25 / self.stress.max() ** 2 / len(low) + np.where(low, below, 0.0))

    @classmethod
    def of(cls, test: TensileTest, top: float) -> "Curve | None":
        near = test.stretch <= top * (1 + 1e-9)
        if near.sum() < 5:
            return None
        x, y = test.stretch[near], test.stress[near]
        cell = np.minimum((POINTS * (x - x[0]) / (x[-1] - x[0])).astype(int), POINTS - 1)
        count = np.bincount(cell, minlength=POINTS)
        mean = [np.bincount(cell, values, POINTS)[count > 0] / count[count > 0] for values in (x, y)]
        return cls(test.kind, *mean)

    def where(self, kept: np.ndarray) -> "Curve":
        return Curve(self.kind, self.stretch[kept], self.stress[kept])

    def blocks(self, count: int) -> np.ndarray:
        """The block of each point, of as many along the stretch."""
        x = (self.stretch - self.stretch[0]) / np.ptp(self.stretch)
        return np.minimum((count * x).astype(int), count - 1)

    def errors(self, residuals: np.ndarray) -> dict[str, float]:
        """Root mean squares below LOW and of all, and largest, each of the largest stress there."""
        out = {}
        for name, part in (("low", self.stretch <= LOW), ("all", self.stretch > 0)):
            if part.any():
                r = residuals[part] / self.stress[part].max()
                out |= {name: float(np.sqrt((r**2).mean())), f"{name}_largest": float(np.abs(r).max())}
        return out


def weighted_residuals(law: str, p: np.ndarray, curves: Sequence[Curve]) -> np.ndarray:
    return np.concatenate([(nominal_stress(law, p, c.stretch, c.kind) - c.stress) * c.weight for c in curves])


def fitted(law: str, count: int, curves: Sequence[Curve], top: float) -> np.ndarray:
    """So many numbers of the law, of least squares."""
    from scipy.optimize import least_squares, nnls

    target = np.concatenate([c.stress * c.weight for c in curves])

    def columns(*parts):  # of laws that are linear in some numbers
        rows = [np.concatenate([nominal_stress(*part, c.stretch, c.kind) * c.weight for c in curves]) for part in parts]
        return np.stack(rows, 1)

    if law in ("StableNeoHookean", "MooneyRivlin", "Yeoh"):
        matrix = columns(*((law, unit) for unit in np.eye(count)))
        size = np.linalg.norm(matrix, axis=0)
        solve = nnls if law == "MooneyRivlin" else lambda a, b: np.linalg.lstsq(a, b, rcond=None)
        return solve(matrix / size, target)[0] / size
    if law == "Ogden":
        return _fitted_ogden(count // 2, curves, top, target, columns)
    largest = max(c.stress.max() / c.stretch.max() for c in curves)
    least = 1.01 * (2 * top**2 + top**-4.0 - 3)  # of equibiaxial tension

    def spread(u):
        return np.array([np.exp(u[0]), least + np.exp(u[1])])

    how = dict(bounds=([-30, -30], [40, 30]), x_scale="jac", max_nfev=200)
    starts = ([np.log(largest), np.log(f * least)] for f in (0.03, 0.3))
    runs = [least_squares(lambda u: weighted_residuals(law, spread(u), curves), start, **how) for start in starts]
    return spread(min(runs, key=lambda run: run.cost).x)


def _fitted_ogden(terms: int, curves: Sequence[Curve], top: float, target: np.ndarray, columns) -> np.ndarray:
    """Moduli and exponents of the best stable law. Moduli may have any sign: a difference of terms is soft at first."""
    from scipy.optimize import least_squares

    each, guesses = columns(*(("Ogden", np.array([1.0, a])) for a in EXPONENTS)), []
    size = np.linalg.norm(each, axis=0)
    for k in map(list, combinations(range(len(EXPONENTS)), terms)):
        moduli = np.linalg.lstsq(each[:, k] / size[k], target, rcond=1e-10)[0] / size[k]
        guesses.append((((each[:, k] @ moduli - target) ** 2).sum(), [*moduli, *np.array(EXPONENTS)[k]]))
    guesses = [np.array(p) for _, p in sorted(guesses)]
    guess = next((p for p in guesses if is_stable("Ogden", p, top)), guesses[0])
    unit = np.maximum(np.abs(guess), 1e-9 * np.abs(guess[:terms]).max())
    most = np.array(terms * [np.inf] + terms * [12.0])
    how = dict(bounds=(-most / unit, most / unit), x_scale="jac", max_nfev=200)
    run = least_squares(lambda u: weighted_residuals("Ogden", u * unit, curves), guess / unit, **how)
    return run.x * unit if is_stable("Ogden", run.x * unit, top) else guess


def _judged(law: str, count: int, curves: Sequence[Curve], top: float) -> tuple[np.ndarray, dict]:
    """The law's numbers, and its errors: those of blocks that were not fitted, each other one of BLOCKS; and where there are
    several tests also those of each test from the others."""
    p = fitted(law, count, curves, top)
    own = [c.errors(nominal_stress(law, p, c.stretch, c.kind) - c.stress) for c in curves]
    held = [np.empty_like(c.stress) for c in curves]
    for parity in (0, 1):
        kept = [c.blocks(BLOCKS) % 2 == parity for c in curves]
        q = fitted(law, count, [c.where(k) for c, k in zip(curves, kept)], top)
        for c, k, out in zip(curves, kept, held):
            out[~k] = nominal_stress(law, q, c.stretch[~k], c.kind) - c.stress[~k]
    held_out = [c.errors(r) for c, r in zip(curves, held)]
    errors = {
        name: {key: max(e.get(key, 0.0) for e in each) for key in each[0]}
        for name, each in (("fitted", own), ("held_out", held_out))
    }
    if len(curves) > 1:
        for k, c in enumerate(curves):
            q = fitted(law, count, [*curves[:k], *curves[k + 1 :]], top)
            errors[f"{c.kind} from the others"] = c.errors(nominal_stress(law, q, c.stretch, c.kind) - c.stress)
    return p, errors


def _score(p: np.ndarray, errors: dict) -> float:
    """The largest held-out error over its target, PENALTY for each number; at most PENALTY ** len(p) where all are kept."""
    worst = max(
        e.get(key, 0.0) / target for name, e in errors.items() if name != "fitted" for key, target in TARGETS.items()
    )
    return worst * PENALTY ** len(p)


def named(law: str, p: np.ndarray) -> dict:
    """{number of the law: itself} of numbers in a row; those at the end that are not there are left out."""
    rows = p.reshape(2, -1) if law == "Ogden" else p
    return {name: x.tolist() for name, x in zip(NUMBERS[law], rows)}


def shear_modulus(law: str, p: np.ndarray) -> float:
    """That of small strains [Pa]."""
    return float(np.diff(nominal_stress(law, p, np.array([1 - 1e-5, 1 + 1e-5])))[0] / 6e-5)


def interval_widths(law: str, p: np.ndarray, curves: Sequence[Curve]) -> np.ndarray:
    """Half the width of the 95 % intervals of the numbers and of the shear modulus of small strains: from refits, to first
    order, after half of the HALVES contiguous blocks of each curve is left out, every half in turn.

    Blocks, not points, for residuals along a curve are correlated. Shao, Wu 1989, A general theory for jackknife variance
    estimation, doi:10.1214/aos/1176347263.
    """
    step = 1e-6 * np.abs(p) + 1e-12
    r_of = partial(weighted_residuals, law, curves=curves)
    J = np.stack([(r_of(p + d) - r_of(p - d)) / 2 for d in np.diag(step)], 1)
    r, block = r_of(p), np.concatenate([c.blocks(HALVES) for c in curves])
    A = np.stack([J[block == b].T @ J[block == b] for b in range(HALVES)])
    g = np.stack([J[block == b].T @ r[block == b] for b in range(HALVES)])
    halves = [list(k) for k in combinations(range(HALVES), HALVES // 2)]
    shifts = np.stack([np.linalg.lstsq(A[k].sum(0), g[k].sum(0), rcond=1e-14)[0] for k in halves])  # in steps
    by_p = np.array([shear_modulus(law, p + d) - shear_modulus(law, p - d) for d in np.diag(step)]) / 2
    shifts = np.concatenate([shifts * step, shifts @ by_p[:, None]], 1)
    return QUANTILE * np.sqrt((shifts**2).mean(0))


def fit_rubber(tests: TensileTest | Sequence[TensileTest]) -> dict:
    """The law for some tests of one material, as an entry of a library: its name and numbers, their intervals of 95 %, the
    stretch to which it is valid, and its errors, root mean squares as shares of the largest stress.

    It is fitted by least squares that weigh stretches below 3 by the largest stress there. Of the laws that are stable to
    the largest stretch that the tests reach, and whose errors of what was not fitted keep 3 % up to stretch 3 and 6 % of
    all, the one of least error is taken, where each number more must lessen it by a tenth, and laws with a number whose
    interval holds zero come last, above all where it is the shear modulus. Where none keeps these errors, the law is valid
    to less, in steps of a twentieth, but to 3 at least; `kept` says whether it keeps them there.
    """
    tests = [tests] if isinstance(tests, TensileTest) else list(tests)
    end = max(test.stretch[-1] for test in tests)
    for top in [end, *(x for x in 1 + (end - 1) * np.arange(19, 3, -1) / 20 if x >= LOW)]:
        curves = [c for c in (Curve.of(test, top) for test in tests) if c]
        if not curves:  # too few rows so far down
            break
        found = []
        for law, count in LAWS:
            p, errors = _judged(law, count, curves, top)
            if is_stable(law, p, top):
                widths, score = interval_widths(law, p, curves), _score(p, errors)
                unseen = bool(widths[-1] >= shear_modulus(law, p)), bool(np.any(widths[:-1] >= np.abs(p)))
                found.append((score > PENALTY ** len(p), unseen, score, law, p, widths, errors))
        missed, unseen, _, law, p, widths, errors = min(found, key=lambda x: x[:3])
        if not missed:
            break
    middle = np.array([*p, shear_modulus(law, p)])
    with np.errstate(over="ignore"):  # an interval of the logarithm, or, where zero is within, none
        ends = [
            np.where(widths < np.abs(middle), middle * np.exp(s * widths / np.abs(middle)), np.nan) for s in (-1, 1)
        ]
    low, high = np.sort(ends, axis=0)
    numbers, lows, highs = (
        named(law, x) | {"shear_modulus": float(y)}
        for x, y in ((p, middle[-1]), (low[:-1], low[-1]), (high[:-1], high[-1]))
    )
    intervals = {key: [lows[key], highs[key]] if np.all(np.isfinite(lows[key])) else None for key in numbers}
    found = dict(law=law, numbers=named(law, p), shear_modulus=numbers["shear_modulus"], intervals=intervals)
    return found | dict(valid_to=float(top), measured_to=float(end), errors=errors, kept=not missed)
