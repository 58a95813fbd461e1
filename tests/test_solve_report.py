"""What can be learnt of the solves of a run."""

import warnings

import numpy as np
import pytest
from test_implicit import cube

import diffsim_ti as ds
from diffsim_ti.monitor.stability import StepLimit


def hanging(**options):
    return ds.Scene(cube(), ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], fixed="ymax", **options)


def test_a_rollout_reports_its_last_forward_run():
    """Not what the reverse sweep repeats."""
    rollout = ds.Rollout(ds.ImplicitEulerSolver(hanging(), dt=0.02, substeps=2), 3, checkpoint_every=1)
    assert rollout.report.iterations == 0
    frames = rollout.forward()
    report = rollout.report
    assert [step.step for step in report.steps] == [0, 1, 2] and report.substeps == 6
    assert all(len(step.residuals) == 2 and step.iterations >= 2 for step in report.steps)
    assert all(step.residual == step.residuals[-1][-1] <= 1e-6 for step in report.steps)
    assert report.iterations == sum(len(r) - 1 for step in report.steps for r in step.residuals)
    assert report.products >= report.iterations and report.energies > report.iterations and report.saddles == 0
    assert 0 < sum(step.seconds for step in report.steps) <= report.seconds
    before = str(report)
    rollout.vjp(frames, positions=frames.positions)
    assert str(rollout.report) == before and "3 steps" in before and "Newton iterations" in before
    rollout.forward()
    assert len(rollout.report.steps) == 3


def test_a_simulator_reports_since_its_start():
    simulator = ds.Simulator(ds.BDF2Solver(hanging(), dt=0.02))
    simulator.run(2)
    assert [step.step for step in simulator.report.steps] == [0, 1]
    simulator.reset()
    assert not simulator.report.steps and simulator.report.seconds == 0
    explicit = ds.Simulator(ds.SemiImplicitSolver(hanging(), dt=1e-3, substeps=2))
    explicit.run(3)
    assert explicit.report.substeps == 6 and "nothing to solve" in str(explicit.report)


def laden_column(sideways: float) -> ds.Rollout:
    """A column with eight times Euler's load on it, and a small part of that sideways."""
    mesh = ds.TetrahedralMesh.create_box((2, 9, 2), (0.1, 1.0, 0.1), pattern="five")
    top, load = mesh.vertex_indices("ymax"), 8 * np.pi**2 * 1e6 * 0.1**4 / 48
    forces = np.tile([sideways * load, -load, 0], (len(top), 1)) / len(top)
    terms = [ds.ExternalForce(forces, top)]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.0), terms=terms, fixed="ymin", precision="f64")
    return ds.Rollout(ds.StaticSolver(scene, load_steps=2, max_iterations=400), 1)


def test_statics_say_which_saddles_they_left():
    """Straight up it is in balance, and not stable."""
    rollout = laden_column(0.0)
    with pytest.warns(ds.Buckled, match="saddles? left: the body was in balance and not stable") as said:
        rollout.forward()
    assert rollout.report.saddles >= 1 and "left" in str(rollout.report)
    left = [w.message for w in said if isinstance(w.message, ds.Buckled)]
    assert len(left) == 1 and left[0].saddles == rollout.report.saddles


def test_statics_say_that_a_body_may_have_buckled_on_the_way():
    """What is not quite straight passes no saddle."""
    rollout = laden_column(1e-3)
    with pytest.warns(ds.Buckled, match="rounds of Newton's method met states that are not stable") as said:
        frames = rollout.forward()
    assert rollout.report.saddles == 0 < rollout.report.indefinite
    assert len(said) == 1 and 0 < said[0].message.unstable <= rollout.report.indefinite
    assert said[0].filename == __file__
    assert frames.displacements[-1][:, 0].max() > 0.5


def warned(scene: ds.Scene, load_steps: int) -> tuple[list, ds.Rollout]:
    """(the Buckled of an equilibrium, its rollout)."""
    rollout = ds.Rollout(ds.StaticSolver(scene, load_steps=load_steps), 1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        rollout.forward()
    return [w.message for w in said if isinstance(w.message, ds.Buckled)], rollout


def test_an_arch_that_snaps_says_so_once():
    """Of twelve load steps one leads from one branch of stable equilibria to another."""
    box = ds.TetrahedralMesh.create_box((21, 2, 2), (1.0, 0.02, 0.05))
    places = box.vertices + 0.2 * np.sin(np.pi * box.vertices[:, :1]) * [0, 1, 0]
    mesh = ds.TetrahedralMesh(places, box.tetrahedra)
    top, ends = (mesh.vertices_where(lambda x: abs(abs(x[:, 0] - 0.5) - at) < 1e-9) for at in (0.0, 0.5))
    forces = np.tile([0, -300.0 / len(top), 0], (len(top), 1))
    terms = [ds.ExternalForce(forces, top)]
    left, rollout = warned(ds.Scene(mesh, ds.StableNeoHookean(1e7, 0.3), 1e3, terms, ends, precision="f64"), 12)
    assert len(left) == 1


@pytest.mark.parametrize("strain, load_steps", [(1.0, 1), (3.0, 1), (3.0, 6)])
def test_stretching_is_not_called_buckling(strain, load_steps):
    """Though rounds of Newton's method pass through states with an indefinite Hessian."""
    fixed = {"xmin": "x", "ymin": "y", "zmin": "z", "xmax": "x"}
    mesh, motion = ds.TetrahedralMesh.create_box(3, 0.1), {"xmax": lambda t: (0.1 * strain * t, 0, 0)}
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.45), 1e3, fixed=fixed, motion=motion, precision="f64")
    left, rollout = warned(scene, load_steps)
    assert not left
    if (strain, load_steps) == (3.0, 1):  # shorter ways start so near that none is met
        assert rollout.report.indefinite > 0


def test_contact_alone_is_not_called_buckling():
    """Barriers of what is curved make states with an indefinite Hessian."""
    ball = ds.Sphere(
        (0.02, 1.3, 0.02), 0.25, stiffness_per_area=1e7, width=0.02, path=lambda t: (0, -0.25 * t, 0), by_pairs=False
    )
    mesh = ds.TetrahedralMesh.create_cube(2)
    left, rollout = warned(ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1e3, [ball], "ymin", precision="f64"), 3)
    assert rollout.report.indefinite > 0 and not left


def test_a_step_limit_is_a_float():
    limit = ds.stable_dt(hanging())
    assert isinstance(limit, StepLimit) and isinstance(limit, float) and type(limit.dt) is float
    assert limit == limit.dt > 0 and 0.5 * limit == 0.5 * limit.dt and f"{limit:.3g}" == f"{limit.dt:.3g}"
    assert "set by tetrahedron" in str(limit) and "set by tetrahedron" in f"{limit}"
    ds.SemiImplicitSolver(hanging(), dt=0.9 * limit)
