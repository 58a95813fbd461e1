"""A frame that rotates: closed forms, every derivative in every solver, reactions, batches, what is refused."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_muscles import mesh_of
from test_term_order import SOLVERS

import diffsim_ti as ds

SPIN, CENTER = np.array([1.0, 2.0, -3.0]), np.array([0.3, 0.1, -0.2])
MOVING = [kind for kind in SOLVERS if kind is not ds.StaticSolver]


def turn(t: float) -> np.ndarray:
    """exp([Omega] t), by Rodrigues' formula."""
    angle, axis = np.linalg.norm(SPIN) * t, SPIN / np.linalg.norm(SPIN)
    K = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@pytest.mark.parametrize("kind", MOVING)
def test_what_is_free_flies_straight(kind):
    """A body that is at rest in space goes around the axis in the frame; errors are those of the solver's order."""
    mesh, time = mesh_of(1), 0.2
    start = -np.cross(SPIN, mesh.vertices - CENTER)
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e5, 0.3),
        1000.0,
        ds.RotatingFrame(SPIN, CENTER),
        initial_velocities=start,
        precision="f64",
    )
    off = []
    for n in (100, 200):
        simulator = ds.Simulator(kind(scene, dt=time / n))
        simulator.run(n)
        off.append(np.abs(simulator.positions - CENTER - (mesh.vertices - CENTER) @ turn(time)).max())
    assert off[1] < 0.02 * np.abs(start).max() * time
    assert off[0] / off[1] > (3.5 if kind in (ds.BDF2Solver, ds.ImplicitMidpointSolver) else 1.8)


@pytest.mark.parametrize("order, tolerance", [(1, 0.02), (2, 2e-5)])
def test_a_spinning_bar_grows_as_the_closed_form_says(order, tolerance):
    """Held at its hub, of length L and nu = 0: by rho Omega^2 L^3 / (3 E); on its hub acts rho A Omega^2 L^2 / 2."""
    L, E, rho, rate = 1.0, 1e7, 1000.0, 5.0
    mesh = ds.TetrahedralMesh.create_box((9, 2, 2), (L, 0.1, 0.1), origin=(0, -0.05, -0.05))
    mesh = mesh if order == 1 else mesh.quadratic()
    terms = ds.RotatingFrame((0, 0, rate))
    scene = ds.Scene(mesh, ds.LinearElastic(E, 0.0), rho, terms, {"xmin": "xyz"}, precision="f64")
    hub = ds.Reaction("xmin")
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, outputs=hub).forward()
    grown = frames.displacements[-1][mesh.vertex_sets["xmax"], 0].mean()
    # LinearElastic takes r at the present place, which adds Omega^2 rho L^2 / E times 2 / 5
    more = 1 + 0.4 * rho * (rate * L) ** 2 / E
    assert grown == pytest.approx(more * rho * rate**2 * L**3 / (3 * E), rel=tolerance)
    assert frames["reaction"][-1, 0] == pytest.approx(-rho * 0.01 * (rate * L) ** 2 / 2, rel=max(tolerance, 3e-3))


def rollout_of(kind, order=1, precision="f64", **options) -> ds.Rollout:
    mesh, rng = mesh_of(order), np.random.default_rng(2)
    terms = [ds.RotatingFrame(SPIN, CENTER, name="rotor"), ds.Gravity(), ds.Drag(2.0), ds.Pressure(200.0)]
    start = dict(fixed="xmin", initial_positions=mesh.vertices + 0.01 * rng.normal(size=mesh.vertices.shape))
    start |= dict(initial_velocities=rng.normal(size=mesh.vertices.shape))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, precision=precision, **start)
    steps = {} if kind is ds.StaticSolver else dict(dt=2e-3, substeps=4)
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    return ds.Rollout(kind(scene, **steps, **exact), 3, save_every=1, gradients="all", **options)


@pytest.mark.parametrize("kind", SOLVERS)
def test_every_number(kind):
    still = ("drag_rate",) if kind is ds.StaticSolver else ()
    assert_transposed(rollout_of(kind), 1e-11 if kind.explicit else 1e-8, still)


NAMES = ["rotor.angular_velocity", "rotor.center", "density", "rest_positions", "initial_positions"]


@pytest.mark.parametrize("kind, order", [(ds.VelocityVerletSolver, 1), (ds.BDF2Solver, 1), (ds.StaticSolver, 2)])
def test_gradients_against_differences(kind, order):
    rollout = rollout_of(kind, order, outputs=ds.Reaction("xmin"))
    table = ds.check_gradients(rollout, inputs=NAMES)
    assert table.passed and all(row.relative_error < 1e-5 for row in table.rows), table
    frames, w = rollout.forward(), np.array([0.3, -1.0, 0.5])
    found = rollout.vjp(frames, reaction=np.tile(w, (len(frames.positions), 1)))
    for name in NAMES[:2]:
        ends = [
            (rollout.forward(**{name: rollout.values[name] * s})["reaction"] @ w).sum() for s in (1 - 1e-4, 1 + 1e-4)
        ]
        slope = (found[name] * rollout.values[name]).sum()
        assert slope == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-5), name


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_batches(kind):
    """Scenes of a batch, whose frames turn at rates of their own, move as they do alone."""
    one = rollout_of(kind)
    rates = SPIN * np.array([[1.0], [1.5], [-2.0]])
    batch = ds.Batch(one.solver, 3, 3, save_every=1, gradients="all")
    frames, w = batch.forward(**{"rotor.angular_velocity": rates}), np.ones((3, *one.forward().positions.shape))
    found, summed = batch.vjp(frames, w), 0.0
    for b, rate in enumerate(rates):
        alone = one.forward(**{"rotor.angular_velocity": rate})
        np.testing.assert_allclose(frames.positions[b], alone.positions, rtol=0, atol=1e-11)
        gradients = one.vjp(alone, w[b])
        name = "rotor.angular_velocity"
        np.testing.assert_allclose(found[name][b], gradients[name], rtol=1e-8)
        summed = summed + gradients["rest_positions"]
    np.testing.assert_allclose(found["rest_positions"], summed, rtol=1e-7, atol=1e-9 * np.abs(summed).max())


def test_work_of_the_frame_is_not_taken_for_a_gain_of_the_steps():
    """Passes do not note the work of forces that act vertex by vertex, so runs with these do not watch their energy."""
    workspace = ds.Simulator(rollout_of(ds.VelocityVerletSolver).solver).workspace
    assert workspace.energy_watch is None and workspace.balance() is None


def test_in_float32():
    far = rollout_of(ds.VelocityVerletSolver, precision="f32").forward().positions
    np.testing.assert_allclose(far, rollout_of(ds.VelocityVerletSolver).forward().positions, atol=1e-6)


def test_what_does_not_fit_is_refused():
    frame = ds.RotatingFrame(SPIN)
    with pytest.raises(ValueError, match="one RotatingFrame, got several"):
        ds.Scene(mesh_of(1), ds.StableNeoHookean(1e5, 0.3), 1000.0, [frame, ds.RotatingFrame(SPIN, CENTER)])
    with pytest.raises(ValueError, match="RotatingFrame: angular_velocity .*shape"):
        ds.RotatingFrame(3.0)
