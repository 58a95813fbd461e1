"""Steps of unequal length: the same run where they are equal, exact gradients, the order of each solver, and a search."""

import numpy as np
import pytest
from example_files import example
from test_gradients import full_scene

import diffsim_ti as ds

EXPLICIT = ds.SemiImplicitSolver, ds.VelocityVerletSolver
IMPLICIT = ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver
by_solver = pytest.mark.parametrize("solver", EXPLICIT + IMPLICIT, ids=lambda s: s.__name__)
rng = np.random.default_rng(8)
LENGTHS, SUBSTEPS = rng.uniform(0.6, 1.0, 6) * 2e-3, np.array([3, 5, 4, 6, 3, 4])
STEPS = ds.UnequalSteps(LENGTHS, SUBSTEPS)


def taken_by(solver, scene, steps, **options):
    exact = {} if solver.explicit else dict(tolerance=1e-12)
    return ds.Rollout(solver(scene, dt=1e-3, substeps=2, **exact), steps, **options)


def loaded_scene() -> ds.Scene:
    """What changes within steps and from step to step: pressures, tensions, forces, a path, a motion."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (0.2, 0.1, 0.1), origin=(0, 0.003, 0))
    generator, vertices = np.random.default_rng(2), mesh.vertices
    terms = [
        ds.Gravity(),
        ds.Pressure(lambda t: 300 * np.sin(400 * t), surface="ymax"),
        ds.Traction(generator.normal(size=(6, 3)) * 100, surface="zmax"),
        ds.Cable([vertices[0], vertices[-1]], tension=generator.uniform(1, 3, 6)),
        ds.BodyForce(([0, 5e-3, 1.0], [[0, 0, 0], [3.0, -5, 2], [0, 0, 0]])),
        ds.Ground(stiffness_per_area=3e6, width=0.005, friction=0.3, path=lambda t: [0.1 * t, 0.2 * t, 0]),
    ]
    moved = dict(fixed="xmin", motion=lambda t: [0, 0.05 * np.sin(300 * t), 0])
    return ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), terms=terms, precision="f64", **moved)


def assert_transposed(rollout, rtol):
    """Reverse gradients are the transpose of tangents, in every input."""
    frames, generator = rollout.forward(), np.random.default_rng(5)
    dots = {name: generator.normal(size=np.shape(x)) for name, x in frames.inputs.items() if name in rollout.wanted}
    for name, dot in dots.items():
        dots[name] = dot * np.maximum(np.abs(frames.inputs[name]).max(), 1e-3) * 0.1
    w, z = generator.normal(size=(2, *frames.positions.shape)) * np.array([1, 1e-3])[:, None, None, None]
    dx, dv = rollout.jvp(frames, **dots)
    gradients = rollout.vjp(frames, w, z)
    forward = (w * dx).sum() + (z * dv).sum()
    parts = [(gradients[name] * dot).sum() for name, dot in dots.items()]
    assert abs(forward - sum(parts)) < rtol * np.abs(parts).max()


@by_solver
@pytest.mark.parametrize("scene", [full_scene, loaded_scene])
def test_reverse_gradients_are_the_transpose_of_tangents(solver, scene):
    scene = full_scene(steps=6) if scene is full_scene else loaded_scene()
    rollout = taken_by(solver, scene, STEPS, save_every=2, gradients="all", checkpoint_every=2)
    assert_transposed(rollout, 1e-11 if solver.explicit else 1e-8)


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.BDF2Solver])
def test_gradients_are_those_of_differences(solver):
    rollout = taken_by(solver, loaded_scene(), STEPS, save_every=3, gradients="youngs_modulus")
    assert ds.check_gradients(rollout).passed


@by_solver
def test_equal_lengths_are_equal_steps(solver):
    scene = full_scene(steps=4)
    runs = [taken_by(solver, scene, steps, save_every=2) for steps in (4, [1e-3] * 4)]
    a, b = (run.forward() for run in runs)
    of_loss = [run.vjp(f, np.cos(f.positions), f.velocities) for run, f in zip(runs, (a, b))]
    pairs = [
        (a.positions, b.positions),
        (a.velocities, b.velocities),
        *((of_loss[0][k], of_loss[1][k]) for k in of_loss[0]),
    ]
    for one, other in pairs:
        if solver.explicit:
            assert one.tobytes() == other.tobytes()
        else:  # solved to 1e-12, with another preconditioner
            np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-8 * np.abs(one).max())


@pytest.mark.parametrize("solver", [*EXPLICIT, ds.BDF2Solver])
def test_checkpoints_change_no_bit(solver):
    runs = [taken_by(solver, full_scene(steps=6), STEPS, save_every=3, checkpoint_every=k) for k in (None, 1)]
    assert runs[1].checkpoints.num_segments > 3
    a, b = (run.vjp(run.forward(), *np.ones((2, 3, 27, 3))) for run in runs)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


@by_solver
def test_order_on_steps_that_change_all_the_time(solver):
    """Errors against a fine run as all steps are halved, for steps that are 1, 2, 1, 2, ... times as long."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (0.3, 0.1, 0.1))
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e3, 0.3), terms=[ds.Gravity(), ds.Drag(3.0)], fixed="xmin", precision="f64"
    )
    pattern, ends = np.tile([1.0, 2.0], 12), {}
    for finer in (1, 2, 16):
        lengths = np.repeat(pattern, finer) / pattern.sum() / finer * 0.1
        lengths[: 2 * finer] = lengths[: 2 * finer].mean()  # BDF2 begins with a step of order one
        ends[finer] = taken_by(solver, scene, ds.UnequalSteps(lengths)).forward().positions[-1]
    coarse, fine = (np.linalg.norm(ends[k] - ends[16]) for k in (1, 2))
    expected = (1 - 16**-solver.order) / (2**-solver.order - 16**-solver.order)
    assert coarse / fine == pytest.approx(expected, rel=0.25)


def test_times_and_forces_of_frames():
    scene = loaded_scene()
    rollout = taken_by(ds.VelocityVerletSolver, scene, STEPS, save_every=1, outputs=ds.ContactForce(scene.obstacles[0]))
    frames = rollout.forward()
    np.testing.assert_allclose(rollout.times, np.concatenate([[0], np.cumsum(LENGTHS)]), rtol=1e-15)
    # the floor comes to a body that is held: means over frames of 1.2 to 2 ms, times these, are what one frame's are
    one = taken_by(ds.VelocityVerletSolver, scene, STEPS, outputs=ds.ContactForce(scene.obstacles[0])).forward()
    name = next(iter(frames.outputs))
    impulse = (frames[name][1:] * LENGTHS.reshape(-1, *[1] * (frames[name].ndim - 1))).sum(0)
    assert np.abs(impulse).max() > 0
    np.testing.assert_allclose(impulse, one[name][-1] * LENGTHS.sum(), rtol=1e-12, atol=1e-15)


def test_truncate_and_clip_go_by_steps():
    scene = full_scene(steps=6)
    whole = taken_by(ds.VelocityVerletSolver, scene, STEPS, health=True)
    whole.vjp(whole.forward(), np.ones((2, 27, 3)))
    assert [entry["step"] for entry in whole.health] == [5, 4, 3, 2, 1, 0]
    cut = taken_by(ds.VelocityVerletSolver, scene, STEPS, truncate=2)
    gradient = cut.vjp(cut.forward(), np.ones((2, 27, 3)))["external_forces"]
    assert gradient[4:].any() and not gradient[:3].any()  # the kick at the cut is of both steps that meet there


@pytest.mark.parametrize("solver", EXPLICIT)
def test_contacts_are_judged_alike_whatever_is_kept(solver):
    """Passes of each length by their own, also where a segment between checkpoints has one length alone."""
    every = [None, 1, 2]
    seen = [
        taken_by(solver, falling(), [8e-4, 2e-4, 2e-4, 6e-4] * 16, checkpoint_every=k).forward().contact_resolution
        for k in every
    ]
    assert seen[0].obstacle is not None and seen[0] == seen[1] == seen[2]
    assert seen[0].substep == pytest.approx(4e-4)  # the longest, of two substeps a step, is the coarsest


def test_health_goes_by_the_time_of_the_steps():
    """A decay at one rate has that rate, whatever the lengths of steps are."""
    mesh = ds.TetrahedralMesh.create_cube(2, 0.1)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e3, 0.3), terms=[ds.Drag(30.0)], precision="f64")
    rates = []
    for steps in ([1e-3] * 24, [5e-4] * 12 + [1.5e-3] * 12):
        rollout = taken_by(ds.SemiImplicitSolver, scene, steps, health=True)
        frames = rollout.forward(initial_velocities=np.ones((8, 3)))
        rollout.vjp(frames, velocities=np.stack([np.zeros((8, 3)), np.ones((8, 3))]))
        rates.append(ds.verify.gradient_health(rollout).growth_rate)
    np.testing.assert_allclose(rates, -30.0, rtol=0.01)


# ---- a search ---------------------------------------------------------------------------------------------------------


def falling(**options) -> ds.Scene:
    mesh = ds.TetrahedralMesh.create_box(3, 0.1, origin=(0, 0.02, 0))
    floor = ds.Ground(stiffness_per_area=3e6, width=0.005)
    return ds.Scene(
        mesh,
        ds.StableNeoHookean(1e5, 0.3),
        terms=[ds.Gravity(), floor],
        precision="f64",
        initial_velocities=[0, -1.0, 0],
    )


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.BDF2Solver])
def test_the_search_puts_substeps_where_the_impact_is(solver):
    scene, tolerance = falling(), 1e-3
    plain = solver(scene, dt=4e-3, **(dict(check_start=False) if solver.explicit else {}))
    steps = ds.adaptive_steps(plain, 15, tolerance)
    touch = slice(2, 9)
    assert steps.substeps[touch].max() >= 2 * steps.substeps[0]
    fine = ds.Rollout(ds.VelocityVerletSolver(scene, dt=4e-3, substeps=400), 15, save_every=15).forward()
    end = ds.Rollout(plain, steps).forward().positions[-1]
    assert np.linalg.norm(end - fine.positions[-1], axis=1).max() < 5 * tolerance  # motion stretches errors
    again = ds.Rollout(plain, lambda s: ds.adaptive_steps(s, 15, tolerance))
    assert np.array_equal(again.schedule.substeps, steps.substeps)
    finer = ds.adaptive_steps(plain, 15, tolerance / 10)
    assert finer.substeps.sum() > 1.5 * steps.substeps.sum()
    assert ds.Rollout(plain, finer).forward().contact_resolution.substep <= 4e-3


def test_a_batch_takes_the_steps_of_the_scene_that_needs_most():
    solver = ds.VelocityVerletSolver(falling(), dt=4e-3, check_start=False)
    values = dict(youngs_modulus=[1e5, 2e5, 5e4], initial_velocities=np.zeros((3, solver.scene.mesh.num_vertices, 3)))
    values["initial_velocities"][:, :, 1] = np.array([-1.0, -0.5, -1.5])[:, None]
    each = []
    for b in range(3):
        own = solver.scene.with_values({name: x[b] for name, x in values.items()})
        each.append(ds.adaptive_steps(ds.VelocityVerletSolver(own, dt=4e-3, check_start=False), 15, 1e-3).substeps)
    shared = ds.adaptive_steps(solver, 15, 1e-3, values=values)
    assert np.array_equal(shared.substeps, np.max(each, 0)) and len({tuple(x) for x in each}) == 3
    batch = ds.Batch(solver, shared, 3)
    frames = batch.forward(**values)
    assert frames.alive.all() and batch.lanes
    alone = batch.one.forward(**{name: np.asarray(x)[2] for name, x in values.items()})
    assert np.array_equal(frames.displacements[2], alone.displacements)
    with pytest.raises(
        ValueError, match=r"one axis of scenes in front, got shapes youngs_modulus \(3,\), density \(2,\)"
    ):
        ds.adaptive_steps(solver, 15, 1e-3, values=dict(youngs_modulus=[1e5] * 3, density=[1e3] * 2))


def test_what_bodies_do_between_impacts_needs_no_fine_steps(monkeypatch):
    """Two sizes of steps, and what lies between them as they change; a search of at most three runs of what it finds."""
    solver, passes = ds.VelocityVerletSolver(falling(), dt=4e-3, check_start=False), []
    set_substeps = ds.Simulator.set_substeps
    monkeypatch.setattr(ds.Simulator, "set_substeps", lambda self, n: (passes.append(n), set_substeps(self, n)))
    vertices, bodies = (ds.adaptive_steps(solver, 25, 1e-3, of=of).substeps for of in ("vertices", "bodies"))
    assert sum(passes) <= 3 * (vertices.sum() + bodies.sum())
    stable = int(np.ceil(4e-3 / (0.7 * solver.stable_dt(tight=True).dt)))
    assert np.all(bodies[15:] == stable) and np.all(vertices[15:] > stable)
    fine = np.flatnonzero(bodies == bodies.max())
    assert fine[0] >= 2 and fine[-1] <= 12 and np.array_equal(fine, np.arange(fine[0], fine[-1] + 1))


def test_the_benchmark_of_an_impact(capsys):
    """One start: a finer tolerance takes more substeps, and the finest gradient is the best of those."""
    found = example("benchmarks/impact_steps").main(1, ("block",))["block"]["adaptive"]
    assert "| adaptive |" in capsys.readouterr().out
    substeps, errors = (np.array(column) for column in zip(*((n, e) for n, e, _ in found)))
    assert np.all(np.diff(substeps) > 0) and errors[-1] < 0.02 and errors[-1] <= errors.max()


def test_a_search_goes_on_where_a_solve_does_not_converge():
    """One substep would drive fixed vertices through a floor's barrier faster than Newton's method can follow."""
    mesh = ds.TetrahedralMesh.create_box(3, 0.1, origin=(0, 0.02, 0))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e4, 0.3), terms=[ds.Gravity()], fixed="ymax", precision="f64")
    scene = scene.replace(motion=lambda t: [0, -0.04 * np.sin(np.pi * min(t / 0.1, 1.0)), 0])
    solver = ds.ImplicitEulerSolver(scene, dt=0.05, max_iterations=3)
    with pytest.raises(ds.NotConverged):
        ds.Rollout(solver, 2).forward()
    steps = ds.adaptive_steps(solver, 2, 1.0)
    assert steps.substeps.min() > 1
    ds.Rollout(solver, steps).forward()


# ---- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda s: ds.UnequalSteps([1e-3, 0.0]), "must be > 0"),
        (lambda s: ds.UnequalSteps([1e-3, np.nan]), "must be > 0"),
        (lambda s: ds.UnequalSteps([[1e-3]]), "one number for each step"),
        (lambda s: ds.UnequalSteps([1e-3], 1.5), "whole numbers"),
        (lambda s: ds.UnequalSteps([1e-3] * 3, [1, 2]), "one for each of 3"),
        (lambda s: ds.Rollout(ds.VelocityVerletSolver(s, dt=1e-4, substeps=1), [1e-4, 1.0]), "shorten the longest"),
        (lambda s: ds.Rollout(ds.BDF2Solver(s), [1e-3, 3e-3]), "2.4 times"),
        (lambda s: ds.Rollout(ds.StaticSolver(s), [1.0, 1.0]), "equilibria"),
        (lambda s: ds.Rollout(ds.BDF2Solver(s), 2.5), "whole number >= 0, got 2.5; or pass lengths"),
        (lambda s: ds.adaptive_steps(ds.BDF2Solver(s), 3, 0.0), "tolerance"),
        (lambda s: ds.adaptive_steps(ds.BDF2Solver(s), 0, 1.0), "steps"),
        (lambda s: ds.adaptive_steps(ds.BDF2Solver(s), 3, 1.0, of="tips"), 'must be "vertices" or "bodies"'),
        (lambda s: ds.adaptive_steps(ds.VelocityVerletSolver(s, dt=1e-4), 3, 1e-300), "4096 substeps"),
        (lambda s: ds.adaptive_steps(ds.StaticSolver(s), 3, 1.0), "equilibria"),
    ],
)
def test_what_is_refused(make, said):
    scene = full_scene(steps=2)
    with pytest.raises(ValueError, match=said):
        make(scene)
