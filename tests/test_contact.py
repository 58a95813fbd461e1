"""Obstacles: distances, barrier, what is refused, and what a run reports."""

import numpy as np
import pytest
import taichi as ti
from contact_scenes import BASE, EXPLICIT, FORCE, KEEPING, RESTING, SHAPES, G, points, resting_gap, tetrahedron

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.terms.obstacles import barrier

pytestmark = pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py

RNG = np.random.default_rng(3)
BASE_MESH = tetrahedron()
POINTS = np.vstack([RNG.uniform([-0.4, -0.3, -0.4], [0.9, 0.4, 0.7], (60, 3)), BASE + [0, 0.15, 0]])


def evaluate(term, positions, precision="f64"):
    """(gap, energy, force) of the device counterpart at positions."""
    fp = runtime.PRECISIONS[precision]
    vec = ti.types.vector(4, fp)
    own = dict(table=len(np.concatenate([v.ravel() for v in term.values.values()]))) if term.table.size else {}
    counterpart = term.kernel(precision, **own)

    @ti.kernel
    def look(
        parameters: ti.types.ndarray(fp, 1),
        x: ti.types.ndarray(vec, 1),
        gap: ti.types.ndarray(fp, 1),
        energy: ti.types.ndarray(fp, 1),
        force: ti.types.ndarray(vec, 1),
    ):
        for i in range(x.shape[0]):
            zero = vec(0)
            gap[i] = counterpart.gap(parameters, 0, x[i], zero)
            energy[i] = counterpart.energy(parameters, 0, x[i], zero)
            force[i] = counterpart.force(parameters, 0, x[i], zero, zero)

    numbers = np.concatenate([*(v.ravel() for v in term.values.values()), term.table])
    n = len(positions)
    gap, energy, force = runtime.array(fp, n), runtime.array(fp, n), runtime.array(vec, n)
    look(runtime.upload(numbers, fp), runtime.upload(positions, vec), gap, energy, force)
    return runtime.fetch(gap), runtime.fetch(energy), runtime.fetch(force)


@pytest.mark.parametrize("name", SHAPES)
def test_distance_and_force(name):
    """The kernel's distance is the one that checks and reports use; the force is minus the energy's gradient."""
    term = SHAPES[name](stiffness=300.0, width=0.2)
    gap, energy, force = evaluate(term, POINTS)
    np.testing.assert_allclose(gap, term.distance(POINTS), atol=1e-14)
    assert (gap < 0).any() and (gap > 0.2).any()
    assert np.all(energy[gap >= 0.2] == 0) and np.all(force[gap >= 0.2] == 0)  # exactly nothing beyond the width
    h, numeric = 1e-6, np.zeros_like(force)
    for d in range(3):
        step = h * np.eye(3)[d]
        numeric[:, d] = (evaluate(term, POINTS - step)[1] - evaluate(term, POINTS + step)[1]) / (2 * h)
    np.testing.assert_allclose(force, numeric, rtol=1e-6, atol=1e-6 * np.abs(force).max())
    single = evaluate(term, POINTS, "f32")[2]
    np.testing.assert_allclose(single, force, atol=1e-4 * np.abs(force).max())


def test_sphere_pushes_out_and_bowl_in():
    """Also a vertex that got past is pushed back where it came from."""
    ball, bowl = (ds.Sphere(radius=1.0, inside=inside, stiffness=1e3, width=0.1) for inside in (False, True))
    at = np.array([[1.05, 0, 0], [0.95, 0, 0], [0.3, 0, 0]])
    assert np.all(evaluate(ball, at)[2][:, 0] > 0)
    inward = evaluate(bowl, np.array([[0.95, 0, 0], [1.05, 0, 0]]))[2]
    assert np.all(inward[:, 0] < 0) and inward[1, 0] < inward[0, 0]


@pytest.mark.parametrize("precision, tolerance", [("f64", 1e-12), ("f32", 1e-4)])
def test_barrier_near_its_ends(precision, tolerance):
    """Row 39: value, slope and curvature at the width and at 1e-3 .. 1e-12 of it, against float64 formulas."""
    fp = runtime.PRECISIONS[precision]
    s = np.array([1.0, 1 - 1e-3, 0.5, 1e-2, 1.0001e-3, 0.9999e-3, 1e-4, 1e-6, 1e-9, 1e-12, 0.0, -0.5])
    out = runtime.array(fp, 3, len(s))

    @ti.kernel
    def look(s: ti.types.ndarray(fp, 1), out: ti.types.ndarray(fp, 2)):
        for i in range(s.shape[0]):
            out[0, i], out[1, i] = barrier.value(s[i], fp), barrier.slope(s[i], fp)
            out[2, i] = barrier.curvature(s[i], fp)

    look(runtime.upload(s, fp), out)
    c = np.maximum(s, barrier.CROSSOVER)
    curvature = -2 * np.log(c) - 4 * (c - 1) / c + ((c - 1) / c) ** 2
    slope0 = -(c - 1) * (2 * np.log(c) + (c - 1) / c)
    value = -((c - 1) ** 2) * np.log(c) + (s - c) * (slope0 + (s - c) / 2 * curvature)
    np.testing.assert_allclose(barrier.beta(s), value, rtol=1e-12, atol=1e-15)
    assert barrier.beta(1.5) == 0
    expected = [value, slope0 + (s - c) * curvature, curvature]
    np.testing.assert_allclose(runtime.fetch(out), expected, rtol=tolerance, atol=1e-6 if precision == "f32" else 1e-15)
    assert np.all(runtime.fetch(out)[:, 0] == 0) and np.all(runtime.fetch(out)[1, 1:] < 0)


ERRORS = {
    "friction": (lambda: ds.Ground(friction=-0.1), "friction must be one number >= 0, got -0.1"),
    "friction speed": (lambda: ds.Ground(friction=0.1, friction_speed=0.0), r"friction_speed \[m/s\] must be > 0"),
    "normal": (lambda: ds.HalfSpace(normal=[0, 0, 0]), "normal must not be zero"),
    "point": (lambda: ds.HalfSpace(point=[0, 0]), "point must be 3 numbers"),
    "radius": (lambda: ds.Sphere(radius=0.0), "sphere_radius must be > 0"),
    "axis": (lambda: ds.Capsule([0, 0, 0], [0, 0, 0], 1.0), "start and end must differ"),
    "box": (lambda: ds.Box(size=[1, -1, 1]), "box_size must be > 0"),
    "rotation": (lambda: ds.Box(rotation=[0, 1]), "rotation must be 3 finite numbers"),
    "mesh of nothing": (lambda: ds.MeshObstacle(BASE, []), "at least one triangle, segment or point"),
    "mesh index": (
        lambda: ds.MeshObstacle(BASE, segments=[[0, 3]]),
        "segments must name vertices by index, 0 to 2, got 3",
    ),
    "mesh radius": (lambda: ds.MeshObstacle(BASE, radius=-1.0), "mesh_radius must be one number >= 0"),
    "width": (lambda: ds.Sphere(width=-1.0), r"Sphere: width \[m\] must be > 0"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_refused(case):
    make, message = ERRORS[case]
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("name", SHAPES)
def test_a_body_in_an_obstacle_is_refused(name):
    """Row 41 ff.: vertices and depths are named; inside the barrier's width a body may start."""
    term = SHAPES[name](stiffness=300.0, width=0.2)
    inside = term.distance(tetrahedron(-0.6).vertices) <= 0
    assert inside.any()
    worst = int(np.argmin(term.distance(tetrahedron(-0.6).vertices)))
    with pytest.raises(ValueError, match=rf"vertex {worst}.*\({inside.sum()} vertices\)"):
        points(tetrahedron(-0.6), term)
    points(tetrahedron(0.15), term)


def test_touching_exactly_is_refused_and_a_path_counts():
    with pytest.raises(ValueError, match="starts below or on the ground"):
        points(tetrahedron(0.0), ds.Ground(stiffness=1e4, width=0.01))
    rising = ds.Ground(stiffness=1e4, width=0.01, path=lambda t: [0, 0.3, 0])
    with pytest.raises(ValueError, match="starts below or on the ground"):
        points(tetrahedron(0.15), rising)
    points(tetrahedron(0.35), rising)


def test_stiffness_is_chosen_and_said():
    """From the speed of the fall: at rest on the floor the weight still leaves a gap."""
    mesh, material = tetrahedron(0.1), ds.StableNeoHookean(1e5, 0.3)
    scene = ds.Scene(mesh, material, terms=[ds.Gravity(), ds.HalfSpace(width=0.01)])
    faster = ds.Scene(mesh, material, terms=[ds.Gravity(), ds.HalfSpace(width=0.01)], initial_velocities=[0, -5, 0])
    k, more = (float(s.inputs.values["barrier_stiffness_per_area"]) for s in (scene, faster))
    assert more > 3 * k > 0 and f"stiffness per area {k:.4g} N/m^3 of HalfSpace" in scene.describe()
    assert "barrier_stiffness_per_area [N/m^3]" in scene.describe()
    solver = ds.VelocityVerletSolver(scene, dt=2e-4)
    simulator = ds.Simulator(solver)
    simulator.run(2000)
    assert simulator.contact_resolution.smallest_gap > 0.02 * 0.01
    with pytest.raises(ValueError, match="nothing says how stiff"):
        ds.Scene(mesh, material, terms=[ds.HalfSpace(width=0.01)])


@pytest.mark.parametrize("solver", FORCE + RESTING)
@pytest.mark.parametrize("mass, gap", [(1e-3, 9.9429e-3), (1e-1, 9.4391e-3), (10.0, 5.3589e-3)])
def test_weight_at_rest_on_a_slope(solver, mass, gap):
    """R22 on a tilted plane: the load across it decides; friction holds the vertex."""
    angle = 0.3
    n = np.array([np.sin(angle), np.cos(angle), 0])
    mesh = tetrahedron(0.3)
    plane = ds.HalfSpace(BASE[0] + [0, 0.3, 0] - resting_gap(mass * G) * n, n, stiffness=1e4, width=0.01, friction=1.0)
    scene = points(mesh, plane, mass, fixed=[1, 2, 3], terms=[ds.Gravity(-G / np.cos(angle))])
    end = ds.Rollout(solver(scene, dt=1e-3), 500).forward()
    reached = (end.positions[-1, 0] - plane.values["half_space_point"]) @ n
    assert reached == pytest.approx(gap, abs=1e-7)
    assert end.contact_resolution.smallest_gap == pytest.approx(gap, abs=1e-7)
    assert end.contact_resolution.obstacle.startswith("HalfSpace") and end.contact_resolution.vertex == 0


def test_absent_obstacles_compile_nothing():
    bare = ds.Simulator(ds.SemiImplicitSolver(ds.Scene(tetrahedron(), ds.StableNeoHookean(1e5, 0.3)), dt=1e-4))
    arrays = bare.workspace.arrays
    assert arrays.features().groups == () and np.prod(bare.workspace.watch.seen.shape) == 1
    assert np.prod(arrays.path.shape) == 1 and str(bare.contact_resolution) == "contact: none"
    plain = ds.Simulator(ds.SemiImplicitSolver(points(tetrahedron(0.5), ds.Ground(stiffness=1e4, width=0.01)), dt=1e-4))
    (group,) = plain.workspace.arrays.features().groups
    assert not group.force.friction and group.path < 0 and group.size == 3


@pytest.mark.parametrize("solver", FORCE + KEEPING)
def test_several_obstacles_and_energy(solver):
    """A body between a floor, a ball and a wall: kinetic, elastic and contact energy add up to what it started with."""
    mesh = ds.TetrahedralMesh.create_box(2, size=0.2, origin=[0, 0.12, 0])
    options = dict(stiffness=2e3, width=0.1)
    terms = [
        ds.Ground(**options),
        ds.Sphere([0.1, -0.7, 0.1], 0.75, **options),
        ds.HalfSpace([0.3, 0, 0], [-1, 0, 0], **options),
    ]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 500.0, terms=terms, initial_velocities=[0.7, -0.8, 0.1])
    simulator = ds.Simulator(solver(scene, dt=1e-4))
    start, drift, touched = simulator.compute_energy(), 0.0, 0.0
    for _ in range(40):
        simulator.run(100)
        energy = simulator.compute_energy()
        drift, touched = max(drift, abs(energy - start)), max(touched, energy.parts["contact"])
    assert touched > 0.1 * start and drift < (0.02 if solver.order == 1 else 1e-4) * start
    assert set(scene.inputs.names) >= {
        "barrier_stiffness",
        "barrier_stiffness_2",
        "barrier_stiffness_3",
        "sphere_radius",
    }


@pytest.mark.parametrize("solver", FORCE + EXPLICIT)
def test_symmetric_contact_stays_symmetric(solver):
    """Row 48: all lower vertices meet the floor in the same pass, one exactly at the width; nothing breaks the symmetry."""
    x = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [0, 1, 0], [0, 0, 0]]) * 0.2
    tets = [[0, 2, 4, 5], [2, 1, 4, 5], [1, 3, 4, 5], [3, 0, 4, 5]]
    mesh = ds.TetrahedralMesh(x + [0, 0.01, 0], tets, fix_orientation=True)
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity(), ds.Ground(stiffness=1e4, width=0.01, friction=0.3)]
    )
    end = ds.Rollout(solver(scene, dt=2e-4), 2000).forward()
    p = end.positions[-1]
    mirrored, turned = p[[1, 0, 2, 3, 4, 5]] * [-1, 1, 1], p[[2, 3, 0, 1, 4, 5]][:, [2, 1, 0]]
    assert np.all(np.isfinite(p)) and end.contact_resolution.smallest_gap < 0.01
    np.testing.assert_allclose(mirrored, p, atol=1e-10)
    np.testing.assert_allclose(turned, p, atol=1e-10)


@pytest.mark.parametrize("solver", FORCE)
def test_momentum_balance(solver):
    """What a moving wall does to a body: its impulse is the change of momentum, its work the change of energy.

    Without friction forces are normal and given by the barrier: impulse and work are summed over the steps' states.
    """
    wall = ds.HalfSpace([-0.05, 0, 0], [1, 0, 0], stiffness=500.0, width=0.1, path=lambda t: [0.4 * t, 0, 0])
    scene = points(tetrahedron(0.0), wall, fixed=[])
    steps, dt = 1000, 5e-4
    frames = ds.Rollout(solver(scene, dt=dt), steps, save_every=1).forward()
    s = (frames.positions[..., 0] - (-0.05 + 0.4 * frames.times[:, None])) / 0.1
    push = -500.0 * 0.1 * np.where(s < 1, slope_of(s), 0)  # (frames, vertices) [N]
    gained = frames.velocities[-1, :, 0] - frames.velocities[0, :, 0]
    impulse = dt * (push[:-1].sum(0) if solver.order == 1 else 0.5 * (push[1:] + push[:-1]).sum(0))
    np.testing.assert_allclose(impulse, gained, rtol=1e-7, atol=5e-8)  # its own elasticity of 1e-6 Pa acts too
    assert gained[0] > 0.1  # the wall caught up
    kinetic = 0.5 * (frames.velocities**2).sum((1, 2))
    stored = 500.0 * 0.1**2 * np.where(s < 1, -((s - 1) ** 2) * np.log(np.minimum(s, 1)), 0).sum(1)
    work = dt * 0.4 * np.concatenate([[0], np.cumsum(0.5 * (push[1:] + push[:-1]).sum(1))])
    balance = kinetic + stored - work
    assert np.abs(balance - balance[0]).max() < (2e-2 if solver.order == 1 else 1e-4) * work[-1]


def slope_of(s):
    with np.errstate(all="ignore"):
        return np.where(s < 1, -(s - 1) * (2 * np.log(np.minimum(s, 1)) + (s - 1) / s), 0)


@pytest.mark.parametrize("up", ["x", "-z"])
def test_any_axis_may_point_up(up):
    """A fall that is turned with its gravity and its floor is the fall, turned, and so are its gradients."""
    axis, sign = "xyz".index(up[-1]), -1 if up[0] == "-" else 1
    turn = (np.diag([1, sign, sign]) @ np.eye(3)[[(axis + 2) % 3, axis, (axis + 1) % 3]]).T
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (0.3, 0.2, 0.1), origin=(0, 0.06, 0))
    results = []
    for direction, R in (("y", np.eye(3)), (up, turn)):
        terms = [ds.Gravity(-9.81, up=direction), ds.Ground(0.05, width=0.02, friction=0.3, up=direction)]
        options = dict(terms=terms, initial_velocities=R @ [0.5, 0, 0.1], precision="f64")
        scene = ds.Scene(mesh.rotated(R), ds.StableNeoHookean(5e4, 0.3), **options)
        rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 50, gradients=["ground_height", "gravity"])
        frames, seed = rollout.forward(), np.zeros((2, mesh.num_vertices, 3))
        seed[-1] = np.cos(np.arange(3 * mesh.num_vertices)).reshape(-1, 3) @ R.T
        by = rollout.vjp(frames, positions=seed)
        results.append((frames.positions[-1] @ R, by["ground_height"], by["gravity"] @ R))
    for own, turned in zip(*results):
        np.testing.assert_allclose(turned, own, rtol=1e-8, atol=1e-12)
    assert f"Ground(up={up!r}" in scene.describe() and abs(by["ground_height"]) > 0
    origin = 1e6 * np.eye(3)[axis]  # what is measured from far away has the height above it
    floor = scene.terms[1]
    assert floor.shift(origin)[0] == sign * 1e6
    drawn, _ = floor.surface(1.0)
    assert np.allclose(floor.distance(drawn), 0)
    with pytest.raises(ValueError, match=f"at -0.14 m above {up} = 0.2"):
        scene.replace(terms=[ds.Ground(0.2, stiffness=1.0, up=up)])


def test_what_points_up_is_refused_otherwise():
    with pytest.raises(ValueError, match="Ground: up must be one of 'x', 'y', 'z', '-x', '-y', '-z', got 'w'"):
        ds.Ground(up="w")
    with pytest.raises(ValueError, match="leave up='z' out"):
        ds.Gravity((0, 0, -9.81), up="z")
