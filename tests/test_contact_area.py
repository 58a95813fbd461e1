"""Stiffness per area: contact as an integral over the surface, in every solver, with its gradients."""

import warnings
from functools import cache

import numpy as np
import pytest
from contact_scenes import EXPLICIT, FORCE, resting_gap
from test_every_adjoint import assert_transposed
from test_swept import needle

import diffsim_ti as ds
from diffsim_ti.inputs.surface_areas import SurfaceAreas

SOFT = ds.StableNeoHookean(1e5, 0.3)
CORNERS = 0.1 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])  # of a regular tetrahedron
ROUGH = dict(friction=0.3, friction_speed=5.0)


def areas_of(mesh, X=None) -> np.ndarray:
    link = SurfaceAreas(mesh)
    return link.value(mesh.vertices if X is None else X)[0]


# ---- the area of a vertex -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["kuhn", "five"])
def test_areas_of_a_cube_are_those_of_each_of_its_faces(pattern):
    """However its squares are cut in two, and whichever face it lies on; inner vertices have none."""
    cube = ds.TetrahedralMesh.create_cube(resolution=4, size=0.2, pattern=pattern)
    areas, x = areas_of(cube), cube.vertices
    assert areas[np.setdiff1d(np.arange(cube.num_vertices), cube.surface_vertices)].max() == 0
    for d in range(3):
        for end in (0.0, 0.2):
            assert areas[np.isclose(x[:, d], end)].sum() == pytest.approx(0.04, rel=1e-12)


def test_areas_of_a_box_converge_to_those_of_its_faces():
    """At edges between unequal cells the larger one counts more."""
    errors = []
    for cells in (2, 4, 8):
        box = ds.TetrahedralMesh.create_box((cells + 1, cells + 1, 2 * cells + 1), size=(0.2, 0.3, 0.3))
        bottom = np.isclose(box.vertices[:, 1], 0)
        errors.append(abs(areas_of(box)[bottom].sum() / 0.06 - 1))
    assert errors[0] < 0.3 and errors[1] < 0.6 * errors[0] and errors[2] < 0.6 * errors[1]


def test_areas_of_a_smooth_surface_add_up_to_it():
    errors = []
    for n in (5, 10):
        box = ds.TetrahedralMesh.create_box(n, size=2.0, origin=(-1, -1, -1))
        x = box.vertices
        far = np.linalg.norm(x, axis=1, keepdims=True)
        ball = np.divide(x * np.abs(x).max(1, keepdims=True), far, out=np.zeros_like(x), where=far > 0)
        errors.append(1 - areas_of(box, ball).sum() / (4 * np.pi))
    assert 0 < errors[1] < 0.4 * errors[0] and errors[1] < 0.1


def test_areas_turn_and_grow_with_the_body():
    mesh = ds.TetrahedralMesh.create_cube(resolution=3)
    x = mesh.vertices + 0.03 * np.random.default_rng(0).standard_normal(mesh.vertices.shape)
    turned = ds.TetrahedralMesh(x, mesh.tetrahedra).rotated((1.0, 2.0, 3.0), 0.7)
    np.testing.assert_allclose(areas_of(mesh, turned.vertices), areas_of(mesh, x), rtol=1e-12)
    np.testing.assert_allclose(areas_of(mesh, 2 * x), 4 * areas_of(mesh, x), rtol=1e-12)


# ---- contact does not depend on the mesh -----------------------------------------------------------------------------


def test_the_gap_under_a_cube_does_not_depend_on_its_mesh():
    """4, 9, 25 and 49 vertices on the floor, and the gap at which the pressure rho g h is carried."""
    gaps = []
    for resolution in (2, 3, 5, 7):
        mesh = ds.TetrahedralMesh.create_cube(resolution=resolution, size=0.2).translated((0, 0.008, 0))
        terms = [ds.Gravity(), ds.Drag(40.0), ds.Ground(stiffness_per_area=1e6, width=0.01)]
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), terms=terms, precision="f64")
        simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=0.02))
        simulator.run(50)
        gaps.append(simulator.positions[:, 1].min())
    assert max(gaps) < 1.01 * min(gaps)
    assert gaps[-1] == pytest.approx(resting_gap(1000 * 9.81 * 0.2, stiffness=1e6), rel=2e-3)


@pytest.mark.parametrize("solver", [*EXPLICIT, *FORCE, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_equal_areas_are_equal_stiffnesses(solver):
    """A regular tetrahedron, thrown onto a floor and a wall: `stiffness` of each vertex is that per area times the area."""
    mesh = ds.TetrahedralMesh(CORNERS + [0.105, 0.105, 0], [[0, 1, 2, 3]], fix_orientation=True)
    k, (area, *others) = 3e3, areas_of(mesh)
    np.testing.assert_allclose(others, area, rtol=1e-12)
    found = []
    for stiff in (dict(stiffness_per_area=k), dict(stiffness=k * area)):
        floor, wall = ds.Ground(width=0.02, **ROUGH, **stiff), ds.HalfSpace(normal=(1, 0, 0), width=0.02, **stiff)
        scene = ds.Scene(mesh, SOFT, 100.0, [ds.Gravity(), floor, wall], initial_velocities=[-0.3, -0.5, 0.4])
        rollout = ds.Rollout(solver(scene, dt=1e-3, substeps=2), 10, 5, gradients="all")
        frames = rollout.forward()
        w, z = np.random.default_rng(1).standard_normal((2, *frames.positions.shape))
        found.append((frames, rollout.vjp(frames, w, z)))
    (ours, by), (theirs, by_vertex) = found
    tolerance = dict(rtol=1e-9, atol=1e-11) if solver.explicit else dict(rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(ours.positions, theirs.positions, **tolerance)
    assert by["barrier_stiffness_per_area"] == pytest.approx(area * by_vertex["barrier_stiffness"], rel=1e-5)
    assert by["friction"] == pytest.approx(by_vertex["friction"], rel=1e-5)
    watched = (ours.contact_resolution, theirs.contact_resolution)
    assert watched[0].share == pytest.approx(watched[1].share, rel=1e-6)
    assert watched[0].omega_dt == pytest.approx(watched[1].omega_dt, rel=1e-6)


# ---- gradients ----------------------------------------------------------------------------------------------------------


@cache
def sliding(precision="f64", **options) -> ds.Scene:
    """A skewed cube that slides over a floor and a ball that moves, pushed by a wall whose stiffness is of each vertex."""
    mesh = ds.TetrahedralMesh.create_cube(2, size=0.2)
    rng = np.random.default_rng(2)
    mesh = ds.TetrahedralMesh(mesh.vertices + 0.005 * rng.standard_normal(mesh.vertices.shape), mesh.tetrahedra)
    terms = [
        ds.Gravity(),
        ds.Ground(-0.03, width=0.05, stiffness_per_area=3e3, **ROUGH),
        ds.Sphere((0, -0.13, 0), 0.1, width=0.04, stiffness_per_area=2e4, path=lambda t: [0.01 * t, 0.01 * t, 0]),
        ds.HalfSpace((-0.03, 0, 0), (1, 0, 0), width=0.05, stiffness=50.0),
    ]
    speed = dict(initial_velocities=[-0.3, -0.4, 0.5])
    return ds.Scene(mesh, ds.StableNeoHookean(2e4, 0.3), 500.0, terms, precision=precision, **speed, **options)


def sliding_rollout(solver, precision="f64") -> ds.Rollout:
    static = solver is ds.StaticSolver
    tolerance = {} if solver.explicit else dict(tolerance=1e-11 if precision == "f64" else 1e-5)
    held = dict(fixed=sliding().mesh.vertices[:, 1] > 0.15) if static else {}
    scene = sliding(precision) if not static else sliding().replace(**held)
    made = solver(scene, **tolerance) if static else solver(scene, dt=2e-3, substeps=2, **tolerance)
    return ds.Rollout(made, 1 if static else 4, 1 if static else 2, gradients="all")


ALL = [*EXPLICIT, FORCE[0], ds.ImplicitEulerSolver, ds.StaticSolver]


@pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py
@pytest.mark.parametrize("solver", ALL, ids=lambda s: s.__name__)
def test_tangents_and_adjoints_belong_together(solver):
    assert_transposed(sliding_rollout(solver), 1e-11 if solver.explicit else 1e-7)


@pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py
@pytest.mark.parametrize("solver", ALL, ids=lambda s: s.__name__)
def test_gradients_are_slopes(solver):
    """By the stiffnesses, and by the rest shape, which says how large the surface is."""
    rollout = sliding_rollout(solver)
    names = [name for name in rollout.wanted if "per_area" in name] + ["rest_positions", "barrier_stiffness"]
    assert len(names) == 4
    report = ds.check_gradients(rollout, inputs=names)
    assert report.passed, report


def on_a_needle(precision="f64", **options) -> ds.Rollout:
    """A cube whose bottom face, not its vertices, meets a needle."""
    mesh = ds.TetrahedralMesh.create_box(2, size=0.1).translated((0, -0.006, 0))
    scene = ds.Scene(mesh, SOFT, terms=[needle(**options)], initial_velocities=(0.1, -0.2, 0), precision=precision)
    tolerance = 1e-12 if precision == "f64" else 1e-6
    return ds.Rollout(ds.ImplicitEulerSolver(scene, dt=2e-3, tolerance=tolerance), 2, 1, gradients="all")


def test_faces_have_areas_too():
    rollout = on_a_needle(stiffness_per_area=1e7)
    assert_transposed(rollout, 1e-7, ("capsule_start",))  # its other end acts
    report = ds.check_gradients(rollout, inputs=["rest_positions", "barrier_stiffness_per_area", "barrier_width"])
    assert report.passed, report


# ---- what a scene says, and what it refuses -----------------------------------------------------------------------------


def test_the_scene_chooses_it_by_the_impact():
    """Per area, from the material and the speed alone: no mesh changes it."""
    chosen = []
    for resolution in (2, 4):
        mesh = ds.TetrahedralMesh.create_cube(resolution=resolution, size=0.2).translated((0, 0.05, 0))
        scene = ds.Scene(mesh, SOFT, terms=[ds.Gravity(), ds.Ground(width=0.01, name="floor")])
        assert "floor.stiffness_per_area [N/m^3]" in scene.describe() and "of Ground" in scene.describe()
        chosen.append(float(scene.inputs.values["floor.stiffness_per_area"]))
    assert chosen[0] == pytest.approx(chosen[1]) and chosen[0] > 0


PRESSING = {
    "muscle": (dict(terms=[ds.Muscle([0, 1, 0], 4e4, 0.0)]), 8e4),  # twice, for loads that are applied suddenly
    "muscle over time": (dict(terms=[ds.Muscle([0, 1, 0], 2e4, lambda t: 1.5 * t)]), 6e4),
    "pressure": (dict(terms=[ds.Pressure(3e4)]), 6e4),
    "traction": (dict(terms=[ds.Traction(lambda t: (0, -4e4 * t, 3e4 * t))]), 1e5),
    "body force": (dict(terms=[ds.BodyForce((0, -50.0, 0), per="mass")]), 2 * 1000 * 50 * 0.2),
    "force": (dict(terms=[ds.ExternalForce((0, -40.0, 0), vertices=[0, 1])]), 2 * 2 * 40 / 0.2**2),
    "two": (dict(terms=[ds.Pressure(3e4), ds.Muscle([0, 1, 0], 4e4, 0.0)]), 1.4e5),
}


@pytest.mark.parametrize("kind", PRESSING)
def test_the_scene_chooses_it_by_what_presses(kind):
    """k = (rho c v + ... + 2 p) / (1.19 w), p of all that can press."""
    options, pressure = PRESSING[kind]
    mesh = ds.TetrahedralMesh.create_cube(resolution=2, size=0.2).translated((0, 0.05, 0))

    def chosen(terms=()):
        scene = ds.Scene(mesh, SOFT, terms=[ds.Gravity(), ds.Ground(name="floor", width=0.01), *terms])
        return float(scene.inputs.values["floor.stiffness_per_area"])

    assert 1.19 * 0.01 * (chosen(options["terms"]) - chosen()) == pytest.approx(pressure, rel=1e-9)


def test_the_scene_chooses_it_by_what_moves():
    mesh = ds.TetrahedralMesh.create_cube(resolution=2, size=0.2).translated((0, 0.05, 0))
    still = ds.Scene(mesh, SOFT, terms=[ds.Ground(width=0.01, name="floor")], initial_velocities=(0, -0.8, 0))
    path = ds.Scene(mesh, SOFT, terms=[ds.Ground(width=0.01, name="floor", path=lambda t: [0, 0.8 * t, 0])])
    led = ds.Scene(
        mesh,
        SOFT,
        terms=[ds.Ground(width=0.01, name="floor")],
        fixed="ymax",
        motion=([0, 1], [[0, 0, 0], [0, -0.8, 0]]),
    )
    chosen = [float(scene.inputs.values["floor.stiffness_per_area"]) for scene in (still, path, led)]
    assert chosen[1:] == pytest.approx([chosen[0]] * 2)


def test_advice_is_in_the_unit_of_the_obstacle():
    mesh = ds.TetrahedralMesh.create_cube(resolution=2, size=0.2).translated((0, 0.0105, 0))
    for stiff, words in (
        (dict(stiffness_per_area=1e3), "stiffness_per_area to .* N/m\\^3"),
        (dict(stiffness=10.0), "N/m,"),
    ):
        floor = ds.Ground(width=0.01, **stiff)
        scene = ds.Scene(mesh, SOFT, terms=[floor], initial_velocities=(0, -3, 0))
        with (
            warnings.catch_warnings(),
            pytest.raises(ds.Crossing, match=f"raise its {words}|raise its stiffness to .*{words}"),
        ):
            warnings.simplefilter("ignore")
            solver = with_force(scene)
            ds.Simulator(solver).run(200)


def with_force(scene):
    return ds.VelocityVerletSolver(scene, dt=2e-4, contact="force")


@pytest.mark.backends
@pytest.mark.usefixtures("vertices_alone")  # Vulkan knows no other stage
@pytest.mark.parametrize("solver", [*EXPLICIT, FORCE[0]], ids=lambda s: s.__name__)
def test_backend_transpose_of_areas(solver):
    rollout = sliding_rollout(solver, "f32")
    assert ds.dot_product_test(rollout) <= 1e-5


@pytest.mark.backends
def test_backend_of_areas_in_implicit_steps():
    """A face on a needle stops as in float64 on a processor; without the needle it would go 0.8 mm down."""
    positions = on_a_needle("f32", stiffness_per_area=1e7).forward().positions
    assert (positions[-1] - positions[0])[:, 1].mean() == pytest.approx(-6.6162e-5, rel=1e-3)


def test_the_scene_chooses_the_width_by_the_smallest_body():
    """One per cent of its longest side, said in the scene's description; what is given stays, whatever the body."""
    small, tall = (ds.TetrahedralMesh.create_box(2, size) for size in ((0.02, 0.01, 0.01), (0.3, 2.0, 0.3)))
    both = ds.TetrahedralMesh.joined({"small": small, "tall": tall.translated((1.0, 0, 0))}).translated((0, 0.7, 0))
    corners, closed = TABLE.vertices - [0, 2, 0], TABLE.surface_triangles
    own = ds.Sphere((0, -9, 0), 1.0, stiffness=1.0, width=0.5)
    terms = [ds.Ground(), ds.MeshObstacle(corners, closed, resolution=4, stiffness=1.0), own, ds.SelfContact()]
    assert "barrier_width=chosen by the scene" in repr(terms[0]) and "width=chosen" not in repr(own)
    for mesh, size in ((small.translated((0, 1, 0)), 0.02), (tall.translated((0, 1, 0)), 2.0), (both, 0.02)):
        scene = ds.Scene(mesh, SOFT, terms=[ds.Gravity(), *terms])
        values = scene.inputs.values
        assert values["barrier_width"] == values["barrier_width_2"] == pytest.approx(0.01 * size, rel=1e-12)
        assert values["barrier_width_3"] == 0.5 and values["self_contact_width"] == pytest.approx(
            0.01 * size, rel=1e-12
        )
        assert f"barrier_width={0.01 * size:g}" in scene.describe()
        given = ds.MeshObstacle(corners, closed, resolution=4, stiffness=1.0, width=0.01 * size)
        assert np.array_equal(scene.terms[2].table, given.table)
    again = scene.replace(mesh=tall.translated((0, 1, 0)))  # it is chosen anew
    assert again.inputs.values["barrier_width"] == pytest.approx(0.02)


TABLE = ds.TetrahedralMesh.create_cube(resolution=2)
