"""From measurements to numbers: `identify`."""

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from diffsim_ti.checked import shown
from diffsim_ti.identification.descent import l_bfgs_b, torch_descent
from diffsim_ti.identification.levenberg_marquardt import DENSE, levenberg_marquardt
from diffsim_ti.identification.measurements import measurements
from diffsim_ti.identification.modal_test import ModalTest
from diffsim_ti.identification.priors import Priors
from diffsim_ti.identification.problem import Problem, is_experiment
from diffsim_ti.identification.result import Identification, Information, described
from diffsim_ti.identification.search import Ended, Search
from diffsim_ti.progress import progress as progress_bar
from diffsim_ti.rollout import Rollout

METHODS = {"Levenberg-Marquardt": levenberg_marquardt, "L-BFGS-B": l_bfgs_b}


def identify(
    rollout: Rollout | ModalTest | Iterable[Rollout | ModalTest],
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
    method: str | Callable = "Levenberg-Marquardt",
) -> Identification:
    """Find numbers of a scene from what was measured: least squares, with intervals and a test of the residuals.

    Minimises sum ((y(x) - d) / noise)^2 + prior over free variables t(x) (`Unknown`) by Levenberg-Marquardt:

        (J^T J + damping) dt = -J^T r,    J = dr/dt by tangent runs, above 20 unknowns by products J d and J^T w in CG

    rollout: one, or a `ModalTest`, or one per experiment. data: {output: values}, NaN where missing, with `noise` [the
    output's unit], one number or {output: number}; or a `Measurement`, or a list of those; for several experiments a list
    of all that.
    unknowns: {input: start, or Unknown}. prior: {unknown: Normal, Smooth, or a list of them}.
    max_iterations: steps, after which it stops as it is. tolerance: stop when a step promises less than this share of
    a standard error per unknown. covariance: default up to 20
    unknowns; costs a tangent run each. callback(report of the iteration, frames of each experiment),
    first of the start as iteration 0: return True to stop. progress: a bar on stderr.
    resume: a result's `state`, or a path, written after each iteration and gone on from if it is there.
    method: "Levenberg-Marquardt", which takes the fewest simulations; "L-BFGS-B" (SciPy's) needs gradients alone, so serves
    where tangents are dear; or a function that makes a torch optimiser of a list of tensors, t of all unknowns, such as
    `lambda t: torch.optim.Adam(t, lr=0.05)`, for costs that are rough. Both begin anew when resumed.
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
    if not callable(method) and method not in METHODS:
        known = ", ".join(METHODS)
        raise ValueError(
            f"identify: method must be {known} or a function that makes a torch optimiser, got {shown(method)}"
        )
    go_on = partial(torch_descent, method) if callable(method) else METHODS[method]
    several = not is_experiment(rollout)
    rollouts = list(rollout) if several else [rollout]
    noises = noise if several and isinstance(noise, list | tuple) else [noise] * len(rollouts)
    given = [measurements(x, s) for x, s in zip(data, noises)] if several else [measurements(data, noise)]
    problem = Problem(rollouts, given, unknowns)
    search = Search(problem, Priors(prior, problem.unknowns, rollouts[0].scene.mesh), resume)
    most, with_covariance = max_iterations, problem.size <= DENSE if covariance is None else covariance
    with progress_bar("identify", most) if progress else nullcontext(lambda *_: None) as show:
        try:
            if callback is not None and not search.is_resumed and callback(search.row(0), search.point.frames) is True:
                raise Ended("stopped by the callback")
            if len(search.report) >= most:
                raise Ended(f"stopped after {most} iterations")
            stopped, converged = go_on(search, partial(search.record, most, show, callback), tolerance)
        except Ended as end:
            stopped, converged = str(end), False
    return _result(search, stopped, converged, with_covariance)


def _result(search: Search, stopped: str, converged: bool, with_covariance: bool) -> Identification:
    problem, t = search.problem, search.point.t
    residual = search.point.residual
    settled, more = float(problem.size), {}
    if with_covariance:
        J, R = problem.jacobian(search.point) if search.J is None else search.J, search.priors.R
        found = Information.of(problem.labels, J, (R.T * search.priors.weights(t)) @ R)
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
