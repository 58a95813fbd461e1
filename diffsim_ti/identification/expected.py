"""An experiment before it is made: how well would it determine the unknowns, and which of several does so best."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import public
from diffsim_ti.identification.measurements import measurements
from diffsim_ti.identification.priors import Priors
from diffsim_ti.identification.problem import Experiment, Problem, is_experiment
from diffsim_ti.identification.result import Information, described


@dataclass(repr=False)
class Expectation:
    """What an experiment would tell: standard errors, 95 % intervals about the numbers assumed, what it leaves open."""

    estimates: dict
    standard_errors: dict
    intervals: dict
    covariance: np.ndarray
    information: Information

    __repr__ = brief_fields

    @property
    def unseen(self) -> list[dict[str, float]]:
        """Directions that such data would not determine."""
        return self.information.unseen

    @property
    def log_volume(self) -> float:
        """log of the volume of the confidence region of the free variables, up to a constant: the less the better."""
        return 0.5 * float(np.linalg.slogdet(self.information.covariance)[1])


@public
def expected(
    rollout: Experiment | Iterable[Experiment],
    data: Any,
    unknowns: dict,
    noise: ArrayLike | None = None,
    prior: dict | None = None,
) -> Expectation:
    """Intervals to expect of an experiment, from one run and a tangent for each unknown: the Cramer-Rao bound.

    Arguments (data, unknowns, noise, prior) as in `identify`; unknowns start at the numbers that are assumed. Of the
    data only shape, noise and NaN count; a name, or a list of names, of outputs stands for complete data.
    Atkinson, Donev, Tobias, Optimum Experimental Designs, 2007, ch. 17.
    """
    several = not is_experiment(rollout)
    rollouts = list(rollout) if several else [rollout]
    given = list(data) if several else [data]
    filled = [measurements(_complete(x, r), noise) for x, r in zip(given, rollouts)]
    problem = Problem(rollouts, filled, unknowns)
    priors = Priors(prior, problem.unknowns, rollouts[0].scene.mesh)
    t = np.zeros(problem.size)
    found = Information.of(problem.labels, problem.jacobian(problem.run(t)), priors.hessian(t))
    return Expectation(problem.numbers(t), **described(problem, t, found))


def _complete(data, rollout: Experiment):
    if isinstance(data, str):
        data = [data]
    if isinstance(data, list | tuple) and all(isinstance(name, str) for name in data):
        return {name: np.zeros(rollout.outputs[name].shape(rollout.num_frames)) for name in data}
    return data


@public
def compare(
    rollout: Experiment, choices: dict, unknowns: dict, noise: ArrayLike | None = None, prior: dict | None = None
) -> dict[str, Expectation]:
    """Expectations of several measurements of one experiment, the best first: least volume of the confidence region.

    unknowns, noise, prior: as there. choices: {name: data as in `expected`}, such as Measurement("positions", zeros,
    noise, at=markers). One run and a tangent per unknown serve all. For several loads, call `expected` with each rollout.
    D-optimality: Atkinson, Donev, Tobias, Optimum Experimental Designs, 2007, ch. 10.
    """
    lists = {name: measurements(_complete(data, rollout), noise) for name, data in choices.items()}
    problem = Problem([rollout], [[m for given in lists.values() for m in given]], unknowns)
    priors = Priors(prior, problem.unknowns, rollout.scene.mesh)
    t, out, begin = np.zeros(problem.size), {}, 0
    J, hessian = problem.jacobian(problem.run(t)), priors.hessian(t)
    for name, given in lists.items():
        end = begin + sum(len(m.deviation) for m in given)
        found, begin = Information.of(problem.labels, J[begin:end], hessian), end
        out[name] = Expectation(problem.numbers(t), **described(problem, t, found))
    return dict(sorted(out.items(), key=lambda pair: pair[1].log_volume))
