"""Sweeps over grids of numbers, and studies by executors: here, in spawned processes, on Dask's workers."""

import csv
import json

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.cli import main
from diffsim_ti.cli.study import axis
from diffsim_ti.study import Problem, Settings, chart, stability_map, sweep
from diffsim_ti.study.executors import each, pool
from diffsim_ti.study.stability_axes import AXES

FILE = """
import diffsim_ti as ds

def scene(height=0.1):
    mesh = ds.TetrahedralMesh.create_box(2, (0.1, height, 0.1))
    return ds.Scene(mesh, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=[ds.Gravity()], fixed="ymin")

def results(frames):
    return {"sag": -frames.displacements[..., 1].min()}
"""


def scene(height: float = 0.1) -> ds.Scene:
    mesh = ds.TetrahedralMesh.create_box(2, (0.1, height, 0.1))
    return ds.Scene(mesh, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=[ds.Gravity()], fixed="ymin", precision="f64")


SHORT = Settings(duration=0.02, frames=4)
OVER = dict(height=[0.1, 0.2], E=[1e4, 1e5, -1.0])


def test_rows_are_runs_of_their_own():
    done = sweep(scene, OVER, settings=SHORT)
    moved = done.column("largest displacement [m]")
    assert moved.shape == (2, 3) and np.isnan(moved[:, 2]).all() and (moved[:, 0] > moved[:, 1]).all()
    assert all(("youngs_modulus" in row["said"]) == (row["E"] < 0) for row in done.rows)
    rollout = SHORT.rollout(scene(0.2), dict(youngs_modulus=np.array(1e5)))
    frames = rollout.forward(youngs_modulus=1e5)
    assert moved[1, 1] == np.linalg.norm(frames.displacements, axis=-1).max()
    again = sweep(rollout, dict(youngs_modulus=[1e5], density=[1000.0]))
    assert again.rows[0]["largest displacement [m]"] == moved[1, 1]


@pytest.mark.parametrize(
    "over, said",
    [
        ({}, "at least one value each"),
        (dict(E=[]), "at least one value each"),
        (dict(speed=[1.0]), "'speed' is no input of the scene.*arguments of its function: height"),
    ],
)
def test_wrong_grids_are_refused(over, said):
    with pytest.raises(ValueError, match=said):
        sweep(scene, over)


def test_executors_give_the_same():
    """Two spawned processes: a sweep, a stability map and a chart, bit for bit."""
    asked = Problem.of_scene(scene(), 0.01, frames=2)
    few = dict(solvers=(ds.SemiImplicitSolver,), precisions=("f64",), levels=2, repeats=1)
    share = dict(shares=(0.5, 1.05), steps=20)
    quantity = type(AXES["nu"])("nu", "-", (0.0, 0.3), AXES["nu"].scene)
    with pool(2) as executor:
        there, mapped = sweep(scene, OVER, executor=executor, settings=SHORT), None
        mapped = stability_map(ds.SemiImplicitSolver, quantity, executor=executor, **share)
        charted = chart(asked, executor=executor, **few)
    here = sweep(scene, OVER, settings=SHORT)
    assert json.dumps(there.rows) == json.dumps(here.rows)
    alone = stability_map(ds.SemiImplicitSolver, quantity, **share)
    assert mapped.rows() == alone.rows()
    assert [p.error for p in charted.points] == [p.error for p in chart(asked, **few).points]


def test_dask():
    """Two local workers of a cluster."""
    distributed = pytest.importorskip("distributed")
    cluster = dict(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None)
    with distributed.Client(**cluster) as client:
        there = sweep(scene, OVER, executor=client.get_executor(), settings=SHORT)
    assert json.dumps(there.rows) == json.dumps(sweep(scene, OVER, settings=SHORT).rows)


def test_the_first_error_ends_it():
    with pytest.raises(ZeroDivisionError):
        each(None, lambda x: 1 / x, [(1,), (0,)])


@pytest.mark.parametrize(
    "text, values",
    [
        ("E=1e4..1e6:3:log", [1e4, 1e5, 1e6]),
        ("speed=-1..1:3", [-1, 0, 1]),
        ("nu=.3,.4", [0.3, 0.4]),
        ("youngs_modulus[soft]=1e4", [1e4]),
    ],
)
def test_axes(text, values):
    name, read = axis(text)
    assert name == text.split("=")[0] and read == pytest.approx(values, rel=1e-12)


@pytest.mark.parametrize(
    "text", ["E", "E=", "=1,2", "E=1..2", "E=0..1:5:log", "E=1..2:1", "E=1..2:3:lin", "E=1..2:3:log:x"]
)
def test_wrong_axes_are_refused(text):
    with pytest.raises(ValueError, match="expected NAME=FROM..TO:COUNT"):
        axis(text)


def test_the_command(tmp_path, capsys):
    path = tmp_path / "scene.py"
    path.write_text(FILE)
    more = ["--duration", "0.02", "--frames", "4", "-o", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as end:
        main(["sweep", str(path), "--over", "E=1e4..1e6:3:log", "--over", "height=.1,.2", *more])
    assert end.value.code == 0 and "6 runs, 0 refused" in capsys.readouterr().out
    rows = list(csv.DictReader(open(tmp_path / "out" / "sweep.csv")))
    assert list(rows[0]) == ["E", "height", "sag", "said"] and float(rows[0]["sag"]) > float(rows[-1]["sag"]) > 0
    assert json.loads((tmp_path / "out" / "sweep.json").read_text())["results"] == ["sag"]
    assert (tmp_path / "out" / "sweep.png").stat().st_size > 5000
    with pytest.raises(SystemExit) as end:
        main(["sweep", str(path), "--over", "E=-1,-2", *more])
    assert end.value.code == 2 and "no run gave a number" in capsys.readouterr().err
