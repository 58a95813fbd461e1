"""Commands that measure: chart, stability, growth, recommend."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffsim_ti import runtime
from diffsim_ti.cli import options as opt
from diffsim_ti.common.progress import progress
from diffsim_ti.solvers import SOLVERS

Quick = Annotated[bool, typer.Option("--quick", help="small meshes, few steps: seconds instead of minutes")]


def chart(
    problem: Annotated[
        str,
        typer.Argument(
            help="oscillator, lame, lame-gradient, beam, sag, bounce, bounce-gradient, "
            "identify; a mesh; or a Python file that defines scene, which is run"
        ),
    ],
    output: opt.Folder = Path("output/chart"),
    quick: Quick = False,
    duration: Annotated[float, typer.Option(help="of a scene of one's own [s]")] = 0.2,
    gradient: Annotated[
        str | None, typer.Option(help="of a scene of one's own: chart the gradient by this input")
    ] = None,
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    fixed: opt.Fixed = None,
    limit: Annotated[float, typer.Option(help="leave out runs expected to take longer than this [s]")] = 1.0,
    repeats: Annotated[int, typer.Option(help="timed rounds, of which the best counts")] = 3,
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
        str, typer.Argument(help="stiffness, nu, impact, quality, compression, viscosity, activation, friction, or all")
    ] = "all",
    solver: Annotated[list[str] | None, typer.Option(help="class name; may be repeated; default all")] = None,
    output: opt.Folder = Path("output/stability"),
    quick: Quick = False,
    workers: opt.Workers = 1,
    backend: opt.Backend = "cpu",
) -> None:
    """Map where each solver is accurate, bounded, loses energy, raises, or is wrong silently. Exit code 1 if one is."""
    from dataclasses import replace

    from diffsim_ti.study import map_picture
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
            for file in map_picture.write_maps(results, output, name):
                print(f"  {file}")
    for line in silent:
        print(f"wrong silently: {line}")
    if silent:
        raise typer.Exit(1)


def growth(
    scene: Annotated[
        str, typer.Argument(help="all built-in scenes, a mesh, or a Python file that defines scene")
    ] = "all",
    duration: Annotated[float, typer.Option(help="simulated time [s]")] = 3.0,
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
    scene: Annotated[Path, typer.Argument(help="a mesh, or a Python file that defines scene, which is run")],
    duration: Annotated[float, typer.Option(help="simulated time [s]")] = 0.2,
    tolerance: Annotated[float, typer.Option(help="of the motion, over the largest displacement")] = 1e-2,
    memory: Annotated[float | None, typer.Option(help="most that gradients may keep [MB]")] = None,
    gradients: Annotated[bool, typer.Option(help="whether the run will be differentiated")] = True,
    budget: Annotated[float, typer.Option(help="wall time for trial runs [s]")] = 20.0,
    quick: Annotated[bool, typer.Option("--quick", help="the same as --budget 4")] = False,
    workers: opt.Workers = 1,
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    fixed: opt.Fixed = None,
    coarser: Annotated[Path | None, typer.Option(help="a coarser mesh of the body, to try ten nodes on")] = None,
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
