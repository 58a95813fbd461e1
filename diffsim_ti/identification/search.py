"""Where a search for numbers is, what it costs there, and its report; the ways to go on are in the modules beside it."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from diffsim_ti.identification.priors import Priors
from diffsim_ti.identification.problem import Point, Problem
from diffsim_ti.solvers import NotConverged

FAILURES = (ValueError, ArithmeticError, NotConverged)  # of a run whose numbers went too far


class Ended(Exception):
    """A search stops here, with the reason as its text."""


STOPPED = "stopped by the callback"


class Search:
    """The best point so far, its cost sum r^2 + prior, and a report of each iteration, written to `path` if there is one."""

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
