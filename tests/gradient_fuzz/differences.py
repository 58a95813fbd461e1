"""Extrapolated central differences that know how far off they are."""

from collections.abc import Callable

import numpy as np

CLOSE = 3e-6, 1e-6, 3e-7, 1e-7, 3e-8, 1e-8
STEPS = 0.05 / 2.0 ** np.array([0, 1, 2, 3, 4, 5, 7, 9, 11, 13, 15])


def derivative(change: Callable[[float], float], enough: float, noise: float = 0.0, expected: float = np.nan) -> tuple:
    """(f'(0), estimate of its error) from change(h) = f(h) - f(-h), by Neville's extrapolation in h^2 (Ridders 1982).

    Steps are made smaller until three neighbours in the table agree to `enough`, and to their end where that is not near
    `expected`. noise: rounding of one change. The estimate is the largest distance to the three neighbours, and never below
    what rounding leaves. doi:10.1016/S0141-1195(82)80057-0.
    """
    rows, best = [], (np.nan, np.inf)
    for k, h in enumerate(STEPS):
        row = [change(h) / (2 * h)]
        for m in range(min(k, 4)):
            row.append(row[m] + (row[m] - rows[-1][m]) / ((STEPS[k - m - 1] / h) ** 2 - 1))
        rows.append(row)
        for m in range(1, len(row)):
            before = rows[k - 1]
            error = (
                max(abs(row[m] - x) for x in (row[m - 1], before[m - 1], before[min(m, len(before) - 1)])) + noise / h
            )
            if error < best[1]:
                best = float(row[m]), float(error)
        if k >= 2 and best[1] <= enough and not abs(best[0] - expected) > 10 * enough:
            break
    return best


def closer(f: Callable[[float], float]) -> list[tuple]:
    """(f'(0), error) from both sides, from the right, from the left, for f(0) = 0: where three neighbours among the
    smallest steps agree best.

    Contact has kinks of second order everywhere: a plateau of `derivative` may be that behind one. At a kink itself the two
    sides differ.
    """
    right, left = (np.array([f(s * h) / (s * h) for h in CLOSE]) for s in (1, -1))
    out = []
    for side in ((right + left) / 2, right, left):
        best = min((side[k : k + 3] for k in range(len(CLOSE) - 2)), key=np.ptp)
        out.append((float(np.median(best)), float(np.ptp(best))))
    return out
