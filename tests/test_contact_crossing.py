"""No vertex gets through an obstacle in silence."""

import numpy as np
import pytest
from contact_scenes import EXPLICIT, FORCE, SHAPES, points, tetrahedron

import diffsim_ti as ds
from diffsim_ti.writers.adaptive_run import ForwardRun

pytestmark = pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py

solvers = pytest.mark.parametrize("solver", FORCE)


@solvers
@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("how", ["rollout", "simulator"])
def test_speed_table(solver, dt, how):
    """Row 41: from 1 to 65 m/s a vertex bounces, or the error says where it got to; it is never below in silence."""
    crossed = []
    for speed in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 65.0):
        scene = points(
            tetrahedron(0.3 * speed * dt + 0.03),
            ds.Ground(stiffness=1e4, width=0.01),
            initial_velocities=[0.1, -speed, 0],
        )
        own = solver(scene, dt=dt, allow_unstable=True)
        steps = max(3, int(0.1 / speed / dt))
        try:
            if how == "rollout":
                frames = ds.Rollout(own, steps, save_every=1).forward()
                lowest, seen = frames.positions[:, :3, 1].min(), frames.contact_resolution.smallest_gap
            else:
                simulator = ds.Simulator(own)
                simulator.run(steps)
                lowest, seen = simulator.positions[:3, 1].min(), simulator.contact_resolution.smallest_gap
            assert lowest > 0 and seen > 0
        except ds.Crossing as error:
            crossed.append(speed)
            assert error.depth > 0 and error.vertex in (0, 1, 2) and 0.3 * speed < error.speed < 1.1 * speed
            assert f"vertex {error.vertex} gets {error.depth:.3g} m behind Ground(" in str(error)
            assert f"at {error.speed:.4g} m/s" in str(error)
            if speed < 3.7:  # m v^2 / 2 is less than the barrier holds, k w^2 6.9 = 6.9 J
                assert error.stiffness is None and f"reduce the substep to {error.stable_dt:.3g} s" in str(error)
            elif speed > 4 or dt < 1e-3:
                assert error.stiffness > 1e4 and f"raise its stiffness to {error.stiffness:.3g} N/m" in str(error)
    assert 65.0 in crossed and (dt > 1e-4 or 1.0 not in crossed)


@solvers
def test_the_state_before_is_kept(solver):
    scene = points(tetrahedron(0.108), ds.Ground(stiffness=1e4, width=0.01), mass=0.05, initial_velocities=[0, -10, 0])
    simulator = ds.Simulator(solver(scene, dt=1e-2, substeps=1))
    with pytest.raises(ds.Crossing) as caught:
        simulator.run(5)
    assert simulator.step_count == caught.value.step == 1 and simulator.positions[0, 1] == pytest.approx(0.008)
    assert caught.value.stiffness is None and 0 < caught.value.depth < 0.092
    simulator.set_substeps(1000)
    simulator.run(2)  # finer steps get on from there
    assert simulator.positions[0, 1] > 0 and simulator.contact_resolution.smallest_gap > 0


THIN = {
    "box": lambda **o: ds.Box([0.25, -0.05, 0.2], [2, 0.002, 2], **o),
    "capsule": lambda **o: ds.Capsule([-1, -0.05, 0], [1, -0.05, 0], 0.002, **o),
    "cylinder": lambda **o: ds.Cylinder([0.2, -0.049, 0.2], [0.2, -0.051, 0.2], 1.0, **o),
}


@solvers
@pytest.mark.parametrize("name", THIN)
def test_thin_obstacles_are_not_jumped_over(solver, name):
    """A plate of 2 mm and a wire, at a step that takes vertices from one side to the other."""
    for vertical, dt in ((-20.0, 1e-2), (-20.0, 4e-3)):
        scene = points(tetrahedron(0.02), THIN[name](stiffness=1e3, width=0.005), initial_velocities=[0, vertical, 0])
        with pytest.raises(ds.Crossing, match=f"behind {type(scene.terms[0]).__name__}"):
            ds.Rollout(solver(scene, dt=dt), 8).forward()


@solvers
def test_a_fast_obstacle_does_not_run_over_a_vertex(solver):
    """What counts is the motion against each other."""
    wall = ds.HalfSpace([-0.5, 0, 0], [1, 0, 0], stiffness=1e3, width=0.05, path=lambda t: [30 * t, 0, 0])
    with pytest.raises(ds.Crossing, match="behind HalfSpace") as caught:
        ds.Rollout(solver(points(tetrahedron(0.0), wall, fixed=[]), dt=5e-3), 10).forward()
    assert caught.value.vertex in (0, 1, 2, 3) and caught.value.depth > 0


@pytest.mark.parametrize("solver", FORCE + EXPLICIT)
@pytest.mark.parametrize("name", ["half_space", "sphere", "capsule"])
def test_forward_runs_divide_the_step(solver, name):
    """A run that follows the state takes finer steps until nothing crosses, and reports the smallest gap."""
    term = SHAPES[name](stiffness=1e5, width=0.03)
    scene = ds.Scene(
        tetrahedron(0.15), ds.StableNeoHookean(1e5, 0.3), 300.0, [ds.Gravity(), term], initial_velocities=[0, -6, 0]
    )
    run = ForwardRun(scene, solver, frame_time=0.02)
    for _ in range(4):
        run.advance()
    assert run.seen.crossed == 0 and 0 < run.seen.gap < 0.03
    assert run.seen.gap <= run.simulator.contact_resolution.smallest_gap


def test_moving_obstacles_in_forward_runs():
    term = ds.HalfSpace([-0.1, 0, 0], [1, 0, 0], stiffness=2e3, width=0.03, path=lambda t: [2 * t, 0, 0])
    scene = ds.Scene(tetrahedron(0.15), ds.StableNeoHookean(1e5, 0.3), 300.0, [term])
    run = ForwardRun(scene, ds.VelocityVerletSolver, frame_time=0.05)
    run.advance()
    run.advance()
    assert run.seen.crossed == 0 and 0 < run.seen.gap < 0.03
    assert run.simulator.velocities[:, 0].mean() > 1.0


@pytest.mark.parametrize("solver", FORCE)
def test_a_run_that_fails_may_be_marked(solver):
    """As in a Batch: frames hold the last good state, gradients are zero, and the next run is as if nothing had been."""
    scene = points(tetrahedron(0.035), ds.Ground(stiffness=1e2, width=0.01), initial_velocities=[0.1, -0.3, 0])
    rollout = ds.Rollout(solver(scene, dt=1e-3), 120, save_every=10, raise_errors=False)
    failed = np.tile([0.1, -1.0, 0], (4, 1))
    frames = rollout.forward(initial_velocities=failed)
    assert not frames.alive and not rollout.alive and isinstance(frames.error, ds.Crossing)
    last = frames.error.step // 10
    assert (frames.positions[: last + 1, :3, 1] > 0).all() and (frames.positions[last:] == frames.positions[last]).all()
    with pytest.warns(UserWarning, match="gradient of a run that was stopped is zero"):
        gradients = rollout.vjp(frames, positions=np.ones_like(frames.positions))
    assert not any(np.any(x) for x in gradients.values())
    with pytest.raises(ds.Crossing):
        rollout.jvp(frames, barrier_width=1.0)
    good, alone = rollout.forward(), ds.Rollout(rollout.solver, 120, save_every=10).forward()
    assert good.alive and (good.positions == alone.positions).all()
    assert np.any(rollout.vjp(good, positions=np.ones_like(good.positions))["initial_velocities"])
    with pytest.raises(ds.Crossing):
        ds.Rollout(rollout.solver, 120).forward(initial_velocities=failed)
