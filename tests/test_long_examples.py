"""Examples that run longest, which CI runs, too; what they are made of has its tests in the suite.

python -m pytest --thorough tests/test_long_examples.py
"""

import numpy as np
import pytest
import torch
from example_files import example
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.thorough


def test_indentation(capsys, monkeypatch):
    indentation = example("identify/indentation")
    monkeypatch.setattr(indentation, "STEPS", 3)
    numbers = indentation.main()
    assert max(numbers["errors"].values()) < 0.01 and numbers["runs"] <= 10
    assert max(numbers["spread"]) < 0.01  # standard errors, of numbers in logarithms
    assert "friction = " in capsys.readouterr().out


def test_measured_beam(tmp_path, capsys, monkeypatch):
    """Recordings that it makes itself, seen by a tilted camera: numbers come back, and the weight's motion is foretold."""
    beam = example("identify/measured_beam")
    monkeypatch.setattr(beam, "EDGE", 8e-3)
    monkeypatch.setattr(beam, "EVERY", 20)
    truth, tilt = dict(youngs_modulus=2.2e5, drag_rate=9.0), Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
    rng = np.random.default_rng(0)
    for name, mass, share in (("gravity_a", 0.0, 0.1), ("load40_a", 0.04, 0.2)):
        body = beam.mesh(2, beam.EDGE if mass else 0.0)
        numbers = dict(truth, prony_shares=np.array([0.0, 0.05]), support=(share, 0.0))
        numbers["youngs_modulus"] *= beam.finer(2, body)
        moved = beam.swing(body, "drag", numbers, 1.6, mass).forward()["markers"]
        before, after = (
            np.tile(moved[:1], (60, 1, 1)),
            np.tile(beam.hang(body, numbers, mass).forward()["markers"][-1], (60, 1, 1)),
        )
        tip = np.concatenate([before, moved, after]) + (beam.TIP - moved[0])
        seen = np.concatenate([tip, np.tile(beam.BASE, (len(tip), 1, 1))], 1) @ tilt + [0.1, 0.2, 0.3]
        seen = seen + 1e-5 * rng.standard_normal(seen.shape)
        rows = np.column_stack([0.01 * np.arange(len(seen)), seen.reshape(-1, 18)])
        np.savetxt(tmp_path / f"beam_{name}.csv", rows, delimiter=",", header="time, x, y, z of six markers")
    found = beam.main(tmp_path, kinds=("drag",), span=0.4, output=tmp_path)
    intervals, errors = found["fits"]["drag"].intervals, found["errors"][0.04]
    for name, x in truth.items():
        low, high = intervals[name]
        assert low < x < high < 1.2 * low
    assert abs(errors["rest"]) < 0.01 and abs(errors["frequency"]) < 0.01 and abs(errors["decay"]) < 0.1
    assert "with 40 g, predicted:" in capsys.readouterr().out
    for name in ("measured_beam.png", "beam_load40_a.gif"):
        assert (tmp_path / name).stat().st_size > 20_000


def test_soft_hand():
    """The gradient of what slips says to squeeze more; a grip that it found holds what the one at first drops."""
    hand = example("control/soft_hand")
    scene, start = hand.hand_scene(), np.radians(np.repeat(hand.START, 3)).reshape(2, 3)
    grip = hand.Grip(scene, 0.4)
    frames, slip = grip.run(start)
    gradient = grip.loss(frames, slip)[1]
    squares = [(grip.run(start + move)[1] ** 2).sum(1) for move in (1e-5, -1e-5)]
    ends = [float((square / (square + hand.LOST**2)).sum()) for square in squares]
    assert gradient.sum() == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-3) and np.all(gradient[:, :2] < 0)
    whole = hand.Grip(scene, 0.6, gradients=())
    found = np.radians([[20.9, 26.7, 12.7], [17.7, 23.6, 10.7]])
    slips = [np.linalg.norm(whole.run(turns)[1], axis=1).max() for turns in (start, found)]
    assert slips[0] > 0.05 and slips[1] < hand.SLIP


def test_a_gripper_learns_to_lift():
    """The gradient through joints, contact and friction, along which the loss falls, is that of differences."""
    pytest.importorskip("pinocchio", reason='pip install "diffsim-ti[robots]"')
    pytest.importorskip("gymnasium", reason='pip install "diffsim-ti[envs]"')
    module = example("control/grasp_and_lift")
    lift, scale = module.Lift(2, 3), torch.tensor(module.SCALE)
    at = torch.tensor(module.START[:, :3] + 0.1 * module.SCALE, requires_grad=True)
    loss, frames = lift.loss(at)
    loss.backward()
    along = -(scale**2) * at.grad / (scale * at.grad).norm()
    with torch.no_grad():
        ends = [lift.loss(at + e * along)[0].item() for e in (1e-4, -1e-4)]
    expected = (ends[0] - ends[1]) / 2e-4
    assert (at.grad * along).sum().item() == pytest.approx(expected, rel=1e-4) and expected < -0.1
    assert 0.2 < lift.found(frames)["ratio"] < 1 and lift.found(frames)["slip"] < module.LIFT


def test_controller(tmp_path):
    result = example("control/train_controller").main(tmp_path, iterations=45)
    assert result["miss_seen"] < 0.025 and result["miss_unseen"] < 0.04 and result["miss_before"] > 0.1
    assert (tmp_path / "train_controller.gif").stat().st_size > 50_000


@pytest.mark.parametrize("order", [1, 2])
def test_finger_shape(order, tmp_path, capsys):
    """The same pull, a harder grip; the gradient of a contact force by ten numbers of a shape."""
    module = example("design/finger_shape")
    for numbers in module.main(tmp_path, quick=True, orders=[order]).values():
        assert numbers["ratio"] > 1.4 and numbers["volume"] < 1e-3
        assert numbers["deeper"] < 1.75 + 1e-6 and numbers["wider"] < 1 + 1e-6 and numbers["smallest_J"] > 0.2
    name = "finger_shape.png" if order == 1 else "finger_shape_ten_nodes.png"
    assert (tmp_path / name).stat().st_size > 10_000
    assert "times" in capsys.readouterr().out
    finger, rng = module.Finger((6, 2, 2), order), np.random.default_rng(3)
    x, change = 0.1 * rng.standard_normal((2, 2 * module.STATIONS))
    slope = finger.grip(x)[1] @ change
    assert slope == pytest.approx(
        (finger.grip(x + 1e-3 * change)[0] - finger.grip(x - 1e-3 * change)[0]) / 2e-3, rel=1e-4
    )


@pytest.mark.filterwarnings("ignore:Measured")
def test_dumbbell(capsys):
    """To a crosshead's strain of 8 %, on a coarse mesh: within 2 % of the closed form; the shoulders take a third."""
    numbers = example("identify/dumbbell").main(steps=1, cells=(8, 2, 1), top=1.08)
    narrow, shoulders = numbers["at the narrow part"], numbers["12 mm farther out"]
    assert max(narrow["error"], shoulders["error"]) < 0.02
    assert 1 < narrow["share"][0] < 1.05 and 0.65 < shoulders["modulus"] < 0.72
    assert abs(numbers["found"] - numbers["truth"]) < 4 * numbers["deviation"] < 0.02 * numbers["truth"]
    assert "of the closed form" in capsys.readouterr().out


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


def test_learned_material(tmp_path):
    result = example("identify/learned_material").main(tmp_path, iterations=20)
    assert result["median_error"] < 0.12
    assert result["unseen_motion_error"] < 0.02 < 0.2 < result["unseen_motion_error_before"]
    assert (tmp_path / "learned_material.png").stat().st_size > 5000


def test_bounce_gradients(capsys, tmp_path, monkeypatch):
    """Soft balls: the stage's gradients are good at the longest steps of the body, and get better with shorter ones."""
    cases, bounce = [("balls", 2e-3), ("blocks", 0.01)], example("contact/bounce_gradients")
    kinds = ("stage, default", "stage, damping 0", "stage, damping 1")
    monkeypatch.setattr(bounce, "KINDS", {kind: bounce.KINDS[kind] for kind in kinds})
    found = bounce.main(tmp_path, starts=2, finest=1 / 8, cases=cases, shares=(0.8, 0.1))
    errors, edges = found.values()
    default = errors["stage, default"]
    assert edges["stage, default"].max() < 0.01  # sharp edges, and the width that obstacles have by default
    assert default[0] < 0.02 and default[-1] < 0.25 * default[0]
    assert errors["stage, damping 1"][-1] > 4 * errors["stage, damping 0"][-1]  # what damping costs
    assert (tmp_path / "bounce_gradients.png").stat().st_size > 10_000 and "median error" in capsys.readouterr().out


def test_cantilever(capsys):
    """Small strains as another code finds them (its numbers have three digits); large rotations as the elastica."""
    numbers = example("benchmarks/cantilever").main(quick=True)
    for share, known in numbers["shares"].values():
        assert share == pytest.approx(known, abs=6e-3)
    ((fine, extrapolated),) = numbers["elastica"].values()
    assert -0.06 < fine[0] < -0.04  # locked
    assert np.abs(extrapolated).max() < 0.018  # and how much of it extrapolation from 2 and 3 cells takes away
    assert "elastica" in capsys.readouterr().out


@pytest.mark.filterwarnings("error:scenes")
def test_cubes_learn_to_jump_by_gradients(capsys):
    pytest.importorskip("gymnasium", reason='pip install "diffsim-ti[envs]"')
    found = example("control/jumper").main(8, 3, 12)
    assert found["jumped"] > found["rest"] + 0.01
    assert found["best"] > found["first"] + 0.03
    assert "at once" in capsys.readouterr().out
