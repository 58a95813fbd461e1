"""The command line: `diffsim-ti` or `python -m diffsim_ti`. One function per command."""

import io
import logging
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from typer import Option

from diffsim_ti import runtime
from diffsim_ti.cli import options as opt
from diffsim_ti.cli import study, view
from diffsim_ti.cli.fit import fit
from diffsim_ti.cli.identify import identify
from diffsim_ti.cli.selftest import selftest
from diffsim_ti.common import interrupts
from diffsim_ti.common.progress import LOG
from diffsim_ti.materials import StableNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.doctor import findings, mended, step_in_words
from diffsim_ti.mesh.files import read_mesh
from diffsim_ti.monitor.stability import element_limit
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import SemiImplicitSolver, stable_dt
from diffsim_ti.terms import Drag, Gravity
from diffsim_ti.verify import check_gradients as judge
from diffsim_ti.writers import View, writer_for
from diffsim_ti.writers.adaptive_run import ForwardRun, Interrupted, file_in, run_and_write

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # for which [s] is no unit
    epilog="Exit codes: 0 done; 1 check-gradients found a wrong gradient, check something in a mesh, fit a file that is no "
    "test, selftest a number that is not as stored, or stability a run that is wrong and does not say so; 2 an error, said "
    "in one line on stderr; 130 interrupted.",
)
ClickException = typer.BadParameter.__mro__[2]  # typer carries click inside or beside it, depending on its version
measuring = study.chart, study.stability, study.growth, study.recommend, study.sweep
for command in (*measuring, view.render, view.view, identify, fit, selftest):
    app.command()(command)


@app.callback()
def everywhere(
    traceback: Annotated[bool, Option("--traceback", help="show the traceback of an error")] = False,
    version: Annotated[
        bool, Option("--version", is_eager=True, callback=opt.say_version, help="say the version, and stop")
    ] = False,
) -> None:
    """Soft bodies on tetrahedra, simulated with Taichi."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and exit: 0 done, 2 an error, 130 interrupted."""
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that a console of another locale cannot show ends no run
            stream.reconfigure(errors="backslashreplace")
    try:
        said, code = _ran(arguments)
    except KeyboardInterrupt:  # of a signal that came just as the command ended
        interrupts.command_ended()
        said, code = "interrupted", 130
    if code in (2, 130):
        print("error: " + " ".join(said.split()), file=sys.stderr)
    sys.exit(code)


def _ran(arguments: list[str]) -> tuple[str, int]:
    """(what to say, exit code) of a command."""
    wants_traceback = "--traceback" in arguments  # wherever it stands
    with _lines_on_stderr():
        said = "interrupted"
        try:
            interrupts.commands_may_run()
            code = app([a for a in arguments if a != "--traceback"], standalone_mode=False, prog_name="diffsim-ti")
        except Interrupted as stop:
            said, code = str(stop), 130
        except (KeyboardInterrupt, typer.Abort):
            code = 130
        except ClickException as error:
            said, code = f"{error.format_message()} (see diffsim-ti --help)", 2
        except (ValueError, TypeError, RuntimeError, OSError, FloatingPointError, MemoryError) as error:
            if wants_traceback:
                raise
            said, code = str(error) or type(error).__name__, 2
        finally:
            stopped = interrupts.command_ended()
    if stopped and code != 130:
        said, code = "interrupted", 130  # swallowed on its way
    return said, code if isinstance(code, int) else 0


@contextmanager
def _lines_on_stderr() -> Iterator[None]:
    """Warnings and records of the logger "diffsim_ti" as lines on stderr."""
    handler, level = logging.StreamHandler(sys.stderr), LOG.level
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)
        LOG.addHandler(handler)
        LOG.setLevel(level or logging.INFO)
        try:
            yield
        finally:
            LOG.removeHandler(handler)
            LOG.setLevel(level)


# ---- commands ---------------------------------------------------------------------------------------------------------

OUTPUT = "folder for a series and a picture of the end (default output/simulate), or a file by its suffix: "
OUTPUT += f"{opt.SUFFIXES}; may be repeated"
ACCURACY = (
    "also say what mesh, steps, solver and rounding cost the height of the centre of mass at the end, and draw the "
)
ACCURACY += "share of each tetrahedron, with an implicit solver; without --dt by steps as long as the last ones"


@app.command()
def simulate(
    context: typer.Context,
    mesh: opt.MeshFile,
    output: Annotated[list[Path] | None, Option("--output", "-o", help=OUTPUT)] = None,
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    volume: opt.Volume = "tetrahedra",
    order: opt.Order = 1,
    size: opt.Size = None,
    up: opt.UpAxis = opt.Up.y,
    fix_orientation: opt.FixOrientation = False,
    duration: Annotated[float, Option(help="simulated time [s]")] = 1.0,
    fps: Annotated[float, Option(help="frames per second")] = 30.0,
    dt: Annotated[float | None, Option(help="substep [s], taken as it is; default: follows the stable step")] = None,
    solver: Annotated[str, Option(help="verlet, semi-implicit, implicit-euler or bdf2")] = "verlet",
    gravity: Annotated[float, Option(help="along y [m/s^2]")] = -9.81,
    drag: Annotated[float, Option(help="rate at which velocities fall [1/s]")] = 0.0,
    velocity: Annotated[tuple[float, float, float], Option(help="at the start [m/s]")] = (0.0, 0.0, 0.0),
    fixed: opt.Fixed = None,
    ground: Annotated[bool, Option(help="a floor at y = 0, the body above it")] = True,
    height: Annotated[float | None, Option(help="of the lowest point [m]; default a tenth of the size")] = None,
    ground_stiffness_per_area: Annotated[
        float | None, Option(help="[N/m^3]; default from the impact's pressure")
    ] = None,
    ground_stiffness: Annotated[float | None, Option(help="of each vertex [N/m], instead of that per area")] = None,
    ground_width: Annotated[float | None, Option(help="[m]; default 1 % of the size")] = None,
    ground_friction: Annotated[float, Option(help="Coulomb's coefficient of the floor")] = 0.0,
    azimuth: Annotated[float, Option(help="where pictures are taken from, about y [degrees]")] = 32.0,
    arrows: opt.Arrows = None,
    accuracy: Annotated[bool, Option("--accuracy", help=ACCURACY)] = False,
    backend: opt.Backend = "cpu",
    precision: opt.Precision = "f32",
    threads: opt.Threads = None,
    config: opt.Config = None,
    write_config: opt.WriteConfig = None,
) -> None:
    """Simulate a body, by default its fall onto a floor; write a series and a picture of the end, or films, arrays ..."""
    begin = time.perf_counter()
    if write_config:
        return opt.write_options(context, write_config)
    opt.check_length(duration, fps, dt)
    view = View(fps=fps, azimuth=azimuth, title=mesh.stem, fit="end", arrows=tuple(arrows or ()))
    asked = [file_in(o, mesh.stem + suffix) for o in output or [Path("output/simulate")] for suffix in (".pvd", ".png")]
    writers = [writer_for(path, view) for path in dict.fromkeys(asked)]
    kind = opt.solver_class(solver)
    law = opt.make_material(material, youngs_modulus, poissons_ratio)
    body = opt.load_body(mesh, size, up, fix_orientation, order)
    runtime.init(backend, precision, threads)
    floor = dict(stiffness=ground_stiffness, stiffness_per_area=ground_stiffness_per_area)
    floor |= dict(width=ground_width, friction=ground_friction)
    scene, _ = opt.fall_scene(
        body, law, density, gravity, drag, velocity, fixed, ground, height, volume=volume, **floor
    )
    frames = max(1, round(duration * fps))
    run = ForwardRun(scene, kind, duration / frames, dt, opt.forces_named(arrows or (), scene))
    frames = max(1, round(duration / run.frame_time))  # which has whole steps
    opt.check_time_it_takes(run, duration)
    setup = time.perf_counter() - begin
    writing, files, _ = run_and_write(run, frames, writers)
    said = ""
    if accuracy:
        shares = None if kind.explicit else str(asked[0].with_name(f"{mesh.stem}_accuracy.png"))
        said = opt.accuracy_of(run, frames, shares)
        files += [shares] if shares else []
    opt.print_summary(run, setup, writing, files)
    if said:
        print(said)


@app.command()
def info(
    mesh: opt.MeshFile,
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    material: opt.MaterialName = "StableNeoHookean",
    size: opt.Size = None,
    fix_orientation: opt.FixOrientation = False,
    tight: Annotated[bool, Option("--tight", help="also the tight limit, by Lanczos")] = False,
) -> None:
    """Say what is in a mesh file: sizes, quality, groups, and the stable explicit step for given moduli."""
    body = opt.load_body(mesh, size, opt.Up.y, fix_orientation)
    scene = Scene(body, opt.make_material(material, youngs_modulus, poissons_ratio), density)
    print(body.describe())
    print(f"mass: {scene.inputs.derive(scene.inputs.values).mass.sum():.6g} kg")
    print(f"stable step for {scene.material!r}, density {density:g} kg/m^3, at rest:")
    print(f"  {element_limit(scene)}")
    if tight:
        print(f"  {stable_dt(scene)}")


@app.command()
def check(
    mesh: opt.MeshFile,
    mend: Annotated[Path | None, Option(help="write the mesh there without what can be mended in one way only")] = None,
) -> None:
    """Say what may be wrong with a mesh file, with a remedy for each; exit code 1 if there is anything."""
    parts, left_out = read_mesh(mesh)
    found = findings(parts)
    for text in left_out:
        print(f"- left out: {text}")
    print(found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            vertices, elements, vertex_sets, tetrahedron_sets, triangles = mended(parts)
            sets = dict(vertex_sets=vertex_sets, tetrahedron_sets=tetrahedron_sets, surface_sets=triangles)
            body = TetrahedralMesh(vertices, elements, **sets)
            print(f"- {step_in_words(body)}")
        except ValueError as error:
            if mend:
                raise
            print(f"- it cannot be used as it is: {error}")
        if mend:
            body.save(mend)
            print(f"written: {mend}, with {sum(finding.mended for finding in found)} of {len(found)} findings mended")
    if found or left_out:
        raise typer.Exit(1)


@app.command("check-gradients")
def check_gradients(
    mesh: opt.MeshFile,
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    material: opt.MaterialName = "StableNeoHookean",
    order: opt.Order = 1,
    size: opt.Size = None,
    up: opt.UpAxis = opt.Up.y,
    steps: Annotated[int, Option(help="length of the rollout")] = 50,
    dt: Annotated[float | None, Option(help="[s]; default half the stable step")] = None,
    solver: Annotated[str, Option(help="semi-implicit or verlet")] = "semi-implicit",
    fixed: opt.Fixed = None,
    drag: Annotated[float, Option(help="rate at which velocities fall [1/s]")] = 0.5,
    backend: opt.Backend = "cpu",
    precision: opt.Precision = "f64",
) -> None:
    """Check every gradient of a short fall onto a floor against differences.

    The body starts half a barrier width above the floor, moving, so that contact takes part. Exit code 0 if all are
    right, 1 if one is wrong.
    """
    runtime.init(backend, precision)
    law, body = opt.make_material(material, youngs_modulus, poissons_ratio), opt.load_body(mesh, size, up, order=order)
    ground = opt.make_ground(body, law, density, -9.81, 0.5, width=0.02 * np.ptp(body.bounding_box, 0).max())
    lift = 0.5 * float(ground.values["barrier_width"]) - body.bounding_box[0, 1]
    body = body.translated([0, lift, 0])
    velocities = 0.1 * np.random.default_rng(0).standard_normal(body.vertices.shape) + [0, -0.5, 0]
    terms, held = [Gravity(), Drag(drag), ground], opt.fixed_vertices(body, fixed or [])
    scene = Scene(body, law, density, terms, held, initial_velocities=velocities)
    kind = opt.solver_class(solver, implicit=False)
    dt = 0.5 * stable_dt(scene).dt if dt is None else dt
    report = judge(Rollout(kind(scene, dt=dt), steps, gradients="all"))
    if not report.passed:
        raise typer.Exit(1)


@app.command()
def demo(
    output: opt.Folder = Path("output/demo"),
    backend: opt.Backend = "cpu",
    quick: Annotated[bool, Option("--quick", hidden=True)] = False,
) -> None:
    """Drop a twisted jelly column, write pictures and a series, and take the gradient of its fall by Young's modulus."""
    from diffsim_ti.picture import save_picture

    begin = time.perf_counter()
    runtime.init(backend)
    body, law = twisted_column(3 if quick else 9), StableNeoHookean(3e4, 0.4)
    ground = opt.make_ground(body, law, 1000.0, -9.81, np.sqrt(2 * 9.81 * 0.15))
    scene = Scene(body, law, 1000.0, [Gravity(), ground])
    frames = 6 if quick else 36
    run = ForwardRun(scene, SemiImplicitSolver, 1 / 30)
    setup = time.perf_counter() - begin
    moments = (frames // 6, frames // 2, frames)
    writing, files, kept = run_and_write(run, frames, output, "column", moments)
    begin = time.perf_counter()
    points = np.concatenate([frame.positions for frame in kept])
    box, top = np.stack([points.min(0), points.max(0)]), max(np.percentile(f.fields["von_mises"], 99.5) for f in kept)
    for k, frame in enumerate(kept):
        files.append(str(output / f"column_{k}.png"))
        stress, look = frame.fields["von_mises"], dict(ground=0.0, limits=(0.0, float(top)), box=box)
        save_picture(
            files[-1], body, frame.positions, stress, "von Mises stress [Pa]", title=f"t = {frame.time:.2f} s", **look
        )
    opt.print_summary(run, setup, writing + time.perf_counter() - begin, files)
    state = dict(initial_positions=kept[1].positions, initial_velocities=kept[1].velocities)
    print_gradient(scene.replace(**state, precision="f64"))


def twisted_column(cells: int) -> TetrahedralMesh:
    """A square column 0.6 m high, wrung by 150 degrees and tilted, its lowest point 0.15 m above y = 0."""
    mesh = TetrahedralMesh.create_box((cells + 1, 3 * cells + 1, cells + 1), (0.2, 0.6, 0.2), origin=(-0.1, 0.0, -0.1))
    x, y, z = mesh.vertices.T
    angle = np.radians(150) * y / 0.6
    wrung = np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], 1)
    mesh = TetrahedralMesh(wrung, mesh.tetrahedra).rotated([0.3, 0, 1], np.radians(-28))
    return mesh.translated([0, 0.15 - mesh.bounding_box[0, 1], 0])


def print_gradient(scene: Scene, seconds: float = 0.05, change: float = 1e-3) -> None:
    """Gradient by E of the mean height after `seconds`, in float64, beside a central difference."""
    dt = 0.4 * stable_dt(scene).dt  # as fine as gradients through the contact want it
    steps = int(np.ceil(seconds / dt))
    rollout = Rollout(SemiImplicitSolver(scene, dt=seconds / steps), steps, gradients="youngs_modulus")
    E = float(scene.inputs.values["youngs_modulus"])
    frames = rollout.forward()
    by_positions = np.zeros(frames.positions.shape)
    by_positions[-1, :, 1] = 1 / scene.mesh.num_vertices
    gradient = float(rollout.vjp(frames, positions=by_positions)["youngs_modulus"])
    heights = [rollout.forward(youngs_modulus=E * (1 + s * change)).positions[-1, :, 1].mean() for s in (1, -1)]
    difference = (heights[0] - heights[1]) / (2 * change * E)
    height = frames.positions[-1, :, 1].mean()
    print(f"mean height {seconds:g} s after the middle picture: {height:.6f} m ({steps} steps, f64)")
    print(f"its gradient by Young's modulus: {gradient:.6e} m/Pa; central difference {difference:.6e} m/Pa")
