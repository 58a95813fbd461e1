"""Steps that add energy say so; what is done on a body from outside is not blamed on them."""

import warnings

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.monitor.energy_balance import EnergyGained
from diffsim_ti.monitor.stability import lanczos_limit
from diffsim_ti.study.stability_axes import AXES
from diffsim_ti.study.stability_map import given_by_muscles
from diffsim_ti.writers.adaptive_run import ForwardRun

MESH = ds.TetrahedralMesh.create_box(4, size=0.1)
ABOVE = MESH.translated([0, 0.02 - MESH.bounding_box[0, 1], 0])
SOFT = ds.StableNeoHookean(1e5, 0.3)
NOISE = np.random.default_rng(0).standard_normal(MESH.vertices.shape)
EXPLICIT = (ds.VelocityVerletSolver, ds.SemiImplicitSolver)


def body(terms=(), mesh=MESH, **options) -> ds.Scene:
    return ds.Scene(mesh, SOFT, 1000.0, terms, precision=options.pop("precision", "f64"), **options)


def simulator(scene, share, kind=ds.VelocityVerletSolver, every=50, **options) -> ds.Simulator:
    """Steps of ten substeps, each a share of the stable one; the balance is looked at every so many passes."""
    out = ds.Simulator(kind(scene, dt=10 * share * ds.stable_dt(scene).dt, substeps=10, **options))
    out.workspace.energy_watch.every = every
    return out


@pytest.mark.parametrize("kind", EXPLICIT)
def test_a_gain_below_the_stable_step_is_said_and_the_advice_helps(kind):
    """Hot cubes at nine tenths of the limit gain a third of their energy and more, though omega dt < 2 everywhere."""
    scene = body(initial_velocities=0.3 * NOISE)
    hot = simulator(scene, 0.9, kind)
    with pytest.warns(EnergyGained, match=r"step \d+, t = .* has gained .* J, 1\d% of the energy that moves") as said:
        while hot.time < 0.85 or not said.list:
            hot.step()
    first = said.list[0].message
    assert len(said.list) == 1 and said[0].filename == __file__
    assert first.time == pytest.approx(first.step * hot.solver.dt) and 40 <= first.step < 60
    start = 0.5 * float((scene.inputs.derive(scene.inputs.values).mass[:, None] * (0.3 * NOISE) ** 2).sum())
    while hot.workspace.energy_watch.gained < start / 3:
        assert hot.solver.substep < lanczos_limit(hot.workspace).dt
        hot.step()
    # as advised
    calm = ds.Simulator(kind(scene, dt=hot.solver.dt, substeps=int(np.ceil(hot.solver.dt / first.substep))))
    calm.workspace.energy_watch.every = 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calm.run(3 * hot.step_count)
    watch = calm.workspace.energy_watch
    assert watch.gained < 0.01 * watch.moving and watch.moving > 0.5 * start


@pytest.mark.parametrize("rounded", [False, True])
def test_rollouts_say_it_once_a_run_and_name_the_step(rounded):
    """The same wherever states are kept, also where the lengths of steps differ by rounding."""
    h, found = 0.9 * ds.stable_dt(body()).dt, []
    steps = ds.UnequalSteps(np.diff(np.linspace(0, 700 * h, 701))) if rounded else 700
    for every in (None, 30):
        solver = ds.VelocityVerletSolver(body(initial_velocities=0.3 * NOISE), dt=h)
        rollout = ds.Rollout(solver, steps, checkpoint_every=every)
        rollout.forward(initial_velocities=0 * NOISE)
        rollout.sweep.workspace.energy_watch.every = 240
        with pytest.warns(EnergyGained) as said:
            rollout.forward()
        found.append([warning.message for warning in said.list])
    (first,), (again,) = found
    assert 400 <= first.step < 700 and first.time == pytest.approx(first.step * h)
    assert f"step {first.step}, " in str(first) and str(again) == str(first)


LOADS = np.zeros(MESH.vertices.shape)
LOADS[-1] = 0, 0.3, 0.2
SHAKEN = dict(fixed="xmin", motion=lambda t: [0.01 * np.sin(40 * t), 0.01 * np.sin(55 * t), 0])
PLATE = lambda t: [0.3 * np.sin(20 * t), 0.01 * np.sin(60 * t), 0]  # noqa: E731


PEAK = ds.Sphere([0.05, -0.04, 0.05], 0.05, stiffness=50.0, width=0.02, by_pairs=True)
DOWN = lambda t: [0, -0.008 * np.sin(30 * t), 0]  # noqa: E731


def ball(by_pairs: bool) -> ds.Sphere:
    place, path = [0.05, -0.04, 0.05], lambda t: [0, 0.05 * np.sin(30 * t), 0]
    return ds.Sphere(place, 0.05, stiffness=400.0, width=0.02, path=path, by_pairs=by_pairs)


WORK = {
    "loads": lambda: body([ds.ExternalForce(LOADS)], fixed="xmin"),
    "loads of steps": lambda: body(
        [ds.ExternalForce(np.array([LOADS * np.sin(0.3 * k) for k in range(80)]))], fixed="xmin"
    ),
    "drag": lambda: body([ds.Drag(30.0), ds.Gravity()], initial_velocities=0.1 * NOISE, fixed="xmin"),
    "motion": lambda: body([ds.Gravity()], **SHAKEN),
    "motion, drag": lambda: body([ds.Drag(10.0)], **SHAKEN),
    "a muscle": lambda: body([ds.Muscle([0, 1, 0], 2e4, 1.0)], fixed="xmin"),
    "a muscle of steps": lambda: body(
        [ds.Muscle([0, 1, 0], 3e4, 0.5 + 0.5 * np.sin(0.3 * np.arange(80)))], fixed="xmin"
    ),
    "a ball": lambda: body([ball(False)], ABOVE),
    "a ball by pairs": lambda: body([ball(True)], ABOVE),
    "supports above a ball by pairs": lambda: body([PEAK], ABOVE, fixed=dict(ymin="xyz"), motion=dict(ymin=DOWN)),
    "rollers above a ball by pairs": lambda: body([PEAK], ABOVE, fixed=dict(ymin="y"), motion=dict(ymin=DOWN)),
    "a belt": lambda: body([ds.Gravity(), ds.Ground(0.0, 2e3, width=0.01, friction=0.5, path=PLATE)], ABOVE),
}


@pytest.mark.parametrize("kind", EXPLICIT)
@pytest.mark.parametrize("work", WORK)
def test_work_from_outside_is_counted(kind, work):
    """The energy changes by most of what moves, or more; but for that work it rises by less than half a per cent."""
    run = simulator(WORK[work](), 0.5, kind)
    seen = [float(run.compute_energy())]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(80):
            run.step()
            seen.append(float(run.compute_energy()))
    watch = run.workspace.energy_watch
    assert np.ptp(seen) > 0.5 * watch.moving and watch.share < 5e-3, (np.ptp(seen), watch.moving, watch.share)


@pytest.mark.parametrize("kind", EXPLICIT)
def test_what_a_steady_muscle_makes_unstable_is_a_gain(kind):
    """As the kinetic and stored energy rise beyond what it gives; when its pull changes it is taken for a load."""
    scene = AXES["activation"].scene(1.0)
    pulls = np.where(np.arange(202) < 200, 1.0, 0.5)
    scene = scene.replace(terms=[ds.Muscle([0, 1, 0], 1e5, pulls)])
    run = ds.Simulator(kind(scene, dt=0.4 * ds.stable_dt(scene).dt))
    with pytest.warns(EnergyGained):
        run.run(200)
    watch, given = run.workspace.energy_watch, given_by_muscles(run)
    assert watch.steady and given > 0
    assert watch.gained == pytest.approx(float(run.compute_energy()) - given, rel=0.5)
    run.run(2)
    assert not watch.steady


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_obstacles_as_a_force_count_too(friction):
    run = simulator(
        body([ds.Gravity(), ds.Ground(0.0, 2e3, width=0.01, friction=friction, path=PLATE)], ABOVE),
        0.15,
        contact="force",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run.run(200)
    watch = run.workspace.energy_watch
    assert watch.moving > 0.1 and watch.share < 0.02


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_bounce_at_the_usual_step_is_not_blamed(precision):
    scene = body(
        [ds.Gravity(), ds.Ground(0.0, None, width=0.01)], ABOVE, precision=precision, initial_velocities=[0.5, -2, 0]
    )
    run = simulator(scene, 0.7)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run.run(150)
    assert run.workspace.energy_watch.share < 0.05


def test_what_is_done_between_steps_is_outside_the_balance():
    """Another state, another substep, another force, a reset."""
    run = simulator(body([ds.Gravity(), ds.ExternalForce(LOADS)], fixed="xmin"), 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(30):
            run.run(3)
            if k % 4 == 0:
                run.set_state(velocities=0.1 * (1 + k) * NOISE)
            elif k % 4 == 1:
                run.set_substeps(10 + k)
            elif k % 4 == 2:
                run.set_forces(LOADS * k)
            else:
                run.reset()
    assert run.workspace.energy_watch.share < 0.01


def test_looks_change_no_bit():
    scene = body([ds.Gravity(), ds.Ground(0.0, None, width=0.01, friction=0.3), ds.Drag(1.0)], ABOVE, precision="f32")
    ends = []
    for every in (20, 10**9):
        run = simulator(scene, 0.7, every=every)
        run.run(60)
        ends.append((run.positions, run.velocities, run.contact_resolution))
    assert np.array_equal(ends[0][0], ends[1][0]) and np.array_equal(ends[0][1], ends[1][1])
    assert ends[0][2] == ends[1][2]


@pytest.mark.parametrize("work", [name for name in WORK if name != "loads of steps"])
def test_bdf2_is_not_blamed_for_work_from_outside(work):
    run = ds.Simulator(ds.BDF2Solver(WORK[work](), dt=2e-3))
    seen = [float(run.compute_energy())]
    for _ in range(40):
        run.step()
        seen.append(float(run.compute_energy()))
    watch = run.workspace.energy_watch
    assert np.ptp(seen) > 0.2 * watch.moving and watch.share < 0.01


def test_what_bdf2_adds_is_the_change_of_the_energy():
    run = ds.Simulator(ds.BDF2Solver(body(initial_velocities=0.3 * NOISE, fixed="xmin"), dt=2e-3, tolerance=1e-9))
    start = run.compute_energy()
    run.run(20)
    watch = run.workspace.energy_watch
    assert watch.gained == pytest.approx(run.compute_energy() - start, rel=1e-5) and watch.gained < -0.3 * watch.moving


def test_self_contact_is_counted():
    """Two blocks fall on each other and on the floor: their pairs' energy and forces are in the balance."""
    blocks = [ds.TetrahedralMesh.create_box(3, size=0.05).translated([0, y, 0]) for y in (0.02, 0.09)]
    scene = ds.Scene(
        ds.TetrahedralMesh.joined(blocks),
        SOFT,
        1000.0,
        [ds.Gravity(), ds.Ground(0.0, 200.0, width=0.01), ds.SelfContact(200.0, 0.01)],
        initial_velocities=[0, -1, 0],
        precision="f64",
    )
    run = simulator(scene, 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        least = min(run.step() or run.smallest_gap() for _ in range(140))
    assert least < 0.008 and run.workspace.energy_watch.share < 0.02


def test_the_midpoints_advice_helps():
    """A cube squeezed to 0.6, in steps that it cannot follow."""
    mesh = ds.TetrahedralMesh.create_box(3, size=0.1)
    squeezed = (mesh.vertices - 0.05) * [1, 0.6, 1] + 0.05
    scene = ds.Scene(mesh, SOFT, 1000.0, initial_positions=squeezed, precision="f64")
    with pytest.warns(EnergyGained, match="^step .* or BDF2Solver or ImplicitEulerSolver") as said:
        ds.Simulator(ds.ImplicitMidpointSolver(scene, dt=1e-2)).run(30)
    advised = round(1e-2 / said.list[0].message.substep)
    for solver in (ds.ImplicitMidpointSolver(scene, 1e-2, advised), ds.BDF2Solver(scene, 1e-2)):
        run = ds.Simulator(solver)
        start, seen = run.compute_energy(), []
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for _ in range(30):
                run.step()
                seen.append(run.compute_energy())
        assert max(seen) < 1.1 * start


# ---- the drift of runs, apart from what is done to the body ------------------------------------------------------------

SLIDING = dict(initial_velocities=np.array([1.0, 0.0, 0.0]))
SWINGING = dict(initial_velocities=0.3 * np.sin(20 * MESH.vertices[:, [1, 2, 0]]))
ALONE = dict(  # terms and options of scenes in which energy is taken or given in one way
    free=([], SWINGING),
    drag=([ds.Drag(5.0)], SWINGING),
    friction=([ds.Gravity(), ds.Ground(-0.004, friction=0.5, stiffness_per_area=1e6, width=0.01)], SLIDING),
    fluid=([ds.SurfaceDrag(500.0)], SLIDING),
    traction=([ds.Traction((50.0, 0, 0), "xmax")], dict(fixed="xmin")),
    pressure=([ds.Pressure(lambda t: 1e4 * t)], dict(fixed="xmin")),
    muscle=([ds.Muscle((1, 0, 0), 2e3, lambda t: min(1, 20 * t))], {}),
    supports=([ds.Gravity()], dict(fixed="xmin", motion=lambda t: (0, 0.01 * np.sin(60 * t), 0))),
    rollers=([ds.Gravity()], dict(fixed={"xmin": "x"}, motion=lambda t: (0.01 * np.sin(60 * t), 0, 0))),
    wall=(
        [ds.HalfSpace((0, -0.02, 0), (0, 1, 0), stiffness_per_area=1e6, width=0.01, path=lambda t: (0, 0.5 * t, 0))],
        {},
    ),
)
ALL_AT_ONCE = "drag friction traction muscle supports"
LARGEST_DRIFT = {  # share of the energy that moves, of substeps of 1e-4 s, and of 1e-3 s in implicit steps
    ds.VelocityVerletSolver: 1e-3,
    ds.SemiImplicitSolver: 1e-2,
    ds.ImplicitMidpointSolver: 1e-2,
    ds.BDF2Solver: 0.2,
    ds.ImplicitEulerSolver: 0.5,
}


@pytest.mark.parametrize(
    "names, kind",
    [
        (ALL_AT_ONCE, ds.VelocityVerletSolver),
        ("friction", ds.BDF2Solver),
        *(pytest.param(name, kind, marks=pytest.mark.thorough) for name in ALONE for kind in LARGEST_DRIFT),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_the_drift_of_a_run_is_that_of_its_steps(names, kind):
    """It falls with the step, however much friction, drag, loads and what moves take and give."""
    terms, options = [], {}
    for name in names.split():
        terms += [term for term in ALONE[name][0] if type(term) not in map(type, terms)]
        options |= ALONE[name][1]
    scene, drifts, part = body(terms, MESH, **options), [], 0.01 if kind.explicit else 0.02
    for dt in (1e-4, 5e-5) if kind.explicit else (1e-3, 2.5e-4):
        run = ForwardRun(scene, kind, part, dt=dt)
        for _ in range(2 if kind.explicit else 1):
            run.advance()
        change = (run.energies[-1] - run.energies[0]) / run.largest_energy
        drifts.append(run.drift / run.largest_energy)
    assert abs(drifts[0]) < LARGEST_DRIFT[kind] and abs(drifts[1]) < max(0.7 * abs(drifts[0]), 1e-5)
    assert names == "free" or abs(change) > 3 * abs(drifts[1]) + 0.02


def test_what_cannot_be_told_apart_is_not_called_drift():
    viscous = ds.Scene(MESH, ds.KelvinVoigt(SOFT, time=1e-3), 1000.0, precision="f64", **SWINGING)
    run = ForwardRun(viscous, ds.VelocityVerletSolver, 1e-3, dt=1e-4)
    run.advance()
    assert run.drift is None and run.energies[-1] < run.energies[0]
