"""Some fixed configurations of the fuzz of gradients; `fuzz_gradients.py` draws as many as one likes."""

from functools import lru_cache

import numpy as np
import pytest
from battery_of_verdicts import judge as judged
from gradient_fuzz.differences import derivative
from gradient_fuzz.judge import PASSED, ZERO, judge
from gradient_fuzz.report import Report, failure_text

# the cheapest of each family of solvers; the command draws all others. That of explicit steps is left out, as
# test_every_adjoint.py, test_loads_together.py and test_gradient_faults.py have the same there
EXPLICIT = (39,)
IMPLICIT = (52,)
# Euler, Verlet, BDF2, statics; f32; patches; one launch per pass; self-contact
OF_EACH_KIND = (34, 47, 60, 81, 93, 212)
LONGER = (1184, 1696, 2048, 17, 26, 36, 40, 43, 49, 50, 57, 58, 61, 90, 91, 131, 132, 135, 208, 211)
LONGEST = (0, 4, 5)  # the midpoint rule on curved ten-node tetrahedra, before rough obstacles: minutes each


@lru_cache(maxsize=None)
def result(seed):
    return judge(seed)


@pytest.mark.parametrize(
    "seed",
    [
        *IMPLICIT,
        *(pytest.param(seed, marks=pytest.mark.thorough) for seed in EXPLICIT + OF_EACH_KIND + LONGER + LONGEST),
    ],
)
def test_configuration(seed):
    found = result(seed)
    assert not found.failed, failure_text(found)
    assert not found.refusal, found.refusal
    assert len(found.rows) >= 6 and sum(row.verdict in (PASSED, ZERO) for row in found.rows) >= len(found.rows) - 1


@pytest.mark.parametrize("seed", [*IMPLICIT, pytest.param(*EXPLICIT, marks=pytest.mark.thorough)])  # odd: with a fault
def test_verdicts(seed):
    found = judged(seed)
    assert not found.failures and not found.refusal, found
    for _, verdict, fault, resolution in found.rows:
        assert verdict == ("WRONG" if fault > resolution else "right"), found


@pytest.mark.thorough
def test_they_meet_what_they_should():
    """Scenes go where gradients are hard: contact acts, friction sticks and slides, bodies and statics press."""
    report = Report()
    for seed in EXPLICIT + IMPLICIT + OF_EACH_KIND:
        report.add(result(seed))
    shares = report.shares()
    assert shares["obstacle"] >= 0.5 and min(shares["sticks"], shares["slides"]) >= 0.2
    assert shares["self_contact"] >= 0.15 and shares["static_contact"] >= 0.1
    assert report.counts()[ZERO] <= 0.1 * sum(report.counts().values())


def test_differences_know_how_far_off_they_are():
    for f, exact in ((np.sin, 1.0), (lambda x: np.exp(3 * x), 3.0), (lambda x: x + x * abs(x), 1.0)):
        value, error = derivative(lambda h, f=f: f(h) - f(-h), 1e-12)
        assert abs(value - exact) <= 3 * error + 1e-14 and error < 1e-5
    _, error = derivative(lambda h: abs(h + 1e-3) - abs(-h + 1e-3), 1e-9, noise=1e-9)
    assert error >= 1e-9 / 0.05  # rounding of the function cannot be extrapolated away
