"""The torch examples recover what they should; each writes a picture, and goes on where it was stopped."""

import numpy as np
import pytest
import torch
from example_files import example


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


def test_learned_material(tmp_path):
    result = example("identify/learned_material").main(tmp_path, iterations=20)
    assert result["median_error"] < 0.12
    assert result["unseen_motion_error"] < 0.02 < 0.2 < result["unseen_motion_error_before"]
    check_files(tmp_path, "learned_material")


def test_resumed_controller_is_the_uninterrupted_one(tmp_path, monkeypatch):
    module, states = example("control/train_controller"), []
    monkeypatch.setattr(module, "save_reaches", lambda *_, **__: None)
    for folder, stops in (("whole", [6]), ("parts", [3, 6])):
        for stop in stops:
            result = module.main(tmp_path / folder, iterations=stop)
        states.append({key: value for key, value in result.items() if key != "seconds"})
    assert states[0] == states[1]


def test_arm(tmp_path, capsys):
    """Newton's method is quadratic with a right slope, which differences confirm; the wrench holds the finger."""
    pytest.importorskip("pinocchio", reason='pip install "diffsim-ti[robots]"')
    arm = example("control/arm")
    numbers = arm.main(tmp_path, quick=True)
    history = numbers["history"]
    assert history[0] > 0.1 and history[-1] < 1e-6 and len(history) <= 6
    assert numbers["pressed"][1] == pytest.approx(-2.0, abs=2e-6)
    np.testing.assert_allclose(numbers["tip"][[0, 2]], arm.PLACE, atol=1e-8)
    np.testing.assert_allclose(numbers["force"], numbers["pressed"] + [0, numbers["weight"], 0], atol=1e-6)
    assert (tmp_path / "arm.png").stat().st_size > 10_000 and "wrench at the flange" in capsys.readouterr().out
    pressing = arm.Pressing(4)
    angles = torch.tensor(numbers["angles"], requires_grad=True)
    frames = pressing.frames(angles)
    # moments of table, weight and arm about the flange add up to nothing
    x = frames.positions[-1].detach().numpy()
    at = x - x[pressing.mesh.vertex_indices("xmin")].mean(0)
    loads = frames["table"][-1].detach().numpy()
    loads[:, 1] -= 9.81 * pressing.rollout.solver.scene.mass_matrix().diagonal()[::3]
    np.testing.assert_allclose(np.cross(at, loads).sum(0) + numbers["moment"], 0, atol=1e-7)
    residual = pressing.residual(frames)
    slopes = torch.stack([torch.autograd.grad(r, angles, retain_graph=True)[0] for r in residual]).numpy()
    for k in range(3):
        move = 1e-5 * torch.eye(3, dtype=torch.float64)[k]
        ends = [pressing.residual(pressing.frames(angles.detach() + s * move)).detach().numpy() for s in (1, -1)]
        np.testing.assert_allclose(slopes[:, k], (ends[0] - ends[1]) / 2e-5, atol=1e-5 * np.abs(slopes).max())


@pytest.fixture(autouse=True)
def default_dtype():
    torch.set_default_dtype(torch.float32)
