"""From measurements to numbers: `identify`."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from diffsim_ti.common.checked import shown
from diffsim_ti.common.progress import progress as progress_bar
from diffsim_ti.common.public import public
from diffsim_ti.identification import search as searching
from diffsim_ti.identification.measurements import measurements
from diffsim_ti.identification.mesh_check import mesh_check
from diffsim_ti.identification.modal_test import ModalTest
from diffsim_ti.identification.problem import Problem, experiments
from diffsim_ti.identification.result import Identification, Information, MeshCheck, described
from diffsim_ti.identification.search import DENSE, FAILURES, METHODS, STOPPED, Ended, Search
from diffsim_ti.identification.unknowns import TIME_OFFSET, Priors
from diffsim_ti.rollout import Rollout

FAR, AT_MOST = 3.0, 4  # residuals over the noise beyond which further starts are tried, and how many
SLIGHT = 1e-3  # share of a cost which the noise does not explain; where a step promises less, a minimum is near
SET_ASIDE = "set aside near a minimum that does not explain the data"


@public
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
    starts: int | Iterable[dict] | None = None,
    check_mesh: bool | None = None,
) -> Identification:
    """Find numbers of a scene from what was measured: least squares, with intervals and a test of the residuals.

    Minimises sum ((y(x) - d) / noise)^2 + prior over free variables t(x) (`Unknown`) by Levenberg-Marquardt:

        (J^T J + damping) dt = -J^T r,    J = dr/dt by tangent runs, above 20 unknowns by products J d and J^T w in CG

    rollout: one, or a `ModalTest`, or one per experiment. data: {output: values}, NaN where missing, with `noise` [the
    output's unit], one number or {output: number}; or a `Measurement`, or a list of those; for several experiments a list
    of all that.
    unknowns: {input: start, or Unknown}. prior: {unknown: Normal, Smooth, or a list of them}.
    max_iterations: steps, after which it stops as it is. tolerance: stop when a step promises less than this share of
    a standard error per unknown. covariance: default up to 20 unknowns; costs a tangent run each. callback(report of the
    iteration, frames of each experiment), first of the start as iteration 0, and not of searches by early data: return
    True to stop. progress: a bar in a terminal; without one the logger "diffsim_ti" says every five seconds, at level INFO,
    how far it is.
    resume: a result's `state`, or a path, written after each iteration and gone on from if it is there.
    method: "Levenberg-Marquardt", which takes the fewest simulations; "L-BFGS-B" (SciPy's) needs gradients alone, so serves
    where tangents are dear; or a function that makes a torch optimiser of a list of tensors, t of all unknowns, such as
    `lambda t: torch.optim.Adam(t, lr=0.05)`, for costs that are rough. Both begin again when resumed.
    starts: how many searches, the first from the unknowns' own start, the second from what early data alone lead to from
    there (`grown`), the others from those of sixteen times as many points around whose cost is least (`around`); or further
    starts, a list of {unknown: numbers}. The best search is returned, `Identification.starts` has all. Default: one, and up
    to five more, until one explains the data, where the residuals of the first are more than three times the noise; it is
    set aside for them near such a minimum. max_iterations are of each.
    check_mesh: fit the data again with ten-node tetrahedra of the same mesh, by a few forward runs, and widen the intervals
    by what estimates move (`MeshCheck`). Default: where it costs no more than three times the fit, or takes some seconds.
    False for data that this very mesh computed, which do not contain its error.
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
        known = f"{', '.join(METHODS)} or a function that makes a torch optimiser"
        raise ValueError(f"identify: method must be {known}, got {shown(method)}")
    go_on = partial(searching.torch_descent, method) if callable(method) else METHODS[method]
    rollouts, data, noises = experiments(rollout, data, noise)
    given = [measurements(x, s) for x, s in zip(data, noises)]
    problem = Problem(rollouts, given, unknowns)
    if method != "Levenberg-Marquardt" or problem.size > DENSE:
        problem.check_gradients()
    priors = Priors(prior, problem.unknowns, rollouts[0].scene.mesh)
    further = AT_MOST if starts is None else searching.further_starts(problem, starts)
    most, with_covariance = max_iterations, problem.size <= DENSE if covariance is None else covariance
    searches: list[Search] = []

    def search(one: Search, show, hesitates: bool = False) -> bool:
        """Run a search to its end, or until it `hesitates`; whether there may be more."""
        record = partial(one.record, most, show, callback)

        def recorded(promised=None, why=None):
            record(promised, why)
            if hesitates and promised is not None and promised < SLIGHT * one.cost and _is_far(one, FAR):
                raise Ended(SET_ASIDE)

        try:
            if (
                callback is not None
                and not (one.is_resumed or one.report)
                and callback(one.row(0), one.point.frames) is True
            ):
                raise Ended(STOPPED)
            if len(one.report) >= most:
                raise Ended(f"stopped after {most} iterations")
            one.stopped, one.converged = go_on(one, recorded, tolerance)
        except Ended as end:
            one.stopped, one.converged = str(end), False
        if one not in searches:
            searches.append(one)
        return one.stopped != STOPPED

    with progress_bar("identify", most, progress) as show:
        first = Search(problem, priors, resume)
        more, ways = search(first, show, starts is None), further
        if not isinstance(further, list):
            early = searching.grown(problem, priors, go_on, most, show)
            again = [first] * (first.stopped == SET_ASIDE)  # to its end, where nothing explains the data
            late = searching.around(problem, priors, further)
            ways = islice(chain(early, again, late), None if starts is None else further)
        if more and (starts is not None or (not first.stopped.startswith("stopped") and _is_far(first, FAR))):
            for start in ways:
                if start is first:
                    more = search(first, show)
                else:
                    with suppress(*FAILURES):  # numbers that end its first run
                        more = search(Search(problem, priors, None, start, len(searches)), show)
                if not more or (starts is None and not _is_far(first if start is first else searches[-1], 1.0)):
                    break
    best = min(searches, key=lambda search: search.cost)
    if best is not first:
        best.path = first.path
        best.write()
    return _result(searches, best, with_covariance, check_mesh if more else False)


def _is_far(search: Search, times: float) -> bool:
    """Whether the residuals are more than what so many times the noise explains."""
    from scipy.special import chdtrc

    r = search.point.residual
    square, degrees = float(r @ r) / times**2, len(r) - search.problem.size
    return degrees > 0 and float(chdtrc(degrees, square)) < 0.01


def _result(searches: list[Search], search: Search, with_covariance: bool, check_mesh) -> Identification:
    problem, t, residual, stopped = search.problem, search.point.t, search.point.residual, search.stopped
    if ended := [label for label, x, ends in zip(problem.labels, t, problem.reach.T) if x in ends]:
        stopped = f"{stopped}, with {', '.join(ended)} at the end of what its range, or its run, lets it reach"
    starts = []
    for one in searches:
        ends = dict(start=problem.all_numbers(one.start), numbers=problem.all_numbers(one.point.t))
        starts.append(ends | dict(cost=one.cost, chi_square=one.chi_square, stopped=one.stopped))
    settled, more, simulations = float(problem.size), {}, problem.simulations
    mesh = MeshCheck(reason="more unknowns than a covariance is made for")
    if with_covariance:
        J = problem.jacobian(search.point) if search.J is None else search.J
        found = Information.of(problem.labels, J, search.priors.hessian(t))
        simulations = problem.simulations
        mesh = mesh_check(search, J, found, check_mesh)
        more = described(problem, t, found, 0.0 if mesh.shifts is None else mesh.shifts)
        settled = found.seen_share
    inputs = [{k: x for k, x in problem.inputs(e, t).items() if k != TIME_OFFSET} for e in range(len(problem.rollouts))]
    numbers, degrees = (problem.numbers(t), problem.labels, problem.all_numbers(t)), max(len(residual) - settled, 0.0)
    how = simulations, stopped, search.converged, search.report, inputs, search.state, starts, mesh
    return Identification(*numbers, residual, search.chi_square, degrees, *how, **more)
