"""The command line: `diffsim-ti` or `python -m diffsim_ti`. One function per command; heavy imports inside them."""

import sys
import time
import warnings
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffsim_ti.series import Interrupted

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, help="Soft bodies on tetrahedra.")
ClickException = typer.BadParameter.__mro__[2]  # typer carries click inside or beside it, depending on its version
Up = Enum("Up", {name: name for name in ("x", "y", "z", "-x", "-y", "-z")}, type=str)
SIDES = {f"{axis}{end}": (d, end) for d, axis in enumerate("xyz") for end in ("min", "max")}

MeshFile = Annotated[Path, typer.Argument(metavar="MESH", help="tetrahedra, in any format that meshio reads")]
Size = Annotated[float | None, typer.Option(help="scale the longest side of the bounding box to this [m]")]
UpAxis = Annotated[Up, typer.Option(help="axis of the file that points up; the body is turned to have y up")]
FixOrientation = Annotated[bool, typer.Option("--fix-orientation", help="turn inside-out tetrahedra")]
MaterialName = Annotated[str, typer.Option(help="the law, by class name; capitals do not matter")]
Youngs = Annotated[float, typer.Option("--youngs-modulus", "-E", help="Young's modulus [Pa]")]
Poisson = Annotated[float, typer.Option("--poissons-ratio", "--nu", help="Poisson's ratio [-]")]
Density = Annotated[float, typer.Option(help="[kg/m^3]")]
Backend = Annotated[str, typer.Option(help="cpu, cuda or vulkan")]
Precision = Annotated[str, typer.Option(help="f32 or f64")]
Threads = Annotated[int | None, typer.Option(help="CPU threads, default all")]
Output = Annotated[Path, typer.Option("--output", "-o", help="folder for the series and the picture")]


@app.callback()
def options(traceback: Annotated[bool, typer.Option("--traceback", help="show the traceback of an error")] = False):
    """Soft bodies on tetrahedra, simulated with Taichi. Errors are one line on stderr, with exit code 2."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and exit: 0 done, 2 an error, 130 interrupted."""
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    wants_traceback = "--traceback" in arguments  # wherever it stands
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)
        try:
            code = app([a for a in arguments if a != "--traceback"], standalone_mode=False, prog_name="diffsim-ti")
        except Interrupted as stop:
            code = _fail(str(stop), 130)
        except (KeyboardInterrupt, typer.Abort):
            code = _fail("interrupted", 130)
        except ClickException as error:
            code = _fail(f"{error.format_message()} (see diffsim-ti --help)")
        except (ValueError, TypeError, RuntimeError, OSError, FloatingPointError, MemoryError) as error:
            if wants_traceback:
                raise
            code = _fail(str(error) or type(error).__name__)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int = 2) -> int:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return code


@contextmanager
def progress(title: str, total: int):
    """Yields a function to tell what is done; shows it on stderr after two seconds, as lines if that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn(),
                   console=console, transient=True)  # fmt: skip
    task, start, said = bar.add_task(title, total=total, note=""), time.perf_counter(), [time.perf_counter()]

    def update(done: int, note: str = "") -> None:
        now = time.perf_counter()
        if console.is_terminal and now - start > 2 and not bar.live.is_started:
            bar.start()
        elif not console.is_terminal and now - said[0] > 5:
            said[0] = now
            print(f"{title}: {done} of {total}, {note}", file=sys.stderr, flush=True)
        bar.update(task, completed=done, note=note)

    try:
        yield update
    finally:
        bar.stop()


# ---- a scene from options ---------------------------------------------------------------------------------------------


def load_body(path: Path, size: float | None = None, up: Up = Up.y, fix_orientation: bool = False):
    """The mesh of a file, y up and of the size asked for; vertices of no tetrahedron are left out."""
    from diffsim_ti.mesh import TetrahedralMesh

    mesh = TetrahedralMesh.from_file(path, fix_orientation=fix_orientation, drop_orphans=True)
    axis, sign = "xyz".index(up.value[-1]), -1 if up.value[0] == "-" else 1
    if up is not Up.y:
        rows = np.eye(3)[[(axis + 2) % 3, axis, (axis + 1) % 3]]
        mesh = mesh.rotated(np.diag([1, sign, sign]) @ rows)
    if size is not None:
        if not size > 0:
            raise ValueError(f"--size must be > 0 [m], got {size:g}")
        mesh = mesh.scaled(size / np.ptp(mesh.bounding_box, 0).max())
    return mesh


def make_material(name: str, youngs_modulus: float, poissons_ratio: float):
    """A material by its class's name."""
    from diffsim_ti.materials import MATERIALS

    for kind in MATERIALS:
        if kind.__name__.lower() == name.lower().replace("-", "").replace("_", ""):
            return kind(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
    raise ValueError(f"--material: no law is called {name!r}; there are {', '.join(k.__name__ for k in MATERIALS)}")


def fixed_vertices(mesh, names: list[str]) -> np.ndarray | None:
    """Vertices of the mesh's sets, or, for xmin .. zmax, those within 1 % of the size from that side."""
    chosen = []
    for name in names:
        if name in SIDES and name not in mesh.vertex_sets:
            (d, end), box = SIDES[name], mesh.bounding_box
            off = np.abs(mesh.vertices[:, d] - box[int(end == "max"), d])
            chosen.append(np.flatnonzero(off <= 0.01 * np.ptp(box, 0).max()))
        else:
            chosen.append(mesh.vertex_indices(name))
    return np.unique(np.concatenate(chosen)) if chosen else None


def make_ground(mesh, material, density: float, gravity: float, speed: float, stiffness: float | None = None,
                width: float | None = None):  # fmt: skip
    """The floor y = 0 for a body that meets it at `speed` [m/s]: width 1 % of the size, stiffness from the impact.

    A front that is stopped feels p = rho c v (c the speed of pressure waves), to which come rho v^2 and the weight of the
    column above, rho g H. A vertex of mean surface area A shall carry p A at half the width: k = p A / (1.19 w). A vertex
    that meets the floor alone may carry 47 times that before it uses 98 % of the width.
    """
    from diffsim_ti.terms import Ground

    extent = np.ptp(mesh.bounding_box, 0)
    width = 0.01 * extent.max() if width is None else width
    if stiffness is None:
        mu, lam = material.lame(material.values(mesh))
        wave = np.sqrt(np.max(lam + 2 * mu) / density)
        pressure = density * (wave * speed + speed**2 + abs(gravity) * extent[1])
        a, b, c = (mesh.vertices[mesh.surface_triangles[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / len(mesh.surface_vertices)
        stiffness = float(pressure * area / (1.19 * width))
    return Ground(0.0, stiffness, width)


# ---- what is said at the end ------------------------------------------------------------------------------------------


def print_summary(run, setup: float, writing: float, files: list[str]) -> None:
    """A table of what was simulated, how fast, how well, and where it was written."""
    from rich.console import Console
    from rich.table import Table

    sim, seen = run.simulator, run.seen
    substeps, m = sum(seen.substeps), run.scene.mesh.num_tetrahedra
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    names = iter(("mesh", "material", "", "solver"))
    for line in sim.describe().splitlines():
        table.add_row(*line.split(": ", 1) if line.startswith(("terms", "fixed", "built")) else (next(names, ""), line))
    table.add_row("simulated", f"{sim.time:.4g} s in {len(seen.substeps)} frames")
    counts = f"{substeps}, from {min(seen.substeps)} to {max(seen.substeps)} a frame"
    table.add_row("substeps", f"{counts}, {seen.shortest:.3g} to {seen.longest:.3g} s each")
    parts = f"{len(seen.retries)}, of parts of {sim.solver.dt:.3g} s, again with half the substep; the last:"
    table.add_row("retries", parts if seen.retries else "none")
    for retry in seen.retries[-3:]:
        table.add_row("", retry if len(retry) < 130 else retry[:127] + "...")
    table.add_row("wall time", f"compile and setup {setup:.2f} s, stepping {seen.seconds:.2f} s, writing {writing:.2f} s")
    each = seen.seconds / substeps
    table.add_row("speed", f"{1 / each:.0f} substeps/s, {each / m * 1e9:.1f} ns per tetrahedron and substep")
    for name, energy in (("energy at start", run.energies[0]), ("energy at end", run.energies[-1])):
        table.add_row(name, f"{energy:.6g} J: " + ", ".join(f"{k} {v:.4g}" for k, v in energy.parts.items()))
    drift = run.energies[-1] - run.energies[0]
    share = drift / max(run.largest_energy, 1e-300)
    table.add_row("energy drift", f"{drift:+.3g} J, {share:+.2%} of the largest kinetic + elastic + contact energy")
    inverted = f", {seen.inverted} tetrahedra inside-out at once" if seen.inverted else ""
    table.add_row("smallest J", f"{seen.J:.4g}{inverted}")
    if run.ground:
        width = float(run.ground.values["barrier_width"])
        crossed = f"{seen.crossed} vertices crossed, by up to {-seen.gap:.3g} m" if seen.crossed else "none crossed"
        table.add_row("smallest gap", f"{seen.gap:.4g} m, barrier {width:.3g} m wide; {crossed}")
    for k, name in enumerate(files):
        table.add_row("" if k else "files", name)
    console = Console()
    Console(width=console.width if console.is_terminal else 400).print(table)


# ---- commands ---------------------------------------------------------------------------------------------------------


@app.command()
def simulate(
    mesh: MeshFile,
    output: Output = Path("output/simulate"),
    material: MaterialName = "StableNeoHookean",
    youngs_modulus: Youngs = 1e5,
    poissons_ratio: Poisson = 0.4,
    density: Density = 1000.0,
    size: Size = None,
    up: UpAxis = Up.y,
    fix_orientation: FixOrientation = False,
    duration: Annotated[float, typer.Option(help="simulated time [s]")] = 1.0,
    fps: Annotated[float, typer.Option(help="frames per second")] = 30.0,
    dt: Annotated[float | None, typer.Option(help="substep [s], taken as it is; default: follows the stable step")] = None,
    solver: Annotated[str, typer.Option(help="semi-implicit or verlet")] = "semi-implicit",
    gravity: Annotated[float, typer.Option(help="along y [m/s^2]")] = -9.81,
    drag: Annotated[float, typer.Option(help="rate at which velocities fall [1/s]")] = 0.0,
    velocity: Annotated[tuple[float, float, float], typer.Option(help="at the start [m/s]")] = (0.0, 0.0, 0.0),
    fixed: Annotated[list[str] | None, typer.Option(help="vertex set, or xmin .. zmax, to hold; may be repeated")] = None,
    ground: Annotated[bool, typer.Option(help="a floor at y = 0, the body above it")] = True,
    height: Annotated[float | None, typer.Option(help="of the lowest point [m]; default a tenth of the size")] = None,
    ground_stiffness: Annotated[float | None, typer.Option(help="[N/m]; default from the impact's pressure")] = None,
    ground_width: Annotated[float | None, typer.Option(help="[m]; default 1 % of the size")] = None,
    azimuth: Annotated[float, typer.Option(help="where the picture is taken from, about y [degrees]")] = 32.0,
    backend: Backend = "cpu",
    precision: Precision = "f32",
    threads: Threads = None,
):
    """Simulate a body, by default its fall onto a floor; write a ParaView series and a picture of the end."""
    from diffsim_ti import runtime
    from diffsim_ti.picture import save_picture
    from diffsim_ti.scene import Scene
    from diffsim_ti.series import ForwardRun, run_and_write
    from diffsim_ti.solvers import SemiImplicitSolver, VelocityVerletSolver
    from diffsim_ti.terms import Drag, Gravity

    begin = time.perf_counter()
    for name, value in (("duration", duration), ("fps", fps), ("density", density)):
        if not value > 0:
            raise ValueError(f"--{name} must be > 0, got {value:g}")
    solvers = {"semi-implicit": SemiImplicitSolver, "verlet": VelocityVerletSolver}
    if solver not in solvers:
        raise ValueError(f"--solver must be one of {', '.join(solvers)}, got {solver!r}")
    law = make_material(material, youngs_modulus, poissons_ratio)
    body = load_body(mesh, size, up, fix_orientation)
    runtime.init(backend, precision, threads)
    terms = [Gravity(gravity)] if gravity else []
    if drag:
        terms.append(Drag(drag))
    if ground:
        low, height = body.bounding_box[0, 1], 0.1 * np.ptp(body.bounding_box, 0).max() if height is None else height
        body = body.translated([0, height - low, 0])
        speed = np.sqrt(min(velocity[1], 0) ** 2 + 2 * abs(gravity) * max(height, 0))
        terms.append(make_ground(body, law, density, gravity, speed, ground_stiffness, ground_width))
    scene = Scene(body, law, density, terms, fixed_vertices(body, fixed or []), initial_velocities=velocity)
    frames = max(1, round(duration * fps))
    run = ForwardRun(scene, solvers[solver], duration / frames, dt)
    setup = time.perf_counter() - begin
    writing, files, _ = run_and_write(run, frames, output, mesh.stem)
    begin = time.perf_counter()
    sim, picture = run.simulator, output / f"{mesh.stem}.png"
    save_picture(picture, body, sim.positions, sim.tetrahedron_fields().von_mises, "von Mises stress [Pa]",
                 0.0 if ground else None, f"{mesh.stem}, t = {sim.time:.3g} s", azimuth=azimuth)  # fmt: skip
    print_summary(run, setup, writing + time.perf_counter() - begin, [*files, str(picture)])


@app.command()
def info(
    mesh: MeshFile,
    youngs_modulus: Youngs = 1e5,
    poissons_ratio: Poisson = 0.4,
    density: Density = 1000.0,
    material: MaterialName = "StableNeoHookean",
    size: Size = None,
    fix_orientation: FixOrientation = False,
    tight: Annotated[bool, typer.Option("--tight", help="also the tight limit, by Lanczos")] = False,
):
    """Say what is in a mesh file: sizes, quality, groups, and the stable explicit step for given moduli."""
    from diffsim_ti import stability
    from diffsim_ti.scene import Scene

    body = load_body(mesh, size, Up.y, fix_orientation)
    scene = Scene(body, make_material(material, youngs_modulus, poissons_ratio), density)
    print(body.describe())
    print(f"mass: {scene.inputs.derive(scene.inputs.values).mass.sum():.6g} kg")
    print(f"stable step for {scene.material!r}, density {density:g} kg/m^3, at rest:")
    print(f"  {stability.element_limit(scene)}")
    if tight:
        from diffsim_ti.solvers import SemiImplicitSolver

        print(f"  {SemiImplicitSolver(scene, dt=1.0, allow_unstable=True).stable_dt(tight=True)}")


@app.command()
def demo(
    output: Output = Path("output/demo"),
    backend: Backend = "cpu",
    quick: Annotated[bool, typer.Option("--quick", hidden=True)] = False,
):
    """Drop a twisted jelly column, write pictures and a series, and take the gradient of its fall by Young's modulus."""
    from diffsim_ti import runtime
    from diffsim_ti.materials import StableNeoHookean
    from diffsim_ti.picture import save_picture
    from diffsim_ti.scene import Scene
    from diffsim_ti.series import ForwardRun, run_and_write
    from diffsim_ti.solvers import SemiImplicitSolver
    from diffsim_ti.terms import Gravity

    begin = time.perf_counter()
    runtime.init(backend)
    body, law = twisted_column(3 if quick else 9), StableNeoHookean(3e4, 0.4)
    ground = make_ground(body, law, 1000.0, -9.81, np.sqrt(2 * 9.81 * 0.15))
    scene = Scene(body, law, 1000.0, [Gravity(), ground])
    frames = 6 if quick else 36
    run = ForwardRun(scene, SemiImplicitSolver, 1 / 30)
    setup = time.perf_counter() - begin
    moments = (frames // 6, frames // 2, frames)
    writing, files, kept = run_and_write(run, frames, output, "column", moments)
    begin = time.perf_counter()
    points = np.concatenate([positions for _, positions, _, _ in kept])
    box, top = np.stack([points.min(0), points.max(0)]), max(np.percentile(stress, 99.5) for *_, stress in kept)
    for k, (t, positions, _, stress) in enumerate(kept):
        files.append(str(output / f"column_{k}.png"))
        save_picture(files[-1], body, positions, stress, "von Mises stress [Pa]", 0.0, f"t = {t:.2f} s", (0.0, float(top)),
                     box=box)  # fmt: skip
    print_summary(run, setup, writing + time.perf_counter() - begin, files)
    _, positions, velocities, _ = kept[1]
    print_gradient(scene.replace(initial_positions=positions, initial_velocities=velocities, precision="f64"))


def twisted_column(cells: int):
    """A square column 0.6 m high, wrung by 150 degrees and tilted, its lowest point 0.15 m above y = 0."""
    from diffsim_ti.mesh import TetrahedralMesh

    mesh = TetrahedralMesh.create_box((cells + 1, 3 * cells + 1, cells + 1), (0.2, 0.6, 0.2), origin=(-0.1, 0.0, -0.1))
    x, y, z = mesh.vertices.T
    angle = np.radians(150) * y / 0.6
    wrung = np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], 1)
    mesh = TetrahedralMesh(wrung, mesh.tetrahedra).rotated([0.3, 0, 1], np.radians(-28))
    return mesh.translated([0, 0.15 - mesh.bounding_box[0, 1], 0])


def print_gradient(scene, seconds: float = 0.05, change: float = 1e-3) -> None:
    """Gradient by E of the mean height after `seconds`, in float64, beside a central difference."""
    from diffsim_ti.rollout import Rollout
    from diffsim_ti.solvers import SemiImplicitSolver

    dt = 0.5 * SemiImplicitSolver(scene, dt=1.0, allow_unstable=True).stable_dt(tight=True).dt
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
