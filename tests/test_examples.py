"""Every example runs and finds what it looks for."""

import json
import os
import runpy
import subprocess
import sys

import numpy as np
import pytest
from example_files import EXAMPLES, example

ARCH = os.environ.get("DIFFSIM_TI_ARCH", "cpu")


def test_throw_at_target(capsys):
    numbers = example("control/throw_at_target").main()
    assert numbers["miss"] <= 1e-6 and numbers["iterations"] <= 6
    # drag c and steps h make v = (target - fall) c / (1 - exp(-c T)) up to the order of the step
    c, T = 0.6, 0.6
    fall = np.array([0, -9.81, 0]) * (T - (1 - np.exp(-c * T)) / c) / c
    expected = (np.array([2.0, 1.2, -0.5]) - fall) * c / (1 - np.exp(-c * T))
    np.testing.assert_allclose(numbers["velocity"], expected, rtol=5e-3)
    assert "throw with" in capsys.readouterr().out


def test_stiffness_field(tmp_path):
    """Every tetrahedron is told right, and to a per cent in the median, from noise of 20 micrometres."""
    result = example("identify/stiffness_field").main(tmp_path)
    assert result["median_error"] < 0.005 and result["worst_tenth"] < 0.02 and result["classified"] == 1
    assert result["simulations"] < 400 and (tmp_path / "stiffness_field.png").stat().st_size > 5000


def test_costs_of_identification():
    """On a field of 72 unknowns: fewer simulations than differences, whose share grows with the unknowns."""
    told = example("benchmarks/identify_costs").main(cells=(3, 2, 2), most=250, rates=(0.1,))
    for found in told.values():
        for best, theirs in zip(found["Levenberg-Marquardt"], found["SciPy, differences"]):
            assert theirs is None or best[0] <= theirs[0]


def test_identify_beam(capsys):
    numbers = example("identify/identify_beam").main()
    assert numbers["error"] <= 1e-3 and numbers["evaluations"] <= 20
    assert 0.08 <= numbers["residual_mm"] <= 0.12  # nothing is left but the noise of 0.1 mm
    assert "E = " in capsys.readouterr().out


def test_scipys_minimisers(capsys):
    found = example("identify/with_scipy").main()
    assert all(one["worst"] < 0.02 for one in found.values())  # noise of 0.02 mm
    np.testing.assert_allclose(found["L-BFGS-B"]["E"], found["Newton-CG"]["E"], rtol=1e-2)
    assert found["L-BFGS-B"]["runs"] <= 60 and "Newton-CG: E =" in capsys.readouterr().out


def test_walker(tmp_path, capsys):
    """Four of its 25 iterations."""
    numbers = example("control/walker").main(tmp_path, iterations=4)
    assert numbers["way_before"] + 0.003 < numbers["way"] and "walker, a second" in capsys.readouterr().out
    assert (tmp_path / "walker.gif").stat().st_size > 100_000


def test_swimmer(tmp_path, capsys, monkeypatch):
    """Of two of its five seconds; four iterations bring it more than ten times as far as it came by random strokes."""
    swimmer = example("control/swimmer")
    monkeypatch.setattr(swimmer, "STEPS", 100)
    numbers = swimmer.main(tmp_path, iterations=4)
    assert numbers["way"] > 0.03 > 10 * numbers["way_before"] > 0 and abs(numbers["aside"]) < 0.02
    assert "swimmer, five seconds" in capsys.readouterr().out and (tmp_path / "swimmer.gif").stat().st_size > 50_000


def test_tutorial(tmp_path, capsys, monkeypatch):
    """As a script."""
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "tutorial.py"), run_name="__main__")
    said = capsys.readouterr()
    assert not said.err and "friction" in said.out and "WRONG" not in said.out and "E = 4.5" in said.out, said
    assert (tmp_path / "output" / "tutorial.png").stat().st_size > 20_000


def test_inverse_rest_shape(capsys):
    numbers = example("design/inverse_rest_shape").main()
    assert numbers["ratio"] >= 100 and numbers["iterations"] <= 6
    assert numbers["lift"] > numbers["before"] > 0.05  # cast upwards, by more than the mean sag
    assert "sag" in capsys.readouterr().out


def test_stack(capsys):
    numbers = example("contact/stack").main(3, 0.3)
    assert 0.29 < numbers["height"] < 0.31 and numbers["drift"] < 1e-5 and numbers["gap"] > 1e-3
    assert min(numbers["between"]) > 0 and "high after" in capsys.readouterr().out


def test_bowl(capsys):
    numbers = example("contact/bowl").main(4, 2, 22)
    assert 0 < numbers["gap"] < 0.25 * 0.1 / 2 and numbers["radius"] < 0.5
    assert "no surface passed through another" in capsys.readouterr().out


@pytest.mark.parametrize("precision", ["f32", pytest.param("f64", marks=pytest.mark.thorough)])
def test_benchmark(precision):
    """In a process of its own: it starts Taichi."""
    command = [sys.executable, EXAMPLES / "benchmarks" / "speed.py", *"--common --json --sizes 4 --repeats 1".split()]
    paths = os.pathsep.join([str(EXAMPLES.parent), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run([*command, "--precision", precision], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    row = json.loads([line for line in done.stdout.splitlines() if line.startswith("{")][-1])
    assert row["who"] == "diffsim_ti" and row["tets"] == 6 * 3**3 and row["precision"] == precision
    assert 0 < row["forward_ns"] < row["forward_backward_ns"]


@pytest.mark.executed_ptx
@pytest.mark.parametrize(
    "more", [["reference", "explicit f32"], pytest.param(["1 scenes"], marks=pytest.mark.thorough)], ids=" ".join
)
def test_gpu_gate(more):
    """Parts of the script for the day a card is there, each in a process of its own, on whatever this run is on."""
    only = ["device", *more, "Warp, 48,000"]
    command = [sys.executable, str(EXAMPLES / "benchmarks/gpu_gate.py"), f"--arch={ARCH}", "--largest=6000", "--only"]
    out = subprocess.run([*command, *only], capture_output=True, text=True)
    rows = {row["part"]: row for row in (json.loads(line) for line in out.stdout.splitlines() if line.startswith("{"))}
    assert out.returncode == 0 and list(rows) == only, out.stdout + out.stderr
    assert rows["device"]["arch"] == ARCH and rows[more[-1]]["passed"] and "left_out" in rows["Warp, 48,000"]
    assert "1 scenes" in more or "| explicit f32 | motion" in out.stdout
