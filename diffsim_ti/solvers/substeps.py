"""How many substeps a step takes where that is left to the solver, substeps="auto"."""

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import numpy as np

from diffsim_ti.common.checked import shown, whole
from diffsim_ti.monitor.stability import StepLimit, element_limit, over_time, sampled_by_runs

if TYPE_CHECKING:
    from diffsim_ti.solvers.solver import Solver

Substeps = int | Literal["auto"]

SHARE = 0.7  # of the stable step, which a substep is at the most where a step is divided
NEAR = 0.9  # of the stable step as it is estimated, beyond which it is found by Lanczos
MOST = 10_000  # of a step, that are chosen without being asked for


class Chosen(int):
    """A number of substeps that "auto" chose, and may raise."""


def checked(substeps: Substeps, explicit: bool) -> int:
    """The number that a solver was given; of "auto" one, which an explicit solver may raise."""
    if isinstance(substeps, str) and substeps == "auto":
        return Chosen(1) if explicit else 1
    if isinstance(substeps, str):
        raise ValueError(f'substeps must be "auto" or a whole number >= 1, got {shown(substeps)}')
    return substeps if isinstance(substeps, Chosen) else whole("substeps", substeps, 1)


def needed(dt: float, stable: float, share: float = SHARE) -> int:
    """Substeps of dt [s] that are a share of a stable step [s] at the most, but for rounding."""
    return max(1, math.ceil((1 - 1e-12) * dt / (share * stable)))


def divided(dt: float, stable: StepLimit) -> int:
    """Substeps of dt [s]: one where it is stable as it is, else as many as `SHARE` asks for.

    Raises ValueError beyond 10 000 of them.
    """
    count = 1 if dt <= stable.dt else needed(dt, stable.dt)
    if count > MOST:
        raise ValueError(
            f"dt = {dt:g} s would take {count} substeps, for the stable step is {stable}: check the units of Young's "
            f"modulus [Pa], density [kg/m^3] and mesh [m], take an implicit solver, or pass substeps={count} if they are "
            "meant"
        )
    return count


class RunSubsteps:
    """Whether the substeps of a rollout suit the values of its runs.

    The stable step at other values is that of the last Lanczos, scaled as the bound by elements; Lanczos is asked again
    where that comes near the substep.
    """

    def __init__(self, solver: "Solver", values: dict):
        self.solver, self.scene, self._settled = solver, solver.scene, False
        self._last = (solver.stable_dt().dt, solver.stable_dt(tight=True).dt) if solver.knows_limit else None
        timed = {name for name, i in self.scene.inputs.described.items() if i.is_per_step}
        timed -= {self.scene.input_names(term)[term.plain] for term in over_time(self.scene)}
        self._no_matter = timed | {"initial_positions", "initial_velocities"}
        self._known = [] if sampled_by_runs(self.scene) else self._that_matter([values])

    def fit(self, each: Iterable[dict]) -> "Solver":
        """The solver for a run with these values, those of each scene of a batch, of which the one of the least bound rules:
        the first run settles the number of substeps. Raises ValueError where a later one asks for more."""
        each = self._that_matter(each)
        limit = self._limit(each, 1.0 if self._settled else SHARE)
        if not self._settled:
            self.solver = self.solver.with_substeps_for(limit)
        elif limit is not None and self.solver.substep > limit.dt:
            self.solver.refuse_values(limit)
        self._known, self._settled = each, True
        return self.solver

    def matters(self, name: str) -> bool:
        """Whether the stable step depends on an input."""
        return name not in self._no_matter

    def _that_matter(self, each: Iterable[dict]) -> list[dict]:
        return [{name: x for name, x in values.items() if self.matters(name)} for values in each]

    def _limit(self, each: list[dict], share: float) -> StepLimit | None:
        """The stable step at the stiffest of some values, None where substeps are known to be within a share of it."""
        if len(each) == len(self._known) and all(map(_same, each, self._known)):
            return None
        if len(each) == 1 and any(_same(each[0], known) for known in self._known):
            return None
        inputs, h = self.scene.inputs, self.solver.substep
        bounds = [element_limit(self.scene, inputs.values | values, self.solver.kicks).dt for values in each]
        b = int(np.argmin(bounds))
        guess = bounds[b] if self._last is None else max(bounds[b], NEAR * self._last[1] / self._last[0] * bounds[b])
        if h <= guess * (1.0 if self.solver.substeps == 1 else share):  # a whole step is taken where it is stable
            return None
        limit = self.solver.limit_at(inputs.values | each[b])
        self._last = bounds[b], limit.dt
        return limit


def _same(values: dict, known: dict) -> bool:
    return all(x is known.get(name) or np.array_equal(x, known.get(name)) for name, x in values.items())
