"""Contact as a stage of explicit passes: its secant, its energy, that nothing crosses at any step, and its derivatives."""

import functools

import mpmath as mp
import numpy as np
import pytest
import taichi as ti
from contact_scenes import EXPLICIT, SHAPES, G, points, resting_gap, tetrahedron, with_options
from test_contact_crossing import THIN

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles import contact_stage
from diffsim_ti.solvers.explicit.kernels import explicit_kernels
from diffsim_ti.terms.obstacles import barrier, secant

pytestmark = pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py

DAMPINGS = [0.0, 0.02, 0.4, 1.0]
solvers = pytest.mark.parametrize("solver", EXPLICIT)
dampings = pytest.mark.parametrize("damping", DAMPINGS)


# ---- the secant's slope ------------------------------------------------------------------------------------------------


def exact(s, t):
    """(sigma, its derivatives by s and t) with sixty digits."""
    corner = mp.mpf(barrier.CROSSOVER)
    first = -2 * (corner - 1) * mp.log(corner) - (corner - 1) ** 2 / corner
    second = -2 * mp.log(corner) - 4 * (corner - 1) / corner + ((corner - 1) / corner) ** 2

    def beta(x):
        if x < corner:
            return -((corner - 1) ** 2) * mp.log(corner) + (x - corner) * (first + (x - corner) * second / 2)
        return -((x - 1) ** 2) * mp.log(x) if x < 1 else mp.mpf(0)

    def slope(x):
        if x < corner:
            return first + (x - corner) * second
        return -(x - 1) * (2 * mp.log(x) + (x - 1) / x) if x < 1 else mp.mpf(0)

    s, t = mp.mpf(s), mp.mpf(t)
    value = (beta(t) - beta(s)) / (t - s)
    return value, (value - slope(s)) / (t - s), (slope(t) - value) / (t - s)


@pytest.mark.parametrize("precision, tolerance", [("f64", 1e-13), ("f32", 1e-4)])
def test_secant_to_round_off(precision, tolerance):
    """Arguments far apart, near, nearly equal, on either side of 1 and of the crossover: no digit is lost."""
    fp, rng = runtime.PRECISIONS[precision], np.random.default_rng(0)
    s, t = (10 ** rng.uniform(-4, 0.3, 1500) for _ in range(2))
    near = s * (1 + 0.99 * rng.choice([-1, 1], 1500) * 10 ** rng.uniform(-12 if fp == ti.f64 else -3, 0, 1500))
    t = np.where(rng.random(1500) < 0.5, t, near)
    if fp == ti.f32:
        s, t = (x.astype(np.float32).astype(np.float64) for x in (s, t))
    out = runtime.array(fp, 3, 1500)

    @ti.kernel
    def look(s: ti.types.ndarray(fp, 1), t: ti.types.ndarray(fp, 1), out: ti.types.ndarray(fp, 2)):
        for i in range(s.shape[0]):
            out[0, i], out[1, i], out[2, i] = secant.secant(s[i], t[i], fp)

    look(runtime.upload(s, fp), runtime.upload(t, fp), out)
    found = runtime.fetch(out)
    with mp.workdps(60):
        expected = np.array([[float(x) for x in exact(a, b)] for a, b in zip(s, t)]).T
    scale = np.abs(expected) + [[1e-3], [1e-2], [1e-2]]  # near 1 everything vanishes, and round-off of s - 1 is left
    assert np.abs((found - expected) / scale).max() < tolerance


def test_secant_of_equal_arguments_is_the_slope():
    s = np.array([1e-4, 1e-3, 0.01, 0.3, 0.999, 1.0, 1.2])
    out = runtime.array(ti.f64, 3, len(s))

    @ti.kernel
    def look(s: ti.types.ndarray(ti.f64, 1), out: ti.types.ndarray(ti.f64, 2)):
        for i in range(s.shape[0]):
            value, by_s, by_t = secant.secant(s[i], s[i], ti.f64)
            out[0, i] = value - barrier.slope(s[i], ti.f64)
            out[1, i] = by_s - barrier.curvature(s[i], ti.f64) / 2
            out[2, i] = by_t - barrier.curvature(s[i], ti.f64) / 2

    look(runtime.upload(s, ti.f64), out)
    assert np.abs(runtime.fetch(out) / (1 + 1 / s**2)).max() < 1e-12


# ---- energy, and that nothing crosses ------------------------------------------------------------------------------------


@solvers
@dampings
def test_energy_never_grows(solver, damping):
    """One to four flat walls at a vertex, any stiffness, width, speed and step: kinetic and barriers' energy only fall.

    With c = 0 they stay, to the tolerance of the root.
    """
    rng = np.random.default_rng(1)
    for _ in range(6):
        normals = rng.uniform([-0.08, 0.3, -0.08], [1, 1, 1], (rng.integers(1, 5), 3))
        width, dt, speed = rng.uniform(0.02, 0.2), 10 ** rng.uniform(-3.5, -1.5), rng.uniform(0.5, 3)
        walls = [
            ds.HalfSpace(-0.05 * n / np.linalg.norm(n), n, stiffness=10 ** rng.uniform(3, 6), width=width)
            for n in normals
        ]
        scene = points(tetrahedron(0.0), walls, fixed=[1, 2, 3], initial_velocities=[0, -speed, 0], precision="f64")
        simulator = ds.Simulator(solver(scene, dt=dt, contact_damping=damping, allow_unstable=True))
        energies = [float(simulator.compute_energy())]
        for _ in range(min(60, int(0.4 / speed / dt) + 4)):
            try:
                simulator.step()
            except ds.Crossing as error:  # more energy than the barrier holds, which c = 0 does not damp
                assert damping < 0.5 and error.stiffness is not None
                break
            energies.append(float(simulator.compute_energy()))
        rise = np.diff(energies)
        assert rise.max() < 1e-9 * energies[0]
        if damping == 0:
            assert np.abs(rise).max() < 1e-9 * energies[0]


@solvers
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_few_rounds_find_the_root(solver, precision, monkeypatch):
    """At rest, where a move is round-off of a gap, and in impacts: eight rounds of Newton's method are as good as sixty."""
    ends = []
    for rounds in (60, 8):
        monkeypatch.setattr(contact_stage, "MOST_ROUNDS", rounds)
        explicit_kernels.cache_clear()
        for gap, speed, damping in ((0.0088, 0.0, 1.0), (0.0088, 0.0, 0.005), (0.02, 1.0, 0.005), (0.02, 4.0, 1.0)):
            mesh = ds.TetrahedralMesh.create_box(3, size=0.2, origin=(0, gap, 0))
            law, terms = ds.StableNeoHookean(1e5, 0.3), [ds.Gravity(), ds.Drag(5.0), ds.Ground(width=0.01)]
            scene = ds.Scene(mesh, law, terms=terms, initial_velocities=(0, -speed, 0), precision=precision)
            ends.append(ds.Rollout(solver(scene, dt=1e-3, contact_damping=damping), 150).forward().positions[-1])
    explicit_kernels.cache_clear()
    assert all(np.array_equal(few, many) for few, many in zip(ends[4:], ends[:4]))


@solvers
@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2])
def test_no_speed_is_too_large(solver, dt):
    """The table of speeds that a force cannot hold beyond 3.7 m/s, and at long steps not at all: the damped stage can."""
    for speed in (1.0, 4.0, 16.0):
        scene = points(
            tetrahedron(0.3 * speed * dt + 0.03),
            ds.Ground(stiffness=1e4, width=0.01),
            initial_velocities=[0.1, -speed, 0],
        )
        own = solver(scene, dt=dt, contact_damping=1.0, allow_unstable=True)
        frames = ds.Rollout(own, max(3, int(0.1 / speed / dt)), save_every=1).forward()
        assert frames.positions[:, :3, 1].min() > 0 and frames.contact_resolution.smallest_gap > 0


@solvers
@dampings
@pytest.mark.parametrize("name", THIN)
def test_thin_obstacles_hold(solver, name, damping):
    """A plate of 2 mm and a wire, at a step that would take vertices from one side to the other."""
    for vertical, dt in ((-20.0, 1e-2), (-20.0, 4e-3)):
        scene = points(tetrahedron(0.02), THIN[name](stiffness=1e7, width=0.005), initial_velocities=[0, vertical, 0])
        frames = ds.Rollout(solver(scene, dt=dt, contact_damping=damping), 8, save_every=1).forward()
        touched = frames.positions[:, :3][:, np.abs(scene.terms[0].distance(tetrahedron(0.02).vertices[:3])) < 0.1]
        assert touched[..., 1].min() > -0.05 and scene.terms[0].distance(touched.reshape(-1, 3)).min() > 0


@solvers
def test_a_fast_wall_pushes(solver):
    """What counts is the motion against each other: a wall at 30 m/s takes the vertices along."""
    wall = ds.HalfSpace([-0.5, 0, 0], [1, 0, 0], stiffness=1e6, width=0.05, path=lambda t: [30 * t, 0, 0])
    scene = points(tetrahedron(0.0), wall, fixed=[])
    frames = ds.Rollout(solver(scene, dt=5e-3, contact_damping=1.0), 10, save_every=1).forward()
    gap = frames.positions[..., 0] + 0.5 - 30 * frames.times[:, None]
    assert gap.min() > 0 and frames.velocities[-1, :, 0].min() > 29


@solvers
def test_a_vertex_between_two_walls(solver):
    """Pressed from both sides by stiff walls, one of which moves, with other obstacles near: it stays between them."""
    near = [
        ds.HalfSpace([0, 0, 0], [0, 1, 0.1], stiffness=1e5, width=0.05),
        ds.Box([-0.05, 0.11, -0.05], [0.2, 0.02, 0.2], stiffness=1e5, width=0.05, path=lambda t: [0, -0.6 * t, 0]),
    ]
    scene = points(tetrahedron(0.05), near, fixed=[1, 2, 3])
    frames = ds.Rollout(solver(scene, dt=2e-3, contact_damping=0.3), 60, save_every=1).forward()
    for wall, place in zip(near, (np.zeros((61, 3)), np.outer(frames.times, [0, -0.6, 0]))):
        assert min(wall.gap(x[:1], o)[0] for x, o in zip(frames.positions, place)) > 0


@solvers
def test_momentum_and_work_of_a_wall(solver):
    """What a moving wall gives is what the body gains: pushes, by the secant, times h are the change of momentum."""
    k, w, dt, steps = 500.0, 0.1, 2e-3, 250
    wall = ds.HalfSpace([-0.05, 0, 0], [1, 0, 0], stiffness=k, width=w, path=lambda t: [0.4 * t, 0, 0])
    own = solver(points(tetrahedron(0.0), wall, fixed=[]), dt=dt, contact_damping=0.0)
    frames = ds.Rollout(own, steps, save_every=1).forward()
    s = (frames.positions[..., 0] + 0.05 - 0.4 * frames.times[:, None]) / w
    apart = np.abs(np.diff(s, axis=0)) > 1e-7
    change = np.where(apart, np.diff(s, axis=0), 1)
    push = -k * w * np.where(apart, np.diff(beta(s), axis=0) / change, 0)
    gained = frames.velocities[-1, :, 0] - frames.velocities[0, :, 0]
    np.testing.assert_allclose(dt * push.sum(0), gained, rtol=1e-6, atol=1e-6)
    assert gained[0] > 0.1


def beta(s):
    return np.where(s < 1, -((s - 1) ** 2) * np.log(np.minimum(s, 1)), 0)


@pytest.mark.parametrize("solver, damping", [(ds.SemiImplicitSolver, 1.0), (ds.VelocityVerletSolver, 0.02)])
def test_at_rest_friction_holds_what_coulomb_holds(solver, damping):
    """A vertex pressed on a slope at tan = 1/2: friction 0.52 holds it, 0.48 lets it slide."""
    angle = np.arctan(0.5)
    n, down = np.array([-np.sin(angle), np.cos(angle), 0]), np.array([-np.cos(angle), -np.sin(angle), 0])
    turn = np.stack([-down, n, np.cross(-down, n)], 1)
    mesh = tetrahedron(resting_gap(G * np.cos(angle)))
    mesh = ds.TetrahedralMesh(mesh.vertices @ turn.T, mesh.tetrahedra)
    for friction, slides in ((0.52, False), (0.48, True)):
        plane = ds.HalfSpace(normal=n, stiffness=1e4, width=0.01, friction=friction, friction_speed=1e-4)
        scene = points(mesh, plane, terms=[ds.Gravity(-G)])
        frames = ds.Rollout(solver(scene, dt=1e-3, contact_damping=damping), 1000).forward()
        way = (frames.positions[-1] - frames.positions[0])[:3] @ down
        free = 0.5 * G * (np.sin(angle) - friction * np.cos(angle))
        assert way == pytest.approx(np.full(3, free), rel=2e-2) if slides else np.all(np.abs(way) < 2e-3), way


# ---- derivatives ---------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=None)
def crowded(kind, damping: float, precision: str = "f64", **options):
    """A cube that falls among a rough floor that moves, two walls and a ball that rises: up to four at a vertex."""
    mesh = ds.TetrahedralMesh.create_box(3, size=0.1, origin=(0, 0.002, 0))
    terms = [
        ds.Gravity(),
        ds.Drag(2.0),
        ds.Ground(width=0.004, stiffness=900.0, friction=0.3, path=lambda t: [0.1 * t, 0.3 * t, 0]),
        ds.HalfSpace((-0.002, 0, 0), (1, 0.3, 0), width=0.004, stiffness=400.0, friction=0.2),
        ds.HalfSpace((-0.036, 0, 0), (1, -0.3, 0.02), width=0.004, stiffness=400.0),
        ds.Sphere((0.05, -0.1, 0.05), 0.1, width=0.004, stiffness=300.0, path=lambda t: [0, 0.2 * t, 0], friction=0.4),
    ]
    law, v = ds.StableNeoHookean(3e4, 0.3), (-1.2, -1.0, 0.2)
    scene = ds.Scene(mesh, law, terms=terms, initial_velocities=v, precision=precision)
    return ds.Rollout(kind(scene, dt=1e-3, contact_damping=damping), 12, save_every=3, gradients="all", **options)


def check_rows(rollout, inputs=None) -> int:
    """All rows of the check are right to 1e-4, or to what differences resolve; how many are not 0."""
    assert ds.dot_product_test(rollout) < 1e-11
    report = ds.check_gradients(rollout, inputs=inputs, verbose=False)
    error = [min(row.relative_error, 1e5 * abs(row.analytic - row.differences)) for row in report.rows]
    assert max(error) < 1e-4, str(report)
    return sum(row.analytic != 0 for row in report.rows)


@solvers
@dampings
def test_every_input_in_a_crowd(solver, damping):
    rollout = crowded.__wrapped__(solver, damping)
    assert check_rows(rollout) > 20
    assert rollout.forward().contact_resolution.smallest_gap < 0.002


@pytest.mark.parametrize(
    "solver, names",
    [
        (EXPLICIT[0], ["initial_velocities", "sphere_radius", "rest_positions"]),
        (EXPLICIT[1], ["density", "ground_height", "sphere_path"]),
    ],
)
def test_inputs_in_a_crowd_that_acts_on_faces(solver, names):
    assert check_rows(crowded(solver, 0.02), names) == len(names)


@solvers
def test_a_rough_belt_pushes_no_vertex_through_a_wall(solver):
    """Friction with one obstacle leads to another: of that way a vertex takes a share (contact_friction.py)."""
    belt = ds.Ground(-0.011, stiffness=1e6, width=0.01, friction=1.5, path=lambda t: [-20 * t, 0, 0])
    wall = ds.HalfSpace([-0.011, 0, 0], [1, 0.2, 0.1], stiffness=1e6, width=0.01, friction=0.3)
    options = dict(fixed=[1, 2, 3], initial_velocities=[-1.0, -6.0, 0.3], precision="f64")
    rollout, other = (
        ds.Rollout(solver(points(tetrahedron(), own, **options), dt=1e-3, contact_damping=0.02), 3, 1, gradients="all")
        for own in ([belt, wall], [wall, belt])
    )
    frames = rollout.forward()
    np.testing.assert_array_equal(frames.positions, other.forward().positions)
    gaps = [[float(o.gap(x[:1])[0]) for o in (belt, wall)] for x in frames.positions]
    assert np.min(gaps) > 0, gaps
    assert check_rows(rollout) > 12


@solvers
def test_checkpoints_repeat_the_bits(solver):
    whole, parts = crowded(solver, 0.02), crowded(solver, 0.02, checkpoint_every=2)
    seed = np.random.default_rng(0).standard_normal(whole.forward().positions.shape)
    one, two = (r.vjp(r.forward(), seed) for r in (whole, parts))
    assert all(np.array_equal(one[name], two[name]) for name in one)


@solvers
def test_single_precision_follows(solver):
    """Float32 against float64: what 24 bits of positions leave of gaps of 1e-2 of a 4 mm width."""
    double, single = (crowded.__wrapped__(solver, 0.02, precision) for precision in ("f64", "f32"))
    seed = np.random.default_rng(0).standard_normal(double.forward().positions.shape)
    one, two = (r.vjp(r.forward(), seed) for r in (double, single))
    for name in ("youngs_modulus", "initial_velocities", "gravity"):
        assert np.linalg.norm(two[name] - one[name]) < 2e-2 * np.linalg.norm(one[name]), name


@pytest.mark.executed_ptx
@pytest.mark.parametrize("name", SHAPES)
def test_every_shape(name):
    """Each obstacle's own numbers, moving and rough, through the stage."""
    term = SHAPES[name](stiffness=300.0, width=0.2, friction=0.4, friction_speed=0.05, path=lambda t: [0.3 * t, 0, 0])
    scene = ds.Scene(
        tetrahedron(0.15),
        ds.StableNeoHookean(2e4, 0.3),
        100.0,
        [ds.Gravity(), term],
        initial_velocities=[0.8, -1.0, 0.3],
        precision="f64",
    )
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=4e-3, contact_damping=0.1), 12, gradients="all")
    assert ds.dot_product_test(rollout) < 1e-12


# ---- what is refused -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(contact="barrier"), 'contact must be "stage" or "force"'),
        (dict(contact_damping=-0.1), "contact_damping must lie between 0 and 1, got -0.1"),
        (dict(contact_damping=float("nan")), "contact_damping must lie between 0 and 1"),
    ],
)
def test_refused(options, message):
    scene = points(tetrahedron(0.1), ds.Ground(stiffness=1e4, width=0.01))
    with pytest.raises(ValueError, match=message):
        ds.SemiImplicitSolver(scene, dt=1e-3, **options)


def test_options_go_along():
    """A solver made anew for another scene keeps how it treats contact."""
    force = with_options(ds.VelocityVerletSolver, contact="force")(
        points(tetrahedron(0.1), ds.Ground(stiffness=1e4, width=0.01)), dt=1e-3
    )
    assert ds.VelocityVerletSolver(force.scene, dt=1e-3).stages_contact and not force.stages_contact
    rollout = ds.Rollout(ds.SemiImplicitSolver(force.scene, dt=1e-3, contact_damping=0.7), 2).with_scene(
        precision="f32"
    )
    assert rollout.solver.contact_damping == 0.7
