"""What crushes a body is refused before its first frame, and the advice of the error works."""

import re

import battery_of_falls
import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.cli.options import fall_scene
from diffsim_ti.scene.strength import check_strength
from diffsim_ti.writers.adaptive_run import ForwardRun

CUBE = ds.TetrahedralMesh.create_box(4, size=0.5)


def fallen(E, height, **options):
    """A cube of half a metre, whose weight is 4.9 kPa."""
    return fall_scene(CUBE, ds.StableNeoHookean(E, 0.4), 1000.0, height=height, **options)[0]


@pytest.mark.parametrize(
    "E, height, why",
    [(4e3, 0.05, "by its own weight"), (9e3, 0.5, "meets the floor at 3.13 m/s")],
    ids=["weight", "speed"],
)
@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.BDF2Solver])
def test_the_advice_works(E, height, why, solver):
    with pytest.raises(ValueError, match=f"{why}.* is crushed|is crushed {why}") as refusal:
        ForwardRun(fallen(E, height), solver, 1 / 30)
    said = str(refusal.value)
    advised = [dict(E=float(re.search(r"modulus to (\S+) Pa", said)[1]), height=height)]
    lower = re.search(r"from at most (\S+) m", said)
    assert (lower is None) == ("weight" in why)
    if lower:
        advised.append(dict(E=E, height=float(lower[1])))
    for better in advised:
        scene = fallen(**better)
        run = ForwardRun(scene, solver, 1 / 60)
        for _ in range(40):
            run.advance()
        weight = 9.81 * scene.inputs.derive(scene.inputs.values).mass.sum()
        rise = (max(run.energies) - run.energies[0]) / (weight * better["height"])
        assert run.seen.gap > 0 and run.seen.crossed == 0 and rise < 0.01 and run.seen.implicit_parts == 0, (
            better,
            rise,
        )


def test_what_is_strong_enough_is_let_through():
    check_strength(fallen(5e3, 0.05))
    check_strength(fallen(1e4, 0.4))
    check_strength(fallen(1e3, None, floor=False))  # it flies
    check_strength(fallen(4.8e3, 0.3, gravity=0.0, velocity=(0.0, 2.0, 0.0), stiffness=1e4))  # away from the floor
    with pytest.raises(ValueError, match=r"meets the floor at 3 m/s.* raise Young's modulus to 36000 Pa$"):
        check_strength(fallen(8e3, 0.045, gravity=-9.81, velocity=(0.0, -np.sqrt(8.1), 0.0)))
    with pytest.raises(ValueError, match="by its own weight"):
        check_strength(fallen(4e3, None, floor=False, fixed=["ymax"]))


def test_the_battery_follows_the_advice():
    case = dict(mesh=str(battery_of_falls.ASSETS[0]), size=1.0, youngs_modulus=1e4, height=1.0, solver="verlet")
    result = battery_of_falls.fall(case)
    assert result["advised"] == 79000 and battery_of_falls.judge(result) == "good", result
