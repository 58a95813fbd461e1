"""Substeps for each step of a run, found by running it once and looking at the error of each step."""

import math

import numpy as np

from diffsim_ti.checked import instance, number, whole
from diffsim_ti.simulator import Simulator
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.schedule import UnequalSteps

GROWTH = 2.0  # of substeps from one step to the next, at most
SHARE = 0.7  # of the stable step, at most: beyond it the fastest waves are slowed to a half
MOST = 4096  # substeps of a step


def adaptive_steps(solver: Solver, steps: int, tolerance: float) -> UnequalSteps:
    """`steps` steps of solver.dt, each in as many substeps as keep the run's error of positions near `tolerance` [m].

    A run from the scene's start takes each step twice, in n and in 2 n substeps. From the differences of both in the
    displacements and velocities, times 2^p / (2^p - 1) with a solver of order p, the step's error is

        e = max |du| + |mean dv| (what is left of the run),

    for a wrong mean velocity, as after an impact, carries on. With e = c n^-p the fewest substeps of all steps together for
    a given sum of errors have n^(p + 1) in proportion to c: so n is chosen, and all are scaled until errors add up to the
    tolerance. That is no bound: motion stretches errors, or shrinks them.

    BDF2 starts anew in each step of the search, by backward Euler, so that it finds more substeps than its runs need.
    The search costs about three runs of what it finds. Pass the result as `steps` of a `Rollout`. Gradients are exactly
    those of its steps, which do not change with the inputs; where they fit no longer, the run warns or raises as any other.

        rollout = ds.Rollout(solver, ds.adaptive_steps(solver, steps=40, tolerance=1e-3))

    Raises ValueError for a solver without time, and for a tolerance that is not > 0 or that 4096 substeps of a step do not
    meet.
    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4, doi:10.1007/978-3-540-78862-1.
    """
    instance("adaptive_steps", "solver", solver, Solver, "a solver such as VelocityVerletSolver(scene)")
    if not solver.order:
        raise ValueError(f"{type(solver).__name__} finds equilibria, whose error no shorter step makes smaller")
    tolerance, steps = number("tolerance", tolerance, unit="m"), whole("steps", steps, 1)
    search = _Search(solver, steps, tolerance)
    substeps, errors, fewest = (np.array(column) for column in zip(*(search.advance() for _ in range(steps))))
    substeps = np.ceil(substeps * (errors.sum() / tolerance) ** (1 / solver.order))
    return UnequalSteps(np.full(steps, solver.dt), _smooth(np.maximum(substeps, fewest)))


def _smooth(substeps: np.ndarray) -> np.ndarray:
    """With no step much longer than its neighbours."""
    out, last = substeps.copy(), len(substeps) - 1
    for k in range(last):
        out[k + 1] = max(out[k + 1], np.ceil(out[k] / GROWTH))
    for k in range(last, 0, -1):
        out[k - 1] = max(out[k - 1], np.ceil(out[k] / GROWTH))
    return out


class _Search:
    """A run that stands at the end of the steps that are chosen.

    fewest: substeps of a step that stability asks for.
    """

    def __init__(self, solver: Solver, steps: int, tolerance: float):
        options = {name: getattr(solver, name) for name in solver.arguments}
        if solver.explicit:
            options["check_start"] = False
            self.fewest = math.ceil(solver.dt / (SHARE * solver.stable_dt(tight=True).dt))
        else:
            self.fewest = 1
        self.simulator = Simulator(type(solver)(solver.scene, **options))
        self.start = self.simulator.workspace.history(1)
        self.mass = self.simulator.workspace.arrays.values.mass
        self.steps, self.allowed, self.last = steps, tolerance / (steps * self.fewest), self.fewest

    def advance(self) -> tuple[float, float, int]:
        """Take the next step: (substeps that it needs, its error [m] with these, the fewest with which it can be taken)."""
        sim, n, fewest = self.simulator, max(self.fewest, math.ceil(self.last / GROWTH)), self.fewest
        sim.workspace.save(self.start, 0)
        while n <= MOST:
            coarse, fine = self._end(n), self._end(2 * n)
            if coarse is None or fine is None:
                n *= 2
                fewest = n
                continue
            error = self._error(coarse, fine)
            enough = max(fewest, n * (error / (n * self.allowed)) ** (1 / (sim.solver.order + 1)))
            if enough <= 2 * n:
                self.last = enough
                sim.step_count += 1
                return enough, error * (n / enough) ** sim.solver.order, fewest
            n *= 2
        raise ValueError(
            f"step {sim.step_count}, t = {sim.time:.4g} s: {MOST} substeps do not keep its error small enough for the "
            "tolerance: raise it, or look at what is so stiff there"
        )

    def _error(self, coarse: tuple, fine: tuple) -> float:
        solver, order = self.simulator.solver, self.simulator.solver.order
        left = (self.steps - self.simulator.step_count - 1) * solver.dt
        du, dv = (a - b for a, b in zip(coarse, fine))
        carried = left * np.linalg.norm(self.mass @ dv) / self.mass.sum()
        return float(np.linalg.norm(du, axis=1).max() + carried) * 2**order / (2**order - 1)

    def _end(self, n: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Displacements and velocities after the step in n substeps; None where that goes wrong."""
        sim = self.simulator
        sim.workspace.restore(self.start, 0)
        sim.workspace.forget()
        sim.set_substeps(n)
        try:
            sim.step()
        except FloatingPointError:  # Divergence, NotConverged
            return None
        sim.step_count -= 1
        return sim.displacements.astype(np.float64), sim.velocities.astype(np.float64)
