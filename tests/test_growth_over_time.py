"""Growth over time: free and held bodies against closed forms, every derivative in every solver, momentum, errors."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh
from test_muscles import mesh_of
from test_term_order import SOLVERS

import diffsim_ti as ds

STEPS = 3


def growths(mesh) -> list:
    """Every spelling of growth over time."""
    rng, m = np.random.default_rng(1), mesh.num_tetrahedra
    return [
        ds.Growth((np.array([0.0, 0.003, 0.1]), np.array([0.01, 0.03, 0.1])), name="keyed"),
        ds.Growth(0.02 * rng.uniform(size=(STEPS, 2)), ["left", "right"], per="set", name="pair"),
        ds.Growth(0.02 * rng.uniform(size=m), per="tetrahedron"),
        ds.Gravity(),
    ]


def rollout_of(kind, terms=None, law=None, **options) -> ds.Rollout:
    mesh, rng = mesh_of(), np.random.default_rng(2)
    start = mesh.vertices + 0.01 * rng.normal(size=mesh.vertices.shape)
    options = dict(fixed="xmin", initial_positions=start) | options
    law, terms = law or ds.StableNeoHookean(1e5, 0.3), growths(mesh) if terms is None else terms
    scene = ds.Scene(mesh, law, 1000.0, terms, precision="f64", **options)
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    static = kind is ds.StaticSolver
    solver = kind(scene, load_steps=2, dt=2e-3, **exact) if static else kind(scene, dt=2e-3, substeps=4, **exact)
    return ds.Rollout(solver, STEPS, save_every=1, gradients="all")


@pytest.mark.parametrize("kind", SOLVERS)
def test_every_number(kind):
    """By a dot product each: growth of every spelling, moduli, the rest shape."""
    assert_transposed(rollout_of(kind), 1e-11 if kind.explicit else 1e-8)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitMidpointSolver])
def test_gradients_against_differences(kind):
    names = ["keyed.growth", "pair.growth", "growth_over_time", "growth", "youngs_modulus", "rest_positions"]
    table = ds.check_gradients(rollout_of(kind), inputs=names)
    assert all(row.relative_error < 1e-5 for row in table.rows), table


def test_viscous_and_remembering_materials_grow():
    """The growth is of what they are around."""
    law = ds.KelvinVoigt(ds.Grown(ds.StableNeoHookean(1e5, 0.3), 0.01), time=1e-3)
    assert_transposed(rollout_of(ds.SemiImplicitSolver, law=law), 1e-11)
    with pytest.raises(ValueError, match="KelvinVoigt.Grown"):
        rollout_of(ds.SemiImplicitSolver, law=ds.KelvinVoigt(ds.StableNeoHookean(1e5, 0.3), time=1e-3))


def bar(terms, fixed, E=1e5, nu=0.3, kind=ds.StaticSolver) -> ds.Simulator:
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), ds.LinearElastic(E, nu), 1000.0, terms, fixed, precision="f64")
    return ds.Simulator(kind(scene, dt=0.1, tolerance=1e-12))


def test_a_free_body_grows_without_stress():
    """In statics, on three planes, to (1 + g) of its size, step by step."""
    fixed = {"xmin": "x", "ymin": "y", "zmin": "z"}
    simulator = bar([ds.Growth([0.1, 0.2])], fixed)
    X = simulator.scene.mesh.vertices
    for growth in (0.1, 0.2):
        simulator.step()
        np.testing.assert_allclose(simulator.positions - X.min(0), (1 + growth) * (X - X.min(0)), atol=1e-9)
        assert simulator.tetrahedron_fields().von_mises.max() < 1e-4


@pytest.mark.parametrize("free_sides", [True, False])
def test_a_held_bar_carries_what_its_closed_form_says(free_sides):
    """-E alpha T with free sides; held all round only the mean, -E alpha T / (1 - 2 nu)."""
    E, nu, g = 1e5, 0.3, 1e-6
    sides = {} if free_sides else {"ymax": "y", "zmax": "z"}
    fixed = {"xmin": "x", "xmax": "x", "ymin": "y", "zmin": "z"} | sides
    simulator = bar([ds.Growth(lambda t: g * min(t, 0.1) / 0.1)], fixed, E, nu)
    simulator.step()
    fields, u = simulator.tetrahedron_fields(), simulator.displacements
    if free_sides:
        np.testing.assert_allclose(fields.von_mises, E * g, rtol=1e-4)
    else:
        assert np.abs(u).max() < 1e-15
        density = 3 * E * g**2 / (2 * (1 - 2 * nu))  # 9 K g^2 / 2 of the mean stress 3 K g = E g / (1 - 2 nu)
        np.testing.assert_allclose(fields.energy_density, density, rtol=1e-4)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_momentum_stays(kind):
    """Of a body that nothing holds, to round-off, however it grows."""
    mesh = mesh_of()
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, growths(mesh)[:3], precision="f64")
    exact = {} if kind.explicit else dict(tolerance=1e-13)
    frames = ds.Rollout(kind(scene, dt=2e-3, substeps=4, **exact), STEPS).forward()
    m, v = scene.inputs.derive(scene.inputs.values).mass, frames.velocities[-1]
    assert np.abs(v).max() > 1e-3
    limit = 1e-12 if kind.explicit else 1e-9
    assert np.abs(m @ v).max() < limit * (m @ np.abs(v)).max()
    if kind.explicit:  # backward Euler turns a little
        spin = np.cross(frames.positions[-1], m[:, None] * v).sum(0)
        assert np.abs(spin).max() < limit * np.abs(m @ np.abs(v)).max()


def test_what_grows_step_by_step_is_what_a_run_grows():
    rollout = rollout_of(ds.SemiImplicitSolver)
    simulator = ds.Simulator(rollout.solver)
    simulator.run(STEPS)
    np.testing.assert_allclose(simulator.positions, rollout.forward().positions[-1], atol=1e-12)


def test_what_does_not_fit_is_refused():
    mesh = random_mesh(2)
    m = mesh.num_tetrahedra
    for growth, options, words in (
        (-1.0, {}, "growth must be > -1"),
        (0.1, dict(per="vertex"), "per must be one of"),
        (np.zeros(m + 1), dict(per="tetrahedron"), "takes growth of shape"),
        (0.1, dict(tetrahedra=np.zeros(0, int)), "acts on nothing"),
    ):
        with pytest.raises(ValueError, match=words):
            ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.Growth(growth, **options)], precision="f64")
    with pytest.raises(ValueError, match="patches"):
        ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.Growth(0.1)], volume="patches")
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.Growth(0.1)], precision="f64")
    with pytest.raises(ValueError, match="does not support Growth over time"):
        ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 1, outputs=ds.Stress())
