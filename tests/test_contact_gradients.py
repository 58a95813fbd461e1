"""Gradients through contact, friction and moving obstacles, and where they can be trusted."""

import functools
import warnings

import numpy as np
import pytest
from contact_scenes import EXPLICIT, FORCE, KEEPING, SHAPES, points, tetrahedron

import diffsim_ti as ds

pytestmark = pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py

SOLVERS = [ds.SemiImplicitSolver, ds.VelocityVerletSolver]
solvers = pytest.mark.parametrize("solver", SOLVERS)
STEPS, SUBSTEPS = 24, 2


def path(t):
    return [0.3 * t, 0.1 * np.sin(5 * t), -0.2 * t]


@functools.lru_cache(maxsize=None)
def rollout_of(name, solver, rough=True, moving=True, **options):
    """A tetrahedron that falls onto a shape, slides on it, and is followed by it."""
    own = dict(friction=0.4, friction_speed=0.05) if rough else {}
    term = SHAPES[name](stiffness=300.0, width=0.2, **own, path=path if moving else None)
    scene = ds.Scene(
        tetrahedron(0.15),
        ds.StableNeoHookean(2e4, 0.3),
        100.0,
        [ds.Gravity(), ds.Drag(0.5), term],
        initial_velocities=[0.8, -1.0, 0.3],
    )
    return ds.Rollout(
        solver(scene, dt=4e-3, substeps=SUBSTEPS), STEPS, save_every=STEPS // 4, gradients="all", **options
    )


@pytest.mark.parametrize("name", SHAPES)
def test_every_input(name):
    """Moduli, density, gravity, the shape's numbers, stiffness, width, friction, path, rest shape: against differences.

    Friction is C1, so that Taylor's rate may fall below 2 where a step leaves its smooth piece: differences decide here.
    """
    rollout = rollout_of(name, ds.SemiImplicitSolver)
    report = ds.check_gradients(rollout, verbose=False)
    assert rollout.forward().contact_resolution.smallest_gap < 0.19
    assert {"friction", "friction_speed", "barrier_stiffness", "barrier_width"} <= {row.input for row in report.rows}
    assert sum(row.input.endswith("_path") for row in report.rows) == 1
    for row in report.rows:
        assert row.relative_error < 1e-6 and row.verdict == "right", str(report)
        assert row.analytic != 0 or row.input == "friction_speed", row.input  # which changes nothing while all slides


@pytest.mark.executed_ptx
@solvers
@pytest.mark.parametrize("name", ["ground", "box", "sphere"])
def test_tangent_and_mirror(name, solver):
    """Row gate: <w, J v> = <J^T w, v> to round-off, for all inputs at once."""
    assert ds.dot_product_test(rollout_of(name, solver)) < 1e-12


@solvers
def test_smooth_contact_without_friction(solver):
    assert ds.check_gradients(rollout_of("cylinder", solver, rough=False), verbose=False).passed


@pytest.mark.thorough
def test_several_rough_and_moving_obstacles():
    """Rows of sums, columns of paths and the order of frictions: two that move, two that are rough, one that is neither."""
    options = dict(stiffness=300.0, width=0.2)
    rough = dict(friction=0.3, friction_speed=0.05)
    terms = [
        SHAPES["ground"](**options, **rough),
        ds.HalfSpace([-0.1, 0, 0], [1, 0, 0], **options, path=path),
        SHAPES["sphere"](**options, **rough, path=lambda t: [0.1 * t, 0, 0]),
        SHAPES["bowl"](**options),
    ]
    scene = ds.Scene(
        tetrahedron(0.15),
        ds.StableNeoHookean(2e4, 0.3),
        100.0,
        [ds.Gravity(), *terms],
        initial_velocities=[-0.5, -1.0, 0.3],
    )
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=4e-3, substeps=SUBSTEPS), STEPS)
    assert {"half_space_path", "sphere_path", "friction", "friction_2"} <= set(rollout.inputs)
    report = ds.check_gradients(rollout, verbose=False)
    assert all(row.relative_error < 1e-6 and row.verdict == "right" for row in report.rows), str(report)
    assert ds.dot_product_test(rollout) < 1e-12


@solvers
def test_the_same_however_it_is_run(solver):
    """Checkpointed, in parallel launches, and again: the same bits; step by step in a Simulator the same states."""
    whole = rollout_of("ground", solver)
    frames = whole.forward()
    adjoint = np.random.default_rng(0).standard_normal(frames.positions.shape)
    gradients = whole.vjp(frames, adjoint, adjoint)
    pieces = rollout_of("ground", solver, checkpoint_every=5)
    again = pieces.vjp(pieces.forward(), adjoint, adjoint)
    spread = ds.Rollout(
        solver(whole.scene, dt=4e-3, substeps=SUBSTEPS, parallel=True), STEPS, STEPS // 4, gradients="all"
    )
    parallel = spread.vjp(spread.forward(), adjoint, adjoint)
    for name in gradients:
        np.testing.assert_array_equal(gradients[name], again[name], name)
        np.testing.assert_array_equal(gradients[name], parallel[name], name)
    simulator = ds.Simulator(solver(whole.scene, dt=4e-3, substeps=SUBSTEPS))
    for frame in range(1, 5):
        simulator.run(STEPS // 4)
        np.testing.assert_allclose(simulator.positions, frames.positions[frame], atol=1e-14)
    seen, other = simulator.contact_resolution, frames.contact_resolution
    assert seen.smallest_gap == pytest.approx(other.smallest_gap, rel=1e-12)


def test_single_precision():
    """f32 gradients against f64 ones, to 1e-3."""
    double = rollout_of("ground", ds.SemiImplicitSolver)
    single = double.with_scene(precision="f32")
    adjoint = np.random.default_rng(0).standard_normal((5, 4, 3))
    ours, exact = (r.vjp(r.forward(), adjoint) for r in (single, double))
    for name, value in exact.items():
        assert np.abs(ours[name] - value).max() < 1e-3 * np.abs(value).max(), name


@solvers
@pytest.mark.parametrize("rough", [False, True])
def test_translation_along_the_floor(solver, rough):
    """I2 and I3 survive: the floor is the same everywhere, so the sum of gradients by positions is the sum of weights."""
    rollout = rollout_of("ground", solver, rough=rough, moving=False)
    frames = rollout.forward()
    w = np.random.default_rng(1).standard_normal(frames.positions.shape)
    by = rollout.vjp(frames, w)["initial_positions"].sum(0)
    exact = w.sum((0, 1))
    assert frames.contact_resolution.smallest_gap < 0.19
    assert np.abs(by - exact)[[0, 2]].max() < 1e-12 * np.abs(w).sum()
    assert abs(by - exact)[1] > 1e-3  # but not across the floor


@solvers
def test_moving_all_together(solver):
    """Start and obstacle displaced alike: everything is displaced, so the gradients by start and path add up to I2."""
    rollout = rollout_of("sphere", solver)
    frames = rollout.forward()
    w = np.random.default_rng(2).standard_normal(frames.positions.shape)
    by = rollout.vjp(frames, w)
    total = by["initial_positions"].sum(0) + by["sphere_path"].sum(0)
    np.testing.assert_allclose(total, w.sum((0, 1)), atol=1e-12 * np.abs(w).sum())
    np.testing.assert_allclose(by["sphere_center"], by["sphere_path"].sum(0), atol=1e-12 * np.abs(w).sum())


@solvers
def test_first_contact(solver):
    """Row 57: nothing by an obstacle that is never touched; finite and one-sided on either side of the first touch."""
    term = ds.Ground(stiffness=1e3, width=0.1, friction=0.3)
    for height, touched in ((0.35, False), (0.2 + 1e-9, False), (0.2 - 1e-9, True), (0.15, True)):
        scene = points(tetrahedron(height), term, initial_velocities=[0.2, -1, 0])
        rollout = ds.Rollout(solver(scene, dt=1e-3), 100)  # the last pass ends at 0.1 s
        frames = rollout.forward()
        gradients = rollout.vjp(frames, np.ones_like(frames.positions))
        obstacle = [gradients[n] for n in ("ground_height", "barrier_stiffness", "barrier_width", "friction")]
        assert all(np.all(np.isfinite(g)) for g in gradients.values())
        assert np.isfinite(frames.contact_resolution.smallest_gap) == touched
        assert touched or not np.any(obstacle)
    assert gradients["ground_height"] != 0 and gradients["friction"] != 0


# ---- where gradients of a bounce can be trusted --------------------------------------------------------------------------

HEIGHTS = 400


@functools.lru_cache(maxsize=None)
def bounces(solver, speed: float):
    """400 vertices that start 0.02 to 0.04 m above the floor at the same speed [m/s]."""
    one, n = tetrahedron(0.0), HEIGHTS
    lift = 0.02 + np.linspace(0, 0.02, n)
    vertices = np.concatenate([one.vertices + [k, h, 0] for k, h in enumerate(lift)])
    mesh = ds.TetrahedralMesh(vertices, np.concatenate([one.tetrahedra + 4 * k for k in range(n)]))
    scene = ds.Scene(
        mesh,
        ds.LinearElastic(1e-6, 0.0),
        4 / one.volume,
        fixed=np.arange(3, 4 * n, 4),
        terms=[ds.Ground(stiffness=1e4, width=0.01)],
        initial_velocities=[0, -speed, 0],
    )
    return scene


@pytest.mark.parametrize("solver", FORCE + KEEPING + EXPLICIT)
@pytest.mark.parametrize("speed", [0.2, 0.5, 1.0, 2.0, 3.0])
def test_bounce_sweep(solver, speed):
    """R23: height after a bounce falls as the start rises, d y / d y0 = -1. No warning: within 10 %. Signs wrong: a warning.

    Steps from far too long to fine, by (omega dt) of the deepest place.
    """
    scene, silent, warned_wrong = bounces(solver, speed), 0, 0
    fine = {0.2: 1.0e-3, 0.5: 6e-4, 1.0: 6e-4, 2.0: 4e-4, 3.0: 4.8e-5}[speed]
    for dt in fine * np.array([1, 1.5, 2.2, 3.2] if solver in FORCE else [2, 4, 8, 16]):
        steps = int(0.08 / speed / dt)
        rollout = ds.Rollout(solver(scene, dt=dt, allow_unstable=True), steps, gradients=["initial_positions"])
        frames = rollout.forward()
        adjoint = np.zeros_like(frames.positions)
        adjoint[-1, ::4, 1] = 1
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            by = rollout.vjp(frames, adjoint)["initial_positions"][::4, 1]
        assert np.all(frames.velocities[-1, ::4, 1] > 0)
        error = np.abs(by + 1).max()
        if not said:
            assert frames.contact_resolution.resolved and error <= 0.1
            silent += 1
        else:
            assert "gradients through contacts may be off by more than 10 %" in str(said[0].message)
            assert said[0].filename == __file__
            assert frames.contact_resolution.advised_substep < dt
            warned_wrong += bool(np.any(by >= 0))
    assert silent >= (1 if solver in FORCE else 2)  # a stage takes steps at least four times as long
    assert speed != 2.0 or warned_wrong >= 1 or solver not in FORCE


@pytest.mark.parametrize("solver", FORCE + EXPLICIT)
def test_advised_step_is_enough(solver):
    """Taking the step that the warning names silences it."""
    scene, dt = bounces(solver, 2.0), 1e-3 if solver in FORCE else 8e-3
    coarse = ds.Rollout(solver(scene, dt=dt, allow_unstable=True), int(0.04 / dt)).forward().contact_resolution
    assert not coarse.resolved
    dt = 0.9 * coarse.advised_substep
    fine = ds.Rollout(solver(scene, dt=dt, allow_unstable=True), int(0.04 / dt)).forward().contact_resolution
    assert fine.resolved
