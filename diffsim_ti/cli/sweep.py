"""The command that runs a scene over a grid of its numbers."""

import inspect
import runpy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffsim_ti import runtime
from diffsim_ti.cli import options as opt
from diffsim_ti.solvers import StaticSolver


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


@dataclass(frozen=True)
class ResultsOfFile:
    """`results` of a Python file."""

    path: str
    precision: str

    def __call__(self, frames):
        return _of_file(self.path, self.precision)["results"](frames)


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
    scene: Annotated[Path, typer.Argument(help="a mesh, or a Python file that defines scene or rollout, which is run")],
    over: Annotated[
        list[str], typer.Option(help="E=1e4..1e6:20:log, speed=0..2:5 or nu=0.3,0.4; more than one: a grid")
    ],
    output: opt.Folder = Path("output/sweep"),
    duration: Annotated[float, typer.Option(help="of a scene [s]")] = 0.2,
    frames: Annotated[int, typer.Option(help="of a scene")] = 20,
    solver: Annotated[str, typer.Option(help="verlet, semi-implicit, implicit-euler, bdf2 or static")] = "verlet",
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
    from diffsim_ti.study.executors import workers_of
    from diffsim_ti.study.sweep import Settings, largest_motion
    from diffsim_ti.study.sweep import sweep as run
    from diffsim_ti.study.sweep_picture import write_sweep

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
            results = ResultsOfFile(str(scene), precision)
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
