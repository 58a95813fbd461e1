"""Contact, friction and moving obstacles in implicit steps."""

import numpy as np
import pytest
from contact_scenes import SHAPES, G, points, resting_gap, tetrahedron

import diffsim_ti as ds
from diffsim_ti.solvers.implicit.multigrid import Multigrid
from diffsim_ti.solvers.implicit.newton import Newton

SOLVERS = (ds.ImplicitEulerSolver, ds.BDF2Solver)
solvers = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.__name__)
every = pytest.mark.parametrize("solver", [*SOLVERS, ds.StaticSolver], ids=lambda s: s.__name__)


def floor(friction=0.3, path=lambda t: [0, 0, 0]) -> ds.Ground:
    """Rough and with a path, whether or not a test asks for it, so that all have the same kernels."""
    return ds.Ground(stiffness=1e4, width=0.01, friction=friction, path=path)


@solvers
@pytest.mark.parametrize("mass", [1e-2, 1.0, 10.0])
def test_weight_rests_at_the_gap_where_the_barrier_carries_it(solver, mass):
    """R22, settling from a start in the barrier that is not its equilibrium, in steps of 0.01 s."""
    scene = points(tetrahedron(0.004), floor(), mass, terms=[ds.Gravity(-G), ds.Drag(5.0)], precision="f64")
    x = ds.Rollout(solver(scene, dt=1e-2, tolerance=1e-10), 500).forward().positions[-1]
    np.testing.assert_allclose(x[:3, 1], resting_gap(mass * G), atol=1e-6)


@solvers
def test_incline(solver):
    """R21: friction 0.50 sticks, but for a creep slower than friction_speed; 0.49 slides 0.274198 m in 2.5 s."""
    from test_contact_friction import on_incline

    for friction, slides in ((0.50, False), (0.49, True)):
        scene, down = on_incline(friction, 1e-4, precision="f64")
        frames = ds.Rollout(solver(scene, dt=1e-2), 250).forward()
        way = (frames.positions[-1] - frames.positions[0])[:3] @ down
        if slides:
            assert way == pytest.approx(np.full(3, 0.274198), rel=1e-2)
        else:
            assert np.all(way > 0) and np.all(way <= (1.02 if solver is ds.ImplicitEulerSolver else 1.5) * 1e-4 * 2.5)


@pytest.mark.executed_ptx
@solvers
@pytest.mark.parametrize("friction, distance", [(0.2, 1.019368), (0.4, 0.509684)])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_stopping_distance(solver, friction, distance, precision):
    scene = points(
        tetrahedron(resting_gap(G)),
        floor(friction),
        terms=[ds.Gravity(-G)],
        initial_velocities=[2, 0, 0],
        precision=precision,
    )
    frames = ds.Rollout(solver(scene, dt=5e-3), 240, save_every=10).forward()
    assert (frames.positions[-1] - frames.positions[0])[:3, 0] == pytest.approx(np.full(3, distance), rel=1e-2)
    assert np.abs(frames.velocities[-1, :3]).max() < (1e-4 if precision == "f64" else 1e-3)  # friction_speed is 1e-3


@solvers
def test_a_moving_floor_drags(solver):
    belt = floor(path=lambda t: [1.5 * t, 0, 0])
    scene = points(tetrahedron(resting_gap(G)), belt, terms=[ds.Gravity(-G)], precision="f64")
    frames = ds.Rollout(solver(scene, dt=5e-3), 200, save_every=10).forward()
    np.testing.assert_allclose(frames.velocities[:, 0, 0], np.minimum(0.3 * G * frames.times, 1.5), atol=2e-2)


def met_at_five_metres_per_second(solver, **options) -> ds.Rollout:
    """A nearly incompressible cube, by a plane that rises through a third of it in one step of 10 ms."""
    plane = ds.HalfSpace(
        [0, -0.012, 0], [0, 1, 0], stiffness_per_area=1e7, width=0.005, friction=0.3, path=lambda t: [0, 5 * t, 0]
    )
    mesh, law = ds.TetrahedralMesh.create_cube(5, 0.1), ds.StableNeoHookean(1e5, 0.499)
    scene = ds.Scene(mesh, law, 1000.0, [ds.Gravity(), plane], precision="f64", volume="patches")
    return ds.Rollout(solver(scene, dt=0.01, preconditioner="block_jacobi", **options), 3, save_every=1)


@pytest.mark.filterwarnings("ignore")
def test_a_fast_plane_lifts_in_long_steps(monkeypatch):
    """With more rounds of Newton's method than asked for, as long as they gain (its second step takes 54)."""
    rollout = met_at_five_metres_per_second(ds.BDF2Solver, max_iterations=42)
    frames = rollout.forward()
    above = frames.positions[:, :, 1].min(1) - (-0.012 + 0.05 * np.arange(4))
    assert above.min() > 0 and frames.velocities[-1, :, 1].mean() > 5
    monkeypatch.setattr(Newton, "steady", 0)
    with pytest.raises(ds.NotConverged):
        rollout.forward()


def test_midpoints_refuse_a_fast_plane_in_terms_of_it():
    with pytest.raises(ds.Tunnelling, match="HalfSpace.* m/s: take a solver whose steps end where forces are taken"):
        met_at_five_metres_per_second(ds.ImplicitMidpointSolver).forward()


def test_a_rising_floor_lifts():
    lift = floor(path=lambda t: [0, 0.1 * t, 0])
    scene = points(tetrahedron(resting_gap(G)), lift, terms=[ds.Gravity(-G), ds.Drag(1.0)], precision="f64")
    frames = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=1e-2), 100).forward()
    assert (frames.positions[-1] - frames.positions[0])[0, 1] == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize("speed", [1.0, 8.0, 65.0])
def test_no_step_is_too_large_for_the_barrier(speed):
    """Row 41: whatever the speed, iterates stay in front of the floor."""
    mesh = ds.TetrahedralMesh.create_cube(resolution=2, size=0.2).translated([0, 0.05, 0])
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e6, 0.3),
        terms=[ds.Ground(stiffness=1e6, width=0.01)],
        initial_velocities=[0, -speed, 0],
        precision="f64",
    )
    frames = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=1e-2), 20, save_every=1).forward()
    assert frames.positions[:, :, 1].min() > 0 and frames.velocities[-1, :, 1].mean() > -0.1 * speed


def rough(solver, shape="bowl", **options) -> ds.Rollout:
    """A body pressed on a moving, rough obstacle, sliding and sticking; in a bowl its normal changes along the way."""
    # nearer to what acts on faces, these are pushed with 1e6 N at first, and rounding is as large
    height = 0.02 if shape in ("sphere", "box") else 0.006
    mesh, rng = tetrahedron(height), np.random.default_rng(0)
    obstacle = SHAPES[shape](
        stiffness=2e3, width=0.05, friction=0.4, friction_speed=0.05, path=lambda t: [0.3 * t, 0.1 * t, -0.2 * t]
    )
    static = solver is ds.StaticSolver
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e4, 0.3),
        100.0,
        terms=[ds.Gravity(-G), obstacle],
        fixed=[1, 2, 3] if static else None,
        precision="f64",
        initial_velocities=0.2 * rng.standard_normal((4, 3)) - [0, 0.1, 0],
    )
    made = solver(scene, dt=1e-2, tolerance=1e-11, max_iterations=200)
    return ds.Rollout(made, 2, save_every=1, gradients="all", **options)


@every
def test_gradients_through_friction_on_a_moving_obstacle(solver):
    # a deep barrier against a soft body: differences of equilibria see no more than four or five digits
    report = ds.check_gradients(rough(solver), verbose=False, tolerance=1e-4 if solver is ds.StaticSolver else 1e-6)
    assert report.passed, str(report)
    assert {"sphere_path", "sphere_radius", "friction", "friction_speed"} <= {row.input for row in report.rows}


@pytest.mark.executed_ptx
@pytest.mark.parametrize(
    "shape",
    ["bowl", *(pytest.param(shape, marks=pytest.mark.thorough) for shape in ("half_space", "sphere", "box", "mesh"))],
)
def test_reverse_sweep_against_tangent_on_every_shape(shape):
    assert ds.dot_product_test(rough(ds.ImplicitEulerSolver, shape)) < 1e-9


@solvers
def test_checkpoints_give_the_same_bits(solver):
    results = []
    for every_so_many in (None, 1):
        rollout = rough(solver, checkpoint_every=every_so_many)
        frames = rollout.forward()
        results.append(rollout.vjp(frames, np.ones(frames.positions.shape)))
    for name, gradient in results[0].items():
        np.testing.assert_array_equal(gradient, results[1][name])


@pytest.mark.parametrize("large, products", [(1000, 15), (0, 3.5)], ids=["finest level", "all levels"])
def test_multigrid_follows_contact_that_comes_and_goes(large, products, monkeypatch):
    """A firm barrier stiffens a few vertices by orders of magnitude: the preconditioner must know in every round."""
    monkeypatch.setattr(Multigrid, "large", large)  # vertices from which on all levels do
    mesh = ds.TetrahedralMesh.create_cube(resolution=7, size=0.2).translated([0, 0.01, 0])
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e5, 0.4),
        terms=[ds.Gravity(), ds.Ground(stiffness=1e6, width=0.005)],
        initial_velocities=[0, -1.0, 0],
        precision="f64",
    )
    solver = ds.ImplicitEulerSolver(scene, dt=5e-3, preconditioner="multigrid")
    workspace, most = solver.workspace(solver.start_values()), 0
    for j in range(12):
        workspace.advance(j, j + 1, 12)
        report = workspace.newton.report
        most = max(most, report.products / len(report.residuals))
    assert (mesh.vertices + workspace.read(workspace.state, 0)[0])[:, 1].min() > 0 and most < products
