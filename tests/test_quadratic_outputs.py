"""Results of ten-node tetrahedra: tensors, energies, volumes and points, with their derivatives."""

import numpy as np
import pytest
from quadratic_meshes import crumpled, with_vertices
from test_tensor_outputs import POINTS, assert_derivatives, bent, outputs, sections

import diffsim_ti as ds
from diffsim_ti.visual.colouring import field_of
from diffsim_ti.visual.frame import Frame
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import open_writer


def body() -> ds.TetrahedralMesh:
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), size=(0.2, 0.1, 0.1)).quadratic()
    x = mesh.vertices + 0.003 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    return with_vertices(mesh, x)


def rollout_of(kind):
    mesh = body()
    E = np.linspace(4e4, 8e4, mesh.num_tetrahedra) if kind == "verlet" else 5e4
    law = ds.Corotated if kind == "verlet" else ds.StableNeoHookean
    start = {} if kind == "static" else dict(initial_positions=bent(mesh.vertices))
    volume = "patches" if kind == "midpoint" else "tetrahedra"
    gravity = ds.Gravity((3.0, -9.81, 2.0))
    scene = ds.Scene(mesh, law(E, 0.3), 900.0, gravity, "xmin", precision="f64", volume=volume, **start)
    solver = {
        "verlet": lambda: ds.VelocityVerletSolver(scene, dt=2e-4),
        "static": lambda: ds.StaticSolver(scene, tolerance=1e-12),
        "midpoint": lambda: ds.ImplicitMidpointSolver(scene, dt=5e-3, tolerance=1e-12),
    }[kind]()
    more = [ds.MaterialPoints(POINTS), ds.Stress("of_some", at="vertices", of=[0, 3, 4])]
    more += [] if kind == "static" else sections()
    return ds.Rollout(solver, 2, save_every=1, outputs=outputs() + more, gradients="all")


@pytest.mark.parametrize("kind", ["verlet", "static", "midpoint"])
def test_derivatives(kind):
    """Seeds are the transpose of tangents, and gradients agree with differences, for each output and input by itself."""
    assert_derivatives(rollout_of(kind), kind != "static", 1e-11 if kind == "verlet" else 1e-8)


def test_a_homogeneous_stretch_has_its_closed_form():
    mesh, E, nu = crumpled(0.02), 5e4, 0.3
    F = np.diag([1.3, 0.9, 1.1]) + 0.1 * np.random.default_rng(1).normal(size=(3, 3))
    J, green = np.linalg.det(F), 0.5 * (F.T @ F - np.eye(3))
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    sigma = (mu * (F @ F.T - np.eye(3)) + lam * (J - 1) * J * np.eye(3)) / J
    points = mesh.locate(mesh.centroids).points
    kept = [ds.Stress(), ds.Stress("nodal", at="vertices"), ds.Strain("marked", at=points), ds.EnclosedVolume()]
    kept += [ds.MaterialPoints(points), ds.ElasticEnergy(), ds.KineticEnergy()]
    velocities = np.ones((mesh.num_vertices, 3)) * [1.0, 2, 2]
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(E, nu),
        initial_positions=mesh.vertices @ F.T,
        initial_velocities=velocities,
        precision="f64",
    )
    frames = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-6), 1, outputs=kept).forward()
    assert frames["stress"][0] == pytest.approx(np.tile(sigma, (mesh.num_tetrahedra, 1, 1)), abs=1e-9 * E)
    assert frames["nodal"][0] == pytest.approx(np.tile(sigma, (mesh.num_vertices, 1, 1)), abs=1e-9 * E)
    assert frames["marked"][0] == pytest.approx(np.tile(green, (len(points), 1, 1)), abs=1e-10)
    assert frames["volume"][0] == pytest.approx(J * mesh.volume, rel=1e-12)
    np.testing.assert_allclose(frames["material_points"][0], points @ F.T, atol=1e-11)
    assert frames["kinetic_energy"][0] == pytest.approx(0.5 * 1000 * mesh.volume * 9, rel=1e-12)
    psi = mu / 2 * (np.trace(F.T @ F) - 3) - mu * np.log(J) + lam / 2 * (J - 1) ** 2
    shares = scene.inputs.derive(scene.inputs.values).volumes.sum()  # the points' rule, exact where edges are straight
    assert frames["elastic_energy"][0] == pytest.approx(psi * shares, rel=1e-9)


def test_stress_at_places_and_vertices_is_that_of_the_place():
    """A displacement of second degree has linear strains, which are found anywhere in an element and at all nodes, those of
    the surface included, not only their means."""
    mesh, E, nu = ds.TetrahedralMesh.create_box((2, 2, 3), 1.0).quadratic(), 5e4, 0.3
    x, y, z = mesh.vertices.T
    u = 1e-3 * np.stack([x * x + y * z, x * y - z * z, y * y + x * z], 1)
    places = np.random.default_rng(3).uniform(0.1, 0.9, (6, 3))
    X, Y, Z = np.concatenate([places, mesh.vertices]).T
    rows = [[2 * X, Z, Y], [Y, X, -2 * Z], [Z, 2 * Y, X]]
    H = 1e-3 * np.moveaxis(np.array(rows), 2, 0)
    strain, mu, lam = 0.5 * (H + np.swapaxes(H, 1, 2)), E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    exact = 2 * mu * strain + lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    scene = ds.Scene(mesh, ds.LinearElastic(E, nu), initial_positions=mesh.vertices + u, precision="f64")
    named = [ds.Stress(name, at, kind="first_piola") for name, at in (("places", places), ("nodes", "vertices"))]
    frames = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-6), 1, outputs=named).forward()
    found = np.concatenate([frames["places"][0], frames["nodes"][0]])
    assert found == pytest.approx(exact, abs=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("order", [1, 2])
def test_of_says_which_side_of_an_interface_is_meant(order):
    """Two materials of one strain: stress is that of the side that is named, at its vertices; without, between the two."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), 1.0)
    mesh = mesh.with_tetrahedron_set("soft", mesh.centroids[:, 0] < 0.5)
    mesh = mesh if order == 1 else mesh.quadratic()
    law = ds.LinearElastic({"soft": 1e4, "default": 5e4}, 0.0)
    scene = ds.Scene(mesh, law, initial_positions=mesh.vertices * [1.001, 1, 1], precision="f64")
    named = [ds.Stress("soft", "vertices", of="soft", kind="first_piola"), ds.Stress("both", "vertices")]
    named += [ds.Strain("one", "vertices", of="soft"), ds.Strain("mean", "vertices")]
    named += [ds.Stress("stiff", "vertices", of=mesh.centroids[:, 0] > 0.5, kind="first_piola")]
    frames = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-6), 1, outputs=named).forward()
    x, soft, stiff = mesh.vertices[:, 0], frames["soft"][0][:, 0, 0], frames["stiff"][0][:, 0, 0]
    assert soft == pytest.approx(np.where(x <= 0.5, 10.0, 50.0)) and stiff == pytest.approx(
        np.where(x < 0.5, 10.0, 50.0)
    )
    middle = frames["both"][0][np.isclose(x, 0.5), 0, 0]
    assert middle.min() > 15 and middle.max() < 45
    assert frames["one"] == pytest.approx(frames["mean"], abs=1e-12)
    with pytest.raises(ValueError, match="no tetrahedron set is called 'hard'"):
        ds.Stress(at="vertices", of="hard").settled(scene)


def test_pictures_and_files_have_von_mises_stress_at_vertices(tmp_path):
    mesh = body()
    scene = ds.Scene(mesh, ds.Corotated(5e4, 0.3), 900.0, initial_positions=bent(mesh.vertices), precision="f64")
    simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=2e-4))
    exact = simulator.output(ds.Stress(at="vertices", von_mises=True))
    frame = Frame.of(simulator)
    assert frame.fields["von_mises"] == pytest.approx(exact, rel=1e-10)
    assert field_of(simulator, "von_mises") == pytest.approx(exact, rel=1e-10)
    with open_writer(tmp_path / "run.pvd", scene) as out:
        out.write(frame)
    saved = SavedSeries(tmp_path / "run.pvd").frame(0)
    assert saved.colours["von_mises"] == pytest.approx(exact, rel=1e-10) and len(saved.colours["J"]) == len(
        mesh.elements
    )


def test_volumes_are_of_whole_faces():
    mesh = body()
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3))
    with pytest.raises(ValueError, match="faces of this mesh have 6 vertices, got 3: take whole faces"):
        ds.EnclosedVolume(mesh.surface_triangles).settled(scene)
    with pytest.raises(ValueError, match="the surface is open"):
        ds.EnclosedVolume(mesh.surface_faces[1:]).settled(scene)
    turned = ds.EnclosedVolume(mesh.surface_faces[:, [0, 2, 1, 5, 4, 3]])
    frames = ds.Rollout(ds.VelocityVerletSolver(scene, 1e-6), 1, outputs=[turned]).forward()
    assert frames["volume"][0] == pytest.approx(-mesh.volume, rel=1e-6)
