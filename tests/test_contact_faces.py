"""Faces and edges in explicit steps: what is narrower than a triangle is felt between its corners."""

import re

import numpy as np
import pytest
from impact_judge import Judge

import diffsim_ti as ds
from diffsim_ti.mechanics.obstacles.face_contact_points import FaceContactPoints
from diffsim_ti.monitor.stability import Stiffness
from diffsim_ti.writers.adaptive_run import ForwardRun

SIZE, WIDTH = 0.2, 0.01
EXPLICIT = [ds.SemiImplicitSolver, ds.VelocityVerletSolver]
both = pytest.mark.parametrize("solver", EXPLICIT, ids=lambda s: s.__name__)
DOWN = np.array([0, -0.5, 0])


def in_box(center, half):
    return dict(kind="box", center=np.array(center), axes=np.eye(3), half=np.array(half))


def along(start, end, radius):
    return dict(kind="capsule", start=np.array(start), end=np.array(end), radius=radius)


# what no vertex of the body meets: (obstacle, the same as the judge knows it)
NARROW = {
    "capsule": (
        lambda **o: ds.Capsule((-0.4, -0.02, 0.01), (0.4, -0.02, 0.02), 0.01, **o),
        along((-0.4, -0.02, 0.01), (0.4, -0.02, 0.02), 0.01),
    ),
    "thin box": (lambda **o: ds.Box((0, -0.21, 0), (0.01, 0.4, 0.8), **o), in_box((0, -0.21, 0), (0.005, 0.2, 0.4))),
    "needle": (
        lambda **o: ds.Capsule((0, -0.5, 0.01), (0.01, -0.02, 0.01), 0.004, **o),
        along((0, -0.5, 0.01), (0.01, -0.02, 0.01), 0.004),
    ),
}


def cube(obstacle, speed=0.0, lift=0.0, precision="f64", E=1e5, **options) -> ds.Scene:
    """Eight vertices, twelve triangles, above the obstacle and on their way down."""
    mesh = ds.TetrahedralMesh.create_box(2, size=SIZE).translated([-0.47 * SIZE, lift, -0.45 * SIZE])
    terms = [obstacle, ds.Gravity()]
    options = options | dict(initial_velocities=(0.05 * speed, -speed, 0.02 * speed))
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), 1000.0, terms, precision=precision, **options)


def pressed(kind: str, stiffness=50.0, path=None, precision="f64", per_area=False, **options) -> ds.Scene:
    """A cube whose lowest faces are in the barrier; per area it is as stiff as a vertex on a square of one width."""
    strength = dict(stiffness_per_area=stiffness / WIDTH**2) if per_area else dict(stiffness=stiffness)
    lift = {"capsule": -0.004, "needle": -0.008, "thin box": -0.003}[kind]
    return cube(NARROW[kind][0](width=WIDTH, path=path, **strength), lift=lift, precision=precision, **options)


def wobbling(t):
    return 0.3 * t, 0.2 * t - 3 * t * t, -0.1 * t


@pytest.mark.parametrize("kind, per_area", [("capsule", False), ("capsule", True)])
def test_forces_and_energies_are_those_of_implicit_steps(kind, per_area):
    """What a very short pass does is the force, and force and energy are those of the potential."""
    scene = pressed(kind, per_area=per_area)
    x = scene.mesh.vertices + 1e-4 * np.random.default_rng(0).standard_normal(scene.mesh.vertices.shape)
    ours = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-7))
    theirs = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=1e-3))
    for simulator in (ours, theirs):
        simulator.set_state(positions=x)
    potential = theirs.workspace.potential
    potential.place(theirs.displacements)
    assert ours.compute_energy().parts["contact"] == pytest.approx(theirs.compute_energy().parts["contact"], rel=1e-12)
    assert ours.compute_energy().parts["contact"] > 1e-5
    mass = ours.workspace.arrays.values.mass
    expected = potential.forces()[0] + mass[:, None] * [0, -9.81, 0]
    ours.step()
    found = mass[:, None] * ours.velocities / 1e-7
    assert np.abs(potential.faces.forces()).max() > 0.02
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max(), rtol=0)


def test_force_is_the_slope_of_the_energy_while_points_come_and_go():
    """Along a way past a capsule, from where no point feels it to where many do, and off a corner."""
    simulator = ds.Simulator(ds.SemiImplicitSolver(pressed("capsule"), dt=1e-7))
    start, mass = simulator.positions.copy(), simulator.workspace.arrays.values.mass
    rest, h = simulator.scene.mesh.vertices, 1e-7
    felt, energies = [], []
    for share in np.linspace(0, 1, 161):
        simulator.set_state(positions=start + [0.02 * share, 0.012 - 0.013 * share, 0.11 * share], velocities=0 * start)
        energies.append(simulator.compute_energy().parts["contact"])
        simulator.step()
        forces = mass[:, None] * (simulator.velocities / h + [0, 9.81, 0])
        felt.append((forces * [0.02, -0.013, 0.11]).sum())  # of a rigid motion: the body's own forces sum up to nothing
    change = np.diff(energies)
    by_force = -0.5 / 160 * (np.array(felt[1:]) + np.array(felt[:-1]))
    assert energies[0] == 0 and max(energies) > 0.01 and np.allclose(start[0], rest[0])
    np.testing.assert_allclose(change, by_force, atol=0.01 * np.abs(change).max())


@both
@pytest.mark.parametrize("kind", NARROW)
def test_nothing_passes(solver, kind):
    """A coarse cube falls on what no vertex of it meets: it stays in front, or an error raises whose advice helps."""
    make, solid = NARROW[kind]
    stiffness, substeps = 400.0, 1
    for _ in range(3):
        scene = cube(make(stiffness=stiffness, width=WIDTH), speed=0.6, lift=0.003)
        simulator = ds.Simulator(solver(scene, dt=2e-3, substeps=substeps))
        judge = Judge(scene.mesh.surface_triangles, solid, simulator.positions)
        try:
            for _ in range(60):
                simulator.step()
                assert judge.after_step(simulator.positions, np.zeros(3)) is None
            break
        except ds.Crossing as error:
            assert "face (" in str(error) and error.depth > 0 and error.speed > 0.1
            if error.stiffness is None:
                substeps = int(np.ceil(2e-3 / float(re.search(r"substep to ([-+.\de]+) s", str(error))[1])))
            else:
                stiffness = float(re.search(r"stiffness to ([-+.\de]+) N/m", str(error))[1])
    assert simulator.step_count == 60 and simulator.contact_resolution.smallest_gap > 0
    velocity = np.average(simulator.velocities, axis=0, weights=simulator.workspace.arrays.values.mass)
    assert velocity[1] > -0.6 - 0.06 * 9.81 + 0.3  # far slower than a free fall


@pytest.mark.usefixtures("vertices_alone")
def test_without_points_within_faces_the_cube_falls_over_the_capsule():
    """What the tests above would not notice otherwise."""
    make, solid = NARROW["capsule"]
    simulator = ds.Simulator(
        ds.SemiImplicitSolver(cube(make(stiffness=400.0, width=WIDTH), speed=0.6, lift=0.003), dt=2e-3)
    )
    judge = Judge(simulator.scene.mesh.surface_triangles, solid, simulator.positions)
    assert any([simulator.step(), judge.after_step(simulator.positions, np.zeros(3))][1] for _ in range(60))


def test_a_fall_with_steps_that_follow_the_contact_ends_by_explicit_steps():
    make, solid = NARROW["capsule"]
    run = ForwardRun(
        cube(make(stiffness=300.0, width=0.005), speed=0.7, precision="f32"), ds.SemiImplicitSolver, 1 / 30
    )
    judge = Judge(run.scene.mesh.surface_triangles, solid, run.simulator.positions)
    run.before_part = lambda: wrong.append(judge.after_step(run.simulator.positions, np.zeros(3)))
    wrong, lowest = [], run.simulator.positions[:, 1].min()
    for _ in range(3):
        run.advance()
    assert not any(wrong) and run.seen.implicit_parts == 0
    assert run.simulator.positions[:, 1].min() > lowest - 0.05
    start, highest = float(run.energies[0]), max(map(float, run.energies))
    assert highest - start < 0.01 * 0.5 * 8 * 0.7**2


# ---- gradients -----------------------------------------------------------------------------------------------------------


def rollout(solver, kind, precision="f64", stiffness=50.0, dt=4e-4, steps=6, **options) -> ds.Rollout:
    own = {name: options.pop(name) for name in ("contact", "parallel") if name in options}
    scene = pressed(kind, stiffness, wobbling, precision, options.pop("per_area", False))
    return ds.Rollout(solver(scene, dt=dt, substeps=2, **own), steps, save_every=3, **dict(gradients="all") | options)


@pytest.mark.parametrize(
    "kind, solver, precision, options",
    [
        ("capsule", ds.SemiImplicitSolver, "f64", dict()),
        ("capsule", ds.SemiImplicitSolver, "f64", dict(stiffness=2000.0, dt=3.2e-3)),  # in many parts
        ("needle", ds.VelocityVerletSolver, "f64", dict(contact="force", per_area=True)),
        ("thin box", ds.SemiImplicitSolver, "f32", dict(per_area=True, parallel=True)),
    ],
)
def test_the_adjoint_is_the_transpose_of_the_tangent(kind, solver, precision, options):
    """Of every input by itself."""
    made, gate = rollout(solver, kind, precision, **options), 1e-12 if precision == "f64" else 2e-4
    for name in made.wanted:
        assert ds.dot_product_test(made, [name]) < gate, name


@pytest.mark.parametrize("solver, per_area", [(ds.VelocityVerletSolver, True), (ds.SemiImplicitSolver, False)])
def test_gradients_agree_with_differences_where_a_pass_is_gone_in_many_parts(solver, per_area):
    made = rollout(solver, "capsule", stiffness=200.0 if per_area else 2000.0, dt=3.2e-3, steps=3, per_area=per_area)
    frames = made.forward()
    made.vjp(frames, positions=np.ones_like(frames.positions))
    workspace = made.sweep.workspace
    assert max(parts for parts, *_ in workspace.faces.kept.values()) >= 4
    assert 0.1 < workspace.watch.faces_omega_dt() < 0.5
    report = ds.check_gradients(made)
    assert report.passed, report


def test_checkpoints_and_repetition_change_no_bit():
    made = [rollout(ds.SemiImplicitSolver, "capsule", checkpoint_every=k) for k in (None, 2, 5)]
    found = []
    for one in (*made, made[0]):
        frames = one.forward()
        found.append(one.vjp(frames, positions=np.ones_like(frames.positions)))
    for other in found[1:]:
        for name, gradient in found[0].items():
            np.testing.assert_array_equal(gradient, other[name], err_msg=name)


@pytest.mark.backends
def test_many_threads_or_another_device_do_the_same():
    one = rollout(ds.SemiImplicitSolver, "capsule", "f32" if ds.runtime.arch_name() == "vulkan" else "f64")
    other = rollout(ds.SemiImplicitSolver, "capsule", "f32", parallel=True)
    frames = [made.forward() for made in (one, other)]
    np.testing.assert_allclose(frames[0].positions, frames[1].positions, atol=1e-6)
    gradients = [made.vjp(f, positions=np.ones_like(f.positions)) for made, f in zip((one, other), frames)]
    for name, gradient in gradients[0].items():
        np.testing.assert_allclose(gradient, gradients[1][name], rtol=2e-4, atol=1e-5 * np.abs(gradient).max())


def test_a_capsule_that_swings_adds_no_energy_of_the_steps():
    """Its work on faces is counted: what the steps themselves add is little beside it."""
    scene = pressed("capsule", 400.0, path=lambda t: (0, 0.004 * np.sin(60 * t), 0))
    simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3, substeps=10))
    simulator.workspace.energy_watch.every = 50
    start = simulator.compute_energy()
    simulator.run(80)
    watch = simulator.workspace.energy_watch
    assert abs(simulator.compute_energy() - start) > 0.05 * watch.moving
    assert watch.gained < 0.005 * watch.moving


@both
def test_a_state_from_outside_is_looked_at_between_its_vertices(solver):
    make, _ = NARROW["capsule"]
    simulator = ds.Simulator(solver(cube(make(stiffness=400.0, width=WIDTH), lift=0.003), dt=1e-3))
    x = simulator.positions - [0, 0.02, 0]
    with pytest.raises(ValueError, match=r"Capsule.* reaches .* m into face \(.*: move the body or the obstacle"):
        simulator.set_state(positions=x)
    simulator.reset()
    simulator.step()
    with pytest.raises(ValueError, match=r"Capsule.* reaches .* m into face"):
        ds.Simulator(solver(cube(make(stiffness=400.0, width=WIDTH), lift=-0.012), dt=1e-3))
    rollout = ds.Rollout(solver(simulator.scene, dt=1e-3), 1)
    with pytest.raises(ValueError, match=r"Capsule.* reaches .* m into face"):
        rollout.forward(initial_positions=x)


# ---- what it costs, and what it says -------------------------------------------------------------------------------------


@pytest.mark.parametrize("obstacle", [
    ds.Ground(-0.02), ds.HalfSpace((0, -0.02, 0), stiffness=1e3), ds.Sphere((0, 0.3, 0), 2.0, inside=True, stiffness=1e3),
    ds.Sphere((0, -30.02, 0), 30.0, stiffness=1e3),
], ids=lambda o: type(o).__name__)  # fmt: skip
def test_obstacles_larger_than_triangles_cost_nothing(obstacle):
    workspace = ds.Simulator(ds.SemiImplicitSolver(cube(obstacle), dt=1e-3)).workspace
    assert workspace.faces is None and workspace.watch.seen.shape == (3, 8)
    assert workspace.arrays.corner.shape == (32,)
    ball = cube(ds.Sphere((0, -0.52, 0), 0.5, stiffness=1e3))
    assert ds.Simulator(ds.SemiImplicitSolver(ball, dt=1e-3)).workspace.faces is not None


def test_a_pass_that_cannot_follow_says_so(monkeypatch):
    monkeypatch.setattr(FaceContactPoints, "most_parts", 1)
    simulator = ds.Simulator(ds.VelocityVerletSolver(pressed("capsule", 2000.0), dt=2e-3))
    with pytest.warns(UserWarning, match=r"of faces was stiffer than the substep 0.002 s .*take substeps of"):
        simulator.run(3)
    resolution = simulator.contact_resolution
    assert not resolution.resolved and len(resolution.vertex) == 3 and "of face (" in str(resolution)


def test_the_stable_step_does_not_know_contact_within_faces():
    """A barrier of a thousand times the stiffness is followed at seven tenths of the body's limit."""
    free = ds.Simulator(ds.SemiImplicitSolver(cube(ds.Ground(-1.0)), dt=2e-3))
    limit = Stiffness(free.workspace).largest()[0]
    for stiffness in (2e3, 2e6):
        scene = cube(NARROW["capsule"][0](stiffness=stiffness, width=WIDTH), speed=0.6, lift=0.003)
        simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=0.7 * 2 / limit**0.5))
        assert Stiffness(simulator.workspace).largest()[0] == pytest.approx(limit, rel=1e-6)
        watch = simulator.workspace.energy_watch
        watch.every = 5
        simulator.run(50)
        assert watch.gained < 0.35 * watch.moving and 0 < simulator.contact_resolution.smallest_gap < 1.2 * WIDTH


@both
def test_faces_push_no_vertex_through_a_wall(solver):
    """A face that a ball pushes takes its corners along, to a wall that they feel themselves (limited_displacement.py)."""
    wall = ds.HalfSpace((-0.002, 0, 0), (1, 0.3, 0), width=0.004, stiffness=400.0, friction=0.2)
    ball = ds.Sphere(
        (0.05, -0.1, 0.05), 0.1, width=0.004, stiffness=300.0, path=lambda t: [0, 0.2 * t, 0], friction=0.4
    )
    mesh, law = ds.TetrahedralMesh.create_box(3, size=0.1, origin=(0, 0.002, 0)), ds.StableNeoHookean(3e4, 0.3)
    terms, v = [ds.Gravity(), ds.Drag(2.0), wall, ball], (-1.8, -1.5, 0.3)
    scene = ds.Scene(mesh, law, terms=terms, initial_velocities=v, precision="f64")
    rollout = ds.Rollout(solver(scene, dt=1e-3, contact_damping=0.02), 22, save_every=1, gradients="all")
    assert min(wall.gap(x).min() for x in rollout.forward().positions) > 0
    assert ds.dot_product_test(rollout) < 1e-11


STARTS = np.random.default_rng(3)


@pytest.mark.parametrize("solver, precision", [(ds.VelocityVerletSolver, "f64"), (ds.BDF2Solver, "f32")])
def test_what_starts_in_front_of_a_face_is_not_behind_it(solver, precision):
    """A needle points at a face, an edge, a corner of a cube, so that its gap is known: what does not touch stays, and what
    touches runs on."""
    mesh = ds.TetrahedralMesh.create_box(2, size=SIZE)
    touched = 0
    cases = (5e-4, 6.0, [1, 0, 0]), (5e-4, 0.02, [0, 1, 0]), (5e-3, 0.05, [0, 1, 1]), (5e-3, 3.0, [1, 1, 1])
    for width, gap, outwards in cases:  # gaps in widths
        n = np.array(outwards) / np.linalg.norm(outwards)
        at = np.where(n > 0, SIZE, STARTS.uniform(0.3, 0.7, 3) * SIZE)
        start = at + (gap * width + 1e-3) * n
        needle = ds.Capsule(start, start + 0.3 * n, 1e-3, width=width, stiffness_per_area=1e7)
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[needle], fixed="xmin", precision=precision)
        simulator = ds.Simulator(solver(scene, dt=1e-4))
        simulator.run(2)
        if gap > 1.4:
            assert not simulator.velocities.any()
        else:
            touched += simulator.velocities.any()
    assert touched


def test_a_needle_that_starts_near_still_does_not_slip_between_points():
    """Points reach less far where a body starts near an obstacle: what gets between them is found all the same."""
    mesh = ds.TetrahedralMesh.create_box(2, size=SIZE)
    at = np.array([0.43, 1, 0.41]) * SIZE
    needle = ds.Capsule(
        at + [0, 6e-4, 0], at + [0, 0.3, 0], 1e-4, width=5e-3, stiffness_per_area=1e3, path=lambda t: [0, -t, 0]
    )
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[needle], fixed="ymin", precision="f64")
    simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-4))
    assert simulator.workspace.faces.is_shortened
    with pytest.raises(ds.Crossing, match="face .* behind Capsule"):
        simulator.run(60)
