"""How often intervals of rubber fits hold: synthetic tensile tests with residuals that are correlated along the curve.

    python tests/battery_of_fits.py --cases 200

For laws, correlation lengths (as shares of the curve) and seeds: how often the 95 % interval of each number holds the truth.
A row that holds less often than in 90 % is marked.
"""

import argparse

import numpy as np

from diffsim_ti.materials import rubber_fit

TRUTHS = {  # law: numbers [Pa], largest stretch
    "StableNeoHookean": ([4e4], 4.0),
    "MooneyRivlin": ([4e4, 2e4], 4.0),
    "Yeoh": ([1.6e5, 1.4e4, 900.0], 3.0),
    "Gent": ([1e5, 60.0], 5.0),
    "Ogden": ([4e4, 2.6], 8.0),
}
NOISE, POINTS = 0.005, 160


def noisy(law: str, correlation: float, rng) -> tuple[np.ndarray, np.ndarray]:
    """(stretch, stress [Pa]) with noise of half a per cent, mostly proportional, of this correlation length."""
    p, top = TRUTHS[law]
    stretch, e = np.linspace(1.02, top, POINTS), rng.standard_normal(POINTS)
    rho = np.exp(-1 / POINTS / correlation)
    for k in range(1, POINTS):
        e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * e[k]
    exact = rubber_fit.nominal_stress(law, np.array(p), stretch)
    return stretch, exact + NOISE * e * (0.1 * exact.max() + 0.9 * exact)


def held(law: str, correlation: float, cases: int, seed: int = 0) -> np.ndarray:
    """How often each number's interval, and that of the shear modulus, holds the truth."""
    rng, (p, top) = np.random.default_rng(seed), TRUTHS[law]
    truth, hits = np.array([*p, rubber_fit.shear_modulus(law, np.array(p))]), []
    for _ in range(cases):
        curves = [rubber_fit.Curve("uniaxial", *noisy(law, correlation, rng))]
        found = rubber_fit.fitted(law, len(p), curves, top)
        widths = rubber_fit.interval_widths(law, found, curves)
        hits.append(np.abs([*found, rubber_fit.shear_modulus(law, found)] - truth) <= widths)
    return np.mean(hits, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for law in TRUTHS:
        for correlation in (0.002, 0.01, 0.03):
            shares = held(law, correlation, asked.cases, asked.seed)
            mark = "" if shares.min() >= 0.9 else "   TOO SELDOM"
            print(f"{law:17} correlation {correlation:.3f}: {', '.join(f'{x:.0%}' for x in shares)}{mark}", flush=True)


if __name__ == "__main__":
    main()
