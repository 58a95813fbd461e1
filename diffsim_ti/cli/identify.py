"""The command identify: numbers of a body from a CSV of marker tracks."""

import csv
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffsim_ti.cli.options import Density, MaterialName, MeshFile, Size, fixed_vertices, load_body, make_material

COLUMNS = ("time", "marker", "x", "y", "z")


def read_tracks(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(times [s], places [m] of shape (times, markers, 3)) of a CSV; NaN where missing."""
    with open(path, newline="") as file:
        reader = csv.DictReader(file)
        missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"{path}: no column {missing[0]!r}; needed are {', '.join(COLUMNS)}")
        rows = [(row["marker"], *(float(row[name] or "nan") for name in ("time", "x", "y", "z"))) for row in reader]
    times, markers = sorted({row[1] for row in rows}), sorted({row[0] for row in rows})
    places = np.full((len(times), len(markers), 3), np.nan)
    for marker, time, *place in rows:
        places[times.index(time), markers.index(marker)] = place
    if len(times) < 4 or times[0] != 0 or not np.isfinite(places[0]).all():
        raise ValueError(f"{path}: needs four times or more, and at time 0 every marker, where the body is as its mesh")
    return np.array(times), places


def identify(
    mesh: MeshFile,
    data: Annotated[Path, typer.Argument(help="CSV with columns time, marker, x, y, z [s, m]; all markers at time 0")],
    unknown: Annotated[list[str], typer.Option(help="input=guess, such as youngs_modulus=1e5; may be repeated")],
    noise: Annotated[float, typer.Option(help="standard deviation of a coordinate [m]")],
    material: MaterialName = "StableNeoHookean",
    youngs_modulus: Annotated[float, typer.Option("--youngs-modulus", "-E", help="where it is known [Pa]")] = 1e5,
    poissons_ratio: Annotated[float, typer.Option("--poissons-ratio", "--nu", help="where it is known [-]")] = 0.4,
    density: Density = 1000.0,
    size: Size = None,
    gravity: Annotated[float, typer.Option(help="along y [m/s^2]")] = -9.81,
    drag: Annotated[float, typer.Option(help="rate at which velocities fall [1/s]; a guess if unknown")] = 0.0,
    fixed: Annotated[list[str] | None, typer.Option(help="vertex set, or xmin .. zmax, to hold")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="picture")] = Path("output/identify.png"),
) -> None:
    """Find numbers of a body from tracks of markers on it, with 95 % intervals; write a picture of data and fit."""
    import diffsim_ti as ds
    from diffsim_ti.identification.picture import save_picture

    times, places = read_tracks(data)
    guesses = {}
    for text in unknown:
        name, _, value = text.partition("=")
        try:
            guesses[name] = float(value)
        except ValueError:
            raise ValueError(f"--unknown: expected input=guess, such as youngs_modulus=1e5, got {text!r}") from None
    body = load_body(mesh, size)
    law = make_material(
        material, guesses.get("youngs_modulus", youngs_modulus), guesses.get("poissons_ratio", poissons_ratio)
    )
    ds.init(precision="f64")
    terms = [
        ds.Gravity((0.0, gravity, 0.0)),
        *([ds.Drag(guesses.get("drag", drag))] if drag or "drag" in guesses else []),
    ]
    scene = ds.Scene(body, law, density, terms, fixed_vertices(body, fixed or []), precision="f64")
    frame = float(np.median(np.diff(times)))
    substeps = int(np.ceil(frame / (0.4 * ds.stable_dt(scene))))  # stable up to six times the stiffness guessed
    steps = max(4, int(np.ceil(times[-1] / frame - 1e-9)))
    solver = ds.VelocityVerletSolver(scene, dt=frame, substeps=substeps)
    markers = ds.MaterialPoints(places[0], nearest=True)
    rollout = ds.Rollout(solver, steps, save_every=1, outputs=[markers])
    measured = ds.Measurement(markers.name, places[1:], noise, times=np.minimum(times[1:], rollout.times[-1]))
    found = ds.identify(rollout, measured, guesses, progress=True)
    print(found)
    save_picture(output, found, measured, rollout.forward(**found.inputs[0]))
    print(f"picture written to {output}")
