"""From measurements to numbers: Levenberg-Marquardt on tangents and reverse sweeps."""

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.identification.measurements import measurements
from diffsim_ti.identification.priors import Priors
from diffsim_ti.identification.problem import Point, Problem
from diffsim_ti.identification.result import Identification, Information
from diffsim_ti.rollout import Rollout
from diffsim_ti.solvers import NotConverged

DENSE = 20  # unknowns up to which the Jacobian is made column by column
LONGEST = 2.0  # change of a logarithm in one iteration
LEAST = 1e-3  # damping that keeps directions without information where they are
FAILURES = (ValueError, ArithmeticError, NotConverged)  # of a run whose numbers went too far


class _Search:
    """The state of a Levenberg-Marquardt search: where it is, its damping, its report."""

    def __init__(self, problem: Problem, priors: Priors, state: dict | None):
        self.problem, self.priors, self.damping, self.report = problem, priors, 1e-3, []
        t = np.zeros(problem.size)
        if state is not None:
            if state["labels"] != problem.labels:
                raise ValueError(f"resume: the state is of {state['labels']}, these unknowns are {problem.labels}")
            t, self.damping, self.report = np.array(state["t"]), state["damping"], list(state["report"])
            problem.simulations = state["simulations"]
        self.point = problem.run(t)
        self.cost = self.cost_of(self.point)
        self.J = None

    def cost_of(self, point: Point) -> float:
        return float(point.residual @ point.residual) + self.priors.cost(point.t)

    @property
    def state(self) -> dict:
        return dict(
            labels=self.problem.labels,
            t=self.point.t.tolist(),
            damping=self.damping,
            report=self.report,
            simulations=self.problem.simulations,
        )

    def linearize(self, dense: bool) -> None:
        """Gradient (half of the cost's) and the products that stand for half its Hessian, at the point."""
        at, priors, problem = self.point, self.priors, self.problem
        weights = priors.weights(at.t)
        self.prior_hessian = (priors.R.T * weights) @ priors.R
        if dense:
            self.J = problem.jacobian(at)
            self.gradient = self.J.T @ at.residual + priors.gradient(at.t)
            self.hessian = self.J.T @ self.J + self.prior_hessian
        else:
            self.gradient = problem.transposed(at, at.residual) + priors.gradient(at.t)

    def step(self, dense: bool) -> np.ndarray:
        """The damped Gauss-Newton step."""
        if dense:
            damped = self.hessian + np.diag(self.damping * np.diag(self.hessian) + LEAST)
            return -np.linalg.solve(damped, self.gradient)

        def product(d):
            both = self.problem.transposed(self.point, self.problem.product(self.point, d))
            return both + self.prior_hessian @ d + (self.damping + LEAST) * d

        preconditioner = self.prior_hessian + np.eye(self.problem.size)
        return _conjugate_gradients(product, -self.gradient, preconditioner)

    def limited(self, step: np.ndarray) -> np.ndarray:
        """A step that changes no logarithm and no bounded number by more than LONGEST."""
        free = np.concatenate([np.full(f.size, f.kind != "linear") for f in self.problem.unknowns])
        longest = np.abs(step[free]).max(initial=0.0)
        return step * min(1.0, LONGEST / longest) if longest > 0 else step

    def try_step(self, step: np.ndarray) -> str | None:
        """Take the step if the cost falls; else damp more, and say why."""
        try:
            new = self.problem.run(self.point.t + step)
            cost, why = self.cost_of(new), "the cost rose"
        except FAILURES as error:
            new, cost, why = None, np.inf, f"{type(error).__name__}: {error}"
        if not cost < self.cost:
            self.damping *= 10
            return why
        self.point, self.cost, self.J = new, cost, None
        self.damping = max(self.damping / 10, 1e-9)
        return None


def _conjugate_gradients(product, b: np.ndarray, M: np.ndarray, tolerance: float = 0.05, iterations: int = 40):
    """Approximate solution of A x = b, A symmetric and positive, preconditioned by M: Steihaug 1983, doi:10.1137/0720042."""
    solve = np.linalg.inv(M)
    x, r = np.zeros_like(b), b.copy()
    z = solve @ r
    p, size = z.copy(), float(r @ z)
    stop = tolerance**2 * size
    for _ in range(iterations):
        if size <= stop or size == 0:
            break
        Ap = product(p)
        alpha = size / float(p @ Ap)
        x, r = x + alpha * p, r - alpha * Ap
        z = solve @ r
        size, before = float(r @ z), size
        p = z + size / before * p
    return x


def identify(
    rollout: Rollout | Iterable[Rollout],
    data: Any,
    unknowns: dict,
    noise: ArrayLike | None = None,
    prior: dict | None = None,
    max_iterations: int = 50,
    tolerance: float = 0.03,
    covariance: bool | None = None,
    callback: Callable[[dict, list], object] | None = None,
    progress: bool = False,
    resume: dict | str | Path | None = None,
) -> Identification:
    """Find numbers of a scene from what was measured: least squares, with intervals and a test of the residuals.

    Minimises sum ((y(x) - d) / noise)^2 + prior over free variables t(x) (`Unknown`) by Levenberg-Marquardt:

        (J^T J + damping) dt = -J^T r,    J = dr/dt by tangent runs, above 20 unknowns by products J d and J^T w in CG

    rollout: one, or one per experiment. data: {output: values}, NaN where missing, with `noise` [the output's unit], one
    number or {output: number}; or a `Measurement`, or a list of those; for several experiments a list of all that.
    unknowns: {input: start, or Unknown}. prior: {unknown: Normal, Smooth, or a list of them}.
    max_iterations: steps, after which it stops as it is. tolerance: stop when a step promises less than this share of
    a standard error per unknown. covariance: default up to 20
    unknowns; costs a tangent run each. callback(report of the iteration, frames of each experiment),
    first of the start as iteration 0: return True to stop. progress: print it.
    resume: a result's `state`, or a path, written after each iteration and gone on from if it is there.
    Numbers that end a run (Divergence, NotConverged, ValueError) shorten the step.
    Raises ValueError for what does not fit, before any run, and what the first run raises.
    Marquardt 1963, doi:10.1137/0111030; Seber, Wild, Nonlinear Regression, 1989, ch. 5, on intervals.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> rollout = ds.Rollout(ds.StaticSolver(scene), steps=1)
    >>> seen = rollout.forward(youngs_modulus=8e4).positions
    >>> found = ds.identify(rollout, {"positions": seen}, {"youngs_modulus": 1e5}, noise=1e-4)
    >>> print(f"{found.estimates['youngs_modulus']:.0f} Pa")
    80000 Pa
    """
    several = not isinstance(rollout, Rollout)
    rollouts = list(rollout) if several else [rollout]
    noises = noise if several and isinstance(noise, list | tuple) else [noise] * len(rollouts)
    given = [measurements(x, s) for x, s in zip(data, noises)] if several else [measurements(data, noise)]
    problem = Problem(rollouts, given, unknowns)
    priors = Priors(prior, problem.unknowns, rollouts[0].scene.mesh)
    path = Path(resume) if isinstance(resume, str | Path) else None
    state = (json.loads(path.read_text()) if path.exists() else None) if path else resume
    search, dense, start = _Search(problem, priors, state), problem.size <= DENSE, time.perf_counter()
    stopped, converged, rejected = f"stopped after {max_iterations} iterations", False, 0

    def row(promised: float | None = None, why: str | None = None) -> dict:
        """The report of an iteration, or, without what it promised, of the start."""
        chi_square = float(search.point.residual @ search.point.residual)
        own = dict(iteration=len(search.report) + (promised is not None), cost=search.cost, chi_square=chi_square)
        own |= dict(promised=promised, damping=search.damping, rejected=why, simulations=problem.simulations)
        return own | dict(seconds=time.perf_counter() - start, numbers=problem.all_numbers(search.point.t).tolist())

    if callback is not None and state is None and callback(row(), search.point.frames) is True:
        return _result(search, "stopped by the callback", False, dense if covariance is None else covariance)
    while len(search.report) < max_iterations:
        if rejected == 0:
            search.linearize(dense)
        if dense or rejected == 0:
            step = search.step(dense)
        else:
            step = step * 0.3  # products are dear: along the same way
        promised = float(-search.gradient @ step)
        if promised <= tolerance**2 * problem.size:
            stopped, converged = "converged", True
            break
        step = search.limited(step)
        why = search.try_step(step)
        rejected = rejected + 1 if why else 0
        done = row(promised, why)
        search.report.append(done)
        if path:
            temporary = path.with_name(path.name + ".tmp")
            temporary.write_text(json.dumps(search.state))
            temporary.replace(path)
        if progress:
            shown = ", ".join(f"{label} {x:.5g}" for label, x in list(zip(problem.labels, done["numbers"]))[:4])
            print(f"{done['iteration']:3d}: chi^2 {done['chi_square']:.5g} of {problem.num_data}, {shown}", flush=True)
        if callback is not None and callback(done, search.point.frames) is True:
            stopped = "stopped by the callback"
            break
        if rejected > 12:
            stopped = f"no step lowers the cost ({why})"
            break
    return _result(search, stopped, converged, dense if covariance is None else covariance)


def _result(search: _Search, stopped: str, converged: bool, with_covariance: bool) -> Identification:
    problem, t = search.problem, search.point.t
    residual = search.point.residual
    settled, more = float(problem.size), {}
    if with_covariance:
        J = problem.jacobian(search.point) if search.J is None else search.J
        weights = search.priors.weights(t)
        found = Information.of(problem.labels, J, (search.priors.R.T * weights) @ search.priors.R)
        more, settled = described(problem, t, found), found.seen_share
    return Identification(
        problem.numbers(t),
        problem.labels,
        problem.all_numbers(t),
        residual,
        float(residual @ residual),
        max(len(residual) - settled, 1.0),
        problem.simulations,
        stopped,
        converged,
        search.report,
        [{k: x for k, x in problem.inputs(e, t).items() if k != "time_offset"} for e in range(len(problem.rollouts))],
        search.state,
        **more,
    )


def described(problem: Problem, t: np.ndarray, found: Information) -> dict:
    """Covariance, standard errors and intervals of the numbers, from the information on the free variables."""
    slopes = np.concatenate([free.slopes(t[part]) for free, part in zip(problem.unknowns, problem.parts)])
    errors, intervals = {}, {}
    with np.errstate(over="ignore"):
        for free, part in zip(problem.unknowns, problem.parts):
            s = found.deviations[part]
            ends = np.stack([free.numbers(t[part] - 1.959964 * s), free.numbers(t[part] + 1.959964 * s)], -1)
            error = np.abs(slopes[part]) * s
            errors[free.label] = float(error[0]) if free.size == 1 else error
            intervals[free.label] = tuple(ends[0].tolist()) if free.size == 1 else ends
    covariance = slopes[:, None] * found.covariance * slopes
    return dict(information=found, covariance=covariance, standard_errors=errors, intervals=intervals)
