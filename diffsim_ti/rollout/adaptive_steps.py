"""Substeps for each step of a run, found by running it once and looking at the error of each step."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import instance, number, shown, whole
from diffsim_ti.common.public import public
from diffsim_ti.mesh.sets import pieces
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.schedule import UnequalSteps
from diffsim_ti.terms import Robot

GROWTH = 2.0  # of substeps from one step to the next, at most
SHARE = 0.7  # of the stable step, at most: beyond it the fastest waves are slowed to a half
MOST = 4096  # substeps of a step
LEVELS = 65  # from which that between fine and coarse steps is chosen


@public
def adaptive_steps(
    solver: Solver, steps: int, tolerance: float, of: str = "vertices", values: Mapping[str, ArrayLike] | None = None
) -> UnequalSteps:
    """`steps` steps of solver.dt, each in as many substeps as keep the run's error of positions near `tolerance` [m].

    A run from the scene's start takes each step twice, in n and in 2 n substeps. From the differences of both in the
    displacements and velocities, times 2^p / (2^p - 1) with a solver of order p, the step's error is

        e = max |du| + max |mean dv| (what is left of the run),

    for a wrong mean velocity of a body, as after an impact, carries on. of: "vertices", whose largest |du| counts; or
    "bodies", of which the means of du alone count: for a loss that does not ask how they swing, the steps between impacts
    are then as long as stability lets them be. With e = c n^-p errors are made to add up to the tolerance.
    That is no bound: motion stretches errors, or shrinks them.
    Two numbers of substeps serve all steps, a fine one where c is large, as in contact, and a coarse one elsewhere; which
    steps are which is chosen for the fewest substeps. While the step does not change, what a symplectic solver does wrong
    as a body is pressed together it undoes as the body springs back. The two are in proportion to the roots of the means
    of c: in contact gradients err with the first power of the step, through kinks of friction and barrier, whatever p is.

    BDF2 starts anew in each step of the search, by backward Euler, so that it finds more substeps than its runs need.
    The search costs about three runs of what it finds. Pass the result as `steps` of a `Rollout`. Gradients are exactly
    those of its steps, which do not change with the inputs; where they fit no longer, the run warns or raises as any other.

        rollout = ds.Rollout(solver, ds.adaptive_steps(solver, steps=40, tolerance=1e-3))

    values: of the scenes of a `Batch`, inputs with their axis in front, {"youngs_modulus": [1e4, 2e4]}. Each is run, one
    after the other, and a step has the substeps of the scene that needs most.

    Raises ValueError for robots, whose joints are not in that measure, for a solver without time, for another `of`, and for
    a tolerance that is not > 0 or that 4096 substeps of a step do not meet.
    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4, doi:10.1007/978-3-540-78862-1.
    """
    instance("adaptive_steps", "solver", solver, Solver, "a solver such as VelocityVerletSolver(scene)")
    if not solver.order:
        raise ValueError(f"{type(solver).__name__} finds equilibria, whose error no shorter step makes smaller")
    if solver.scene.terms_of(Robot):
        raise ValueError("adaptive_steps: errors of robots' joints are not in its measure: give the solver substeps=")
    tolerance, steps = number("tolerance", tolerance, unit="m"), whole("steps", steps, 1)
    if of not in ("vertices", "bodies"):
        raise ValueError(f'of must be "vertices" or "bodies", got {shown(of)}')
    found = [_substeps(solver, scene, steps, tolerance, of == "bodies") for scene in solver.scene.with_each(values)]
    return UnequalSteps(np.full(steps, solver.dt), np.max(found, 0))


def _substeps(solver: Solver, scene: Scene, steps: int, tolerance: float, by_body: bool) -> np.ndarray:
    """Those of each step of one scene."""
    search = _Search(solver, scene, steps, tolerance, by_body)
    constants, fewest = (np.array(column) for column in zip(*(search.advance() for _ in range(steps))))
    substeps = _smooth(_shared(constants, fewest, tolerance, solver.order))
    if substeps.max() > MOST:
        raise search.too_fine(int(np.argmax(substeps)))
    return substeps


def _shared(constants: np.ndarray, fewest: np.ndarray, tolerance: float, order: int) -> np.ndarray:
    """Substeps of two sizes whose errors, constants / substeps^order, add up to the tolerance, in all as few as can be."""
    near = np.pad(constants, 1)
    near = np.maximum(constants, np.maximum(near[2:], near[:-2]))  # a step on either side goes with what is between
    found = []
    for level in np.unique(np.quantile(near, np.linspace(0, 1, LEVELS), method="nearest")):
        fine = near >= level
        weights, least = np.zeros(len(near)), np.zeros(len(near))
        for part in (fine, ~fine):
            if part.any():
                weights[part], least[part] = math.sqrt(constants[part].mean()), fewest[part].max()
        found.append(_scaled(weights, least, constants, tolerance, order))
    return min(found, key=np.sum)


def _scaled(weights, least, constants, tolerance: float, order: int) -> np.ndarray:
    """Substeps in proportion to weights, none below the least, whose errors add up to the tolerance."""

    def substeps(scale: float) -> np.ndarray:
        return np.maximum(least, np.ceil(scale * weights))

    def enough(scale: float) -> bool:
        return bool((constants * substeps(scale) ** -float(order)).sum() <= tolerance)

    low, high = 0.0, 1.0
    while not enough(high):
        low, high = high, 2 * high
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return substeps(high)


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

    def __init__(self, solver: Solver, scene: Scene, steps: int, tolerance: float, by_body: bool):
        own = solver.unchecked_for(scene)
        self.fewest = math.ceil(own.dt / (SHARE * own.stable_dt(tight=True).dt)) if own.explicit else 1
        self.simulator = Simulator(own)
        self.start = self.simulator.workspace.history(1)
        self.mass, self.by_body = self.simulator.workspace.arrays.values.mass, by_body
        self.body = pieces(scene.mesh)
        self.steps, self.allowed, self.last = steps, tolerance / (steps * self.fewest), self.fewest

    def advance(self) -> tuple[float, int]:
        """Take the next step: (error times substeps^p of it, the fewest substeps with which it can be taken)."""
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
                return error * n**sim.solver.order, fewest
            n *= 2
        raise self.too_fine(sim.step_count)

    def too_fine(self, step: int) -> ValueError:
        """What to say of a step that needs too many substeps."""
        return ValueError(
            f"step {step}, t = {step * self.simulator.solver.dt:.4g} s: {MOST} substeps do not keep its error small enough "
            "for the tolerance: raise it, or check what is so stiff there"
        )

    def _error(self, coarse: tuple, fine: tuple) -> float:
        solver, order = self.simulator.solver, self.simulator.solver.order
        left = (self.steps - self.simulator.step_count - 1) * solver.dt
        du, dv = (a - b for a, b in zip(coarse, fine))
        near = self._largest(self._means(du) if self.by_body else du)
        return (near + left * self._largest(self._means(dv))) * 2**order / (2**order - 1)

    def _means(self, of_vertices: np.ndarray) -> np.ndarray:
        """Of each body, by mass."""
        sums = [np.bincount(self.body, self.mass * column) for column in of_vertices.T]
        return np.stack(sums, 1) / np.maximum(np.bincount(self.body, self.mass), 1e-300)[:, None]

    @staticmethod
    def _largest(vectors: np.ndarray) -> float:
        return float(np.linalg.norm(vectors, axis=1).max())

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
