"""The examples of contact run and find what they look for."""

import numpy as np
import pytest
from example_files import EXAMPLES, example


def test_incline(capsys):
    """A whole body, not a point: R21 to 1 %."""
    numbers = example("contact/incline").main()
    assert numbers["exact"] == pytest.approx(0.274198, rel=1e-5)
    assert numbers["slides"] == pytest.approx(numbers["exact"], rel=1e-2) and 0 < numbers["holds"] < 1e-3
    assert "Coulomb's law" in capsys.readouterr().out


def test_refinement():
    """The force of a press is that of the surface, not of its vertices."""
    press = example("contact/refinement").force_of_a_press
    ours, theirs = (
        [press(r, {name: k}) for r in (2, 3)] for name, k in (("stiffness_per_area", 1e6), ("stiffness", 1.6e3))
    )
    assert ours[1] == pytest.approx(ours[0], rel=0.01) and ours[0] == pytest.approx(141.6, rel=0.01)
    assert theirs[1] > 1.2 * theirs[0]


def test_damping_map(monkeypatch, capsys):
    """Damping takes energy, the more of it the more, and costs the gradients of resolved contacts."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "contact"))
    (found,) = example("contact/damping_map").main(starts=2, finest=1 / 8, barriers=((0.01, 1),)).values()
    errors, growths, lost = np.array([found[damping] for damping in (0.0, 0.1, 0.3, 1.0)]).T
    assert np.all(np.diff(lost) > 0) and abs(lost[0]) < 0.01 and lost[-1] > 0.03
    assert errors[-1] > 4 * errors[0] and np.all(growths < 1) and "contact_damping" in capsys.readouterr().out


@pytest.mark.parametrize("damping", [0.0, 0.005, 1.0])
def test_a_slab_slides_as_far_as_coulomb_says(damping):
    """v^2 / (2 mu g), whatever the mesh, the kind of stiffness and the damping; and then it stays."""
    refinement = example("contact/refinement")
    exact = 0.7**2 / (2 * 0.3 * 9.81)
    for resolution in (2, 5):
        for kind in refinement.KINDS.items():
            way = refinement.way_of_sliding(resolution, dict([kind]), contact_damping=damping)
            assert way[-1] == pytest.approx(exact, rel=2e-3) and way[-1] == pytest.approx(way[250], abs=1e-4)


def test_a_cube_rocks_when_it_has_slid():
    """As far as a slab within half a per cent; then friction tips it no longer, and it swings back on its barrier."""
    refinement = example("contact/refinement")
    way = refinement.way_of_sliding(3, {"stiffness_per_area": 1e6}, refinement.block(3, 0.0))
    exact = 0.7**2 / (2 * 0.3 * 9.81)
    assert way.max() == pytest.approx(exact, rel=5e-3) and way[way.argmax() :].min() < 0.985 * exact


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


@pytest.mark.thorough
def test_soft_hand_holds_for_two_seconds(capsys, tmp_path):
    numbers = example("control/soft_hand").main(tmp_path)
    assert numbers["before"] < 0.01 and numbers["after"] > 0.07 and numbers["creep"] < 4e-3
    assert numbers["evaluations"] <= 15 and min(numbers["presses"]) > 1.0
    assert (tmp_path / "soft_hand.gif").stat().st_size > 10_000 and "lifted by" in capsys.readouterr().out


@pytest.mark.thorough
def test_rough_blocks(tmp_path, capsys):
    """Slabs hold or go as far as Coulomb's law says; a rough tower leans and stands where a smooth one slides apart."""
    numbers = example("contact/rough_blocks").main(tmp_path, duration=0.5)
    for friction, off in ((0.49, 0.1), (0.3, 0.01)):
        way, law, _ = numbers["slides"][friction]
        assert way == pytest.approx(law, rel=off)
    assert 0 < numbers["slides"][0.51][0] < 1e-3 * 0.5
    # after 1 s and 0.3 s: a lean that is elastic; what slides freely would have gone 0.27 m and 26 mm
    assert 0.005 < numbers["rough"] < 0.02 < numbers["smooth"]
    assert (tmp_path / "rough_blocks.png").stat().st_size > 10_000 and "tower" in capsys.readouterr().out
