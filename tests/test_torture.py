"""The table of what must hold names tests that exist, and is the one that is written down."""

import numpy as np
import pytest
import torture

import diffsim_ti as ds


def test_named_tests_exist():
    assert torture.missing() == []


def test_page_is_up_to_date():
    assert (torture.HERE / "TORTURE.md").read_text() == torture.table(), "run python tests/torture.py"


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
