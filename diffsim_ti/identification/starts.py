"""Where further searches begin."""

from collections.abc import Iterable, Iterator
from contextlib import suppress

import numpy as np

from diffsim_ti.common.checked import shown
from diffsim_ti.identification.levenberg_marquardt import DENSE
from diffsim_ti.identification.priors import Priors
from diffsim_ti.identification.problem import Problem
from diffsim_ti.identification.search import FAILURES

EACH = 16  # points whose cost is asked for, for each start: a run each, where a search takes dozens
WIDTH = dict(log=np.log(10.0), bounded=2.0, linear=3.0)  # of the free variables: a factor of ten, three scales


def further_starts(problem: Problem, starts: int | Iterable[dict]) -> int | list[np.ndarray]:
    """How many further starts there are, or the free variables of those that are given."""
    if isinstance(starts, int | np.integer) and not isinstance(starts, bool):
        if starts < 1:
            raise ValueError(f"identify: starts must be a number >= 1, or a list of {{unknown: numbers}}, got {starts}")
        return int(starts) - 1
    labels, out = [free.label for free in problem.unknowns], []
    for numbers in [starts] if isinstance(starts, dict) else list(starts):
        if not isinstance(numbers, dict) or not set(numbers) <= set(labels):
            raise ValueError(f"identify: a start is {{unknown: numbers}} of {', '.join(labels)}, got {shown(numbers)}")
        t = np.zeros(problem.size)
        for free, part in zip(problem.unknowns, problem.parts):
            if free.label in numbers:
                with np.errstate(invalid="ignore", divide="ignore"):
                    t[part] = free.free(numbers[free.label])
        if not np.all(np.isfinite(t)):
            raise ValueError(f"identify: a start lies where its unknown cannot be: {shown(numbers)}")
        out.append(t)
    return out


def around(problem: Problem, priors: Priors, count: int) -> Iterator[np.ndarray]:
    """So many starts: of a Latin hypercube around the unknowns' own (a factor of ten to both sides, three scales, most of
    the range), with one draw for all numbers of an unknown where there are many, those whose cost is least.

    McKay, Beckman, Conover 1979, doi:10.1080/00401706.1979.10489755.
    """
    rng, points, n = np.random.default_rng(0), [], EACH * count
    each = [np.arange(part.start, part.stop) for part in problem.parts]
    sizes = [1 if problem.size > DENSE else len(at) for at in each]
    draws = [
        WIDTH[free.kind]
        * (2 * (rng.permuted(np.tile(np.arange(n), (size, 1)), axis=1) + rng.random((size, n))) / n - 1)
        for free, size in zip(problem.unknowns, sizes)
    ]
    for k in range(n):
        t = np.concatenate([np.broadcast_to(draw[:, k], len(at)) for draw, at in zip(draws, each)])
        with suppress(*FAILURES):  # numbers that end a run
            r = problem.run(t).residual
            points.append((float(r @ r) + priors.cost(t), k, t))
    return (t for _, _, t in sorted(points, key=lambda point: point[:2])[:count])
