"""Sweeps: a scene over a grid of its numbers, what comes of each, as a table and a picture."""

import inspect
import itertools
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.progress import progress
from diffsim_ti.common.public import Public, public
from diffsim_ti.monitor.stability import element_limit
from diffsim_ti.rollout import Frames, Rollout
from diffsim_ti.rollout.set_values import split_name, spread_all
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import StaticSolver, VelocityVerletSolver
from diffsim_ti.study.executors import each

ALIASES = {"E": "youngs_modulus", "nu": "poissons_ratio", "rho": "density"}
SHARE = 0.8  # of the stable step
TURN = threading.Lock()  # workers of one process take turns, as Taichi does


@dataclass(frozen=True)
class Settings(metaclass=Public):
    """How a scene is run where no rollout is given: solver class, duration [s] and number of frames."""

    solver: type = VelocityVerletSolver
    duration: float = 0.2
    frames: int = 20

    def rollout(self, scene: Scene, values: dict) -> Rollout:
        """A rollout whose explicit substeps are stable for these values."""
        if self.solver is StaticSolver:
            return Rollout(StaticSolver(scene), 1)
        dt, substeps = self.duration / self.frames, 1
        if self.solver.explicit:
            substeps = int(np.ceil(dt / (SHARE * element_limit(scene, scene.inputs.values | values).dt)))
        unchecked = {"check_start": False} if self.solver.explicit else {}
        solver = self.solver(scene, dt=dt, substeps=substeps, **unchecked)
        return Rollout(solver, self.frames, save_every=1)


@dataclass(repr=False)
class Sweep:
    """Rows of a sweep, one for each point of the grid, in its order; the first axis varies slowest.

    over: {name: values}; rows: {name: number} of the point and of its results, NaN where it was refused, `said` why.
    """

    over: dict[str, list[float]]
    rows: list[dict]

    __repr__ = brief_fields

    @property
    def results(self) -> list[str]:
        """Names of the results."""
        names = dict.fromkeys(name for row in self.rows for name in row)
        return [name for name in names if name not in self.over and name != "said"]

    def column(self, name: str) -> np.ndarray:
        """Values of a number or result at all points, in the shape of the grid."""
        return np.array([row[name] for row in self.rows], float).reshape([len(x) for x in self.over.values()])


def largest_motion(frames: Frames) -> dict[str, float]:
    """What a sweep looks at by itself: displacements from the start [m], speed at the end [m/s], and the rollout's outputs
    in the last frame, as far as these are numbers or short vectors."""
    moved = np.linalg.norm(frames.displacements.astype(np.float64) - frames.displacements[0], axis=-1)
    out = {
        "largest displacement [m]": float(moved.max()),
        "displacement at the end [m]": float(moved[-1].max()),
        "speed at the end [m/s]": float(np.linalg.norm(frames.velocities[-1], axis=-1).max()),
    }
    for name, values in frames.outputs.items():
        last = np.asarray(values)[-1]
        if last.size <= 3:
            numbered = [name] if last.ndim == 0 else [f"{name}[{k}]" for k in range(last.size)]
            out |= dict(zip(numbered, last.ravel().tolist()))
    return out


@public
def sweep(
    make: Callable[..., Scene | Rollout] | Scene | Rollout,
    over: Mapping[str, Sequence[float]],
    results: Callable[[Frames], Mapping[str, float]] = largest_motion,
    executor: Executor | None = None,
    settings: Settings | None = None,
) -> Sweep:
    """Run a scene at every point of the grid over = {"E": [1e4, 1e5], "speed": [1, 2, 4]} and gather numbers of each run.

    make: a Rollout, a Scene, or a function that returns one: numbers that it has arguments for go to it, all others are
    inputs of the run: "youngs_modulus" (or E), "drag_rate", "youngs_modulus[soft]" of a named set. A scene is run as
    `settings` say, in explicit steps that are stable at each point.
    results: numbers by name from the frames of a run. A run that raises ValueError or FloatingPointError is a row of NaN
    that says why; all others go on.
    executor: any `concurrent.futures.Executor` (spawned processes, Dask's `client.get_executor()`), which needs `make` and
    `results` to pickle: functions of a module, scenes without functions of their own. The rows are the same, in the same
    order. Default: one after the other in this process.

    Raises ValueError before anything runs for an empty grid, and for names that are neither arguments nor inputs.
    """
    over, settings = {name: [float(x) for x in values] for name, values in over.items()}, settings or Settings()
    if not over or not all(over.values()):
        raise ValueError('over: expected names with at least one value each, such as {"E": [1e4, 1e5]}')
    points = [dict(zip(over, numbers)) for numbers in itertools.product(*over.values())]
    try:
        _check_names(make, points[0])
        calls = [(make, results, settings, point) for point in points]
        with progress("sweep", len(points)) as show:
            rows = each(executor, _row, calls, show)
    finally:
        _called.cache_clear()
    names = dict.fromkeys(name for row in rows for name in row if name != "said")
    return Sweep(over, [dict.fromkeys(names, np.nan) | row | {"said": row.get("said", "")} for row in rows])


def _split(make, point: dict) -> tuple[dict, dict]:
    """(arguments of the function, inputs of the run)"""
    if isinstance(make, Scene | Rollout):
        return {}, point
    taken = inspect.signature(make).parameters
    every = any(p.kind is p.VAR_KEYWORD for p in taken.values())
    given = {name: x for name, x in point.items() if every or name in taken}
    return given, {name: x for name, x in point.items() if name not in given}


def _check_names(make, point: dict) -> None:
    given, left = _split(make, point)
    if not left and given:
        return
    made = _built(make, given)
    known = (made.scene if isinstance(made, Rollout) else made).inputs.values
    for name in left:
        plain = split_name(name)[0]
        if ALIASES.get(plain, plain) not in known:
            own = [] if isinstance(make, Scene | Rollout) else list(inspect.signature(make).parameters)
            raise ValueError(
                f"over: {name!r} is no input of the scene, which has {', '.join(known)}"
                + (f"; arguments of its function: {', '.join(own)}" if own else "")
            )


def _built(make, given: dict) -> Scene | Rollout:
    return make if isinstance(make, Scene | Rollout) else _called(make, tuple(given.items()))


@lru_cache(1)
def _called(make, given: tuple) -> Scene | Rollout:
    """What the function makes; points that differ in inputs only share it."""
    made = make(**dict(given))
    if not isinstance(made, Scene | Rollout):
        raise TypeError(f"the function must return a Scene or a Rollout, got {type(made).__name__}")
    return made


def _row(make, results: Callable, settings: Settings, point: dict) -> dict:
    """One point; in whichever process."""
    given, left = _split(make, point)
    try:
        with TURN, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # said once for each point otherwise
            made = _built(make, given)
            values: dict = {}
            for name, x in left.items():
                plain, part = split_name(name)
                plain = ALIASES.get(plain, plain)
                values[plain] = x if part is None else values.get(plain, {}) | {part: x}
            rollout = made
            if isinstance(made, Scene):
                checked = made.inputs.check(spread_all(made, made.inputs.values, values)[0])
                rollout = settings.rollout(made, checked)
            return point | {name: float(x) for name, x in results(rollout.forward(**values)).items()}
    except (ValueError, FloatingPointError) as error:
        return point | {"said": f"{type(error).__name__}: {error}"}
