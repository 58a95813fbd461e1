"""The command identify: numbers of a body from a CSV of marker tracks, or of a force curve."""

import csv
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, Option

import diffsim_ti as ds
from diffsim_ti.cli.options import Density, MaterialName, MeshFile, Size, Up, fixed_vertices, load_body, make_material

COLUMNS = ("time", "marker", "x", "y", "z")
CURVE = ("displacement", "force")


def read_table(path: Path) -> tuple[list[dict], set[str]]:
    """(rows, names of the columns) of a CSV."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file)
        return list(reader), set(reader.fieldnames or ())


def read_tracks(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(times [s], places [m] of shape (times, markers, 3)) of a CSV; NaN where missing."""
    table, names = read_table(path)
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise ValueError(f"{path}: no column {missing[0]!r}; needed are {', '.join(COLUMNS)}")
    rows = [(row["marker"], *(float(row[name] or "nan") for name in ("time", "x", "y", "z"))) for row in table]
    times, markers = sorted({row[1] for row in rows}), sorted({row[0] for row in rows})
    places = np.full((len(times), len(markers), 3), np.nan)
    for marker, time, *place in rows:
        places[times.index(time), markers.index(marker)] = place
    if len(times) < 4 or times[0] != 0 or not np.isfinite(places[0]).all():
        raise ValueError(f"{path}: needs four times or more, and at time 0 every marker, where the body is as its mesh")
    return np.array(times), places


def read_curve(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(displacements [m], forces [N], NaN where missing) of a CSV."""
    rows = [[float(row[name] or "nan") for name in CURVE] for row in read_table(path)[0]]
    ways, forces = np.array(rows).reshape(-1, 2).T
    if len(ways) == 0 or not np.isfinite(ways).all():
        raise ValueError(f"{path}: needs a displacement [m] in each of one row or more")
    return ways, forces


def numbers_of(unknown: list[str]) -> dict[str, float]:
    """{input: guess} of texts such as youngs_modulus=1e5."""
    guesses = {}
    for text in unknown:
        name, _, value = text.partition("=")
        try:
            guesses[name] = float(value)
        except ValueError:
            raise ValueError(f"--unknown: expected input=guess, such as youngs_modulus=1e5, got {text!r}") from None
    return guesses


DATA = "CSV with columns time, marker, x, y, z [s, m], all markers at time 0; or "
DATA += "displacement, force [m, N], in equilibrium, without the weight"


def identify(
    mesh: MeshFile,
    data: Annotated[Path, Argument(help=DATA)],
    unknown: Annotated[list[str], Option(help="input=guess, such as youngs_modulus=1e5; may be repeated")],
    noise: Annotated[float, Option(help="standard deviation of a coordinate [m], or of a force [N]")],
    material: MaterialName = "StableNeoHookean",
    youngs_modulus: Annotated[float, Option("--youngs-modulus", "-E", help="where it is known [Pa]")] = 1e5,
    poissons_ratio: Annotated[float, Option("--poissons-ratio", "--nu", help="where it is known [-]")] = 0.4,
    density: Density = 1000.0,
    size: Size = None,
    gravity: Annotated[float, Option(help="along y [m/s^2]")] = -9.81,
    drag: Annotated[float, Option(help="rate at which velocities fall [1/s]; a guess if unknown")] = 0.0,
    fixed: Annotated[list[str] | None, Option(help="vertex set, or xmin .. zmax, to fix")] = None,
    pull: Annotated[str | None, Option(help="of a force curve: vertex set, or xmin .. zmax, that is moved")] = None,
    along: Annotated[Up, Option(help="of a force curve: where the displacement and the force point")] = Up.y,
    starts: Annotated[
        int | None, Option(help="how many searches; default more than one where the first explains nothing")
    ] = None,
    check_mesh: Annotated[
        bool | None, Option("--check-mesh/--no-check-mesh", help="fit again by ten-node tetrahedra; default if cheap")
    ] = None,
    output: Annotated[Path, Option("--output", "-o", help="picture")] = Path("output/identify.png"),
) -> None:
    """Find numbers of a body, with 95 % intervals, from tracks of markers on it or a force curve; draw data and fit."""
    from diffsim_ti.identification.result import save_picture

    guesses, body = numbers_of(unknown), load_body(mesh, size)
    law = make_material(
        material, guesses.get("youngs_modulus", youngs_modulus), guesses.get("poissons_ratio", poissons_ratio)
    )
    ds.init(precision="f64")
    curve = set(CURVE) <= read_table(data)[1]
    if curve != (pull is not None):
        raise ValueError(
            "--pull: which vertices the machine moves; it belongs to a CSV with columns displacement, force"
        )
    terms = [ds.Gravity((0.0, gravity, 0.0))] if gravity and not curve else []
    terms += [ds.Drag(guesses.get("drag", drag))] if (drag or "drag" in guesses) and not curve else []
    if curve:
        rollout, measured, ways = _pulled(body, law, density, fixed or [], pull, along, read_curve(data), noise)
    else:
        scene = ds.Scene(body, law, density, terms, fixed_vertices(body, fixed or []), precision="f64")
        (rollout, measured), ways = _tracked(scene, *read_tracks(data), noise), None
    found = ds.identify(rollout, measured, guesses, progress=True, starts=starts, check_mesh=check_mesh)
    print(found)
    more = {} if ways is None else dict(at=ways, at_label="displacement [m]")
    save_picture(output, found, measured, rollout.forward(**found.inputs[0]), **more)
    print(f"picture written to {output}")


def _tracked(scene, times: np.ndarray, places: np.ndarray, noise: float):
    """The rollout that markers were seen in, and what was seen."""
    frame = float(np.median(np.diff(times)))
    steps = max(4, int(np.ceil(times[-1] / frame - 1e-9)))
    solver = ds.VelocityVerletSolver(scene, dt=frame)
    solver.choose_substeps(share=0.4)  # stable up to six times the stiffness guessed
    markers = ds.MaterialPoints(places[0], nearest=True)
    rollout = ds.Rollout(solver, steps, save_every=1, outputs=[markers])
    return rollout, ds.Measurement(markers.name, places[1:], noise, times=np.minimum(times[1:], rollout.times[-1]))


def _pulled(body, law, density, fixed: list[str], pull: str, along: Up, curve, noise: float):
    """The equilibria in which a force was read, what was read, and the displacements of all frames [m]."""
    ways, forces = (np.concatenate([[start], x]) for start, x in zip((0.0, np.nan), curve))
    axis, sign = "xyz".index(along.value[-1]), -1.0 if along.value.startswith("-") else 1.0
    rows = np.zeros((len(ways), 3))
    rows[:, axis] = sign * ways
    held, moved = fixed_vertices(body, fixed), fixed_vertices(body, [pull])
    both = np.union1d(held, moved)
    if len(np.intersect1d(held, moved)):
        raise ValueError(f"--pull {pull}: shares vertices with what is --fixed")
    of_each = rows[:, None] * np.isin(both, moved)[:, None]
    motion = np.arange(float(len(ways))), of_each
    scene = ds.Scene(body, law, density, fixed=both, motion=motion, precision="f64")
    grip = ds.Reaction(moved, name="force")
    rollout = ds.Rollout(ds.StaticSolver(scene), len(ways) - 1, save_every=1, outputs=[grip])
    read = np.full((len(ways), 3), np.nan)
    read[:, axis] = sign * forces
    return rollout, ds.Measurement("force", read, noise), ways
