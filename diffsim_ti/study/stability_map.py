"""Where a solver is accurate, stays bounded, loses energy, is refused, or goes wrong without saying so."""

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import public
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import SOLVERS
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.study.executors import each
from diffsim_ti.study.stability_axes import Axis, power_limit
from diffsim_ti.terms.obstacles.obstacle import Obstacle

OUTCOMES = ("accurate", "bounded", "loses energy", "raises", "wrong silently")  # "raises": or warns
ACCURATE = 0.01  # change of the total energy, over the energy that moves
LOSES = 0.10
GAINS = 0.20  # less may be the error of a nonlinear swap of energy, which comes and goes


@dataclass
class Run:
    """What became of a run: one of OUTCOMES, the largest and the last change of energy (relative), what was said."""

    outcome: str
    rise: float = 0.0
    change: float = 0.0
    said: str = ""


def judge(scene: Scene, kind: type[Solver], dt: float, steps: int = 200, overridden: bool = False) -> Run:
    """Run `steps` steps and judge them by the energy, relative to the energy that can move: kinetic, elastic, contact.

    An explicit step swaps energy to and fro within its stable range, but keeps a neighbouring one (`kept_energy`): that
    one's rise tells growth from swapping. overridden: with allow_unstable=True, as a user may ask; then nothing but the
    state's being finite is looked at.
    """
    options = dict(allow_unstable=True) if overridden and kind.explicit else {}
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            simulator = Simulator(kind(scene, dt=dt, substeps=1, **options))
            first, moving, kept, _ = measure(simulator)
            rise, change, behind, most = 0.0, 0.0, 0.0, 0.0
            for _ in range(20):
                simulator.run(max(1, steps // 20))
                total, now, still_kept, given = measure(simulator)
                most = max(most, given)
                scale = max(moving, min(now, 100 * moving), most)
                gain = still_kept - kept
                if scene.law.viscous:  # whose stress is a part of the neighbouring one, and fades
                    gain = min(gain, total - first)
                change, rise = max(change, abs(total - first) / scale), max(rise, gain / scale)
                behind = max(behind, depth_behind(simulator))
                if not np.isfinite(change + rise) or rise > 1e3:
                    break
    except (ValueError, FloatingPointError) as error:
        return Run("raises", said=f"{type(error).__name__}: {error}")
    texts = [str(warning.message) for warning in said]
    warned = [text for text in texts if "energy may be gained" in text or "has gained" in text]
    if behind > 0 or not rise <= GAINS:
        wrong = f"vertices are {behind:.3g} m behind an obstacle" if behind > 0 else "it grew"
        return Run("raises", rise, change, warned[0]) if warned else Run("wrong silently", rise, change, wrong)
    if (still_kept - kept) / scale < -LOSES:
        return Run("loses energy", rise, change)
    return Run("accurate" if change < ACCURATE else "bounded", rise, change)


def depth_behind(simulator: Simulator) -> float:
    """How far [m] the deepest vertex is behind an obstacle; negative if none is, minus infinity without obstacles."""
    x = simulator.positions[simulator.scene.mesh.surface_vertices].astype(np.float64)
    gaps = [t.gap(x, np.zeros(3)).min() for t in simulator.scene.terms if isinstance(t, Obstacle)]
    return -float(min(gaps, default=np.inf))


def measure(simulator: Simulator) -> tuple[float, float, float, float]:
    """(total energy less what muscles have given, its parts that move, the energy that the solver keeps, what muscles have
    given) [J] at the present state; takes a step."""
    solver, mass = simulator.solver, simulator.scene.inputs.derive(simulator.scene.inputs.values).mass[:, None]
    u, v = simulator.displacements.astype(float), simulator.velocities.astype(float)
    with np.errstate(over="ignore", invalid="ignore"):
        energy, given = simulator.compute_energy(), given_by_muscles(simulator)
        simulator.step()
        total = kept = float(energy) - given
        if solver.explicit:
            kept += kept_energy(solver, mass, v, simulator.displacements - u, simulator.velocities - v)
        moving = float(sum(part for name, part in energy.parts.items() if name != "gravity"))
        return total, moving, kept, given


def given_by_muscles(simulator: Simulator) -> float:
    """What muscles and cables with steady pulls have given the body since it was at rest [J]."""
    hosts = host_forces(simulator.scene).take(simulator.scene.inputs.derive(simulator.values))
    return -hosts.load_energy(simulator.displacements.astype(float))


def kept_energy(solver: Solver, mass: np.ndarray, v: np.ndarray, du: np.ndarray, dv: np.ndarray) -> float:
    """What an explicit solver keeps besides the energy H, exactly for linear forces f:

    symplectic Euler H + (h / 2) v . f, velocity Verlet H - (h^2 / 8) f . f / m. Forces are those that made the step.
    Hairer, Lubich, Wanner, Geometric Numerical Integration, IX.3.
    """
    h = solver.dt
    if solver.order == 1:
        return float((0.5 * mass * v * dv).sum())
    f = 2 * mass * (du - h * v) / h**2
    return float(-(h**2 / 8 * f * f / mass).sum())


@public
def boundary(scene: Scene, kind: type[Solver], steps: int = 2000, accuracy: float = 0.005) -> float:
    """Largest dt [s] at which the solver, its refusal overridden, stays bounded: by bisection around the limit.

    NaN if that is no place within 0.8 and 1.3 of the limit at the start: the motion changes it (contact, unloading).
    """
    low, high = 0.8 * power_limit(scene), 1.3 * power_limit(scene)
    if judge(scene, kind, low, steps, overridden=True).outcome in ("wrong silently", "raises"):
        return np.nan
    while high / low > 1 + accuracy:
        middle = np.sqrt(low * high)
        run = judge(scene, kind, middle, steps, overridden=True)
        low, high = (low, middle) if run.outcome in ("wrong silently", "raises") else (middle, high)
    return float(np.sqrt(low * high))


@dataclass(repr=False)
class StabilityMap:
    """Runs over dt (rows, as shares of the explicit limit) x an axis (columns), with the limits [s] of the columns.

    bounds: the steps [s] up to which the solver, overridden, stayed bounded; NaN where that was not looked for.
    """

    solver: str
    axis: Axis
    shares: np.ndarray
    limits: np.ndarray
    runs: list[list[Run]]
    bounds: np.ndarray

    __repr__ = brief_fields

    @property
    def explicit(self) -> bool:
        """Whether it is a map of an explicit solver, whose stable steps end."""
        return self.solver in [kind.__name__ for kind in SOLVERS if kind.explicit]

    @property
    def outcomes(self) -> np.ndarray:
        """Indices into OUTCOMES, shape (len(shares), len(axis.values))."""
        return np.array([[OUTCOMES.index(run.outcome) for run in row] for row in self.runs])

    @property
    def silent(self) -> list[str]:
        """Runs that went wrong without an error."""
        return [
            f"{row['solver']}, {row['axis']} {row['value']:g} {self.axis.unit}, dt {row['dt']:.3g} s ({row['share']:.2g} of "
            f"the limit): {row['said']}; energy rose by {row['rise']:.2g} of what moves"
            for row in self.rows()
            if row["outcome"] == "wrong silently"
        ]

    def rows(self) -> list[dict]:
        """One row per run, for a table."""
        own, out = dict(solver=self.solver, axis=self.axis.name), []
        for share, runs in zip(self.shares, self.runs):
            for value, limit, run in zip(self.axis.values, self.limits, runs):
                out.append(own | dict(value=value, dt=share * limit, share=share, limit=limit) | asdict(run))
        return out


SHARES = {
    True: (0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.01, 1.05, 1.2, 2.0),  # explicit
    False: (0.1, 0.5, 2.0, 5.0, 15.0, 50.0),
}


@public
def stability_map(
    kind: type[Solver],
    axis: Axis,
    shares: Sequence[float] | None = None,
    steps: int | None = None,
    find_bounds: bool = False,
    show: Callable = lambda note: None,
    executor: Executor | None = None,
) -> StabilityMap:
    """Judge a solver at every share of the explicit limit and every value of the axis.

    shares: of the explicit limit at the start of each scene; default SHARES. steps: per run, default 200, implicit 40.
    find_bounds: of explicit solvers also look by bisection where they stop being bounded.
    executor: any `concurrent.futures.Executor`, which takes a value of the axis at a time; the map is the same.
    """
    shares = np.array(SHARES[kind.explicit] if shares is None else shares)
    steps = (200 if kind.explicit else 40) if steps is None else steps
    calls = [(axis.scene(value), kind, tuple(shares), steps, find_bounds and kind.explicit) for value in axis]
    named = lambda done, note="": show(f"{kind.__name__}, {axis.name}: {done} of {len(calls)}")  # noqa: E731
    limits, columns, bounds = zip(*each(executor, _column, calls, named))
    rows = [list(row) for row in zip(*columns)]
    return StabilityMap(kind.__name__, axis, shares, np.array(limits), rows, np.array(bounds))


def _column(scene: Scene, kind: type[Solver], shares: tuple, steps: int, find_bound: bool) -> tuple:
    """(limit [s], a Run for each share of it, where boundedness ends [s]) of a scene."""
    limit = power_limit(scene)
    runs = [judge(scene, kind, share * limit, steps) for share in shares]
    return limit, runs, boundary(scene, kind) if find_bound else np.nan
