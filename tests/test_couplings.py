"""Remote points, relations between places and fits, against closed forms; forces and moments in balance."""

import numpy as np
import pytest
from quadratic_meshes import ring, with_vertices

import diffsim_ti as ds
from diffsim_ti.inputs.loads import RemoteForces

L, R, E, NU = 1.0, 0.05, 1e7, 0.3


def rod(cells=8) -> ds.TetrahedralMesh:
    """A rod along x of a circular section, of curved ten-node tetrahedra."""
    box = ds.TetrahedralMesh.create_box((cells + 1, 5, 5), (L, 2, 2), "five", (0, -1, -1))
    side = np.abs(box.quadratic().vertices[:, 1:]).max(1) > 1 - 1e-9
    x, y, z = box.vertices.T
    scale = R * np.maximum(np.abs(y), np.abs(z)) / np.maximum(np.hypot(y, z), 1e-9)
    mesh = with_vertices(box, np.stack([x, scale * y, scale * z], 1)).quadratic()
    places = np.array(mesh.vertices)
    places[side, 1:] *= R / np.linalg.norm(places[side, 1:], axis=1)[:, None]
    return with_vertices(mesh, places)


def solved(scene, *outputs) -> ds.Frames:
    return ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1, outputs=outputs).forward()


def test_a_rod_is_twisted_and_bent_by_moments_on_its_face():
    mesh, T = rod(), np.array([0.05, 0.0, 0.02])  # torque, and moment about z [N m]
    scene = ds.Scene(
        mesh, ds.LinearElastic(E=E, nu=NU), terms=ds.RemoteLoad((0, 0, 0, *T), "xmax"), fixed="xmin", precision="f64"
    )
    frames = solved(scene, ds.Reaction(about=(0, 0, 0), name="moment"), ds.Reaction())
    u = frames.displacements[-1]
    end, middle = mesh.vertex_sets["xmax"], np.argmin(np.linalg.norm(mesh.vertices - [L, 0, 0], axis=1))
    y, z = mesh.vertices[end, 1:].T
    turn = (y * u[end, 2] - z * u[end, 1]).sum() / (y**2 + z**2).sum()
    assert turn == pytest.approx(T[0] * L / (E / (2 + 2 * NU) * np.pi * R**4 / 2), rel=0.02)  # G J
    assert u[middle, 1] == pytest.approx(T[2] * L**2 / (2 * E * np.pi * R**4 / 4), rel=0.02)  # E I
    assert np.abs(frames["reaction"][-1]).max() < 1e-10 * T[0] / R
    assert frames["moment"][-1] == pytest.approx(-T, abs=1e-4 * T[0])  # about places that have moved a little


def test_forces_of_a_remote_load_sum_to_it():
    mesh, rng = rod(2), np.random.default_rng(0)
    X, load, point = (
        mesh.vertices + 1e-4 * rng.standard_normal((mesh.num_vertices, 3)),
        rng.standard_normal(6),
        rng.random(3),
    )
    term = ds.RemoteLoad(load, "xmax", point)
    scene = ds.Scene(mesh, ds.LinearElastic(E=E, nu=NU), terms=term, fixed="xmin", precision="f64")
    forces = scene.inputs.derive(scene.inputs.values | {"rest_positions": X}).forces[0]
    at = X[np.unique(mesh.faces_of("xmax"))]
    np.testing.assert_allclose(forces.sum(0), load[:3], atol=1e-13)
    np.testing.assert_allclose(np.cross(at - point, forces).sum(0), load[3:], atol=1e-13)


def test_a_face_is_lifted_level_by_relations_and_balances():
    mesh, lift = ds.TetrahedralMesh.create_box((7, 3, 3), (0.6, 0.1, 0.1)).quadratic(), 0.01
    mean = ds.MultiPointConstraint.mean
    terms = [
        mean(mesh, "xmax", (0, 1, 0), ([0.0, 1.0], [0.0, lift])),
        mean(mesh, "xmax", (0, 0, 1), turn=True, name="level"),
    ]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), terms=terms, fixed="xmin", precision="f64")
    frames = solved(scene, ds.Reaction(), ds.SectionForce((0.3, 0, 0), (1, 0, 0)))
    u = frames.displacements[-1][np.unique(mesh.faces_of("xmax"))]
    a, b = (scene.inputs.values[name].reshape(-1, 3) for name in ("constraint_coefficients", "level.coefficients"))
    assert (a * u).sum() == pytest.approx(lift, rel=1e-12) and (b * u).sum() == pytest.approx(0, abs=1e-12)
    bending, shear = 0.6**3 / (12 * 1e6 * 0.1**4 / 12), 0.6 / (5 / 6 * 1e6 / 2.6 * 0.1**2)
    assert -frames["reaction"][-1, 1] == pytest.approx(lift / (bending + shear), rel=0.05)  # the clamp stiffens
    assert np.abs(frames["section_force"][-1, 1]) == pytest.approx(-frames["reaction"][-1, 1], rel=1e-6)


def test_derivatives_of_forces_at_remote_points():
    mesh, rng = rod(2), np.random.default_rng(0)
    vertices = np.unique(mesh.faces_of("xmax"))
    for point in (None, rng.random(3)):
        link = RemoteForces("load", "areas", vertices, point, "forces")
        shapes = (2, 3, 6), mesh.vertices.shape, len(vertices)
        x = [rng.standard_normal(shapes[0]), mesh.vertices, rng.random(shapes[2]) + 0.5]
        dx, w = [rng.standard_normal(shape) for shape in shapes], rng.standard_normal((2, 3, len(vertices), 3))
        h, dy = 1e-7, link.jvp(x, dx)[0]
        ends = [link.value(*(a + s * h * b for a, b in zip(x, dx)))[0] for s in (1, -1)]
        np.testing.assert_allclose(dy, (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-6 * np.abs(dy).max())
        pulled = sum((a * b).sum() for a, b in zip(dx, link.vjp(x, [w])))
        assert pulled == pytest.approx((w * dy).sum(), rel=1e-10)


@pytest.mark.parametrize("kind", [ds.StaticSolver, ds.ImplicitEulerSolver, ds.VelocityVerletSolver])
def test_gradients(kind):
    mesh, rng = ds.TetrahedralMesh.create_box((3, 2, 2), 0.1), np.random.default_rng(1)
    explicit, free = kind is ds.VelocityVerletSolver, np.flatnonzero(mesh.vertices[:, 0] > 0)
    mean = ds.MultiPointConstraint.mean(mesh, "xmax", (0, 1, 0), ([0.0, 2.0], [0.0, 2e-3]), name="mean")
    soft = ds.MultiPointConstraint(
        [*free[:2], 0], rng.standard_normal((3, 3)), [2e-5, 1e-5], stiffness=1e4, name="soft"
    )
    terms = [ds.RemoteLoad(([0.0, 1.0], 0.1 * rng.standard_normal((2, 6))), "xmax", rng.random(3)), mean]
    terms += [ds.MultiPointConstraint(free[[0, 3, 5]], rng.standard_normal((3, 3)), [2e-5, 1e-5])]
    terms += [] if explicit else [soft]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e4, 0.3), terms=terms, fixed="xmin", precision="f64")
    options = {} if explicit else dict(tolerance=1e-13)
    rollout = ds.Rollout(kind(scene, dt=1e-3, **options), 2, gradients="all")
    assert ds.dot_product_test(rollout) < 1e-9
    u, c = rollout.forward().displacements, scene.inputs.values["mean.coefficients"].reshape(-1, 3)
    along = (c * u[:, np.unique(mesh.faces_of("xmax"))]).sum((1, 2))
    np.testing.assert_allclose(along, [0, 2e-3 * rollout.solver.dt], atol=1e-15)
    names = ["constraint_value", "constraint_coefficients", "mean.coefficients"]
    names += [] if explicit else ["soft.stiffness", "soft.coefficients", "remote_load"]
    if kind is not ds.ImplicitEulerSolver:
        assert ds.check_gradients(rollout, inputs=names).passed


@pytest.mark.parametrize(
    "relations, words",
    [
        ([[0, 9], [[1, 0, 0], [0, 1, 0]]], "along directions in which they are fixed: leave them out"),
        ([[9], [[0, 1, 0]]], "follow from each other: leave one out"),
    ],
)
def test_relations_that_cannot_be_held(relations, words):
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), 0.1)
    terms = [ds.MultiPointConstraint(*relations), ds.MultiPointConstraint([9], [[0, 2.0, 0]], name="another")]
    with pytest.raises(ValueError, match=words):
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e4, 0.3), terms=terms, fixed="xmin")
        ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-4))


def test_two_rings_that_are_shrunk_on_each_other():
    """Radii 1, 1.5, 2, glued where they meet; the inner one would be larger by 0.1 %: pressure and radii of Lame."""

    def bent(a: float, b: float) -> ds.TetrahedralMesh:
        mesh = ring(4)  # of radii 1 and 2
        x, y, z = mesh.vertices.T
        r = np.hypot(x, y)
        grown = (a + (b - a) * (r - 1)) / r
        return with_vertices(mesh, np.stack([grown * x, grown * y, 0.25 * z], 1))

    mesh = ds.TetrahedralMesh.joined({"shaft": bent(1.0, 1.5), "hub": bent(1.5, 2.0)})
    shrink, nu = 1e-3, 0.3
    growth = np.zeros(mesh.num_tetrahedra)
    growth[mesh.tetrahedron_sets["shaft"]] = shrink
    fixed = {
        f"{part}_{side}": axis
        for part in ("shaft", "hub")
        for side, axis in (("ymin", "y"), ("ymax", "x"), ("zmin", "z"))
    }
    tie = ds.Tie("shaft_xmax", "hub_xmin")
    scene = ds.Scene(mesh, ds.Grown(ds.LinearElastic(E=1.0, nu=nu), growth), terms=[tie], fixed=fixed, precision="f64")
    u = solved(scene).displacements[-1]
    radius = np.hypot(*mesh.vertices[:, :2].T)
    radial = (u[:, :2] * mesh.vertices[:, :2]).sum(1) / radius
    # plane stress: the ends are free
    a, b, c = 1.0, 1.5, 2.0
    softness = lambda lo, hi, sign: (hi**2 + lo**2) / (hi**2 - lo**2) + sign * nu  # noqa: E731
    p = shrink / (softness(b, c, 1) + softness(a, b, -1))
    at_c = 2 * p * b**2 * c / (c**2 - b**2)
    assert radial[radius > 2 - 1e-9].mean() == pytest.approx(at_c, rel=0.01)
    at_a = shrink * a - 2 * p * a * b**2 / (b**2 - a**2)
    assert radial[radius < 1 + 1e-9].mean() == pytest.approx(at_a, rel=0.01)


E_RING, BORE, FIT, RIM, HEIGHT, SECTOR = 1e6, 1.0, 1.5, 2.0, 0.1, np.radians(10)


def rings(over: float, cells: int = 5) -> ds.TetrahedralMesh:
    """A sector of a shaft and of a hub; the shaft's radius is larger than that of the hole by `over`."""

    def sector(low, high):
        box = ds.TetrahedralMesh.create_box((cells + 1, 2, 2), (1, 1, HEIGHT), "five")
        s, t, z = box.vertices.T
        r, angle = low + (high - low) * s, SECTOR * (t - 0.5)
        return with_vertices(box, np.stack([r * np.cos(angle), r * np.sin(angle), z], 1))

    return ds.TetrahedralMesh.joined({"shaft": sector(BORE, FIT + over), "hub": sector(FIT, RIM)})


@pytest.mark.filterwarnings("ignore:static solve. surfaces overlap")
def test_a_press_fit_by_contact_and_what_friction_holds_of_it():
    """Parts that overlap in the mesh: pressure and radii of Lame, the pressure's slope by the overlap; then the shaft is
    pushed along the axis until it slides."""
    over, mu = 1.5e-3, 0.2
    mesh, n = rings(over), np.array([np.sin(SECTOR / 2), np.cos(SECTOR / 2), 0])
    sides = dict(ymax=n * [-1, 1, 1], ymin=n, zmin="z")
    fixed = {f"{part}_{side}": how for part in ("shaft", "hub") for side, how in sides.items()}
    push = {"shaft_zmin": ([0.0, 1.0, 2.0], [[0, 0, 0], [0, 0, 0], [0, 0, 1e-3]])}
    contact = ds.SelfContact(stiffness=1e5, width=1e-5, friction=mu, friction_speed=1e-6)
    scene = ds.Scene(
        mesh, ds.LinearElastic(E=E_RING, nu=NU), terms=[contact], fixed=fixed, motion=push, precision="f64"
    )
    outputs = [ds.SelfContactForce("shaft")]
    solver = ds.StaticSolver(scene, tolerance=1e-10)
    frames = ds.Rollout(solver, 2, save_every=1, outputs=outputs).forward()
    softness = lambda lo, hi, sign: (hi**2 + lo**2) / (hi**2 - lo**2) + sign * NU  # noqa: E731
    pressure = E_RING * over / FIT / (softness(FIT, RIM, 1) + softness(BORE, FIT, -1))
    area, across = HEIGHT * SECTOR * FIT, 2 * np.sin(SECTOR / 2) / SECTOR
    first, second = frames["self_contact_force"][1:]
    assert first[0] == pytest.approx(-pressure * area * across, rel=0.01)
    assert np.abs(first[1:]).max() < 5e-3 * pressure * area  # faces of tetrahedra are no mirror images
    radius = np.hypot(*mesh.vertices[:, :2].T)
    radial = (frames.displacements[1, :, :2] * mesh.vertices[:, :2]).sum(1) / radius
    grown = 2 * pressure / E_RING * FIT**2 * RIM / (RIM**2 - FIT**2)
    assert radial[radius > RIM - 1e-9].mean() == pytest.approx(grown, rel=0.01)
    assert second[2] == pytest.approx(-mu * pressure * area, rel=0.02)
    fit = ds.Rollout(solver, 1, outputs=outputs, gradients=["rest_positions", "initial_positions"])
    by, d = fit.vjp(fit.forward(), self_contact_force=np.array([[0, 0, 0], [1.0, 0, 0]])), 1e-6
    ends = [rings(over + e).vertices for e in (d, -d)]
    exact = ((by["rest_positions"] + by["initial_positions"]) * (ends[0] - ends[1])).sum()
    values = [fit.forward(rest_positions=X, initial_positions=X)["self_contact_force"][1, 0] for X in ends]
    assert exact == pytest.approx(values[0] - values[1], rel=1e-5)
    assert exact == pytest.approx(2 * d * first[0] / over, rel=0.01)


def test_bodies_are_pressed_apart_whatever_is_far_away():
    cube, found = ds.TetrahedralMesh.create_cube(2, size=0.1), []
    for others in ([], [cube.translated([7.0, 0, 0])]):
        mesh = ds.TetrahedralMesh.joined([cube, cube.translated([0.003, 0.0995, 0.001]), *others])
        fixed = ["body_0_ymin", "body_1_ymax", *(["body_2_ymin"] * len(others))]
        scene = ds.Scene(mesh, ds.LinearElastic(E=1e5, nu=NU), terms=[ds.SelfContact(1e4, 1e-3)], fixed=fixed)
        with pytest.warns(UserWarning, match="surfaces overlap by up to 0.0005 m"):
            found.append(ds.Rollout(ds.StaticSolver(scene), 1).forward().displacements[-1])
    alone, beside = found[0], found[1][: len(found[0])]
    np.testing.assert_allclose(beside, alone, atol=1e-4 * np.abs(alone).max())
    assert np.abs(alone).max() > 1e-4 and not found[1][len(alone) :].any()


def test_bodies_that_overlap_far_are_refused():
    cube = ds.TetrahedralMesh.create_cube(2, size=0.1)
    mesh = ds.TetrahedralMesh.joined([cube, cube.translated([0, 0.03, 0])])
    scene = ds.Scene(mesh, ds.LinearElastic(E=1e5, nu=NU), terms=[ds.SelfContact(1e4, 1e-3)], fixed=["body_0_ymin"])
    with pytest.raises(ValueError, match="pass through each other"):
        ds.Rollout(ds.StaticSolver(scene), 1).forward()
