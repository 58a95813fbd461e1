"""Implicit steps past obstacles: nothing passes, nothing is impaled, and what cannot be resolved says so."""

import numpy as np
import pytest
from battery_of_impacts import SOLVERS, battery, draw
from impact_judge import Judge

import diffsim_ti as ds
from diffsim_ti.mechanics.obstacles.blocked import Blocked

DAMPED = pytest.mark.parametrize("solver", [ds.ImplicitEulerSolver, ds.BDF2Solver], ids=lambda s: s.__name__)
SOFT = ds.StableNeoHookean(1e5, 0.3)
WALL = dict(kind="box", center=np.array([0.25, 0.05, 0.05]), axes=np.eye(3), half=np.array([0.005, 0.5, 0.5]))


def cube(n=3, size=0.1):
    return ds.TetrahedralMesh.create_box(n, size=size)


STILL = lambda t: np.zeros(3)  # noqa: E731 (of obstacles that could move, so that tests share their kernels)


def wall(path=STILL, **options):
    return ds.Box(center=(0.25, 0.05, 0.05), size=(0.01, 1, 1), width=0.005, path=path, **options)


def judged(simulator, solid, steps, path=STILL):
    judge = Judge(simulator.scene.mesh.surface_triangles, solid, simulator.positions, path(0.0))
    for _ in range(steps):
        simulator.step()
        assert judge.after_step(simulator.positions, path(simulator.time)) is None


@DAMPED
@pytest.mark.parametrize("speed, dt", [(3.0, 1e-2), (3.0, 5e-2), (20.0, 1e-2)])
def test_a_thin_wall_stops_a_cube(solver, speed, dt):
    scene = ds.Scene(cube(), SOFT, terms=[wall()], initial_velocities=(speed, 0, 0), precision="f64")
    simulator = ds.Simulator(solver(scene, dt=dt))
    judged(simulator, WALL, int(1 / speed / dt) + 4)
    assert simulator.positions[:, 0].max() < 0.245


@DAMPED
def test_a_plate_that_comes_pushes_a_body_along(solver):
    """30 m/s and steps of 10 ms: 0.3 m in a step, three times the body."""
    path = lambda t: np.array([30 * t - 0.4, 0, 0])  # noqa: E731
    scene = ds.Scene(cube(), SOFT, terms=[wall(stiffness_per_area=1e6, path=path)], precision="f64")
    simulator = ds.Simulator(solver(scene, dt=1e-2))
    judged(simulator, WALL, 4, path)
    assert simulator.velocities[:, 0].mean() > 25


def plates(low, high, n=3, at=0.104, **near):
    """A cube and two plates, of which one lies above `at`, that go up at these speeds."""
    near = dict(stiffness=1e5, width=0.005) | near
    pair = [
        ds.HalfSpace((0, -0.004, 0), (0, 1, 0), **near, path=lambda t: [0, low * t, 0]),
        ds.HalfSpace((0, at, 0), (0, -1, 0), **near, path=lambda t: [0, high * t, 0]),
    ]
    return ds.Scene(cube(n), SOFT, terms=pair, precision="f64")


def test_a_body_between_two_plates_is_squeezed_in_parts():
    """Its motion has nowhere to be carried: the plates come as room is made, faster where the body gives way on."""
    scene = plates(2, -2)
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=1e-2))
    simulator.step()  # 6.8 cm of 10.8 are left
    y = simulator.positions[:, 1]
    assert 0.016 < y.min() and y.max() < 0.084 and simulator.tetrahedron_fields().J.min() > 0
    assert simulator.report.iterations < 30  # 38 where parts begin from where the body is


def test_no_room_is_left():
    simulator = ds.Simulator(ds.ImplicitEulerSolver(plates(0, -12), dt=1e-2))
    with pytest.raises(Blocked, match=r"^step 0, t = 0 s: .*(vertex|face).* before HalfSpace.*m/s"):
        simulator.step()
    assert np.abs(simulator.displacements).max() == 0


def test_beyond_the_middle_of_a_step():
    scene = ds.Scene(cube(), SOFT, terms=[wall()], initial_velocities=(3.0, 0, 0), precision="f64")
    simulator = ds.Simulator(ds.ImplicitMidpointSolver(scene, dt=1e-2))
    with pytest.raises(ds.Tunnelling, match=r"^step 4, t = 0.04 s: beyond the middle .* meets Box.*m/s.*BDF2Solver"):
        simulator.run(20)
    assert simulator.step_count == 4


NEEDLE = dict(kind="capsule", start=np.array([0.055, -0.1, 0.06]), end=np.array([0.055, -0.012, 0.06]), radius=0.004)


def needle(**options):
    return ds.Capsule((0.055, -0.1, 0.06), (0.055, -0.012, 0.06), 0.004, width=0.004, **options)


@DAMPED
def test_a_needle_between_vertices_carries_a_body(solver):
    """No vertex comes near it."""
    mesh = cube(2)
    scene = ds.Scene(
        mesh, SOFT, terms=[ds.Gravity(), needle(stiffness=1e3)], initial_velocities=(0, -1, 0), precision="f64"
    )
    simulator = ds.Simulator(solver(scene, dt=1e-2))
    judged(simulator, NEEDLE, 5)
    assert np.linalg.norm(simulator.positions[:, [0, 2]] - [0.055, 0.06], axis=1).min() > 0.03
    assert simulator.velocities[:, 1].mean() > -0.5  # it would be -1.5


def test_statics_rest_on_a_needle():
    mesh = cube(2)
    scene = ds.Scene(
        mesh,
        SOFT,
        terms=[ds.Gravity((0, 0, 0)), needle(stiffness=1e3)],
        fixed=mesh.vertices[:, 1] > 0.09,
        motion=lambda t: [0, -0.02 * t, 0],
        precision="f64",
    )
    simulator = ds.Simulator(ds.StaticSolver(scene, dt=0.5))
    judged(simulator, NEEDLE, 2)
    assert np.abs(simulator.positions - (mesh.vertices - [0, 0.02, 0])).max() > 2e-3  # where it would be without


def test_a_state_from_outside_is_looked_at_between_its_vertices():
    mesh = cube(2)
    inside = ds.Capsule((0.055, -0.1, 0.06), (0.055, 0.02, 0.06), 0.004, width=0.002, stiffness=1e3)
    with pytest.raises(ValueError, match="edge of Capsule.* and triangle"):
        ds.Simulator(ds.ImplicitEulerSolver(ds.Scene(mesh, SOFT, terms=[inside], precision="f64")))
    simulator = ds.Simulator(ds.BDF2Solver(ds.Scene(mesh, SOFT, terms=[needle(stiffness=1e3)], precision="f64")))
    with pytest.raises(ValueError, match="edge of Capsule.* and triangle"):
        simulator.set_state(positions=mesh.vertices - [0, 0.03, 0])


def test_errors_name_the_step_of_the_simulator():
    scene = ds.Scene(
        cube(2),
        SOFT,
        terms=[ds.Ground(-0.03, stiffness=1e4, width=0.01)],
        initial_velocities=(0, -1, 0),
        precision="f64",
    )
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=1e-2, substeps=2, max_iterations=1))
    with pytest.raises(ds.NotConverged) as error:
        simulator.run(9)
    assert simulator.step_count > 1 and str(error.value).startswith(f"step {simulator.step_count}, t = 0.0")


def squeezed(solver, **options):
    """Steps in which directions are cut and a floor comes in parts."""
    mesh = cube(2)
    terms = [
        ds.HalfSpace((0, -0.004, 0), (0.05, 1, 0), stiffness=3e3, width=0.01, path=lambda t: [0, 2 * t, 0]),
        ds.Capsule((0.05, 0.106, -1), (0.05, 0.108, 1), 0.004, stiffness=3e3, width=0.01),
    ]
    scene = ds.Scene(mesh, SOFT, terms=terms, initial_velocities=(0, 0.3, 0), precision="f64")
    return ds.Rollout(solver(scene, dt=1e-2, tolerance=1e-11, **options), 2, gradients="all")


@DAMPED
def test_gradients_where_ways_are_cut_and_obstacles_come_in_parts(solver, monkeypatch):
    from diffsim_ti.mechanics.obstacles.approach import Approach

    parts, usual = [], Approach._in_parts
    monkeypatch.setattr(Approach, "_in_parts", lambda self, *a: parts.append(1) or usual(self, *a))
    monkeypatch.setattr(Approach, "_carried", lambda self, *a: None)
    rollout, rng = squeezed(solver), np.random.default_rng(0)
    assert ds.dot_product_test(rollout) < 1e-8 and parts
    values = {name: rollout.values[name] for name in ("initial_velocities", "half_space_path", "capsule_radius")}
    turn = {name: 0.01 * rng.standard_normal(x.shape) for name, x in values.items()}
    weights = rng.standard_normal((2, 8, 3))

    def loss(t):
        return float((weights * rollout.forward(**{n: x + t * turn[n] for n, x in values.items()}).positions).sum())

    gradients = rollout.vjp(rollout.forward(), positions=weights)
    slope, h = sum(float((gradients[name] * turn[name]).sum()) for name in turn), 1e-3
    coarse, fine = ((loss(s * h) - loss(-s * h)) / (2 * s * h) for s in (2, 1))
    assert (4 * fine - coarse) / 3 == pytest.approx(slope, rel=1e-5)


def test_midpoint_steps_are_not_blamed_for_the_work_of_obstacles():
    """A plate that presses a body at rest does work; steps that resolve it add next to none."""
    scene = plates(0.5, 0, n=2, at=1.0, stiffness=1e3, width=0.01)
    simulator = ds.Simulator(ds.ImplicitMidpointSolver(scene, dt=2e-4))
    simulator.run(60)
    watch = simulator.workspace.energy_watch
    assert watch.moving > 1e-2 and abs(watch.share) < 1e-2


def test_part_of_the_battery(capsys):
    """The whole of it: python tests/battery_of_impacts.py --cases 200"""
    cases = [draw(n, 5, SOLVERS) for n in range(40) if n % 5 != 4]  # in float64: fewer kernels to compile
    few = [c for c in cases if c.kind in ("ball", "plate")]
    implicit = [next(c for c in few if c.solver == name) for name in SOLVERS if not SOLVERS[name].explicit]
    explicit = [c for c in cases if c.explicit and c.slow][:2]
    table = battery([*implicit, *explicit], show=lambda text: print(text))
    assert sum(row["cases"] for row in table.values()) == 6 and len(table) == len(SOLVERS)
    assert not any(row["silent"] for row in table.values()), capsys.readouterr().out
