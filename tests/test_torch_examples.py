"""The torch examples recover what they should; each writes a picture, and goes on where it was stopped."""

import json
import os
import shutil
import subprocess
import sys
import time

import pytest
import torch
from example_files import EXAMPLES, example

from diffsim_ti import TetrahedralMesh
from diffsim_ti.optimization import load_state


def check_files(folder, *names, kind="png"):
    for name in names:
        assert (folder / f"{name}.{kind}").stat().st_size > 5000 and (folder / f"{name}.state").exists()


def test_identify(tmp_path, capsys):
    result = example("identify/identify_torch").main(tmp_path)
    assert result["falling"]["E_error"] < 0.01
    assert result["sagging"]["E_error"] < 1e-3 and result["sagging"]["iterations"] <= 10
    assert result["both"]["E_error"] < 0.01 and result["both"]["nu_error"] < 0.01
    check_files(tmp_path, "identify_falling", "identify_sagging", "identify_both")
    out = capsys.readouterr().out
    assert all(word in out for word in ("E_error", "nu_error", "iterations", "seconds"))
    assert result["sagging"]["unseen"] == 1 and "NOT SEEN" in out  # E and density together, under gravity alone


def test_stiffness_field(tmp_path):
    result = example("identify/stiffness_field").main(tmp_path, iterations=15)
    assert result["median_error"] < 0.02 and result["worst_tenth"] < 0.1 and result["classified"] > 0.98
    assert result["start_error"] > 0.6
    check_files(tmp_path, "stiffness_field")


def test_learned_material(tmp_path):
    result = example("identify/learned_material").main(tmp_path, iterations=20)
    assert result["median_error"] < 0.12
    assert result["unseen_motion_error"] < 0.02 < 0.2 < result["unseen_motion_error_before"]
    check_files(tmp_path, "learned_material")


def test_controller(tmp_path):
    result = example("control/train_controller").main(tmp_path, iterations=60)
    assert result["miss_seen"] < 0.025 and result["miss_unseen"] < 0.04 and result["miss_before"] > 0.1
    check_files(tmp_path, "train_controller", kind="gif")


def test_resumed_controller_is_the_uninterrupted_one(tmp_path, monkeypatch):
    module, states = example("control/train_controller"), []
    monkeypatch.setattr(module, "save_reaches", lambda *_, **__: None)
    for folder, stops in (("whole", [6]), ("parts", [3, 6])):
        for stop in stops:
            result = module.main(tmp_path / folder, iterations=stop)
        states.append({key: value for key, value in result.items() if key != "seconds"})
    assert states[0] == states[1]


def distributed(folder, seen=lambda state: None) -> dict:
    """The result of 80 iterations of two processes; seen(state file) while they run."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    paths = os.pathsep.join([str(EXAMPLES.parent), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    script = [str(EXAMPLES / "identify" / "train_distributed.py"), f"--folder={folder}", "--iterations=80"]
    printed = folder.with_suffix(".txt")
    with open(printed, "w") as out:
        process = subprocess.Popen([*command, *script], stdout=out, stderr=subprocess.STDOUT, env=environment)
        while process.poll() is None:
            seen(folder / "train_distributed.state")
            time.sleep(0.01)
    assert process.returncode == 0, printed.read_text()
    return json.loads(next(line for line in printed.read_text().splitlines() if line.startswith("{")))


def test_distributed(tmp_path):
    """In one go, and gone on with from a state of it, as if it had been stopped there."""
    early = tmp_path / "parts" / "train_distributed.state"
    early.parent.mkdir()

    def keep(state):
        if state.exists() and not early.exists():
            shutil.copy(state, early)  # a file is replaced as a whole

    result = distributed(tmp_path / "whole", keep)
    assert result["processes"] == 2 and result["ranks_agree"]
    assert result["difference_from_serial"] < 1e-12
    assert result["E_error"] < 0.02 and result["nu_error"] < 0.03
    check_files(tmp_path / "whole", "train_distributed")
    assert 10 <= load_state(early, TetrahedralMesh.create_cube(3, 0.4))["iteration"] < 80
    resumed = distributed(tmp_path / "parts")
    assert (resumed["E"], resumed["nu"]) == (result["E"], result["nu"])


@pytest.fixture(autouse=True)
def default_dtype():
    torch.set_default_dtype(torch.float32)
