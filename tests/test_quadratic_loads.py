"""Loads on surfaces and volumes of ten-node tetrahedra: integrals with the shape functions of whole faces, exactly."""

import numpy as np
import pytest
from chamber_meshes import hollow_cube, pitted_cube
from quadratic_meshes import box, crumpled, face_rule, renumbered, ring, six, six_by, wavy, with_vertices
from test_every_adjoint import assert_transposed

import diffsim_ti as ds
from diffsim_ti.differentiation.arrays import Recorded, forward, reverse
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.mechanics.pressure.follower_pressure import FollowerPressure, is_symmetric
from diffsim_ti.mechanics.pressure.interaction import Pressures
from diffsim_ti.mesh import reference_face
from diffsim_ti.mesh.face_points import face_points
from diffsim_ti.terms import Chamber

LAW = ds.StableNeoHookean(1e5, 0.3)
CURVED = pytest.mark.parametrize("make", [wavy, crumpled, lambda: ring(2)], ids=["wavy", "crumpled", "ring"])
EXPLICIT = pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver], ids=lambda s: s.__name__)


def derived(scene):
    return scene.inputs.derive(scene.inputs.values)


def dead_forces(mesh, *terms) -> np.ndarray:
    """Of a scene's dead loads, for each vertex."""
    scene = ds.Scene(mesh, LAW, terms=terms, precision="f64")
    out = np.zeros_like(mesh.vertices)
    out[scene.interaction(DeadLoads).acts_at] = derived(scene).forces[0]
    return out


def on_faces(mesh, faces, x=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(shape functions, normals as long as their share, places) by a fine rule, at places x of the vertices."""
    L, weights = face_rule()
    nodes = (mesh.vertices if x is None else x)[faces]
    tangents = np.einsum("qad,fai->fqid", six_by(L), nodes)
    normals = np.cross(tangents[..., 0], tangents[..., 1]) / 2 * weights[:, None]
    return six(L), normals, np.einsum("qa,fai->fqi", six(L), nodes)


# The rule


def test_the_rule_on_faces_is_exact_to_degree_four():
    (s, t), (L, fine) = reference_face.POINTS.T, face_rule()
    for i in range(5):
        for j in range(5 - i):
            exact = fine @ (L[:, 1] ** i * L[:, 2] ** j)
            assert reference_face.WEIGHTS @ (s**i * t**j) == pytest.approx(exact, rel=1e-14)
    assert np.allclose(reference_face.functions(L[:, 1:]), six(L)) and np.all(reference_face.WEIGHTS > 0)
    assert np.allclose(reference_face.derivatives(L[:, 1:]), six_by(L))


@pytest.mark.parametrize("make", [lambda: box(), wavy], ids=["triangles", "six nodes"])
def test_normals_of_points_and_their_derivatives(make):
    mesh, rng = make(), np.random.default_rng(0)
    points, X = face_points(mesh.surface_faces), mesh.vertices
    dX, w = rng.normal(size=X.shape), rng.normal(size=(len(mesh.surface_faces) * points.points, 3))
    difference = (points.normals(X + 1e-6 * dX) - points.normals(X - 1e-6 * dX)) / 2e-6
    by_nodes = points.normals_by_nodes(X).reshape(-1, mesh.surface_faces.shape[1], 3, 3)
    at = np.repeat(dX[mesh.surface_faces], points.points, 0)
    np.testing.assert_allclose(np.einsum("pbij,pbj->pi", by_nodes, at), difference, atol=1e-8)
    leaf = Recorded(X)
    normals = points.normals(leaf)
    np.testing.assert_allclose(forward(normals, [(leaf, dX)]), difference, atol=1e-8)
    (by_X,) = reverse(normals, w, [leaf])
    assert (by_X * dX).sum() == pytest.approx((w * forward(normals, [(leaf, dX)])).sum(), rel=1e-12)


# Dead loads


def test_a_traction_on_flat_faces_acts_at_mid_edge_vertices():
    mesh = box().quadratic()
    f = dead_forces(mesh, ds.Traction([1.0, 2, 3], "xmax"))
    faces = mesh.faces_of("xmax")
    area = np.zeros(mesh.num_vertices)
    corners = mesh.vertices[faces[:, :3]]
    sizes = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    for k in (3, 4, 5):
        np.add.at(area, faces[:, k], sizes / 3)
    np.testing.assert_allclose(f, area[:, None] * [1, 2, 3], atol=1e-15)
    assert f.sum(0) == pytest.approx(3.0 * np.array([1, 2, 3]), rel=1e-14)


@CURVED
def test_a_traction_does_the_work_of_its_integral(make):
    """On curved faces the area is no polynomial; the rule's error is far below that of the shape."""
    mesh, rng = make(), np.random.default_rng(1)
    name = "lid" if "lid" in mesh.surface_sets else None
    t, w = rng.normal(size=3), rng.normal(size=mesh.vertices.shape)
    N, normals, _ = on_faces(mesh, mesh.faces_of(name))
    moved = np.einsum("qa,fai->fqi", N, w[mesh.faces_of(name)])
    exact = (np.linalg.norm(normals, axis=2) * (moved @ t)).sum()
    assert (dead_forces(mesh, ds.Traction(t, name)) * w).sum() == pytest.approx(exact, rel=2e-3)
    whole = np.linalg.norm(normals, axis=2).sum()
    assert dead_forces(mesh, ds.Traction(t, name)).sum(0) == pytest.approx(whole * t, rel=1e-4)


def test_loads_act_on_whole_faces():
    mesh = box().quadratic()
    for load in (
        ds.Traction([1.0, 0, 0], [0, 1, 2]),
        ds.Pressure(1.0, np.arange(6)),
        ds.ElasticFoundation(1.0, 0.0, [5]),
    ):
        with pytest.raises(
            ValueError, match=r"loads act on whole faces: of face \d, rows \d\.\.\d of surface_triangles, . of 4"
        ):
            ds.Scene(mesh, LAW, terms=load)
    given = ds.ElasticFoundation(np.ones(7), 0.0, "xmin")
    with pytest.raises(ValueError, match="normal has 7 numbers for 12 faces; give one or 12"):
        ds.Scene(mesh, LAW, terms=given)


@pytest.mark.parametrize("per", ["volume", "mass"])
def test_body_forces_on_curved_elements(per):
    mesh = wavy()
    f = dead_forces(mesh, ds.BodyForce([1.0, -2, 3], "core", per))
    scale = 1000.0 if per == "mass" else 1.0
    assert f.sum(0) == pytest.approx(scale * mesh.volumes[[1, 2, 3]].sum() * np.array([1, -2, 3]), rel=1e-13)
    assert np.array_equal(np.nonzero(f.any(1))[0], np.unique(mesh.elements[[1, 2, 3]]))


@EXPLICIT
def test_a_body_moves_rigidly_under_a_body_force(solver):
    scene = ds.Scene(wavy(), LAW, terms=ds.BodyForce([0.0, -9810.0, 0]), precision="f64")
    moved = ds.Rollout(solver(scene, 2e-3, 8), 5).forward().positions[-1] - scene.mesh.vertices
    assert np.ptp(moved, axis=0).max() < 1e-13 and moved[0, 1] < -1e-4


def test_a_foundation_gives_way_evenly():
    """A body on springs under a traction on its back sinks by t / c, and shortens evenly: loads on faces are consistent."""
    mesh = box().quadratic()
    terms = [ds.ElasticFoundation(2e4, 1e4, "xmin"), ds.Traction([-300.0, 0, 0], "xmax")]
    scene = ds.Scene(mesh, ds.LinearElastic(1e6, 0.0), terms=terms, precision="f64")
    K = derived(scene).foundation.reshape(-1, 3, 3)
    assert K.sum(0) == pytest.approx(3.0 * np.diag([2e4, 1e4, 1e4]), rel=1e-13)
    u = ds.Rollout(ds.StaticSolver(scene), 1).forward().positions[-1] - mesh.vertices
    exact = np.stack([-300 / 2e4 - 300 / 1e6 * mesh.vertices[:, 0], *np.zeros((2, mesh.num_vertices))], 1)
    np.testing.assert_allclose(u, exact, atol=1e-9)


# Pressures that follow


@CURVED
def test_pressure_on_a_closed_surface_is_minus_p_dv_dx(make):
    mesh, rng = renumbered(make(), 2)[0], np.random.default_rng(3)
    pressure = FollowerPressure(mesh.surface_faces, np.zeros(len(mesh.surface_faces), int), mesh.num_vertices).at([7.0])
    x, w = mesh.vertices + 0.005 * rng.normal(size=mesh.vertices.shape), rng.normal(size=mesh.vertices.shape)

    def volume(x):
        _, normals, places = on_faces(mesh, mesh.surface_faces, x)
        return (normals * places).sum() / 3

    slope = (volume(x + 1e-5 * w) - volume(x - 1e-5 * w)) / 2e-5
    assert (pressure.forces(x) * w).sum() == pytest.approx(-7 * slope, rel=1e-8)
    difference = (pressure.forces(x + 1e-5 * w) - pressure.forces(x - 1e-5 * w)) / 2e-5
    np.testing.assert_allclose(pressure.jvp(x, w), difference, atol=1e-8 * np.abs(difference).max())
    v = rng.normal(size=x.shape)
    assert (pressure.vjp(x, v)[0] * w).sum() == pytest.approx((pressure.jvp(x, w) * v).sum(), rel=1e-11)
    tangent = pressure.tangent(x)
    np.testing.assert_allclose(tangent(w), pressure.jvp(x, w), atol=1e-13 * np.abs(difference).max())
    np.testing.assert_allclose(tangent.T(v), pressure.vjp(x, v)[0], atol=1e-13 * np.abs(difference).max())
    assert (pressure.jvp(x, v) * w).sum() == pytest.approx((pressure.jvp(x, w) * v).sum(), rel=1e-9)  # symmetric
    assert pressure.work(x, 0.1 * w) == pytest.approx(-7 * (volume(x + 0.1 * w) - volume(x)), rel=1e-11)


def test_pressure_on_a_part_is_the_integral_of_its_shape_functions():
    mesh, rng = wavy(), np.random.default_rng(4)
    faces, x = mesh.faces_of("lid"), mesh.vertices + 0.02 * rng.normal(size=mesh.vertices.shape)
    N, normals, _ = on_faces(mesh, faces, x)
    exact = np.zeros_like(x)
    np.add.at(exact, faces, -3.0 * np.einsum("qa,fqi->fai", N, normals))
    pressure = FollowerPressure(faces, np.zeros(len(faces), int), mesh.num_vertices).at([3.0])
    np.testing.assert_allclose(pressure.forces(x), exact, atol=1e-13)
    free = np.tile(np.eye(3), (mesh.num_vertices, 1, 1))
    load_of = np.zeros(len(faces), int)
    assert not is_symmetric(faces, load_of, free, mesh.vertices)
    free[mesh.vertex_indices("lid")] = 0
    assert is_symmetric(faces, load_of, free, mesh.vertices)


@EXPLICIT
def test_explicit_steps_have_the_same_pressure(solver):
    """The first acceleration is that of the host's forces."""
    mesh, h = wavy(), 1e-7
    terms = [ds.Pressure(2e4, "lid", name="a"), ds.Pressure(-1e4, "xmin", name="b")]
    scene = ds.Scene(mesh, LAW, terms=terms, precision="f64")
    u = 0.01 * np.random.default_rng(5).normal(size=mesh.vertices.shape)
    moved = ds.Scene(mesh, LAW, terms=terms, precision="f64", initial_positions=mesh.vertices + u)
    bare = ds.Scene(mesh, LAW, precision="f64", initial_positions=mesh.vertices + u)
    both = [ds.Rollout(solver(s, h), 1).forward().velocities[-1] for s in (moved, bare)]
    pressed = scene.interaction(Pressures)
    force = (
        FollowerPressure(pressed.faces, pressed.load_of, mesh.num_vertices).at([2e4, -1e4]).forces(mesh.vertices + u)
    )
    found = (both[0] - both[1]) / h * derived(scene).mass[:, None]
    np.testing.assert_allclose(found, force, atol=1e-6 * np.abs(force).max())


# Everything at once, both ways


def loaded(precision="f64", closed=False) -> ds.Scene:
    """A curved body under every load, over time, with numbers of each tetrahedron and each face; also muscles, growth, a
    fluid and a frame that rotates."""
    rng = np.random.default_rng(6)
    mesh = ds.TetrahedralMesh.create_box((2, 2, 2), 0.2).quadratic()
    mesh = crumpled(0.003, mesh=mesh)
    count = len(mesh.faces_of("ymin"))
    terms = [
        ds.Traction(100 * rng.normal(size=(3, 3)), "xmax"),
        ds.Pressure((np.array([0.0, 1.0]), np.array([200.0, 500.0])), None if closed else "ymax"),
        ds.Pressure(300.0, None if closed else ["zmin", "ymax"], name="two"),
        ds.BodyForce([10.0, -20, 5], per="mass"),
        ds.BodyForce(50 * rng.normal(size=(3, 3))),
        ds.ElasticFoundation(2e4 * rng.uniform(0.5, 1, count), 1e4 * rng.uniform(0.5, 1, count), "ymin"),
        ds.Gravity(),
        ds.Muscle([1, 0.2, 0], 2e3, (np.array([0.0, 0.003, 0.1]), np.array([0.2, 0.6, 1.0]))),
        ds.Growth(0.02 * rng.uniform(size=mesh.num_tetrahedra), per="tetrahedron"),
        ds.SurfaceDrag(900.0, 1.2, 0.3, [0.4, -0.2, 0.1], name="fluid"),
        ds.RotatingFrame([1.0, 2.0, -3.0], [0.3, 0.1, -0.2]),
    ]
    start = mesh.vertices + 0.002 * rng.normal(size=mesh.vertices.shape)
    return ds.Scene(
        mesh, ds.StableNeoHookean(1e4, 0.3), 800.0, terms, fixed="xmin", precision=precision, initial_positions=start
    )


@EXPLICIT
def test_explicit_adjoints_are_the_transposes_of_tangents(solver):
    assert_transposed(ds.Rollout(solver(loaded(), 2e-3, 4), 3, gradients="all"), 1e-12)


@pytest.mark.parametrize("solver", [ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver], ids=lambda s: s.__name__)
@pytest.mark.parametrize("closed", [False, True])
def test_implicit_adjoints_are_the_transposes_of_tangents(solver, closed):
    assert_transposed(ds.Rollout(solver(loaded(closed=closed), 5e-3, tolerance=1e-11), 3, gradients="all"), 1e-8)


def test_gradients_are_those_of_differences():
    rollout = ds.Rollout(ds.VelocityVerletSolver(loaded(), 2e-3, 4), 3, gradients="all")
    report = ds.verify.check_gradients(rollout, ds.verify.linear_loss(rollout))
    assert report.passed, str(report)


@pytest.mark.parametrize("closed", [False, True])
def test_adjoints_of_equilibria_are_the_transposes_of_tangents(closed):
    scene = loaded(closed=closed)
    scene = scene.replace(terms=[term for term in scene.terms if not isinstance(term, ds.SurfaceDrag)])  # of velocities
    assert_transposed(ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 2, gradients="all"), 1e-8)


# Chambers


def curved(mesh, size=0.006) -> ds.TetrahedralMesh:
    """Ten-node tetrahedra whose edges are bent at random, but for what lies in the plane z = 0, which stays there."""
    mesh = mesh.quadratic()
    moved = size * np.random.default_rng(8).uniform(-1, 1, mesh.vertices.shape)
    moved[mesh.vertices[:, 2] < 1e-9, 2] = 0
    return with_vertices(mesh, mesh.vertices + moved)


def hollow(terms) -> ds.Scene:
    return ds.Scene(curved(hollow_cube()), LAW, 1000.0, terms, fixed="bottom", precision="f64")


def pitted(terms) -> ds.Scene:
    """Its rim slides in a plane, with curved edges."""
    mesh = pitted_cube()
    mesh = curved(mesh.with_vertex_set("wall", mesh.vertices[:, 0] < 0.02))
    return ds.Scene(mesh, LAW, 1000.0, terms, fixed={"cut": "z", "wall": "xy"}, precision="f64")


GAS = dict(pressure=1.1 * 101325, surface="cavity", exponent=1.3, name="gas")


@pytest.mark.parametrize("make", [hollow, pitted])
def test_chambers_have_the_volume_of_their_curved_faces(make):
    scene = make([ds.GasChamber(**GAS)])
    mesh, rng = scene.mesh, np.random.default_rng(9)
    x = mesh.vertices + scene.supports.free(0.01 * rng.normal(size=mesh.vertices.shape))
    _, normals, places = on_faces(mesh, mesh.faces_of("cavity"), x)  # what is open lies in z = 0, as the origin does
    assert scene.chamber_volume("gas", x) == pytest.approx(-(normals * places).sum() / 3, rel=1e-12)
    enclosure, w = scene.terms_of(Chamber)[0].enclosure, scene.supports.free(rng.normal(size=x.shape))
    slope = (enclosure.volume(x + 1e-5 * w) - enclosure.volume(x - 1e-5 * w)) / 2e-5
    gradient = (enclosure.gradient(x) * w).sum()
    assert gradient == pytest.approx(slope, rel=1e-6)
    faces = mesh.faces_of("cavity")
    push = FollowerPressure(faces, np.zeros(len(faces), int), mesh.num_vertices).at([1.0]).forces(x)
    assert (push * w).sum() == pytest.approx(gradient, rel=1e-11)


@pytest.mark.parametrize("make", [pytest.param(hollow, marks=pytest.mark.thorough), pitted])
@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitMidpointSolver], ids=lambda s: s.__name__)
def test_every_number_of_a_gas(make, solver):
    scene = make([ds.GasChamber(**GAS | dict(pressure=1.1 * 101325 * np.array([1.0, 1.1])))])
    options = dict(dt=5e-5, substeps=2) if solver.explicit else dict(dt=2e-3, tolerance=1e-12)
    rollout = ds.Rollout(solver(scene, **options), 2, gradients="all")
    assert_transposed(rollout, 1e-11 if solver.explicit else 1e-8)


@pytest.mark.parametrize("make", [hollow, pitted])
def test_explicit_steps_have_the_gas(make):
    scene, bare, h = make([ds.GasChamber(**GAS)]), make([]), 1e-7
    u = scene.supports.free(0.002 * np.random.default_rng(9).normal(size=scene.mesh.vertices.shape))
    moved = [
        ds.Scene(
            s.mesh,
            LAW,
            1000.0,
            s.terms,
            fixed="bottom" if make is hollow else {"cut": "z", "wall": "xy"},
            initial_positions=s.mesh.vertices + u,
            precision="f64",
        )
        for s in (scene, bare)
    ]
    both = [ds.Rollout(ds.SemiImplicitSolver(s, h), 1).forward().velocities[-1] for s in moved]
    chamber, x = scene.terms_of(Chamber)[0].enclosure, scene.mesh.vertices + u
    p = 1.1 * 101325 * (chamber.volume(scene.mesh.vertices) / chamber.volume(x)) ** 1.3 - 101325
    force = scene.supports.free(p * chamber.gradient(x))
    found = (both[0] - both[1]) / h * derived(scene).mass[:, None]
    np.testing.assert_allclose(found, force, atol=1e-5 * np.abs(force).max())
