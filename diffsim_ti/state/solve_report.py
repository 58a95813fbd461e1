"""What the solves of a run took, step by step."""

import time
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.copies import CarriesMore
from diffsim_ti.common.progress import Steady
from diffsim_ti.common.public import Public


class Buckled(CarriesMore, UserWarning):
    """Statics left a branch of stable equilibria: stationary states that were no minima, `saddles` of them in step `step`,
    or, where that is 0, the new equilibrium is much farther away than the stiffness before and after it explains and
    `unstable` rounds met an indefinite Hessian on the way, which is how a body snaps, or buckles whose mesh is not quite
    symmetric. An indefinite Hessian alone says nothing: rounds pass through states that are no equilibria (not said where
    there is contact, whose barriers have such states; the report counts all)."""

    def __init__(self, message: str = "", step: int = 0, saddles: int = 0, unstable: int = 0):
        super().__init__(message)
        self.step, self.saddles, self.unstable = step, saddles, unstable


@dataclass(repr=False)
class StepReport:
    """Solves of one step of an implicit or static solver, all of its substeps together.

    iterations: Newton rounds; residual: the relative one where the last solve ended; products: of the Hessian; energies:
    evaluations of the energy in line searches, cuts: halvings of a step there; blocked: directions that an obstacle, or the
    surface itself, cut short; indefinite: rounds that met an indefinite Hessian; saddles: stationary states that were left
    because the energy falls from there; seconds of wall time; residuals: those before each round, of each solve.
    """

    step: int
    iterations: int = 0
    residual: float = 0.0
    products: int = 0
    energies: int = 0
    cuts: int = 0
    blocked: int = 0
    indefinite: int = 0
    saddles: int = 0
    seconds: float = 0.0
    residuals: list | None = None

    __repr__ = brief_fields

    def add(self, solve) -> None:
        """Add what a solve took (NewtonReport)."""
        self.iterations += max(len(solve.residuals) - 1, 0)  # the last look finds it solved
        self.residual = solve.residuals[-1] if solve.residuals else self.residual
        self.products, self.energies = self.products + solve.products, self.energies + solve.trials
        self.cuts, self.blocked = self.cuts + solve.halvings, self.blocked + solve.cuts
        self.indefinite, self.saddles = self.indefinite + solve.indefinite, self.saddles + solve.saddles
        self.residuals = (self.residuals or []) + [list(solve.residuals)]


class SolveReport(metaclass=Public):
    """`steps`: a StepReport for each of the last 10 000 steps, empty for explicit solvers, which solve nothing; `seconds`
    and `substeps`, of all. Totals: `iterations`, `products`, `energies`, `cuts`, `blocked`, `indefinite`, `saddles`;
    `residual`: the largest with which a step ended. Of a Rollout's last forward run, or of a Simulator since its reset;
    a reverse sweep's repetitions do not count.
    """

    def __init__(self):
        self.steps: deque[StepReport] = deque(maxlen=10_000)
        self._noting = False
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.steps.clear()
        self.seconds, self.substeps, self._steady = 0.0, 0, Steady()

    @contextmanager
    def of_passes(self, count: int):
        """Note what is done within, `count` passes."""
        begin, self._noting = time.perf_counter(), True
        try:
            yield
        finally:
            self._noting = False
            self.seconds += time.perf_counter() - begin
            self.substeps += count

    def note(self, step: int, seconds: float, solves: list) -> None:
        """Add the solves of a pass to those of its step."""
        if self._noting:
            if not self.steps or self.steps[-1].step != step:
                self.steps.append(StepReport(step))
            self.steps[-1].seconds += seconds
            for solve in solves:
                self.steps[-1].add(solve)
            last = self.steps[-1]
            self._steady.log("step %s: %s Newton iterations, residual %.2g", step, last.iterations, last.residual)

    def _total(self, name: str):
        return sum(getattr(step, name) for step in self.steps)

    iterations = property(lambda self: self._total("iterations"))
    products = property(lambda self: self._total("products"))
    energies = property(lambda self: self._total("energies"))
    cuts = property(lambda self: self._total("cuts"))
    blocked = property(lambda self: self._total("blocked"))
    indefinite = property(lambda self: self._total("indefinite"))
    saddles = property(lambda self: self._total("saddles"))

    @property
    def residual(self) -> float:
        return max((step.residual for step in self.steps), default=0.0)

    def __str__(self) -> str:
        if not self.steps:
            return f"{self.substeps} substeps in {self.seconds:.3g} s, nothing to solve"
        most = max(self.steps, key=lambda step: step.iterations)
        parts = [
            f"{len(self.steps)} steps in {self.seconds:.3g} s",
            f"{self.iterations} Newton iterations, at most {most.iterations} (step {most.step})",
            f"residual {self.residual:.2g} at most",
            f"{self.cuts} line-search cuts, {self.blocked} by contact",
        ]
        parts += [f"{self.indefinite} rounds met unstable states"] if self.indefinite else []
        return ", ".join(parts + ([f"{self.saddles} saddles left"] if self.saddles else []))

    def __repr__(self) -> str:
        return f"SolveReport({self})"
