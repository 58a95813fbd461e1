"""Coulomb friction: sticking, sliding, stopping, and that it only ever slows."""

import re
import warnings

import numpy as np
import pytest
from contact_scenes import BASE, FORCE, RESTING, G, points, resting_gap, tetrahedron

import diffsim_ti as ds
from diffsim_ti.terms.obstacles import friction

solvers = pytest.mark.parametrize("solver", FORCE + RESTING)


def on_incline(friction: float, friction_speed: float, **options):
    """Three vertices of 1 kg at rest in the barrier of a plane inclined by tan = 1/2, and the way down."""
    angle = np.arctan(0.5)
    n, down = np.array([-np.sin(angle), np.cos(angle), 0]), np.array([-np.cos(angle), -np.sin(angle), 0])
    turn = np.stack([-down, n, np.cross(-down, n)], 1)
    mesh = tetrahedron(resting_gap(G * np.cos(angle)))
    mesh = ds.TetrahedralMesh(mesh.vertices @ turn.T, mesh.tetrahedra)
    plane = ds.HalfSpace(normal=n, stiffness=1e4, width=0.01, friction=friction, friction_speed=friction_speed)
    return points(mesh, plane, terms=[ds.Gravity(-G)], **options), down


def test_friction_has_its_digits_in_single_precision():
    """s + c f(s / eps) = s* by its formula, wherever the friction is weak, strong, or just holds."""
    eps, rng = 1e-3, np.random.default_rng(0)
    c = eps * 10.0 ** rng.uniform(-6, 6, 2000)
    speed = (eps + c) * np.concatenate([rng.uniform(0, 1, 1500), 1 + rng.uniform(-1e-3, 1e-3, 500)])
    exact = friction.slip(speed, c, eps, friction.ARRAYS)
    s, f = exact[2] * eps, exact[1]
    sticks = speed < eps + c
    np.testing.assert_allclose((s + c * f)[sticks], speed[sticks], rtol=1e-14)
    single = friction.slip(speed.astype(np.float32), c.astype(np.float32), np.float32(eps), friction.ARRAYS)
    assert single[1].dtype == np.float32
    np.testing.assert_allclose(single[1], f, rtol=3e-6)
    np.testing.assert_allclose(single[0], exact[0], rtol=3e-6)


@solvers
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_incline(solver, precision):
    """R21: friction 0.50 sticks, but for a creep slower than friction_speed; 0.49 slides 0.274198 m in 2.5 s."""
    T, eps = 2.5, 1e-4
    for coefficient, slides in ((0.50, False), (0.49, True)):
        scene, down = on_incline(coefficient, eps, precision=precision)
        frames = ds.Rollout(solver(scene, dt=2e-3), 1250).forward()
        way = (frames.positions[-1] - frames.positions[0])[:3] @ down
        if slides:
            assert way == pytest.approx(np.full(3, 0.274198), rel=1e-2)
        else:
            # f32's grain of the gap, 7e-8 m, changes N by 8e-5; what is just held creeps faster by the root of that
            most = 1.02 if precision == "f64" else 1.02 + 8e-5**0.5
            assert np.all(way > 0) and np.all(way <= most * eps * T) and way.mean() <= 1.02 * eps * T


@solvers
@pytest.mark.parametrize("friction, distance", [(0.2, 1.019368), (0.4, 0.509684)])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_stopping_distance(solver, friction, distance, precision):
    """R21, from 2 m/s; it also stops, and does not come back."""
    scene = points(
        tetrahedron(resting_gap(G)),
        ds.Ground(stiffness=1e4, width=0.01, friction=friction),
        terms=[ds.Gravity(-G)],
        initial_velocities=[2, 0, 0],
        precision=precision,
    )
    frames = ds.Rollout(solver(scene, dt=2e-3), 600, save_every=10).forward()
    way = (frames.positions[-1] - frames.positions[0])[:3, 0]
    assert way == pytest.approx(np.full(3, distance), rel=1e-2)
    assert np.all(np.diff(frames.positions[:, 0, 0]) >= -1e-12)
    assert np.abs(frames.velocities[-1, :3]).max() < 1e-5


@pytest.mark.executed_ptx
@solvers
def test_moving_floor_drags_and_carries(solver):
    """A conveyor's speed is reached after v / (mu g), and then kept."""
    floor = ds.Ground(stiffness=1e4, width=0.01, friction=0.3, friction_speed=1e-3, path=lambda t: [1.5 * t, 0, 0])
    scene = points(tetrahedron(resting_gap(G)), floor, terms=[ds.Gravity(-G)])
    frames = ds.Rollout(solver(scene, dt=1e-3), 1000, save_every=50).forward()
    expected = np.minimum(0.3 * G * frames.times, 1.5)
    np.testing.assert_allclose(frames.velocities[:, 0, 0], expected, atol=6e-3)
    assert frames.velocities[-1, 0, 0] == pytest.approx(1.5, abs=1e-6)


@solvers
@pytest.mark.parametrize("speed", [0.0, 1e-9, 1e-6, 1e-3, 1.0])
def test_friction_never_adds_energy(solver, speed):
    """Row 46: any tangential speed, either way, only falls; no chatter about zero, whatever the step."""
    for sign in (1, -1):
        scene = points(
            tetrahedron(resting_gap(G)),
            ds.Ground(stiffness=1e4, width=0.01, friction=0.8, friction_speed=1e-3),
            terms=[ds.Gravity(-G)],
            initial_velocities=[sign * speed, 0, 0.3 * speed],
        )
        frames = ds.Rollout(solver(scene, dt=1e-2), 60, save_every=1).forward()
        along = frames.velocities[:, 0, [0, 2]]
        size = np.linalg.norm(along, axis=1)
        tiny = 1e-11 * speed  # the body's own elasticity of 1e-6 Pa
        assert np.all(np.diff(size) <= tiny) and np.all(along @ along[0] >= -tiny * speed)
        assert np.abs(frames.velocities[:, 0, 1]).max() < 1e-9  # nothing lifts or sinks


@solvers
def test_friction_work_is_what_the_energy_loses(solver):
    """mu N times the way that was slid, while kinetic energy falls by as much."""
    scene = points(
        tetrahedron(resting_gap(G)),
        ds.Ground(stiffness=1e4, width=0.01, friction=0.25, friction_speed=1e-4),
        terms=[ds.Gravity(-G)],
        initial_velocities=[1.2, 0, -0.5],
    )
    frames = ds.Rollout(solver(scene, dt=1e-4), 3000, save_every=100).forward()
    way = np.linalg.norm(np.diff(frames.positions[:, 0], axis=0), axis=1).cumsum()
    lost = 0.5 * (1.3**2 - (frames.velocities[1:, 0] ** 2).sum(1))
    np.testing.assert_allclose(lost, 0.25 * G * way, rtol=2e-3)


@solvers
def test_static_and_sliding_are_one_continuous_law(solver):
    """Row 46: the velocity after friction is C1 in the velocity before: no jump in gradients where sticking ends."""
    scene = points(
        tetrahedron(resting_gap(G)),
        ds.Ground(stiffness=1e4, width=0.01, friction=0.5, friction_speed=0.05),
        terms=[ds.Gravity(-G)],
    )
    rollout = ds.Rollout(solver(scene, dt=2e-3), 1 if solver.order == 1 else 2, gradients=["initial_velocities"])
    found, ends = [], []
    for speed in np.linspace(0.03, 0.09, 61):  # sticking ends at 0.05 + 0.5 g dt
        velocities = np.zeros((4, 3))
        velocities[:3, 0] = speed
        frames = rollout.forward(initial_velocities=velocities)
        adjoint = np.zeros_like(frames.velocities)
        adjoint[-1, 0, 0] = 1
        found.append(rollout.vjp(frames, velocities=adjoint)["initial_velocities"][0, 0])
        ends.append(frames.velocities[-1, 0, 0])
    found = np.array(found)
    assert np.all(np.isfinite(found)) and np.abs(np.diff(found)).max() < 0.05
    np.testing.assert_allclose(np.gradient(ends, 0.001)[1:-1], found[1:-1], atol=0.02)
    assert found[0] < 0.9 and found[-1] > 0.99


@solvers
def test_two_rough_walls_act_one_after_the_other(solver):
    """In a corner both frictions hold; a vertex that rests in it does not move."""
    wall = ds.HalfSpace([-resting_gap(5.0), 0, 0], [1, 0, 0], stiffness=1e4, width=0.01, friction=0.6)
    scene = points(
        tetrahedron(resting_gap(G)),
        [ds.Ground(stiffness=1e4, width=0.01, friction=0.6), wall],
        terms=[ds.Gravity([-5.0, -G, 2.0])],
        fixed=[1, 2, 3],
    )
    end = ds.Rollout(solver(scene, dt=1e-3), 1000).forward()
    assert np.abs(end.positions[-1, 0] - BASE[0] - [0, resting_gap(G), 0]).max() < 1.1e-3  # creep of friction_speed


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver])
def test_a_block_that_shakes_while_it_slides_says_so_and_viscosity_helps(solver):
    """From 2 m/s it stops after v^2 / (2 mu g); without viscosity its vibrations grow, and it goes 5 % too far."""
    mesh, mu = ds.TetrahedralMesh.create_box((3, 2, 3), (0.1, 0.05, 0.1)).translated([0, 9.9e-4, 0]), 0.7
    floor = ds.Ground(width=1e-3, friction=mu, stiffness_per_area=1e9)

    def way(material):
        scene = ds.Scene(mesh, material, 1000.0, [ds.Gravity(), floor], initial_velocities=(2, 0, 0), precision="f64")
        dt = 0.5 * ds.stable_dt(scene).dt
        simulator = ds.Simulator(solver(scene, dt=dt))
        simulator.run(int(0.33 / dt))
        return (simulator.positions - mesh.vertices)[:, 0].mean() / (2**2 / (2 * mu * G))

    block = ds.StableNeoHookean(1e6, 0.3)
    with pytest.warns(UserWarning, match="slides on Ground.*vibrates at") as warned:
        assert way(block) > 1.02
    assert warned[0].filename == __file__
    time = float(re.search(r"KelvinVoigt\(StableNeoHookean\(...\), (\S+)\)", str(warned[0].message))[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert way(ds.KelvinVoigt(block, time)) == pytest.approx(1, abs=5e-3)
