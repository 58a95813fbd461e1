"""What the commands share: types of options, their TOML file (`--write-config` writes all of them, `--config` reads what is
there), the scene that options describe, the summary at the end."""

import json
import math
import runpy
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated

import numpy as np
import taichi
import torch
import typer
from numpy.typing import ArrayLike
from typer import Argument, Option

import diffsim_ti
from diffsim_ti.common.names import nearest
from diffsim_ti.materials import MATERIALS
from diffsim_ti.materials.material import Material
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.outputs import CenterOfMass, ContactForce, Output, Reaction
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import BDF2Solver, ImplicitEulerSolver, SemiImplicitSolver, Solver, VelocityVerletSolver
from diffsim_ti.terms import Drag, Gravity, Ground, Term
from diffsim_ti.terms.obstacles.stiffness import stiffness_of_impact
from diffsim_ti.writers import WRITERS
from diffsim_ti.writers.adaptive_run import ForwardRun

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

# ---- a file of options ------------------------------------------------------------------------------------------------

OWN = "config", "write-config"  # of which a file says nothing


def _parameters(context: typer.Context) -> dict:
    """The command's parameters by the keys of a file: names of options as they are typed, without dashes in front, and
    `mesh`."""
    named = {max(p.opts, key=len).lstrip("-").lower(): p for p in context.command.params}
    return {key: p for key, p in named.items() if key not in (*OWN, "help")}


def read_options(context: typer.Context, path: Path | None) -> Path | None:
    """Take what a file says for what is not typed. Raises ValueError for keys that are no options, or what is no TOML."""
    if path is None:
        return None
    if not path.is_file():
        raise ValueError(f"--config {path}: no such file; --write-config writes one")
    try:
        with open(path, "rb") as file:
            given = tomllib.load(file)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"--config {path}: {error}; --write-config writes one to begin with") from error
    known = _parameters(context)
    for key in given.keys() - known.keys():
        near = nearest(key, known)
        meant = f"did you mean {near!r}? " if near else ""
        raise ValueError(f"--config {path}: no option is called {key!r}: {meant}there are {', '.join(known)}")
    several = {key: [x] if known[key].multiple and isinstance(x, str) else x for key, x in given.items()}
    context.default_map = {known[key].name: x for key, x in several.items()}
    return path


def write_options(context: typer.Context, path: Path) -> None:
    """Write every option's value, to the bit, with its help; what is not set is left out, as a comment."""
    lines = [f"# options of `diffsim-ti {context.command.name} --config`"]
    for key, parameter in _parameters(context).items():
        value, about = context.params[parameter.name], " ".join((parameter.help or "").split())
        lines.append(f"# {key} =  # not set; {about}" if value is None else f"{key} = {_toml(value)}  # {about}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"options written to {path}")


def _toml(value) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Enum):
        value = value.value
    return repr(value) if isinstance(value, int | float) else json.dumps(str(value), ensure_ascii=False)


# ---- options ----------------------------------------------------------------------------------------------------------

Up = Enum("Up", {name: name for name in ("x", "y", "z", "-x", "-y", "-z")}, type=str)
SIDES = {f"{axis}{end}": (d, end) for d, axis in enumerate("xyz") for end in ("min", "max")}

MeshFile = Annotated[Path, Argument(metavar="MESH", help="tetrahedra, in any format that meshio reads")]
Size = Annotated[float | None, Option(help="scale the longest side of the bounding box to this [m]")]
UpAxis = Annotated[Up, Option(help="axis of the file that points up; the body is turned to have y up")]
FixOrientation = Annotated[bool, Option("--fix-orientation", help="turn inside-out tetrahedra")]
MaterialName = Annotated[str, Option(help="the law, by class name; capitals do not matter")]
Youngs = Annotated[float, Option("--youngs-modulus", "-E", help="Young's modulus [Pa]")]
Poisson = Annotated[float, Option("--poissons-ratio", "--nu", help="Poisson's ratio [-]")]
Density = Annotated[float, Option(help="[kg/m^3]")]
ARROWS = (
    "forces to draw as arrows and to write: reaction (of supports), contact, friction (its part); of a saved series "
)
ARROWS += "those that it contains; may be repeated"
Arrows = Annotated[list[str] | None, Option(help=ARROWS)]
Volume = Annotated[str, Option(help="where a change of volume is resisted: tetrahedra, or patches (near nu = 0.5)")]
Order = Annotated[int, Option(help="1: linear tetrahedra; 2: ten-node ones of the same mesh, which bend right")]
Backend = Annotated[str, Option(help="cpu, cuda or vulkan")]
Precision = Annotated[str, Option(help="f32 or f64")]
Threads = Annotated[int | None, Option(help="CPU threads, default all")]
SUFFIXES = f"{', '.join(WRITERS)} (run_%04d.png: every frame, run.png: the end)"
Fixed = Annotated[list[str] | None, Option(help="vertex set, or xmin .. zmax, to fix; may be repeated")]
CONFIG = "TOML file of options (--write-config); those typed beside it win"
Config = Annotated[Path | None, Option(is_eager=True, callback=read_options, help=CONFIG)]
WriteConfig = Annotated[Path | None, Option(help="write all options to this TOML file, and stop")]
Workers = Annotated[int, Option(help="processes that share the work")]
Folder = Annotated[Path, Option("--output", "-o", help="folder for what is written")]


def say_version(asked: bool) -> None:
    """Of the package, and of what computes."""
    if asked:
        of_taichi = ".".join(map(str, taichi.__version__))
        print(f"diffsim_ti {diffsim_ti.__version__}, taichi {of_taichi}, torch {torch.__version__}")
        raise typer.Exit


MOST_FRAMES = 10**6  # of a run: beyond it a duration is a slip
MOST_DAYS = 30  # that a run may be expected to take


def check_length(duration: float, fps: float, dt: float | None) -> None:
    """Raise ValueError for numbers of a run that are no such numbers, or make more frames or steps than anyone waits for."""
    for name, value in (("duration", duration), ("fps", fps), ("dt", dt)):
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise ValueError(f"--{name} must be > 0 and finite, got {value:g}")
    if duration * fps > MOST_FRAMES:
        raise ValueError(
            f"--duration {duration:g} at --fps {fps:g} makes {duration * fps:.3g} frames, more than {MOST_FRAMES:.0e}: "
            "shorten it, or take fewer frames per second"
        )
    frame = duration / max(1, round(duration * fps))
    if dt is not None and dt > (1 + 1e-9) * frame:
        raise ValueError(f"--dt {dt:g} s is longer than a frame, {frame:g} s: take a shorter one, or a smaller --fps")
    if dt is not None and duration / dt > 1e12:
        raise ValueError(
            f"--duration {duration:g} in steps of --dt {dt:g} s takes {duration / dt:.3g} steps, more than 1e12: shorten "
            "it, or leave --dt out"
        )


def check_time_it_takes(run: ForwardRun, duration: float) -> None:
    """Raise ValueError for a run whose explicit steps would take more than a month."""
    steps = duration / run.first_substep
    seconds = steps * (2e-6 + 2e-8 * run.scene.mesh.num_tetrahedra)  # of quick steps
    if seconds > MOST_DAYS * 86400:
        raise ValueError(
            f"--duration {duration:g} s takes about {steps:.3g} steps of {run.first_substep:.3g} s, more than "
            f"{seconds / 86400:.3g} days: shorten it, lower -E, or take --solver bdf2"
        )


def accuracy_of(run: ForwardRun, frames: int, path: str | None) -> str:
    """What the height of the centre of mass at the end of a run is off by; the shares of its tetrahedra are drawn there."""
    from diffsim_ti.picture import save_picture

    solver = run.simulator.solver.for_scene(run.scene)
    found = Rollout(solver, frames * run.parts, outputs=CenterOfMass()).accuracy("center_of_mass", (0.0, 1.0, 0.0))
    if path:
        save_picture(path, run.scene.mesh, run.simulator.positions, found.shares, "share of the error [m]")
    return str(found)


# ---- a scene from options ---------------------------------------------------------------------------------------------


def load_body(
    path: Path, size: float | None = None, up: Up = Up.y, fix_orientation: bool = False, order: int = 1
) -> TetrahedralMesh:
    """The mesh of a file, y up and of the size asked for; vertices of no tetrahedron are left out. order 2: of ten-node
    tetrahedra, made from linear ones where the file has these."""
    if order not in (1, 2):
        raise ValueError(f"--order must be 1 or 2, got {order}")
    try:
        mesh = TetrahedralMesh.from_file(path, fix_orientation=fix_orientation, drop_orphans=True)
    except ValueError as error:  # the remedy, in the words of the command line
        if "fix_orientation=True" not in str(error):
            raise
        raise ValueError(str(error).replace("fix_orientation=True", "--fix-orientation")) from error
    axis, sign = "xyz".index(up.value[-1]), -1 if up.value[0] == "-" else 1
    if up is not Up.y:
        rows = np.eye(3)[[(axis + 2) % 3, axis, (axis + 1) % 3]]
        mesh = mesh.rotated(np.diag([1, sign, sign]) @ rows)
    if size is not None:
        if not 0 < size < math.inf:
            raise ValueError(f"--size must be > 0 and finite [m], got {size:g}")
        mesh = mesh.scaled(size / np.ptp(mesh.bounding_box, 0).max())
    return mesh.quadratic() if order > mesh.order else mesh


def own_scene(
    path: Path, material: str, youngs_modulus: float, poissons_ratio: float, density: float, fixed: Sequence[str] | None
) -> Scene:
    """A scene from a Python file that defines `scene` or `scene()`, or from a mesh under its own weight."""
    if not path.exists():
        raise ValueError(f"{path}: no such file; give a mesh, or a Python file that defines scene()")
    if path.suffix == ".py":
        made = runpy.run_path(str(path)).get("scene")
        made = made() if callable(made) else made
        if not isinstance(made, Scene):
            raise ValueError(f"{path} must define `scene`, a diffsim_ti.Scene or a function that returns one")
        return made
    body, law = load_body(path), make_material(material, youngs_modulus, poissons_ratio)
    return Scene(body, law, density, Gravity(), fixed_vertices(body, fixed or []))


def make_material(name: str, youngs_modulus: float, poissons_ratio: float) -> Material:
    """A material by its class's name."""
    for kind in MATERIALS:
        if kind.__name__.lower() == name.lower().replace("-", "").replace("_", ""):
            return kind(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
    raise ValueError(f"--material: no law is called {name!r}; there are {', '.join(k.__name__ for k in MATERIALS)}")


def solver_class(name: str, implicit: bool = True) -> type[Solver]:
    """A solver's class by the name that --solver takes."""
    solvers = {"semi-implicit": SemiImplicitSolver, "verlet": VelocityVerletSolver}
    if implicit:
        solvers |= {"implicit-euler": ImplicitEulerSolver, "bdf2": BDF2Solver}
    if name not in solvers:
        raise ValueError(f"--solver must be one of {', '.join(solvers)}, got {name!r}")
    return solvers[name]


def fixed_vertices(mesh: TetrahedralMesh, names: list[str]) -> np.ndarray | None:
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


def make_ground(
    mesh: TetrahedralMesh,
    material: Material,
    density: float,
    gravity: float,
    speed: float,
    stiffness: float | None = None,
    width: float | None = None,
    stiffness_per_area: float | None = None,
    friction: float = 0.0,
) -> Ground:
    """The floor y = 0 for a body that meets it at `speed` [m/s]: width 1 % of the size, stiffness per area [N/m^3] from the
    impact, unless that of each vertex is given [N/m]."""
    width = 0.01 * np.ptp(mesh.bounding_box, 0).max() if width is None else width
    if stiffness is None and stiffness_per_area is None:
        stiffness_per_area = stiffness_of_impact(mesh, material, density, gravity, speed, width)
    return Ground(0.0, stiffness, width, stiffness_per_area=stiffness_per_area, friction=friction)


def fall_scene(
    body: TetrahedralMesh,
    law: Material,
    density: float,
    gravity: float = -9.81,
    drag: float = 0.0,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
    fixed: Sequence[str] | None = (),
    floor: bool = True,
    height: float | None = None,
    extra: Sequence[Term] = (),
    volume: str = "tetrahedra",
    **ground,
) -> tuple[Scene, TetrahedralMesh]:
    """(scene, body): a body let go above the floor y = 0, its lowest point at `height` [m], default a tenth of its size.

    fixed: as `fixed_vertices` takes them; extra: more terms; volume: as `Scene` takes it; ground: what `make_ground` takes.
    """
    terms = ([Gravity(gravity)] if gravity else []) + ([Drag(drag)] if drag else [])
    if floor:
        low, height = body.bounding_box[0, 1], 0.1 * np.ptp(body.bounding_box, 0).max() if height is None else height
        body = body.translated([0, height - low, 0])
        speed = np.sqrt(min(velocity[1], 0) ** 2 + 2 * abs(gravity) * max(height, 0))
        terms.append(make_ground(body, law, density, gravity, speed, **ground))
    elif given := [name for name, x in (dict(height=height) | ground).items() if x]:
        raise ValueError(f"there is no floor, of which {', '.join(given)} would be: leave that out, too")
    fixed = fixed_vertices(body, list(fixed or []))
    return Scene(body, law, density, terms + list(extra), fixed, initial_velocities=velocity, volume=volume), body


FORCES = ("reaction", "contact", "friction")


def forces_named(names: Sequence[str], scene: Scene) -> list[Output]:
    """Outputs of --arrows: what holds the body, what its obstacle does, and what of that is friction."""
    out = []
    for name in dict.fromkeys(names):
        if name not in FORCES:
            raise ValueError(f"--arrows: must be {', '.join(FORCES[:-1])} or {FORCES[-1]}, got {name!r}")
        if name != "reaction" and not scene.obstacles:
            raise ValueError(f"--arrows {name}: there is no obstacle; leave --no-ground out")
        if name == "reaction" and not len(scene.held):
            raise ValueError("--arrows reaction: nothing is held; name what is by --fixed")
        own = dict(name=name, per_vertex=True) | (dict(part="friction") if name == "friction" else {})
        out.append(Reaction(**own) if name == "reaction" else ContactForce(scene.obstacles[0], **own))
    return out


def works_on(scene: Scene, explicit: bool) -> list[str]:
    """What may do work on a body, or take energy from it, in words."""
    known = {"friction": any(getattr(term, "has_friction", False) for term in scene.terms)}
    known["contact damping"] = explicit and any(term.acts_on_surface for term in scene.terms)
    known |= {"drag": scene.term(Drag) is not None, "viscosity": scene.law.viscous or bool(scene.law.state_names)}
    known |= {"motion of supports": scene.motion is not None, "motion of obstacles": bool(scene.moving)}
    found = [what for what, acts in known.items() if acts] + [x.works for x in scene.interactions if x.works]
    return list(dict.fromkeys(found))


# ---- what is said at the end ------------------------------------------------------------------------------------------


def print_summary(run: ForwardRun, setup: float, writing: float, files: list[str]) -> None:
    """A table of what was simulated, how fast, how well, and where it was written."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    sim, seen = run.simulator, run.seen
    substeps, m = sum(seen.substeps), run.scene.mesh.num_tetrahedra
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))

    def row(name: str, line: str) -> None:
        table.add_row(name, Text(line))  # in which [m] is a unit, not markup

    names, named = iter(("mesh", "material", "", "solver")), ("terms", "fixed vertices", "chosen from weight and speed")
    named += ("inputs", "built", "moving by few numbers", "by pairs, also between vertices")
    for line in sim.describe().splitlines():
        name, _, rest = line.partition(": ")
        row(*(name, rest) if name in named else (next(names, ""), line))
    row("simulated", f"{sim.time:.4g} s in {len(seen.substeps)} frames")
    counts = f"{substeps}, from {min(seen.substeps)} to {max(seen.substeps)} a frame"
    row("substeps", f"{counts}, {seen.shortest:.3g} to {seen.longest:.3g} s each")
    parts = f"{len(seen.retries)}, of parts of {sim.solver.dt:.3g} s, again with half the substep; the last:"
    row("retries", parts if seen.retries else "none")
    for retry in seen.retries[-3:]:
        row("", retry if len(retry) < 130 else retry[:127] + "...")
    row("wall time", f"compile and setup {setup:.2f} s, stepping {seen.seconds:.2f} s, writing {writing:.2f} s")
    row("solves", str(sim.report) if sim.report.steps else "none: explicit steps have no equations to solve")
    each = seen.seconds / substeps
    row("speed", f"{1 / each:.0f} substeps/s, {each / m * 1e9:.1f} ns per tetrahedron and substep")
    for name, energy in (("energy at start", run.energies[0]), ("energy at end", run.energies[-1])):
        row(name, f"{energy:.6g} J: " + ", ".join(f"{k} {v:.4g}" for k, v in energy.parts.items()))
    change, acting = run.energies[-1] - run.energies[0], works_on(run.scene, explicit=sim.solver.explicit)
    drift, said = run.drift, " of the largest kinetic + elastic + contact energy"
    share = lambda energy: f"{energy:+.3g} J, {energy / max(run.largest_energy, 1e-300):+.2%}"  # noqa: E731
    if drift is None:
        row("energy change", f"{share(change)}{said}, by steps and {', '.join(acting) or 'what the law does'} together")
    else:
        if acting:
            row("energy by work", f"{share(change - drift)}{said}: {', '.join(acting)}")
        row("energy drift", f"{share(drift)}{said}: of the steps themselves")
    inverted = f", {seen.inverted} tetrahedra inside-out" if seen.inverted else ""
    row("smallest J", f"{seen.J:.4g}{inverted}")
    if run.obstacles:
        width = min(float(t.values["barrier_width"]) for t in run.obstacles)
        crossed = f"{seen.crossed} vertices crossed, by up to {-seen.gap:.3g} m" if seen.crossed else "none crossed"
        row("smallest gap", f"{seen.gap:.4g} m, barrier {width:.3g} m wide; {crossed}")
    for k, name in enumerate(files):
        row("" if k else "files", name)
    console = Console()
    Console(width=console.width if console.is_terminal else 400).print(table)
