"""Stability maps: the boundary is where theory puts it, and outcomes are called by their names."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.mechanics.obstacles.obstacle_collisions import ObstacleCollisions
from diffsim_ti.solvers import SOLVERS
from diffsim_ti.study import boundary, charts, growth, power_limit, stability_map
from diffsim_ti.study.stability_axes import AXES, body
from diffsim_ti.study.stability_map import OUTCOMES, judge

EXPLICIT = [kind for kind in SOLVERS if kind.explicit]


def test_power_iteration_agrees_with_the_eigenvalues_of_the_assembled_matrix():
    """Against a dense matrix of differences of forces at rest, column by column."""
    scene = body(1)
    solver = ds.VelocityVerletSolver(scene, dt=1.0, allow_unstable=True)
    from diffsim_ti.monitor.stability import Stiffness

    stiffness, n = Stiffness(solver.workspace(solver.start_values())), scene.mesh.num_vertices
    dense = np.stack([stiffness.product(e.reshape(n, 3)).ravel() for e in np.eye(3 * n)], 1)
    assert power_limit(scene) == pytest.approx(2 / np.sqrt(np.linalg.eigvalsh(dense)[-1]), rel=1e-4)


@pytest.mark.parametrize("kind", EXPLICIT)
def test_boundary_is_the_theoretical_limit(kind):
    """Within 3 %: symplectic Euler and velocity Verlet are bounded up to 2 / omega_max and no further."""
    scene = body()
    assert boundary(scene, kind) == pytest.approx(power_limit(scene), rel=0.03)


@pytest.mark.parametrize("kind", EXPLICIT)
@pytest.mark.parametrize("axis", ["stiffness", "nu", "quality"])
def test_no_explicit_solver_is_wrong_silently(kind, axis):
    short = replace(AXES[axis], values=AXES[axis].values[:: len(AXES[axis].values) - 1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = stability_map(kind, short, shares=(0.3, 0.95, 1.05), steps=100)
    assert not result.silent, result.silent
    outcomes = np.array(OUTCOMES)[result.outcomes]
    assert set(outcomes[0]) <= {"accurate", "bounded"} and set(outcomes[-1]) == {"raises"}


@pytest.mark.parametrize("kind", SOLVERS)
@pytest.mark.parametrize(
    "axis, values",
    [
        ("impact", (2.0,)),
        ("compression", (0.7,)),
        ("activation", (0.3,)),
        pytest.param("viscosity", (0.01, 1.0, 20.0), marks=pytest.mark.thorough),
    ],
)
def test_no_solver_is_wrong_silently_where_steps_meet_their_end(kind, axis, values):
    """Impacts and squeezed starts, within and beyond the steps that follow them: bounded, damped, or said."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = stability_map(kind, replace(AXES[axis], values=values), shares=(0.3, 0.9, 3.0), steps=40)
    assert not result.silent, result.silent
    assert kind.explicit or kind is ds.ImplicitMidpointSolver or "raises" not in np.array(OUTCOMES)[result.outcomes]


@pytest.mark.parametrize("kind", EXPLICIT)
def test_no_muscle_outgrows_an_explicit_step_in_silence(kind):
    """Pulls of once and twice Young's modulus squeeze the cube, which calms at small steps and blows up at others."""
    strong = replace(AXES["activation"], values=(1.0, 2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = stability_map(kind, strong, shares=(0.1, 0.2, 0.4, 0.6, 0.9, 0.99))
    assert not result.silent, result.silent
    outcomes = np.array(OUTCOMES)[result.outcomes]
    assert set(outcomes[0]) == {"bounded"} and set(outcomes[2:, 1]) == {"raises"} and outcomes[1, 0] == "bounded"


def test_a_map_would_show_what_is_wrong_silently():
    """With its words taken away, the midpoint rule at an impact is found out."""
    scene = AXES["impact"].scene(5.0)
    limit = power_limit(scene)
    assert judge(scene, ds.ImplicitMidpointSolver, 3 * limit, 40).outcome == "raises"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ds.ImplicitMidpointSolver, "may_gain_energy", False)
        patch.setattr(ObstacleCollisions, "check_end", lambda *_: None)
        assert judge(scene, ds.ImplicitMidpointSolver, 3 * limit, 40).outcome == "wrong silently"


def test_outcomes_have_their_names():
    scene, limit = body(), power_limit(body())
    assert judge(scene, ds.VelocityVerletSolver, 0.05 * limit, 40).outcome == "accurate"
    assert judge(scene, ds.SemiImplicitSolver, 0.9 * limit, 40).outcome == "bounded"
    assert judge(scene, ds.ImplicitEulerSolver, limit, 20).outcome == "loses energy"
    assert judge(scene, ds.SemiImplicitSolver, 1.05 * limit, 40).outcome == "raises"
    assert judge(scene, ds.SemiImplicitSolver, 1.01 * limit, 60, overridden=True).outcome == "wrong silently"


def test_maps_of_an_axis_share_a_picture_and_tables(tmp_path):
    short = replace(AXES["nu"], values=(0.0, 0.3))
    results = [stability_map(kind, short, shares=(0.5, 1.05), steps=20) for kind in EXPLICIT]
    files = charts.write_maps(results, tmp_path, "nu")
    assert [name.rsplit(".")[-1] for name in files] == ["png", "csv", "json"]
    assert len((tmp_path / "stability_nu.csv").read_text().splitlines()) == 9
    assert (tmp_path / "stability_nu.png").stat().st_size > 10_000


def test_growth_beyond_the_limit_is_the_fastest_modes_and_has_a_horizon():
    """Within the limit tangents hardly grow; beyond it, at rest, they grow as theory says, until float32 drowns in it."""
    calm = growth(ds.VelocityVerletSolver(body(), dt=0.3 * power_limit(body())), 200)
    assert calm.horizon is None and abs(calm.rate) < 10 and calm.sizes[:, 0] == pytest.approx(1.0)
    scene = body().replace(precision="f32", initial_velocities=None)
    wild = growth(ds.VelocityVerletSolver(scene, dt=1.05 * power_limit(body()), allow_unstable=True), 100)
    # beyond the limit the fastest mode multiplies by exp(2 arccosh(s)) each step, s = dt / limit
    assert wild.rate == pytest.approx(2 * np.arccosh(1.05) / (1.05 * power_limit(body())), rel=0.05)
    assert wild.horizon is not None and "until" in str(wild)


def test_growth_of_ones_own_scene_by_the_command(tmp_path):
    from typer.testing import CliRunner

    from diffsim_ti.cli.app import app

    (tmp_path / "hang.py").write_text(
        "from diffsim_ti.study.growth import GROWTH_SCENES\nscene = GROWTH_SCENES['clamped beam let go']('f64')\n"
    )
    command = ["growth", str(tmp_path / "hang.py"), "--duration", "0.03", "--precision", "f64", "-o", str(tmp_path)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "hang: gradients grow to" in done.output
    assert (tmp_path / "growth.png").stat().st_size > 10_000
    assert len((tmp_path / "growth.csv").read_text().splitlines()) > 10
