"""Triangles, segments and points as obstacles: exact distances, inside and outside, sharp edges, what passes through."""

import numpy as np
import pytest
import taichi as ti
from contact_scenes import box_surface, tetrahedron

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.terms.obstacles import shapes

SIZE, AT = np.array([0.9, 0.6, 0.8]), np.array([0.36, -0.31, 0.22])
CORNERS, TRIANGLES = box_surface(SIZE, -SIZE / 2)
BARRIER = dict(stiffness=300.0, width=0.2)
RNG = np.random.default_rng(5)
PLACES = AT + RNG.uniform(-1.2, 1.2, (300, 3)) * SIZE
SHEET = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]])
SQUARE = [[0, 1, 2], [0, 2, 3]]


def box(**options):
    return ds.Box(AT, SIZE, **BARRIER | options)


def meshed_box(**options):
    return ds.MeshObstacle(CORNERS, TRIANGLES, AT, **BARRIER | options)


def segment_distance(x, a, b):
    share = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(x - a - share[:, None] * (b - a), axis=1)


def sheet_distance(x):
    return np.linalg.norm(
        np.stack([np.maximum(np.abs(x[:, 0]) - 1, 0), x[:, 1], np.maximum(np.abs(x[:, 2]) - 1, 0)]), axis=0
    )


def gaps(term, places, precision="f64"):
    """Distances by the device counterpart."""
    fp, numbers = runtime.PRECISIONS[precision], np.concatenate([v.ravel() for v in term.values.values()])
    vec, counterpart = ti.types.vector(4, fp), term.kernel(precision, table=len(numbers))

    @ti.kernel
    def look(parameters: ti.types.ndarray(fp, 1), x: ti.types.ndarray(vec, 1), out: ti.types.ndarray(fp, 1)):
        for i in range(x.shape[0]):
            out[i] = counterpart.gap(parameters, 0, x[i], vec(0))

    out = runtime.array(fp, len(places))
    look(runtime.upload(np.append(numbers, term.table), fp), runtime.upload(places, vec), out)
    return runtime.fetch(out)


A, B, C = np.array([[0.0, 0, 0], [0.6, 0.2, 0.1], [-0.3, 0.4, 0.2]])
EXACT = {
    "a box": (meshed_box(), box().distance),
    "unwelded": (ds.MeshObstacle(CORNERS[TRIANGLES].reshape(-1, 3), np.arange(36).reshape(12, 3), AT), box().distance),
    "thick": (meshed_box(radius=0.1), lambda x: box().distance(x) - 0.1),
    "a room": (ds.MeshObstacle(CORNERS, TRIANGLES[:, ::-1], AT), lambda x: -box().distance(x)),
    "a sheet": (ds.MeshObstacle(SHEET, SQUARE, AT), lambda x: sheet_distance(x - AT)),
    "segments": (
        ds.MeshObstacle([A, B, C], segments=[[0, 1], [1, 2]], radius=0.05),
        lambda x: np.minimum(segment_distance(x, A, B), segment_distance(x, B, C)) - 0.05,
    ),
    "points": (ds.MeshObstacle([A, B, C]), lambda x: np.linalg.norm(x[:, None] - [A, B, C], axis=2).min(1)),
    "all of them": (
        ds.MeshObstacle([*SHEET, A, B, C], SQUARE, segments=[[4, 5]], points=[6]),
        lambda x: np.minimum(np.minimum(sheet_distance(x), segment_distance(x, A, B)), np.linalg.norm(x - C, axis=1)),
    ),
}


@pytest.mark.parametrize("name", EXACT)
def test_distances_are_exact(name):
    """On the host and, of one with and one without an inside, on the device, in float32 to its round-off."""
    term, exact = EXACT[name]
    np.testing.assert_allclose(term.distance(PLACES), exact(PLACES), atol=1e-14)
    if name == "thick":
        np.testing.assert_allclose(gaps(term, PLACES), exact(PLACES), atol=1e-14)
    if name == "all of them":
        np.testing.assert_allclose(gaps(term, PLACES, "f32"), exact(PLACES), atol=1e-6)


def test_a_large_tree_finds_what_a_look_at_all_finds(monkeypatch):
    """A bumpy ball of 224 triangles, which acts to both sides as one of them is missing."""
    monkeypatch.setattr(shapes, "ROUND", 16)
    x, t = shapes.ball((0, 0, 0), 0.5)
    x = x * (1 + 0.1 * RNG.uniform(-1, 1, (len(x), 1)))
    term = ds.MeshObstacle(x, t[1:])
    places = RNG.uniform(-1, 1, (200, 3))
    one_by_one = np.min([ds.MeshObstacle(x[row], [[0, 1, 2]]).distance(places) for row in t[1:]], 0)
    np.testing.assert_allclose(term.distance(places), one_by_one, atol=1e-14)
    np.testing.assert_allclose(gaps(term, places), one_by_one, atol=1e-14)


def fallen(terms, solver, steps=12, **options):
    scene = ds.Scene(
        tetrahedron(options.pop("lift", 0.15)),
        ds.StableNeoHookean(2e4, 0.3),
        100.0,
        [ds.Gravity(), *np.atleast_1d(terms)],
        precision="f64",
        initial_velocities=options.pop("velocity", (0.5, -1.0, 0.2)),
    )
    simulator = ds.Simulator(solver(scene, dt=4e-3, **options))
    simulator.run(steps)
    return simulator


@pytest.mark.parametrize("solver, options", [(ds.VelocityVerletSolver, dict(substeps=8)), (ds.ImplicitEulerSolver, {})])
def test_a_meshed_box_is_the_analytic_one(solver, options):
    """Flat regions count once, whatever triangles they consist of. With kernels of the land of test_obstacle_pairs.py."""
    rough = dict(friction=0.4, friction_speed=0.05, stiffness=None, stiffness_per_area=3e3, path=lambda t: np.zeros(3))
    found, expected = (
        fallen(make(**rough), solver, **options) for make in (meshed_box, lambda **o: box(by_pairs=True, **o))
    )
    assert found.contact_resolution.smallest_gap < 0.15 if options else True
    np.testing.assert_allclose(found.positions, expected.positions, atol=1e-9)


def test_flat_and_finely_bent_edges_do_not_act_by_pairs():
    """Diagonals of a square, and edges over which faces do not see a ball bend."""
    body = tetrahedron(2.0)
    edges = lambda term: ds.Scene(body, ds.LinearElastic(1e4, 0.3), 100.0, [term]).obstacles[0].primitives  # noqa: E731
    assert len(edges(meshed_box()).edges) == 12 and len(edges(meshed_box()).points) == 8
    assert len(edges(ds.MeshObstacle(SHEET - [0, 1, 0], SQUARE, **BARRIER)).edges) == 4
    x, t = shapes.ball((0, -8.0, 0), 7.0)
    assert edges(ds.MeshObstacle(x.round(9), t, stiffness=300.0, width=0.3)) is None


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sheet_acts_to_both_sides(sign):
    sheet = ds.MeshObstacle(SHEET, SQUARE, path=lambda t: [0, 0.5 * sign * t, 0], **BARRIER | dict(width=0.05))
    lift = 0.02 if sign > 0 else -0.52
    simulator = fallen(sheet, ds.SemiImplicitSolver, lift=lift, velocity=(0, -sign, 0), substeps=8)
    sides = simulator.positions[:3, 1] if sign > 0 else simulator.positions[3:, 1]
    assert np.all(sign * (sides - 0.5 * sign * 0.048) > 0) and simulator.contact_resolution.smallest_gap > 0


def test_what_is_not_nearest_is_not_passed_through_either():
    """A fast vertex next to a point, with a sheet on its way, none of whose edges acts by pairs."""
    options = BARRIER | dict(width=1e-3, by_pairs=False)
    parts = ds.MeshObstacle([*SHEET, [1.3, 0.24, 0.0]], SQUARE, points=[4], **options)
    with pytest.raises(ds.Crossing, match="vertex 0 gets .* m behind MeshObstacle"):
        fallen(parts, ds.SemiImplicitSolver, lift=0.3, velocity=(0, -400.0, 0), steps=2, substeps=4)


def test_an_inside_is_refused_and_a_sheet_has_none():
    body = tetrahedron(0.0)
    scene = lambda term: ds.Scene(body, ds.LinearElastic(1e4, 0.3), 100.0, [term])  # noqa: E731
    low = body.vertices.mean(0) + [0, 0.1, 0] - SIZE / 2
    with pytest.raises(ValueError, match="the body starts on or in MeshObstacle"):
        scene(ds.MeshObstacle(*box_surface(SIZE, low), **BARRIER))
    x, t = box_surface(SIZE, low)
    scene(ds.MeshObstacle(x, t[:, ::-1], **BARRIER))  # a room
    scene(ds.MeshObstacle(x, t[1:], **BARRIER))  # open


ENDS = np.array([[-0.5, -0.3, -1], [0.25, -0.01, -1], [1, -0.3, -1]])
ROOF = np.concatenate([ENDS, ENDS + [0, 0, 2.5]])
SHAPE = ["mesh_vertices", "mesh_position", "mesh_radius", "barrier_width"]


def over_a_roof(vertices=ROOF, shapeable=True, **options) -> ds.Scene:
    """A tetrahedron that slides over an edge."""
    more = BARRIER | dict(width=0.1, friction=0.2, friction_speed=0.1)
    roof = ds.MeshObstacle(
        vertices, [[0, 3, 1], [3, 4, 1], [1, 4, 2], [4, 5, 2]], radius=0.01, shapeable=shapeable, **more
    )
    options = dict(initial_velocities=(1.5, -1.0, 0.0)) | options
    law = ds.StableNeoHookean(2e4, 0.3)
    return ds.Scene(tetrahedron(0.1), law, 100.0, [ds.Gravity(), roof], precision="f64", **options)


def test_gradients_by_the_shape_through_sliding_over_an_edge():
    """Vertices, place, radius and friction; Taylor's remainder falls with the square of the step."""
    rollout = ds.Rollout(ds.SemiImplicitSolver(over_a_roof(), dt=2e-3, substeps=4), 20, gradients=SHAPE)
    report = ds.check_gradients(rollout, verbose=False)
    assert report.passed and ds.dot_product_test(rollout) < 1e-12
    for row in report.rows:
        assert row.relative_error < 1e-6 and row.analytic != 0, str(report)
    other = ROOF + 0.002 * RNG.standard_normal(ROOF.shape)  # as if it had been made so
    moved = rollout.forward(mesh_vertices=other).positions
    again = ds.SemiImplicitSolver(over_a_roof(other, False), dt=2e-3, substeps=4)
    np.testing.assert_allclose(moved, ds.Rollout(again, 20).forward().positions, atol=1e-12)


def test_shapes_in_a_batch_and_in_torch():
    """Three roofs together are each by itself, to the bit, and torch has the same gradients."""
    torch = pytest.importorskip("torch")
    from diffsim_ti.diff_simulator import rollout_frames

    solver = ds.SemiImplicitSolver(over_a_roof(), dt=2e-3, substeps=4)
    rollout, batch = ds.Rollout(solver, 6, gradients=SHAPE), ds.Batch(solver, 6, 3, gradients=SHAPE)
    roofs = ROOF + 0.01 * RNG.standard_normal((3, *ROOF.shape))
    frames = batch.forward(mesh_vertices=roofs)
    by = RNG.standard_normal(frames.positions.shape)
    found = batch.vjp(frames, positions=by)["mesh_vertices"]
    for k in range(3):
        alone = rollout.forward(mesh_vertices=roofs[k])
        np.testing.assert_array_equal(frames.positions[k], alone.positions)
        expected = rollout.vjp(alone, positions=by[k])["mesh_vertices"]
        assert np.abs(expected).max() > 0
        np.testing.assert_allclose(found[k], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    roof = torch.tensor(roofs[2], requires_grad=True)
    (rollout_frames(rollout, mesh_vertices=roof).positions * torch.as_tensor(by[2])).sum().backward()
    np.testing.assert_allclose(roof.grad.numpy(), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("solver", [ds.BDF2Solver, ds.StaticSolver])
def test_gradients_by_the_shape_in_implicit_steps_and_equilibria(solver):
    static = solver is ds.StaticSolver
    options = dict(load_steps=1) if static else dict(dt=1e-2)
    scene = over_a_roof(**(dict(fixed=[1, 3], initial_velocities=None) if static else {}))
    rollout = ds.Rollout(solver(scene, tolerance=1e-10, **options), 1 if static else 4, gradients=SHAPE)
    frames = rollout.forward()
    assert np.abs(rollout.vjp(frames, positions=frames.positions)["mesh_vertices"]).max() > 1e-5
    assert ds.dot_product_test(rollout) < 1e-8


def test_a_crease_presses_by_both_of_its_sides():
    """A vertex is pressed to where two faces are equally near. The barrier of what is nearest has a kink there, where
    Newton's method goes to and fro; the sum over both does not, and its gradients are exact."""
    body = tetrahedron()
    x = body.vertices * [1, -1, 1] + [-0.25, 0.56, 0]  # on its tip
    valley = ds.MeshObstacle(
        [[x, abs(x), z] for z in (-1, 1.5) for x in (-1, 0, 1)],
        [[0, 3, 1], [3, 4, 1], [1, 4, 2], [4, 5, 2]],
        radius=0.01,
        shapeable=True,
        **BARRIER | dict(width=0.1, friction=0.2, friction_speed=0.1),
    )
    body = ds.TetrahedralMesh(x, body.tetrahedra, fix_orientation=True)
    law, down = ds.StableNeoHookean(2e4, 0.3), dict(initial_velocities=(0.1, -1.0, 0.3))
    scene = ds.Scene(body, law, 100.0, [ds.Gravity(), valley], precision="f64", **down)
    solver = ds.ImplicitEulerSolver(scene, dt=1e-2, tolerance=1e-10)
    simulator = ds.Simulator(solver)
    simulator.run(8)
    assert simulator.report.iterations <= 8 * 6
    rollout = ds.Rollout(solver, 6, gradients=[*SHAPE, "friction", "friction_speed"])
    report = ds.check_gradients(rollout, inputs=["mesh_vertices", "friction"], verbose=False)
    assert report.passed and ds.dot_product_test(rollout) < 1e-9, str(report)


def in_a_groove(solver, dt, steps, path=None, obstacles=(slice(0, 4),)):
    """Two sides with 60 degrees between them hold a wedge of weight N by N / (2 sin 30) each, so that it slides along them
    against mu N / sin 30. The bottom of the groove is out of reach: thick sides are nearer. obstacles: the triangles of
    each. Returns normal forces and friction at frames, over mu / sin 30, and the frames."""
    mu, width, radius = 0.2, 0.01, 0.02
    # with kernels of the valley above or, on a path, of the land of test_obstacle_pairs.py
    like = dict(stiffness=1.5e3, shapeable=True) if path is None else dict(stiffness_per_area=1.5e5)
    sides = np.array([[x, abs(z), z * np.tan(np.pi / 6)] for x in (-1, 3) for z in (-1.0, 0.0, 1.0)])
    groove = [
        ds.MeshObstacle(
            sides, [[0, 3, 1], [3, 4, 1], [1, 4, 2], [4, 5, 2]][own], radius=radius, width=width,
            friction=mu, friction_speed=1e-3, path=path, name=f"side_{k}", **like,
        )
        for k, own in enumerate(obstacles)
    ]  # fmt: skip
    low = 2 * (radius + 0.5 * width)
    wedge = np.array([[0, low, 0], [0.2, low, 0], [0.1, low + 0.2, 0.1], [0.1, low + 0.2, -0.1]])
    mesh = ds.TetrahedralMesh(wedge, [[0, 1, 2, 3]], fix_orientation=True)
    terms = [ds.Gravity((6.0, -9.0, 0)), *groove]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), 3e3, terms, initial_velocities=(1.0, 0, 0), precision="f64")
    outputs = [
        ds.ContactForce(x.name, part, name=f"{part}_{x.name}") for part in ("normal", "friction") for x in groove
    ]
    frames = ds.Rollout(solver(scene, dt=dt), steps, save_every=1, outputs=outputs).forward()
    normal, friction = (sum(frames[f"{part}_{x.name}"] for x in groove) for part in ("normal", "friction"))
    return normal[:, 1], -friction[:, 0] / mu * np.sin(np.pi / 6), frames


@pytest.mark.parametrize("turned", [False, True])
def test_friction_in_a_groove_is_that_of_both_sides(turned):
    path = (lambda t: (0, 0, 0, 0.3 * t, 0, 0)) if turned else None
    normal, friction, frames = in_a_groove(ds.ImplicitEulerSolver, 5e-3, 12, path)
    assert normal[1:-1].min() > 5 and np.all(frames.velocities[:, :, 0] > 0.5)
    np.testing.assert_allclose(friction[2:], normal[1:-1], rtol=2e-3)  # it bounces, so not all along


@pytest.mark.parametrize("obstacles, swings", [((slice(0, 4),), True), ((slice(0, 2), slice(2, 4)), False)])
def test_sides_of_a_groove_press_in_turn_in_explicit_steps_unless_each_is_an_obstacle(obstacles, swings):
    normal, friction, frames = in_a_groove(ds.SemiImplicitSolver, 2.5e-4, 240, obstacles=obstacles)
    np.testing.assert_allclose(friction[100:].mean(), normal[100:].mean(), rtol=1e-2)
    assert (np.ptp(frames.positions[100:, 0, 2]) > 1e-6) == swings


def test_what_starts_wrong_is_said_with_what_helps():
    """A sheet through a body between its vertices, a solid whose triangles face inwards, indices that count from one."""
    law, high = ds.StableNeoHookean(2e4, 0.3), ds.TetrahedralMesh.create_box(2, 0.2, origin=(-0.1, -0.07, -0.1))
    scene = lambda obstacle: ds.Scene(high, law, 100.0, [ds.Gravity(), obstacle], precision="f64")  # noqa: E731
    for path in (None, lambda t: (0, 0, 0, 0.01, 0, 0)):
        with pytest.raises(
            ValueError, match="starts with a triangle of MeshObstacle.* between its vertices .* move the body"
        ):
            scene(ds.MeshObstacle(SHEET, SQUARE, path=path, **BARRIER))
        scene(ds.MeshObstacle(SHEET - [0, 0.1, 0], SQUARE, path=path, **BARRIER))
        scene(ds.MeshObstacle(SHEET + [1.2, 0, 0], SQUARE, path=path, **BARRIER))
    solid = CORNERS - [0, 0.4, 0]
    with pytest.raises(ValueError, match=r"so that it is a room: turn them round, triangles\[:, ::-1\], for a solid"):
        scene(ds.MeshObstacle(solid, TRIANGLES[:, ::-1], **BARRIER))
    scene(ds.MeshObstacle(solid, TRIANGLES, **BARRIER))
    with pytest.raises(ValueError, match="0 to 3, got 4; these count from 1: subtract 1"):
        ds.MeshObstacle(SHEET, np.add(SQUARE, 1))


def test_resolution_is_not_asked_for():
    with pytest.warns(DeprecationWarning, match="resolution has no meaning, for distances are exact") as caught:
        ds.MeshObstacle(CORNERS, TRIANGLES, (0, 0, 0), 8)
    assert caught[0].filename == __file__


def test_a_table_that_float32_cannot_count_is_refused():
    with pytest.raises(ValueError, match="float32 cannot count .* pass precision='f64', or fewer"):
        meshed_box().kernel("f32", table=2**24)
