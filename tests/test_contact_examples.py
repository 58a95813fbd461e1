"""The examples of contact run and find what they look for."""

import pytest
from example_files import example


def test_incline(capsys):
    """A whole body, not a point: R21 to 1 %."""
    numbers = example("contact/incline").main()
    assert numbers["exact"] == pytest.approx(0.274198, rel=1e-5)
    assert numbers["slides"] == pytest.approx(numbers["exact"], rel=1e-2) and 0 < numbers["holds"] < 1e-3
    assert "Coulomb's law" in capsys.readouterr().out


def test_bounce_gradients(capsys, tmp_path):
    """Soft balls: the stage's gradients are good at the longest steps of the body, and get better with shorter ones."""
    errors = example("contact/bounce_gradients").main(tmp_path, starts=3, finest=1 / 16)
    default = errors["stage, default"]
    assert default[0] < 0.02 and default[-1] < 0.25 * default[0]
    assert errors["stage, damping 1"][-1] > 4 * errors["stage, damping 0"][-1]  # what damping costs
    assert (tmp_path / "bounce_gradients.png").stat().st_size > 10_000 and "median error" in capsys.readouterr().out


def test_refinement():
    """The force of a press is that of the surface, not of its vertices."""
    press = example("contact/refinement").force_of_a_press
    ours, theirs = (
        [press(r, {name: k}) for r in (2, 3)] for name, k in (("stiffness_per_area", 1e6), ("stiffness", 1.6e3))
    )
    assert ours[1] == pytest.approx(ours[0], rel=0.01) and ours[0] == pytest.approx(141.6, rel=0.01)
    assert theirs[1] > 1.2 * theirs[0]


@pytest.mark.filterwarnings("error:gradients through contacts")
def test_wall_shot(capsys):
    numbers = example("control/wall_shot").main()
    assert numbers["miss"] <= 1e-6 and numbers["iterations"] <= 6  # Newton's method converges: the gradient is exact
    assert numbers["back"] < -1 and numbers["velocity"][0] > 2 and 0 < numbers["gap"] < 0.06 and numbers["resolved"]
    assert "throw with" in capsys.readouterr().out


@pytest.mark.filterwarnings("error:gradients through contacts")
def test_gripper(capsys, tmp_path):
    numbers = example("control/gripper").main(tmp_path)
    assert numbers["before"] > 0.02 and numbers["after"] < 5e-4 and numbers["evaluations"] <= 15
    assert numbers["squeezes"].shape == (2, 5) and numbers["squeezes"].max() > 2e-3 and numbers["resolved"]
    assert (tmp_path / "gripper.gif").stat().st_size > 10_000
    assert "slips by" in capsys.readouterr().out
