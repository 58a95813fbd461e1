"""Where a solver is accurate, stays bounded, loses energy, is refused, or goes wrong without saying so."""

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials import KelvinVoigt, SmithNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.monitor.stability import Stiffness
from diffsim_ti.scene import Scene
from diffsim_ti.simulator import Simulator
from diffsim_ti.solvers import SOLVERS
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.stable_step import start_workspace
from diffsim_ti.study.executors import each
from diffsim_ti.terms import Ground, SelfContact, Term
from diffsim_ti.terms.obstacles.obstacle import Obstacle
from diffsim_ti.terms.obstacles.stiffness import stiffness_of_impact

OUTCOMES = ("accurate", "bounded", "loses energy", "raises", "wrong silently")  # "raises": or warns
ACCURATE = 0.01  # change of the total energy, over the energy that moves
LOSES = 0.10
GAINS = 0.20  # less may be the error of a nonlinear swap of energy, which comes and goes


@dataclass(frozen=True)
class Axis:
    """A quantity that a map runs over: its values and the scene that each makes."""

    name: str
    unit: str
    values: tuple
    scene: Callable  # value -> Scene

    def __iter__(self):
        return iter(self.values)


def body(
    cells: int = 2,
    squeeze: float = 1.0,
    flat: float = 1.0,
    E: float = 1e5,
    nu: float = 0.3,
    terms: Sequence[Term] = (),
    lift: float = 0.0,
    speed: float = 0.0,
    viscous_time: float = 0.0,
) -> Scene:
    """A cube of 0.2 m, its elements flattened to `flat` of their height, the body squeezed to `squeeze` along y, and
    shaken by random velocities of 0.1 % of the speed of sound so that every mode takes part."""
    mesh = TetrahedralMesh.create_box(cells + 1, (0.2, 0.2 * flat, 0.2), "five").translated((0, lift, 0))
    shake = 1e-3 * np.sqrt(E / 1000.0) * np.random.default_rng(0).standard_normal(mesh.vertices.shape)
    start, material = mesh.vertices * [1, squeeze, 1], SmithNeoHookean(E, nu)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nu near 1/2 and slivers are what is looked at
        return Scene(
            mesh,
            KelvinVoigt(material, time=viscous_time) if viscous_time else material,
            1000.0,
            terms,
            initial_positions=start,
            initial_velocities=shake - [0, speed, 0],
            precision="f64",
        )


def impact(speed: float) -> Scene:
    """The cube 2 mm above a barrier 5 mm wide that is as stiff as the impact asks for, moving down."""
    still = body()
    stiffness = stiffness_of_impact(still.mesh, still.material, 1000.0, 0.0, speed, 0.005)
    return body(lift=0.007, speed=speed, terms=[Ground(0.0, width=0.005, stiffness_per_area=stiffness)])


def viscous(ratio: float) -> Scene:
    """The cube, its fastest motion having that damping ratio xi = tau omega / 2."""
    return body(viscous_time=ratio * power_limit(body()))


def rubbing(friction: float) -> Scene:
    """A soft cube that comes down askew on another one and slides on it, as far as they rub."""
    mesh = TetrahedralMesh.create_box(3, 0.2, "five")
    velocity = 0.05 * np.random.default_rng(0).standard_normal((2 * mesh.num_vertices, 3))
    velocity[mesh.num_vertices :] += [1.0, -0.5, 0.2]
    upper = mesh.rotated([0, 1, 0], 0.3, center=(0.1, 0.1, 0.1)).translated((0.03, 0.206, 0.02))
    contact = SelfContact(1e3, 5e-3, friction=friction, friction_speed=0.01)
    both, material = TetrahedralMesh.joined([mesh, upper]), SmithNeoHookean(1e5, 0.3)
    return Scene(both, material, 1000.0, [contact], initial_velocities=velocity, precision="f64")


AXES = {
    "stiffness": Axis("Young's modulus", "Pa", tuple(10.0 ** np.arange(3, 8.1, 1.0)), lambda E: body(E=E)),
    "nu": Axis(
        "Poisson's ratio", "-", (0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.48, 0.49, 0.495, 0.499), lambda nu: body(nu=nu)
    ),
    "impact": Axis("speed of impact", "m/s", (0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0), impact),
    "quality": Axis(
        "height of the elements over their width",
        "-",
        (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01),
        lambda flat: body(flat=flat),
    ),
    "compression": Axis(
        "stretch at the start", "-", (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3), lambda s: body(squeeze=s)
    ),
    "viscosity": Axis("damping ratio of the fastest motion", "-", (0.01, 0.1, 0.3, 1.0, 3.0, 20.0), viscous),
    "friction": Axis("friction of soft on soft", "-", (0.0, 0.1, 0.3, 0.6, 1.0, 10.0), rubbing),
}


def power_limit(scene: Scene, rounds: int = 3000, tolerance: float = 1e-7) -> float:
    """The explicit limit 2 / omega_max [s] at the scene's start, by plain power iteration on the assembled stiffness.

    Independent of the Lanczos iteration by which solvers look at their steps; converges from above. With viscosity, the step
    whose rate 2 / dt makes omega_max as large (`Stiffness`), by bisection.
    """
    stiffness = Stiffness(start_workspace(scene))
    low = 2 / np.sqrt(_largest(scene, stiffness, rounds, tolerance))
    if not stiffness.viscous:
        return low
    low, high = 0.0, low
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        stiffness.set_rate(2 / middle)
        fits = _largest(scene, stiffness, rounds, tolerance) <= (2 / middle) ** 2
        low, high = (middle, high) if fits else (low, middle)
    return low


def _largest(scene: Scene, stiffness: Stiffness, rounds: int, tolerance: float) -> float:
    """The largest eigenvalue."""
    x = np.random.default_rng(5).standard_normal((scene.mesh.num_vertices, 3)) * (stiffness.root > 0)
    value = 0.0
    for k in range(rounds):
        x /= np.linalg.norm(x)
        y = stiffness.product(x)
        before, value = value, float((x * y).sum())
        if abs(value - before) < tolerance * abs(value) and k > 20:
            break
        x = y + 0.05 * abs(value) * x  # negative eigenvalues of a squeezed body do not compete
    return value


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
            simulator = Simulator(kind(scene, dt=dt, **options))
            first, moving, kept = measure(simulator)
            rise, change, behind = 0.0, 0.0, 0.0
            for _ in range(20):
                simulator.run(max(1, steps // 20))
                total, now, still_kept = measure(simulator)
                scale = max(moving, min(now, 100 * moving))
                gain = still_kept - kept
                if scene.law.viscous:  # whose stress is a part of the neighbouring one, and fades
                    gain = min(gain, total - first)
                change, rise = max(change, abs(total - first) / scale), max(rise, gain / scale)
                behind = max(behind, depth_behind(simulator))
                if not np.isfinite(change + rise) or rise > 1e3:
                    break
    except (ValueError, FloatingPointError) as error:
        return Run("raises", said=f"{type(error).__name__}: {error}")
    warned = [
        str(w.message) for w in said if "energy may be gained" in str(w.message) or "has gained" in str(w.message)
    ]
    if behind > 0:
        said = f"vertices are {behind:.3g} m behind an obstacle"
        return Run("raises", rise, change, warned[0]) if warned else Run("wrong silently", rise, change, said)
    if not rise <= GAINS:
        return Run("raises", rise, change, warned[0]) if warned else Run("wrong silently", rise, change, "it grew")
    if (still_kept - kept) / scale < -LOSES:
        return Run("loses energy", rise, change)
    return Run("accurate" if change < ACCURATE else "bounded", rise, change)


def depth_behind(simulator: Simulator) -> float:
    """How far [m] the deepest vertex is behind an obstacle; negative if none is, minus infinity without obstacles."""
    x = simulator.positions[simulator.scene.mesh.surface_vertices].astype(np.float64)
    gaps = [t.gap(x, np.zeros(3)).min() for t in simulator.scene.terms if isinstance(t, Obstacle)]
    return -float(min(gaps, default=np.inf))


def measure(simulator: Simulator) -> tuple[float, float, float]:
    """(total energy, its parts that move, the energy that the solver keeps) [J] at the present state; takes a step."""
    solver, mass = simulator.solver, simulator.scene.inputs.derive(simulator.scene.inputs.values).mass[:, None]
    u, v = simulator.displacements.astype(float), simulator.velocities.astype(float)
    with np.errstate(over="ignore", invalid="ignore"):
        energy = simulator.compute_energy()
        simulator.step()
        kept = float(energy)
        if solver.explicit:
            kept += kept_energy(solver, mass, u, v, simulator.displacements - u, simulator.velocities - v)
        return float(energy), float(sum(part for name, part in energy.parts.items() if name != "gravity")), kept


def kept_energy(
    solver: Solver, mass: np.ndarray, u: np.ndarray, v: np.ndarray, du: np.ndarray, dv: np.ndarray
) -> float:
    """What an explicit solver keeps besides the energy H, exactly for linear forces f:

    symplectic Euler H + (h / 2) v . f, velocity Verlet H - (h^2 / 8) f . f / m. Forces are those that made the step.
    Hairer, Lubich, Wanner, Geometric Numerical Integration, IX.3.
    """
    h = solver.dt
    if solver.order == 1:
        return float((0.5 * mass * v * dv).sum())
    f = 2 * mass * (du - h * v) / h**2
    return float(-(h**2 / 8 * f * f / mass).sum())


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


@dataclass
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
        """Runs that went wrong without a word."""
        return [
            f"{self.solver}, {self.axis.name} {value:g} {self.axis.unit}, dt {share * limit:.3g} s ({share:.2g} of the "
            f"limit): {run.said}; energy rose by {run.rise:.2g} of what moves"
            for share, row in zip(self.shares, self.runs)
            for value, limit, run in zip(self.axis.values, self.limits, row)
            if run.outcome == "wrong silently"
        ]

    def rows(self) -> list[dict]:
        """One row per run, for a table."""
        return [
            dict(
                solver=self.solver,
                axis=self.axis.name,
                value=value,
                dt=share * limit,
                share=share,
                limit=limit,
                outcome=run.outcome,
                rise=run.rise,
                change=run.change,
                said=run.said,
            )
            for share, row in zip(self.shares, self.runs)
            for value, limit, run in zip(self.axis.values, self.limits, row)
        ]


SHARES = {
    True: (0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.01, 1.05, 1.2, 2.0),  # explicit
    False: (0.1, 0.5, 2.0, 5.0, 15.0, 50.0),
}


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
