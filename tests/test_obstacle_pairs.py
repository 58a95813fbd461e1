"""Points and edges of obstacles against faces and edges of bodies: exact gaps, forces, gradients, refusals."""

import re
from functools import lru_cache

import numpy as np
import pytest
from contact_scenes import box_surface
from impact_judge import Judge

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.differentiation.arrays import Recorded, forward, reverse
from diffsim_ti.mechanics.surfaces.contact_parts import PartSolver
from diffsim_ti.mechanics.surfaces.near_corners import NearCorners
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.terms.obstacles import mesh_obstacle
from diffsim_ti.terms.obstacles.barrier import beta

SIZE, WIDTH, PER_AREA, GAP = 0.1, 4e-3, 5e6, 1.5e-3
CAPSULE = dict(kind="capsule", start=np.array([-0.4, -0.02, 0.01]), end=np.array([0.4, -0.02, 0.02]), radius=0.0098)
BOX = dict(kind="box", center=np.array([0, -0.21, 0]), axes=np.eye(3), half=np.array([0.005, 0.2, 0.4]))
BARRIER = dict(width=WIDTH, stiffness_per_area=PER_AREA)


def cube(*terms, lift=0.0, velocity=(0.2, -0.5, 0.1)) -> ds.Scene:
    """Eight vertices and twelve triangles, whose bottom is y = lift."""
    mesh = ds.TetrahedralMesh.create_box(2, SIZE).translated([0, lift, 0])
    material = ds.StableNeoHookean(5e4, 0.3)
    return ds.Scene(mesh, material, 1000.0, list(terms), precision="f64", initial_velocities=velocity)


NARROW = dict(
    capsule=((lambda **o: ds.Capsule((-0.4, -0.02, 0.01), (0.4, -0.02, 0.02), 0.01, **o)), CAPSULE),
    box=((lambda **o: ds.Box((0, -0.21, 0), (0.01, 0.4, 0.8), **o)), BOX),
    cylinder=((lambda **o: ds.Cylinder((-0.4, -0.02, 0.01), (0.4, -0.02, 0.02), 0.01, **o)), CAPSULE),
)


@pytest.mark.parametrize("kind", NARROW)
def test_what_is_narrow_acts_by_pairs_and_explicit_steps_stop_before_it(kind):
    """A coarse cube falls on what no vertex of it meets."""
    make, solid = NARROW[kind]
    obstacle = make(stiffness_per_area=4e6, width=0.01)
    mesh = ds.TetrahedralMesh.create_box(2, size=0.2).translated([-0.094, 0.003, -0.09])
    terms, v = [obstacle, ds.Gravity()], (0.03, -0.6, 0.012)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, initial_velocities=v, precision="f64")
    assert [term.by_pairs for term in scene.obstacles] == [True] and obstacle.by_pairs is None
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=2e-3))
    judge = Judge(mesh.surface_triangles, solid, simulator.positions)
    for _ in range(30):
        simulator.step()
        assert judge.after_step(simulator.positions, np.zeros(3)) is None
    velocity = np.average(simulator.velocities, axis=0, weights=simulator.workspace.arrays.values.mass)
    assert velocity[1] > -0.6 - 0.06 * 9.81 + 0.3  # far slower than a free fall


def test_which_way_an_obstacle_acts_is_fixed_when_the_scene_is_built():
    """Longest edges of the cube are 0.14 m: a ball whose radius is 60 of these squares per width is as good as flat."""
    edge = 1.2 * np.sqrt(2) * SIZE
    limit = edge**2 / (6 * 0.12 * WIDTH)
    ball = lambda radius, **o: ds.Sphere((0, -1 - radius, 0), radius, **o, **BARRIER)  # noqa: E731
    for obstacle, expected in (
        (ball(0.99 * limit), True),
        (ball(1.01 * limit), False),
        (ball(1.01 * limit, by_pairs=True), True),
        (ball(0.01, by_pairs=False), False),
        (ds.MeshObstacle([[0, -1, 0], [0.1, -1, 0]], segments=[[0, 1]], **BARRIER), True),
        (ds.MeshObstacle([[0, -1, 0], [0.1, -1, 0]], segments=[[0, 1]], by_pairs=False, **BARRIER), False),
        (ds.Ground(-1, **BARRIER), False),
        (ds.Sphere((0, 0, 0), 5.0, inside=True, **BARRIER), False),
    ):
        assert cube(obstacle).obstacles[0].by_pairs is expected, obstacle
        assert (cube(obstacle).obstacles[0].primitives is not None) is expected


def test_a_cylinder_is_a_prism_whose_edges_lie_on_it():
    """At most 0.12 widths within it; derivatives by start, end and radius are exact."""
    cylinder = cube(ds.Cylinder((0, -1, 0.02), (0.1, -1.1, 0.3), 0.05, **BARRIER)).obstacles[0]
    prism, rng = cylinder.primitives, np.random.default_rng(0)
    p = np.concatenate([np.ravel(cylinder.values[f"cylinder_{name}"]) for name in ("start", "end", "radius")])
    x, _ = prism.at(p)
    off = (1 - np.cos(np.pi / prism.sides)) * p[6]  # of the sides
    assert 0.06 * WIDTH < off <= 0.12 * WIDTH and np.abs(cylinder.distance(x)).max() < 1e-15
    dp, by = rng.standard_normal(7), rng.standard_normal(x.shape)
    change = (prism.at(p + 1e-6 * dp)[0] - prism.at(p - 1e-6 * dp)[0]) / 2e-6
    recorded = Recorded(p)
    corners, _ = prism.at(recorded)
    tangent, (adjoint,) = forward(corners, [(recorded, dp)]), reverse(corners, by, [recorded])
    np.testing.assert_allclose(tangent, change, atol=1e-8)
    assert (adjoint * dp).sum() == pytest.approx((by * tangent).sum(), rel=1e-12)


def test_a_block_slides_on_rails_that_no_vertex_meets():
    """Cylinders lie between the rows of vertices: friction is mu N, and the block gathers speed as g (sin - mu cos)."""
    mu, tangent, dt = 0.3, 0.5, 5e-3
    rails = [
        ds.Cylinder((-1, -0.016, z), (1, -0.016, z), 0.01, width=5e-3, friction=mu, name=name)
        for name, z in (("left", 1 / 30), ("right", 2 / 30))
    ]
    down = 9.81 / np.hypot(1, tangent)
    mesh, gravity = ds.TetrahedralMesh.create_box(4, size=0.1), ds.Gravity([tangent * down, -down, 0])
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), terms=[gravity, *rails], precision="f64")
    parts = [ds.ContactForce(r, part, name=f"{r}_{part}") for r in ("left", "right") for part in ("normal", "friction")]
    frames = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=dt), 25, save_every=1, outputs=parts).forward()
    normal, friction = (frames[f"left_{part}"] + frames[f"right_{part}"] for part in ("normal", "friction"))
    assert np.all(friction[-12:, 0] < 0)  # it falls by a millimetre first
    # N is that where the step begins
    np.testing.assert_allclose(-friction[-12:, 0], mu * normal[-13:-1, 1], rtol=2e-3)
    speed = frames.velocities[:, :, 0].mean(1)
    expected = tangent * down - mu * normal[-13:-1, 1].mean() / 1.0  # [m/s^2]; it weighs a kilogram and still bounces
    assert (speed[-1] - speed[-13]) / (12 * dt) == pytest.approx(expected, rel=1e-2)


def below(kind: str, gap: float = GAP):
    """An obstacle that acts on no vertex of the cube, by a gap below the middle of its bottom, or of an edge of it."""
    if kind == "pin":
        return ds.MeshObstacle([[0.02, -gap, 0.07]], **BARRIER)
    if kind == "ball":
        return ds.Sphere((0.02, -gap - 0.01, 0.07), 0.01, by_pairs=True, **BARRIER)
    if kind == "wire":
        return ds.Capsule((0.02, -gap - 2e-3, 0.06), (0.06, -gap - 2e-3, 0.08), 2e-3, by_pairs=True, **BARRIER)
    down, turned = -gap - np.sqrt(0.5) * 0.2, (np.pi / 4, 0, 0)  # an edge along x, across the side x = 0 of the bottom
    return ds.Box((0, down, 0.04), (0.06, 0.2, 0.2), turned, by_pairs=True, **BARRIER)


@pytest.mark.parametrize("solver", [ds.ImplicitEulerSolver, ds.SemiImplicitSolver])
@pytest.mark.parametrize("kind", ["pin", "ball", "wire", "edge of a box"])
def test_gaps_are_exact(kind, solver):
    """Where today's nearest vertex is 20 widths away; a point presses with the stiffness of its triangle's area."""
    simulator = ds.Simulator(solver(cube(below(kind)), dt=1e-5))
    assert simulator.smallest_gap() == pytest.approx(GAP, abs=1e-12)
    stored = simulator.compute_energy().parts["contact"]
    if kind in ("pin", "ball"):
        expected = PER_AREA * SIZE**2 / 2 * WIDTH**2 * float(beta(GAP / WIDTH))
        assert stored == pytest.approx(expected, rel=1e-9)
    assert stored > 0


def test_what_is_far_away_changes_nothing():
    """A hundred spikes far from the body: the same bits, by trees without them. With kernels of the land below."""
    like = dict(friction=0.2, path=lambda t: np.zeros(3), **BARRIER)
    blade, sides = box_surface(1.0, -0.5)
    blade = blade * [0.01, 0.4, 0.8] - [0, 0.2 + GAP, 0]
    places = np.random.default_rng(0).uniform(-1, 1, (100, 3)) + [0, -3, 0]
    spikes = np.concatenate([blade, *(places[:, None] + 0.1 * np.eye(4, 3))])
    more = len(blade) + 4 * np.arange(100)[:, None, None] + np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    found = []
    for obstacle in (
        ds.MeshObstacle(blade, sides, **like),
        ds.MeshObstacle(spikes, np.concatenate([sides, more.reshape(-1, 3)]), **like),
    ):
        simulator = ds.Simulator(ds.ImplicitEulerSolver(cube(obstacle, ds.Gravity(0.0)), dt=1e-3))
        simulator.run(8)
        trees = simulator.workspace.pairs.list.trees
        found.append((simulator.positions, trees[0].count, trees[2].count))
    (x, *of_blade), (y, *of_many) = found
    assert np.array_equal(x, y) and np.all(np.array(of_many) <= of_blade) and of_many[1] > 18


def land(long: int, **options) -> ds.MeshObstacle:
    """Rough, of 28 `long` triangles."""
    x, z = np.meshgrid(-0.3 + 0.05 * np.arange(long + 1), np.linspace(-0.3, 0.4, 15), indexing="ij")
    y = -0.03 + 0.02 * np.random.default_rng(3).uniform(size=x.shape)
    first = (15 * np.arange(long)[:, None] + np.arange(14)).ravel()[:, None]
    triangles = np.concatenate([first + [0, 1, 15], first + [1, 16, 15]])
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    return ds.MeshObstacle(vertices, triangles, name="land", **BARRIER, **options)


@pytest.mark.parametrize("solver, dt, steps", [(ds.ImplicitEulerSolver, 5e-3, 4), (ds.SemiImplicitSolver, 1e-3, 50)])
def test_a_run_has_what_is_near_alone_and_finds_what_it_would_find_with_all(solver, dt, steps, monkeypatch):
    """A cube goes over rough land that rises and turns: the same frames, and gradients, as with all of its edges. In
    implicit steps it is drawn so that it leaves what is near within a solve."""
    rise = lambda t: (0, 0.2 * t, 0, 0, 0.4 * t, 0)  # noqa: E731
    options, rough = ({}, {}) if solver.explicit else (dict(tolerance=1e-10), dict(friction=0.2, friction_speed=0.05))
    drawn = [] if solver.explicit else [ds.Gravity((3000.0, -100.0, 0.0))]
    velocity = (4.0 if solver.explicit else 0.0, -0.5, 0.1)
    scene, found, counts = cube(land(40, path=rise, **rough), *drawn, velocity=velocity), [], set()
    take = NearCorners.take

    def counted(self):
        changed = take(self)
        counts.add(self.corners.count)
        return changed

    monkeypatch.setattr(NearCorners, "take", counted)
    for many in (256, 10**6):
        monkeypatch.setattr(mesh_obstacle, "FEW", many)
        rollout = ds.Rollout(solver(scene, dt=dt, **options), steps, gradients="all", save_every=1, checkpoint_every=3)
        frames = rollout.forward()
        seed = np.cos(np.arange(frames.positions.size)).reshape(frames.positions.shape)
        found.append((frames.positions, rollout.vjp(frames, positions=seed)))
    (x, of_near), (y, of_all) = found
    assert len(counts) > 3 and min(counts) < 41 * 15 / 2
    assert np.array_equal(x, y) and x[-1, :, 1].min() > -0.04
    for name, gradient in of_all.items():
        np.testing.assert_allclose(
            of_near[name], gradient, rtol=1e-9, atol=1e-12 * np.abs(gradient).max(), err_msg=name
        )


def test_what_turns_towards_a_body_within_a_step_is_met_in_time(monkeypatch):
    """An obstacle of a point on its axis below a cube and one that comes round from afar, while the list of pairs holds."""
    turn, axis, found = (lambda t: (0, 0, 0, 0, 0, 4.6 * t)), np.array([0.05, -0.3, 0.05]), []
    points = ds.MeshObstacle([axis, axis + [0.34, -0.09, -0.02]], path=turn, about=axis, **BARRIER)
    for many in (1, 10**6):
        monkeypatch.setattr(mesh_obstacle, "FEW", many)
        simulator = ds.Simulator(ds.SemiImplicitSolver(cube(points, velocity=(0, 0, 0)), dt=0.095, substeps=50))
        count = simulator.workspace.pairs.nearby.corners.count
        simulator.run(4)
        found.append((count, simulator.positions))
    (of_near, x), (of_all, y) = found
    assert (of_near, of_all) == (1, 2) and np.array_equal(x, y) and x[:, 0].mean() < SIZE / 2 - 1e-3


@lru_cache
def caught(solver=ds.ImplicitEulerSolver, steps=8, dt=1e-3, outputs=(), **options):
    """A cube that falls on a wire that turns between its vertices, and would meet itself; all with friction."""
    turn = lambda t: (6e-3 * np.sin(30 * t), 0.1 * t, 0.02 * t, 0.5 * t, 3 * t, t)  # noqa: E731
    ends = (-0.03, -0.0115, 0.033), (0.13, -0.013, 0.042)
    rough = dict(friction=0.3, friction_speed=0.05, by_pairs=True, **BARRIER)
    wire = ds.Capsule(*ends, 0.01, path=turn, about=(0.05, -0.02, 0.05), name="wire", **rough)
    scene = cube(wire, ds.SelfContact(1e3, 2e-3, friction=0.2))
    rollout = ds.Rollout(solver(scene, dt=dt, **options), steps, gradients="all", outputs=list(outputs), save_every=1)
    return rollout, rollout.forward()


FORCES = (
    ds.ContactForce("wire", name="force"),
    ds.ContactForce("wire", "friction", name="dragged", per_vertex=True),
    ds.ContactForce("wire", "normal", about=(0, 0, 0), name="moment"),
)


EXPLICIT = dict(solver=ds.SemiImplicitSolver, steps=40, dt=2e-4, outputs=FORCES)
IMPLICIT = dict(outputs=FORCES, tolerance=1e-12)


@pytest.mark.parametrize("options, rounding", [(EXPLICIT, 1e-14), (IMPLICIT, 1e-9)])
def test_obstacles_give_the_body_the_momentum_that_contact_force_says(options, rounding):
    rollout, frames = caught(**options)
    mass = rollout.scene.inputs.derive(rollout.values).mass[:, None]
    gained = np.diff((mass * frames.velocities).sum(1), axis=0)
    np.testing.assert_allclose(
        rollout.solver.dt * frames["force"][1:], gained, atol=rounding * np.abs(gained).max(), rtol=0
    )
    assert np.abs(frames["dragged"]).max() > 0.1 and frames.velocities[-1, :, 1].mean() > -0.3


def test_gradients_of_places_and_forces_agree_with_differences():
    """By all inputs of the wire, its path, its radius and the point that it turns about among them, at once."""
    rollout, frames = caught(**IMPLICIT)
    rng = np.random.default_rng(0)
    seeds = {name: rng.standard_normal(frames[name].shape) for name in ("positions", "force", "dragged", "moment")}
    seeds["positions"] *= 1e3
    gradients = rollout.vjp(frames, **seeds)
    names = [name for name in rollout.wanted if name.startswith("wire.") or name == "rest_positions"]
    sizes = {name: verify.input_scale(rollout, name) for name in names}
    way = {name: sizes[name] * rng.standard_normal(gradients[name].shape) for name in names}
    analytic = sum(float((gradients[name] * way[name]).sum()) for name in names)

    def loss(t):
        there = rollout.forward(**{name: rollout.values[name] + t * way[name] for name in names})
        return sum(float((there[name] * seed).sum()) for name, seed in seeds.items())

    coarse, fine = ((loss(h) - loss(-h)) / (2 * h) for h in (2e-6, 1e-6))
    assert len(names) > 7
    assert analytic == pytest.approx((4 * fine - coarse) / 3, rel=1e-6)


def test_the_adjoint_of_explicit_steps_is_the_transpose_of_their_tangent():
    assert verify.dot_product_test(caught(**EXPLICIT)[0]) < 1e-11


def test_passes_of_a_record_go_back_through_what_was_near_in_each():
    """A cube scrapes over land, of which other edges are near from the ninth pass on: a record made after other values
    gives the gradient that a record with all of them gave. With kernels of `caught`."""
    rough, turn = dict(friction=0.3, friction_speed=0.05), lambda t: (0, 0.2 * t, 0, 0, 0, 0.1 * t)
    terms = land(20, path=turn, **rough), ds.SelfContact(1e3, 2e-3, friction=0.2)
    solver = ds.SemiImplicitSolver(cube(*terms, lift=-0.014, velocity=(4.0, -0.5, 0.1)), dt=1e-3)
    rollout = ds.Rollout(solver, 12, gradients="all")
    frames = rollout.forward()
    with_all = rollout.vjp(frames, positions=np.ones_like(frames.positions))
    rollout.forward(density=900.0)
    anew = rollout.vjp(frames, positions=np.ones_like(frames.positions))
    stage = rollout.sweep.workspace.stages[0]
    assert len(set(stage.by_end.values())) == 2
    for name, gradient in with_all.items():
        np.testing.assert_allclose(anew[name], gradient, atol=1e-12 * np.abs(gradient).max(), rtol=0, err_msg=name)


def test_the_tangent_of_a_hard_impact_goes_from_where_the_run_was(monkeypatch):
    """Its substeps have several parts, each with a state of the run: errors in those that a tangent finds do not go on."""
    box = ds.Box((0.05, -0.013, 0.05), [0.01] * 3, stiffness=1e2, width=2e-3)
    mesh, fast = ds.TetrahedralMesh.create_cube(2, 0.1), [0, -25.0, 0]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.35), 1000.0, [box], initial_velocities=fast, precision="f64")
    rollout, take, later = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-4), 12, gradients="all"), PartSolver.take, []
    rollout.forward()

    def off(self, part, of, at):
        e, b = take(self, part, of, at)
        if np.iscomplexobj(of.motion):
            later.append(part.begin > 0)
            e, b = (x.real * (1 + 1e-6) + 1j * x.imag for x in (e, b))
        return e, b

    monkeypatch.setattr(PartSolver, "take", off)
    assert ds.dot_product_test(rollout) < 1e-8 and sum(later) > 10  # 1e-10, and 2e-5 if errors went on


def test_nothing_passes_what_moves_up_through_it():
    """A wire that no vertex meets comes up into a cube that falls. With kernels of `caught`."""
    up = lambda t: (0, 0.8 * t, 0)  # noqa: E731
    start, end = np.array([-0.05, -0.012, 0.03]), np.array([0.15, -0.012, 0.06])
    wire = ds.Capsule(start, end, 4e-3, by_pairs=True, path=lambda t: (*up(t), 0, 0, 0), width=WIDTH,
                      stiffness_per_area=5e7, friction=0.3, friction_speed=0.05)  # fmt: skip
    scene = cube(wire, ds.SelfContact(1e3, 2e-3, friction=0.2))
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=5e-3))
    solid = dict(kind="capsule", start=start, end=end, radius=4e-3)
    judge = Judge(simulator.scene.mesh.surface_triangles, solid, simulator.positions)
    for _ in range(12):
        simulator.step()
        assert judge.after_step(simulator.positions, np.array(up(simulator.time))) is None
    assert simulator.velocities[:, 1].mean() > 0.3


def test_refusals_name_what_they_are_about():
    with pytest.raises(Overlap, match=r"an edge of Box.* and triangle \(\d+, \d+, \d+\); move"):
        ds.Simulator(ds.ImplicitEulerSolver(cube(below("edge of a box", -1e-3)), dt=1e-3))
    with pytest.raises(ValueError, match="HalfSpace: by_pairs is for shapes of points and edges"):
        ds.HalfSpace(by_pairs=True)


def test_a_hard_impact_on_a_small_box_ends_well_once_advice_is_taken():
    """Elements are squeezed to where the substep is no longer stable, and the error says so, not how fast they then fly."""
    box, mesh = (
        ds.Box((0.05, -0.025, 0.05), [0.01] * 3, stiffness=1e4, width=2e-3),
        ds.TetrahedralMesh.create_box(4, 0.1),
    )
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.35), 1000.0, [box], initial_velocities=[0, -25.0, 0], precision="f64"
    )
    dt, said = 0.7 * float(ds.stable_dt(scene)), []
    while dt and len(said) < 3:
        simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=dt, substeps=1))
        try:
            simulator.run(int(8e-3 / dt))
            dt = None
        except FloatingPointError as error:
            said.append(str(error))
            dt = float(re.search(r"(?:substeps of|substep to) (\S+) s", said[-1])[1])
    assert dt is None and re.search("squeezed: (?:take|reduce)", said[0])


@pytest.mark.backends
def test_vulkan_refuses_the_stage_and_takes_what_the_error_names():
    if ds.runtime.arch_name() != "vulkan":
        pytest.skip("kernels take so many arrays here")
    mesh, law = ds.TetrahedralMesh.create_box(2, SIZE), ds.StableNeoHookean(5e4, 0.3)
    ball, blind = (ds.Sphere((0.05, -0.03, 0.05), 0.01, **BARRIER, **how) for how in ({}, dict(by_pairs=False)))
    scene = ds.Scene(mesh, law, 1000.0, [ball], precision="f32")
    with pytest.raises(ValueError, match="Vulkan lends a kernel too few arrays"):
        ds.SemiImplicitSolver(scene, dt=1e-4)
    for solver in (
        ds.SemiImplicitSolver(ds.Scene(mesh, law, 1000.0, [blind], precision="f32"), dt=1e-4),
        ds.ImplicitEulerSolver(scene, dt=1e-3),
    ):
        assert np.isfinite(ds.Rollout(solver, 2).forward().positions).all()
