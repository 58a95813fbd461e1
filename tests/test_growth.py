"""Growth and thermal strain: closed forms of free and held bodies, and every derivative."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed

import diffsim_ti as ds

E, NU, STRAIN = 1e5, 0.3, 1e-6  # strain: alpha (T - T_0)
SIDES = {"xmin": "x", "ymin": "y", "zmin": "z"}


def cube() -> ds.TetrahedralMesh:
    return ds.TetrahedralMesh.create_cube(2, size=1.0)


def rollout_of(material, fixed, kind=ds.StaticSolver, mesh=None, steps=1, **options) -> ds.Rollout:
    scene = ds.Scene(cube() if mesh is None else mesh, material, 1000.0, fixed=fixed, precision="f64", **options)
    solver = kind(scene, dt=1e-3) if kind.explicit else kind(scene, dt=1e-3, tolerance=1e-13)
    return ds.Rollout(solver, steps, outputs=[ds.Reaction("xmin")], gradients="all")


def test_a_free_body_grows_without_stress():
    """Also by 20 %, in a law of large strains."""
    mesh = cube()
    r = rollout_of(ds.Grown(ds.StableNeoHookean(E, NU), 0.2), SIDES, mesh=mesh)
    frames = r.forward()
    X = mesh.vertices
    np.testing.assert_allclose(frames.positions[-1] - X, 0.2 * (X - X.min(0)), atol=1e-9)
    assert np.abs(frames.outputs["reaction"][-1]).max() < 1e-6 * E


def test_stress_of_a_bar_held_at_both_ends():
    """-E alpha T where its sides are free; held all round it is -E alpha T / (1 - 2 nu)."""
    grown, X = ds.Grown(ds.StableNeoHookean(E, NU), STRAIN), cube().vertices
    bar = rollout_of(grown, {**SIDES, "xmax": "x"}).forward().outputs["reaction"][-1]
    assert bar[0] == pytest.approx(E * STRAIN, rel=1e-4)
    every = {**SIDES, "xmax": "x", "ymax": "y", "zmax": "z"}
    held = rollout_of(grown, every).forward()
    np.testing.assert_allclose(held.positions[-1], X, atol=1e-15)
    assert held.outputs["reaction"][-1][0] == pytest.approx(E * STRAIN / (1 - 2 * NU), rel=1e-4)


def test_a_bar_with_a_gradient_of_temperature_bends_without_stress():
    """Of ten nodes, heated by a field at vertices: its curvature is alpha dT/dz."""
    length, h, slope = 1.0, 0.1, 0.02
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (length, h, h), "five").quadratic()
    x, y, z = mesh.vertices.T
    corners = {"o": (x + y + z == 0), "a": (x == length) & (y + z == 0), "b": (y == h) & (x + z == 0)}
    for name, chosen in corners.items():
        mesh = mesh.with_vertex_set(name, chosen)
    grown = ds.Grown(ds.LinearElastic(E=E, nu=NU), mesh.at_stress_points(slope * z))
    scene = ds.Scene(mesh, grown, fixed={"o": "xyz", "a": "yz", "b": "z"}, precision="f64")
    stress = ds.Stress(at="vertices")
    r = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1, outputs=[stress, ds.ElasticEnergy()], gradients="all")
    frames = r.forward()
    assert np.abs(frames["stress"][-1]).max() < 1e-9 * E * slope * h
    low = (y == 0) & (z == 0)
    np.testing.assert_allclose(frames.displacements[-1, low, 2], slope / 2 * x[low] * (length - x[low]), atol=1e-12)
    assert ds.dot_product_test(r) < 1e-9
    with pytest.raises(ValueError, match=r"at points expected shape \(\d+, 4\) of a mesh with ten nodes"):
        ds.Scene(mesh, ds.Grown(ds.LinearElastic(E=E, nu=NU), np.zeros((3, 4))))


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_every_number_at_points(kind):
    rng, mesh = np.random.default_rng(2), ds.TetrahedralMesh.create_box(2, 0.5, "five").quadratic()
    grown = ds.Grown(ds.StableNeoHookean(E, NU), 0.05 * rng.standard_normal((mesh.num_tetrahedra, 4)))
    scene = ds.Scene(mesh, grown, terms=ds.Growth(0.01), fixed="xmin", precision="f64")
    options = {} if kind.explicit else dict(tolerance=1e-13)
    r = ds.Rollout(kind(scene, dt=1e-3, **options), 2, gradients="all")
    assert_transposed(r, 1e-11 if kind.explicit else 1e-8)
    if kind.explicit:
        report = ds.check_gradients(r, inputs=["growth", "growth_over_time"])
        assert all(row.relative_error < 1e-6 for row in report.rows), report


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_every_number(kind):
    rng, mesh = np.random.default_rng(1), cube()
    grown = ds.Grown(ds.StableNeoHookean(E, NU), 0.1 * rng.standard_normal(mesh.num_tetrahedra))
    start = mesh.vertices + 0.02 * rng.standard_normal(mesh.vertices.shape)
    r = rollout_of(grown, "xmin", kind, mesh, 3, initial_positions=start)
    assert_transposed(r, 1e-11 if kind.explicit else 1e-8)
    if kind.explicit:
        report = ds.check_gradients(r, inputs=["growth", "youngs_modulus"])
        assert all(row.relative_error < 1e-6 for row in report.rows), report


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: ds.Grown(ds.StableNeoHookean(E, NU), -1.0), "growth must be > -1"),
        (lambda: ds.Grown(1.0, 0.1), "material must be a material"),
        (lambda: ds.Grown(ds.Grown(ds.StableNeoHookean(E, NU), 0.1), 0.1), "without"),
    ],
)
def test_what_does_not_fit_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
