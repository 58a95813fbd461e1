"""Commands that measure: chart, stability, growth, recommend, sweep."""

import inspect
import runpy
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from typer import Argument, Option

from diffsim_ti import runtime
from diffsim_ti.cli import options as opt
from diffsim_ti.common.progress import progress
from diffsim_ti.solvers import SOLVERS, StaticSolver

PROBLEM = "oscillator, lame, lame-gradient, beam, sag, bounce, bounce-gradient, identify; a mesh; or "
PROBLEM += "a Python file that defines scene, which is run"
Quick = Annotated[bool, Option("--quick", help="small meshes, few steps: seconds instead of minutes")]


def chart(
    problem: Annotated[str, Argument(help=PROBLEM)],
    output: opt.Folder = Path("output/chart"),
    quick: Quick = False,
    duration: Annotated[float, Option(help="of a scene of one's own [s]")] = 0.2,
    gradient: Annotated[str | None, Option(help="of a scene of one's own: chart the gradient by this input")] = None,
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    fixed: opt.Fixed = None,
    limit: Annotated[float, Option(help="leave out runs expected to take longer than this [s]")] = 1.0,
    repeats: Annotated[int, Option(help="timed rounds, of which the best counts")] = 3,
    workers: opt.Workers = 1,
    backend: opt.Backend = "cpu",
) -> None:
    """Measure time against error for every solver, step, precision and mesh; draw the work-precision diagram."""
    from diffsim_ti.study import PROBLEMS, Problem, charts
    from diffsim_ti.study import chart as measure
    from diffsim_ti.study import problem as built_in
    from diffsim_ti.study.executors import workers_of

    if problem not in PROBLEMS and not Path(problem).suffix:
        raise ValueError(f"no problem is called {problem!r}; there are {', '.join(PROBLEMS)}, or give a file")
    runtime.init(backend)
    if problem in PROBLEMS:
        asked = built_in(problem)
    else:
        scene = opt.own_scene(Path(problem), material, youngs_modulus, poissons_ratio, density, fixed)
        asked = Problem.of_scene(scene, duration, Path(problem).stem, gradient=gradient)
    with workers_of(workers) as executor:
        result = measure(asked, repeats=repeats, limit=limit, quick=quick, say=print, executor=executor)
    unit = "s" if asked.static else "s per simulated s"
    for p in result.front:
        print(f"  {p.seconds:9.3g} {unit}   error {p.error:.2e}   {p.label}")
    for error in (1e-2, 1e-3):
        best = result.time_to(error)
        print(f"error {error:g}: " + (f"{best.seconds:.3g} {unit} with {best.label}" if best else "not reached"))
    if result.reference_error:
        print(f"the reference's own error: {result.reference_error:.1e}")
    refused = sum(bool(p.said) for p in result.points)
    print(f"{len(result.points)} runs, {refused} refused, {len(result.left_out)} left out as too long")
    if not any(np.isfinite(p.error) for p in result.points):
        raise FloatingPointError("no run gave a number; the reasons are in the JSON file")
    for name in charts.write_chart(result, output):
        print(name)


def stability(
    axis: Annotated[
        str, Argument(help="stiffness, nu, impact, quality, compression, viscosity, activation, friction, or all")
    ] = "all",
    solver: Annotated[list[str] | None, Option(help="class name; may be repeated; default all")] = None,
    output: opt.Folder = Path("output/stability"),
    quick: Quick = False,
    workers: opt.Workers = 1,
    backend: opt.Backend = "cpu",
) -> None:
    """Map where each solver is accurate, bounded, loses energy, raises, or is wrong silently. Exit code 1 if one is."""
    from dataclasses import replace

    from diffsim_ti.study import charts
    from diffsim_ti.study.executors import workers_of
    from diffsim_ti.study.stability_axes import AXES
    from diffsim_ti.study.stability_map import OUTCOMES, stability_map

    names = {kind.__name__: kind for kind in SOLVERS}
    for asked, known in (([axis], ["all", *AXES]), (solver or [], names)):
        for name in asked:
            if name not in known:
                raise ValueError(f"{name!r} is none of {', '.join(known)}")
    runtime.init(backend, "f64")
    axes = {name: AXES[name] for name in (AXES if axis == "all" else [axis])}
    if quick:
        axes = {name: replace(a, values=a.values[:: max(1, len(a.values) - 1)]) for name, a in axes.items()}
    kinds = [names[name] for name in solver or (list(names)[:2] if quick else names)]
    silent, done = [], 0
    with workers_of(workers) as executor, progress("stability", len(axes) * len(kinds)) as show:
        for name, quantity in axes.items():
            results = []
            for kind in kinds:
                how = dict(steps=60 if quick else None, find_bounds=not quick, executor=executor)
                result = stability_map(kind, quantity, show=lambda note: show(done, note), **how)
                done += 1
                results.append(result)
                silent += result.silent
                gap = np.nanmax(np.abs(result.bounds / result.limits - 1), initial=0.0)
                counts = ", ".join(f"{(result.outcomes == k).sum()} {word}" for k, word in enumerate(OUTCOMES))
                near = f"; boundary within {gap:.1%} of the limit" if gap else ""
                print(f"{name}, {kind.__name__}: {counts}{near}")
            for file in charts.write_maps(results, output, name):
                print(f"  {file}")
    for line in silent:
        print(f"wrong silently: {line}")
    if silent:
        raise typer.Exit(1)


def growth(
    scene: Annotated[str, Argument(help="all built-in scenes, a mesh, or a Python file that defines scene")] = "all",
    duration: Annotated[float, Option(help="simulated time [s]")] = 3.0,
    output: opt.Folder = Path("output/growth"),
    quick: Quick = False,
    precision: opt.Precision = "f32",
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    fixed: opt.Fixed = None,
    backend: opt.Backend = "cpu",
) -> None:
    """How fast gradients grow with the length of a run (a Lyapunov-like rate), and until when they are of use."""
    from diffsim_ti.study.growth import GROWTH_SCENES, study_growth, write_growth

    if not 0 < duration < np.inf:
        raise ValueError(f"--duration must be > 0 and finite [s], got {duration:g}")
    runtime.init(backend, precision)
    if scene == "all":
        scenes = {name: make(precision) for name, make in GROWTH_SCENES.items()}
    else:
        made = opt.own_scene(Path(scene), material, youngs_modulus, poissons_ratio, density, fixed)
        scenes = {Path(scene).stem: made.replace(precision=precision)}
    results = study_growth(scenes, 0.1 * duration if quick else duration)
    for name, result in results.items():
        print(f"{name}: {result}")
    for file in write_growth(results, output, float(np.finfo(runtime.NUMPY[precision]).eps)):
        print(file)


def recommend(
    scene: Annotated[Path, Argument(help="a mesh, or a Python file that defines scene, which is run")],
    duration: Annotated[float, Option(help="simulated time [s]")] = 0.2,
    tolerance: Annotated[float, Option(help="of the motion, over the largest displacement")] = 1e-2,
    memory: Annotated[float | None, Option(help="most that gradients may keep [MB]")] = None,
    gradients: Annotated[bool, Option(help="whether the run will be differentiated")] = True,
    budget: Annotated[float, Option(help="wall time for trial runs [s]")] = 20.0,
    quick: Annotated[bool, Option("--quick", help="the same as --budget 4")] = False,
    workers: opt.Workers = 1,
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    fixed: opt.Fixed = None,
    coarser: Annotated[Path | None, Option(help="a coarser mesh of the body, to try ten nodes on")] = None,
    backend: opt.Backend = "cpu",
) -> None:
    """Name the cheapest solver, step, precision and checkpoints for a tolerance, from short trial runs."""
    from diffsim_ti.study import recommend as advise
    from diffsim_ti.study.executors import workers_of

    runtime.init(backend)
    body = opt.own_scene(scene, material, youngs_modulus, poissons_ratio, density, fixed)
    coarse, budget = opt.load_body(coarser) if coarser else None, 4.0 if quick else budget
    with workers_of(workers) as executor:
        print(advise(body, duration, tolerance, memory, gradients, budget, coarser=coarse, executor=executor))


@lru_cache(4)
def _of_file(path: str, precision: str) -> dict:
    """Its names, in this process."""
    runtime.arch_name()  # starts Taichi where the parent of this process has it
    runtime.set_precision(precision)
    return runpy.run_path(path)


@dataclass(frozen=True)
class FromFile:
    """`rollout`, or else `scene`, of a Python file, which each process runs for itself."""

    path: str
    precision: str

    @property
    def _made(self):
        names = _of_file(self.path, self.precision)
        made = names.get("rollout", names.get("scene"))
        if made is None:
            raise ValueError(f"{self.path} must define scene or rollout, or functions that return one")
        return made

    @property
    def __signature__(self):
        return inspect.signature(self._made if callable(self._made) else lambda: None)

    def __call__(self, **numbers):
        return self._made(**numbers) if callable(self._made) else self._made


def results_of(path: str, precision: str, frames):
    """What `results` of a Python file says of frames."""
    return _of_file(path, precision)["results"](frames)


def axis(text: str) -> tuple[str, list[float]]:
    """E=1e4..1e6:20:log, speed=0..2:5 or nu=0.3,0.4 as (name, values)."""
    name, _, values = (part.strip() for part in text.partition("="))
    try:
        if not name:
            raise ValueError
        if ".." not in values:
            return name, [float(x) for x in values.split(",")]
        ends, *rest = values.split(":")
        low, high = (float(x) for x in ends.split(".."))
        count, spacing = int(rest[0]), (rest[1:] or ["linear"])[0]
        if len(rest) > 2 or count < 2 or spacing not in ("linear", "log") or not np.isfinite([low, high]).all():
            raise ValueError
        if spacing == "log" and not min(low, high) > 0:
            raise ValueError
    except (ValueError, IndexError):
        raise ValueError(
            f"--over {text}: expected NAME=FROM..TO:COUNT, NAME=FROM..TO:COUNT:log with both ends > 0, or NAME=A,B,C, "
            "such as E=1e4..1e6:20:log"
        ) from None
    return name, (np.geomspace if spacing == "log" else np.linspace)(low, high, count).tolist()


def sweep(
    scene: Annotated[Path, Argument(help="a mesh, or a Python file that defines scene or rollout, which is run")],
    over: Annotated[list[str], Option(help="E=1e4..1e6:20:log, speed=0..2:5 or nu=0.3,0.4; more than one: a grid")],
    output: opt.Folder = Path("output/sweep"),
    duration: Annotated[float, Option(help="of a scene [s]")] = 0.2,
    frames: Annotated[int, Option(help="of a scene")] = 20,
    solver: Annotated[str, Option(help="verlet, semi-implicit, implicit-euler, bdf2 or static")] = "verlet",
    workers: opt.Workers = 1,
    precision: opt.Precision = "f32",
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    fixed: opt.Fixed = None,
    backend: opt.Backend = "cpu",
) -> None:
    """Run a scene over a grid of its numbers; write a table and a picture of what comes of it.

    Numbers are arguments of the file's function scene(...) or rollout(...), or else inputs. A function results(frames) in
    the file says what is noted of each run.
    """
    from diffsim_ti.study.charts import write_sweep
    from diffsim_ti.study.executors import workers_of
    from diffsim_ti.study.sweep import Settings, largest_motion
    from diffsim_ti.study.sweep import sweep as run

    axes = dict(axis(text) for text in over)
    kind = StaticSolver if solver == "static" else opt.solver_class(solver)
    if not duration > 0 or not np.isfinite(duration):
        raise ValueError(f"--duration must be > 0 and finite [s], got {duration:g}")
    if frames < 1:
        raise ValueError(f"--frames must be >= 1, got {frames}")
    runtime.init(backend, precision)
    results = largest_motion
    if scene.suffix == ".py":
        if not scene.exists():
            raise ValueError(f"{scene}: no such file; give a mesh, or a Python file that defines scene or rollout")
        make = FromFile(str(scene), precision)
        if "results" in _of_file(str(scene), precision):
            results = partial(results_of, str(scene), precision)
    else:
        make = opt.own_scene(scene, material, youngs_modulus, poissons_ratio, density, fixed)
    with workers_of(workers) as executor:
        done = run(make, axes, results, executor, Settings(kind, duration, frames))
    refused = [row for row in done.rows if row["said"]]
    print(f"{len(done.rows)} runs, {len(refused)} refused" + (f"; the first: {refused[0]['said']}" if refused else ""))
    for name in done.results:
        x = done.column(name)
        if np.isfinite(x).any():
            print(f"  {name}: {np.nanmin(x):.4g} .. {np.nanmax(x):.4g}")
    for name in write_sweep(done, output):
        print(name)
    if len(refused) == len(done.rows):
        raise FloatingPointError("no run gave a number; the reasons are in the table")
