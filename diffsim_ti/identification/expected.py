"""How well would an experiment determine numbers, before it is made: what it would tell, and what it cannot tell at all."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import public
from diffsim_ti.identification.measurements import measurements
from diffsim_ti.identification.problem import Experiment, Problem, experiments
from diffsim_ti.identification.result import Information, described
from diffsim_ti.identification.unknowns import Priors
from diffsim_ti.inputs.description import InputValue
from diffsim_ti.rollout import Rollout


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
    rollouts, given, noises = experiments(rollout, data, noise)
    filled = [measurements(_complete(x, r), s) for x, r, s in zip(given, rollouts, noises)]
    problem = Problem(rollouts, filled, unknowns)
    priors = Priors(prior, problem.unknowns, rollouts[0].scene.mesh)
    t = np.zeros(problem.size)
    return _told(problem, t, problem.jacobian(problem.run(t)), priors.hessian(t))


def _told(problem: Problem, t: np.ndarray, J: np.ndarray, hessian: np.ndarray) -> Expectation:
    return Expectation(problem.numbers(t), **described(problem, t, Information.of(problem.labels, J, hessian)))


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
        out[name], begin = _told(problem, t, J[begin:end], hessian), end
    return dict(sorted(out.items(), key=lambda pair: pair[1].log_volume))


@dataclass(repr=False)
class Identifiability:
    """What the frames' positions tell of some inputs: eigenvalues of the Fisher matrix, smallest first, in m^2.

    directions[k]: {input: relative change}, of unit length together: along it a relative change eps moves the vertices of
    all frames by eps sqrt(eigenvalues[k]) [m] (Euclidean norm).
    """

    eigenvalues: np.ndarray
    directions: list[dict]
    resolution: float

    @property
    def num_singular(self) -> int:
        """Directions that the frames do not see: their eigenvalues are round-off beside the largest."""
        return int((self.eigenvalues <= self.resolution * self.eigenvalues[-1]).sum())

    def __str__(self) -> str:
        lines = []
        for k, (value, direction) in enumerate(zip(self.eigenvalues, self.directions)):
            parts = ", ".join(f"{name} {np.array2string(np.asarray(x), precision=3)}" for name, x in direction.items())
            lines.append(f"{value:10.3e} m^2 {'NOT SEEN' if k < self.num_singular else ''} {parts}")
        return "\n".join(lines)

    __repr__ = __str__


@public
def identifiability(
    rollout: Rollout, inputs: str | Iterable[str], groups: dict | None = None, **values: InputValue
) -> Identifiability:
    """Which inputs can be recovered from the frames' positions: eigenvalues and directions of the Fisher matrix J^T J.

    J, shape (3 frames vertices, parameters) [m], has a column x_j d positions / d x_j for each number x_j of the inputs, by
    `Rollout.jvp`: parameters are compared by relative changes, as in an optimisation of logarithms.
    groups: input name -> whole numbers, shape of that input: numbers of one group change together (E per region).
    With noise of deviation s [m] on every coordinate, a relative change along direction k is known to
    s / sqrt(eigenvalues[k]) (Cramer-Rao). Costs a tangent run per parameter; raises ValueError for inputs that are zero.
    Bates, Watts, Nonlinear Regression Analysis, 1988, ch. 2, doi:10.1002/9780470316757.
    """
    names = [inputs] if isinstance(inputs, str) else list(inputs)
    frames = rollout.forward(**values)
    columns, labels = [], []
    for name in names:
        if name not in frames.inputs:
            said = rollout.scene.inputs.no_input(name, "this rollout", rollout.inputs)
            raise ValueError(f"identifiability: {said}")
        value = np.asarray(frames.inputs[name])
        if not np.any(value):
            raise ValueError(f"identifiability: {name} is zero, so that relative changes of it mean nothing")
        group = np.asarray((groups or {}).get(name, np.arange(value.size).reshape(value.shape)))
        if group.shape != value.shape:
            raise ValueError(f"groups of {name}: expected shape {value.shape}, got {group.shape}")
        for k in np.unique(group):
            dx, _ = rollout.jvp(frames, **{name: np.where(group == k, value, 0.0)})
            columns.append(dx.ravel())
            labels.append(name)
    J = np.stack(columns, 1)
    _, sizes, directions = np.linalg.svd(J, full_matrices=False)  # not of J^T J, which would lose half the digits
    parts = [{name: d[np.array(labels) == name] for name in names} for d in directions[::-1]]
    resolution = (1e-9 if rollout.scene.precision == "f64" else 1e-4) ** 2
    return Identifiability(sizes[::-1] ** 2, parts, resolution)
