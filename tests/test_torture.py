"""The table of what must hold names tests that exist, and is the one that is written down."""

import warnings

import numpy as np
import pytest
import torture

import diffsim_ti as ds
from diffsim_ti.study.stability_axes import body, power_limit


def test_named_tests_exist():
    assert torture.missing() == []


def test_page_is_up_to_date():
    assert torture.PAGE.read_text() == torture.page(), "run python tests/torture.py"


def test_open_rows_are_these_and_no_more():
    open_rows = [words for rows in torture.ROWS.values() for words, tests in rows.items() if not tests]
    assert len(open_rows) <= 4


@pytest.mark.parametrize("far", [0.0, 10.0, 1e3, 1e6])
def test_strains_keep_their_digits_far_from_the_origin(far):
    """A strain of 1e-3 in float32: von Mises stress E gamma sqrt(3) / 2 (1 + nu) of simple shear, to 1e-3."""
    mesh = ds.TetrahedralMesh.create_cube(2).translated((far, far, far))
    X = mesh.vertices
    start = X + 1e-3 * np.stack([X[:, 1] - far, 0 * X[:, 0], 0 * X[:, 0]], 1)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), initial_positions=start, precision="f32")
    stress = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3)).tetrahedron_fields().von_mises
    assert stress == pytest.approx(np.sqrt(3) * 1e-3 * 1e5 / 2.6, rel=1e-3)


def test_a_million_steps_in_float32():
    """A tumbling free tetrahedron: momentum drifts by less than 1e-4, energy stays in the band of its step."""
    mesh = ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    v = np.cross([0.1, 0.2, 0.3], mesh.vertices - 0.25)
    scene = ds.Scene(mesh, ds.SmithNeoHookean(1e4, 0.3), initial_velocities=v, precision="f32")
    solver = ds.VelocityVerletSolver(scene, dt=2e-3)
    simulator, start = ds.Simulator(solver), None
    frames = ds.Rollout(solver, 1_000_000, save_every=200_000, checkpoint_every=1_000_000).forward()
    start = simulator.compute_energy()
    mass = scene.inputs.derive(scene.inputs.values).mass[:, None]
    x, w = frames.positions.astype(float), frames.velocities.astype(float)
    momentum, spin = (mass * w).sum(1), np.cross(x - x.mean(1, keepdims=True), mass * w).sum(1)
    assert np.abs(momentum).max() <= 1e-4 * np.abs(mass * v).sum()
    assert np.abs(spin - spin[0]).max() <= 2e-2 * np.abs(spin[0]).max()
    simulator.set_state(x[-1], w[-1])
    assert simulator.compute_energy() == pytest.approx(start, rel=2e-2)


def test_midpoint_says_where_it_gains_energy():
    """A cube squeezed to 0.7, in steps of twice the explicit limit: energy comes from nowhere. In a tenth of that, none."""
    scene = body(squeeze=0.7)
    limit = power_limit(scene)
    with pytest.warns(UserWarning, match="has gained .* of the energy that moves"):
        ds.Simulator(ds.ImplicitMidpointSolver(scene, dt=2 * limit)).run(40)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calm = ds.Simulator(ds.ImplicitMidpointSolver(scene, dt=0.1 * limit))
        first = calm.compute_energy()
        calm.run(40)
    # what the watch counts is what the energy has changed by
    watch = calm.workspace.energy_watch
    assert abs(watch.gained - (calm.compute_energy() - first)) <= 1e-5 * watch.moving


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_no_force_acts_on_a_face_exactly_at_the_width(solver):
    """The barrier's energy and force are zero at d = width, to the last bit: what rests there stays."""
    mesh = ds.TetrahedralMesh.create_cube(3, 0.25).translated((0, 0.125, 0))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, ds.Ground(0.0, 1e4, 0.125), precision="f64")
    frames = ds.Rollout(solver(scene, dt=1e-3), 50).forward()
    assert not frames.displacements.any() and not frames.velocities.any()


def test_tip_of_a_hanging_bar_by_its_modulus():
    """E d tip / dE = -rho g L^2 / 2 E for small strains and nu = 0; on a mesh as differences say, to 1e-7."""
    E, L, density = 1e6, 1.0, 1000.0
    exact, errors = density * 9.81 * L**2 / (2 * E), []
    for cells in (2, 6):
        mesh = ds.TetrahedralMesh.create_box((2, cells + 1, 2), (0.1, L, 0.1), "five")
        scene = ds.Scene(mesh, ds.LinearElastic(E, 0.0), density, ds.Gravity(), fixed="ymax", precision="f64")
        tip = mesh.vertex_indices("ymin")
        rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-11), 1)
        hangs = lambda E: -rollout.forward(youngs_modulus=E).displacements[-1, tip, 1].mean()  # noqa: E731, B023
        differences = (hangs(1.001 * E) - hangs(0.999 * E)) / 0.002
        frames = rollout.forward(youngs_modulus=E)
        pull = np.zeros(frames.positions.shape)
        pull[-1, tip, 1] = -1 / len(tip)
        slope = E * float(rollout.vjp(frames, pull)["youngs_modulus"])
        # u = c / E: the central difference over 0.1 % is off by 1e-6 of it
        assert slope == pytest.approx(differences * (1 - 1e-6), rel=1e-7)
        errors.append(abs(-slope / exact - 1))
    assert errors[1] < errors[0] < 1e-3  # linear tetrahedra give the ends of a bar all but exactly
