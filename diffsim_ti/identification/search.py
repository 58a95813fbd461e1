"""Searches for numbers: where one is and what it costs there, the ways to go on, and where further ones begin.

Damped Gauss-Newton steps: Marquardt 1963, doi:10.1137/0111030; solved as far as they are worth it: Eisenstat, Walker 1996,
doi:10.1137/0917003. By gradients alone, a run and a reverse sweep for each: SciPy's L-BFGS-B, or an optimiser of torch.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from diffsim_ti.common.checked import shown
from diffsim_ti.identification.problem import Point, Problem
from diffsim_ti.identification.unknowns import Priors
from diffsim_ti.solvers import NotConverged

FAILURES = (ValueError, ArithmeticError, NotConverged)  # of a run whose numbers went too far


class Ended(Exception):
    """A search stops here, with the reason as its text."""


STOPPED = "stopped by the callback"


class Search:
    """The best point so far, its cost sum r^2 + prior, and a report of each iteration, written to `path` if there is one;
    in the end, why it stopped and whether it converged."""

    stopped, converged = "", False

    def __init__(
        self, problem: Problem, priors: Priors, resume: dict | str | Path | None = None, start=None, number: int = 0
    ):
        self.problem, self.priors, self.damping, self.report, self.number = problem, priors, 1e-3, [], number
        self.path = Path(resume) if isinstance(resume, str | Path) else None
        state = resume
        if self.path is not None:
            state = json.loads(self.path.read_text(encoding="utf-8")) if self.path.exists() else None
        self.is_resumed, t = state is not None, np.zeros(problem.size) if start is None else start
        if state is not None:
            if state["labels"] != problem.labels:
                raise ValueError(f"resume: the state is of {state['labels']}, these unknowns are {problem.labels}")
            t, self.damping, self.report = np.array(state["t"]), state["damping"], list(state["report"])
            problem.simulations = state["simulations"]
        self.began, self.start = time.perf_counter(), t
        self.point = problem.run(t)
        self.cost = self.cost_of(self.point)
        self.J = None  # dr/dt at the point, where it was made

    def cost_of(self, point: Point) -> float:
        return float(point.residual @ point.residual) + self.priors.cost(point.t)

    @property
    def chi_square(self) -> float:
        """Sum of the squared residuals."""
        return float(self.point.residual @ self.point.residual)

    def half_gradient(self, point: Point) -> np.ndarray:
        """Half the cost's gradient by t, from a reverse sweep of each experiment."""
        return self.problem.transposed(point, point.residual) + self.priors.gradient(point.t)

    def keep(self, point: Point, cost: float) -> None:
        """Go to a point whose cost is lower."""
        self.point, self.cost, self.J = point, cost, None

    @property
    def state(self) -> dict:
        where = dict(labels=self.problem.labels, t=self.point.t.tolist(), damping=self.damping)
        return where | dict(report=self.report, simulations=self.problem.simulations)

    def write(self) -> None:
        """Write the state, if there is a path for it."""
        if self.path:
            temporary = self.path.with_name(self.path.name + ".tmp")
            temporary.write_text(json.dumps(self.state), encoding="utf-8")
            temporary.replace(self.path)

    def row(self, iteration: int, promised: float | None = None, why: str | None = None) -> dict:
        """The report of an iteration: what its step promised, why it was not taken."""
        spent = dict(simulations=self.problem.simulations, seconds=time.perf_counter() - self.began)
        where = dict(start=self.number, iteration=iteration, cost=self.cost, chi_square=self.chi_square)
        step = dict(promised=promised, damping=self.damping, rejected=why)
        return where | step | spent | dict(numbers=self.problem.all_numbers(self.point.t).tolist())

    def record(
        self, most: int, show: Callable, callback: Callable | None, promised=None, why: str | None = None
    ) -> None:
        """Note an iteration, write the state, show and tell it. Raises Ended after the last one, or if the callback asks."""
        done = self.row(len(self.report) + 1, promised, why)
        self.report.append(done)
        self.write()
        shown = ", ".join(f"{label} {x:.5g}" for label, x in list(zip(self.problem.labels, done["numbers"]))[:4])
        show(done["iteration"], f"chi^2 {done['chi_square']:.5g} of {self.problem.num_data}, {shown}")
        if callback is not None and callback(done, self.point.frames) is True:
            raise Ended(STOPPED)
        if len(self.report) >= most:
            raise Ended(f"stopped after {most} iterations")


DENSE = 20  # unknowns up to which the Jacobian is made column by column
LONGEST = 2.0  # change of a logarithm in one iteration
LEAST = 1e-3  # damping that keeps directions without information where they are
FORCING = 0.02, 0.1  # least and largest share of the gradient that conjugate gradients leave


class LevenbergMarquardt:
    """Steps (J^T J + damping) dt = -J^T r; J by tangent runs, above DENSE unknowns by products J d and J^T w in CG."""

    def __init__(self, search: Search):
        self.search, self.dense, self.size = search, search.problem.size <= DENSE, None

    def linearize(self) -> None:
        """Gradient (half of the cost's) and the products that stand for half its Hessian, at the point."""
        search, priors = self.search, self.search.priors
        at, self.prior_hessian = search.point, priors.hessian(search.point.t)
        if self.dense:
            J = search.J = search.problem.jacobian(at)
            self.gradient = J.T @ at.residual + priors.gradient(at.t)
            self.hessian = J.T @ J + self.prior_hessian
        else:
            self.gradient = search.half_gradient(at)
        low, high = search.problem.reach  # numbers at an end that the cost pushes outwards stay there
        ended = (at.t <= low) & (self.gradient > 0) | (at.t >= high) & (self.gradient < 0)
        self.moves = ~ended
        both = np.outer(self.moves, self.moves)
        self.gradient, self.prior_hessian = self.gradient * self.moves, self.prior_hessian * both
        if self.dense:
            self.hessian = self.hessian * both

    def step(self) -> np.ndarray:
        """The damped Gauss-Newton step."""
        from scipy.sparse.linalg import LinearOperator, cg

        problem, damping = self.search.problem, self.search.damping
        if self.dense:
            damped = self.hessian + np.diag(damping * np.diag(self.hessian) + LEAST)
            return -np.linalg.solve(damped, self.gradient)

        # residuals r are measured by |root^T r|, as the prior weighs the unknowns
        root = np.linalg.cholesky(np.linalg.inv(self.prior_hessian + np.eye(problem.size)))

        def product(y):
            d = root @ y
            both = problem.transposed(self.search.point, problem.product(self.search.point, d))
            return root.T @ (self.moves * both + self.prior_hessian @ d + (damping + LEAST) * d)

        right = -(root.T @ self.gradient)
        before, self.size = self.size, float(right @ right)
        share = FORCING[1] if before is None else float(np.clip(self.size / before, *FORCING))
        operator = LinearOperator((problem.size, problem.size), product, dtype=np.float64)
        return root @ cg(operator, right, atol=share * np.linalg.norm(right), maxiter=100)[0]

    def limited(self, step: np.ndarray) -> np.ndarray:
        """A step that changes no logarithm and no bounded number by more than LONGEST."""
        free = np.concatenate([np.full(f.size, f.kind != "linear") for f in self.search.problem.unknowns])
        return np.where(free, np.clip(step, -LONGEST, LONGEST), step)

    def try_step(self, step: np.ndarray) -> str | None:
        """Take the step, to where the unknowns reach, if the cost falls; else damp more, and say why."""
        search = self.search
        try:
            new = search.problem.run(np.clip(search.point.t + step, *search.problem.reach))
            cost, why = search.cost_of(new), "the cost rose"
        except FAILURES as error:
            new, cost, why = None, np.inf, f"{type(error).__name__}: {error}"
        if not cost < search.cost:
            search.damping *= 10
            return why
        search.keep(new, cost)
        search.damping = max(search.damping / 10, 1e-9)
        return None


def levenberg_marquardt(search: Search, record: Callable, tolerance: float) -> tuple[str, bool]:
    """(why it stopped, whether it converged: a step promises less than this share of a standard error per unknown)"""
    method, rejected = LevenbergMarquardt(search), 0
    while True:
        if rejected == 0:
            method.linearize()
        if method.dense or rejected == 0:
            step = method.step()
        else:
            step = step * 0.3  # products are dear: along the same way
        promised = float(-method.gradient @ step)
        if promised <= tolerance**2 * search.problem.size:
            return "converged", True
        why = method.try_step(method.limited(step))  # the step itself is what gets shorter
        rejected = rejected + 1 if why else 0
        record(promised, why)
        if rejected > 12:
            return f"no step lowers the cost ({why})", False


SMALL_STEPS = 3  # iterations that hardly lower the cost, one after the other, end L-BFGS-B
PATIENCE = 50  # iterations without a lower cost end torch's


def evaluate(search: Search, t: np.ndarray) -> tuple[float, np.ndarray]:
    """(cost, its gradient) at t; the search keeps the point if it is the best. Raises what the run raises."""
    point = search.point if np.array_equal(t, search.point.t) else search.problem.run(t)
    cost = search.cost_of(point)
    gradient = 2 * search.half_gradient(point)
    if cost < search.cost:
        search.keep(point, cost)
    return cost, gradient


def l_bfgs_b(search: Search, record: Callable, tolerance: float) -> tuple[str, bool]:
    """(why it stopped, whether it converged: iterations that lower the cost by less than tolerance^2 per unknown)

    Byrd, Lu, Nocedal, Zhu 1995, doi:10.1137/0916069.
    """
    from scipy.optimize import minimize

    least, costs = tolerance**2 * search.problem.size, [search.cost]

    def cost_and_gradient(t):
        try:
            return evaluate(search, t)
        except FAILURES:  # numbers that end a run: the line search comes back
            return 2 * search.cost + 10, np.zeros_like(t)

    def note_iteration(t):
        costs.append(search.cost)
        record()
        if len(costs) > SMALL_STEPS and costs[-1 - SMALL_STEPS] - costs[-1] < SMALL_STEPS * least:
            raise StopIteration

    options = dict(maxiter=10**6, maxfun=10**6, maxcor=20, ftol=0.0, gtol=0.0)
    found = minimize(
        cost_and_gradient,
        search.point.t,
        jac=True,
        method="L-BFGS-B",
        bounds=search.problem.reach.T,
        callback=note_iteration,
        options=options,
    )
    if len(costs) > SMALL_STEPS and costs[-1 - SMALL_STEPS] - costs[-1] < SMALL_STEPS * least:
        return "converged", True
    if found.status == 0:  # at a minimum to rounding
        return "converged", True
    return f"L-BFGS-B finds no lower cost ({found.message})", False


METHODS = {"Levenberg-Marquardt": levenberg_marquardt, "L-BFGS-B": l_bfgs_b}


def torch_descent(make: Callable, search: Search, record: Callable, tolerance: float) -> tuple[str, bool]:
    """(why it stopped, whether it converged: the last iterations lowered the cost by less than tolerance^2 per unknown)"""
    import torch

    t = torch.tensor(search.point.t, dtype=torch.float64, requires_grad=True)
    optimizer, costs = make([t]), [search.cost]
    if not isinstance(optimizer, torch.optim.Optimizer):
        raise ValueError(f"identify: method must return a torch optimiser for a list of tensors, got {optimizer!r}")

    def closure():
        cost, gradient = evaluate(search, t.detach().numpy().copy())
        t.grad = torch.from_numpy(gradient)
        return torch.tensor(cost)

    while True:
        try:
            optimizer.step(closure)
        except FAILURES as error:
            return f"numbers went too far; take smaller steps ({type(error).__name__}: {error})", False
        costs.append(search.cost)
        record()
        if len(costs) > PATIENCE and costs[-1 - PATIENCE] - costs[-1] < tolerance**2 * search.problem.size:
            return "converged", True


EARLY = 1 / 16, 1 / 8, 1 / 4, 1 / 2  # of a run


def grown(problem: Problem, priors: Priors, go_on: Callable, most: int, show: Callable) -> Iterator[np.ndarray]:
    """The start that is found from the unknowns' own by the data of the first part of each run, then of longer ones: late
    data of a motion fit many periods, early ones fit one. None where all data are of one instant.

    Pisarenko, Sornette 2004, doi:10.1103/PhysRevE.69.036122, on why a long motion has many minima.
    """
    t = np.zeros(problem.size)
    for share in EARLY if np.any(problem.when > EARLY[-1]) else ():
        with problem.until(share) as count, suppress(*FAILURES):
            if count > problem.size and np.any((problem.when > 0) & (problem.when <= share)):
                one = Search(problem, priors, start=t)
                with suppress(Ended):
                    go_on(one, partial(one.record, most, show, None), 1.0)
                t = one.point.t
    if np.any(t):
        yield t


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
    """Yields so many starts: of a Latin hypercube around the unknowns' own (a factor of ten to both sides, three scales,
    most of the range), with one draw for all numbers of an unknown where there are many, those whose cost is least.

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
    yield from (t for _, _, t in sorted(points, key=lambda point: point[:2])[:count])
