"""Stress at rest against closed forms."""

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.materials.evaluate import evaluate


def relaxed(mesh, material, **support) -> np.ndarray:
    """Displacements of the unloaded body in equilibrium."""
    scene = ds.Scene(mesh, material, 1000.0, precision="f64", **support)
    return ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1).forward().positions[-1] - mesh.vertices


def with_set(mesh, rule) -> ds.TetrahedralMesh:
    """The tetrahedra "a" whose middles fulfil a rule."""
    chosen = np.flatnonzero(rule(mesh.vertices[mesh.tetrahedra[:, :4]].mean(1)))
    return ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, tetrahedron_sets={"a": chosen})


def test_a_bimaterial_strip_bends_as_timoshenko_says():
    """A layer n times as stiff and m times as thick as the rest, compressed by -n E strain; by nu = 0 it is a beam."""
    E, n, m, h, L, strain = 1e6, 2.0, 1 / 3, 0.04, 0.5, 1e-4
    mesh = ds.TetrahedralMesh.create_box((9, 5, 2), (L, h, 0.02))
    low = mesh.vertices[:, 1].min()
    mesh = with_set(mesh, lambda c: c[:, 1] - low < h / 4).quadratic()  # the lowest of four rows: m = 1/3
    matter = ds.StVenantKirchhoff(E={"a": n * E, "default": E}, nu=0.0)
    zero = np.zeros(6)
    stress = {"a": [-n * E * strain, *zero[1:]], "default": zero}
    clamp = mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 1e-9
    u = relaxed(mesh, ds.InitialStress(matter, stress), fixed=clamp)
    middle = np.isclose(mesh.vertices[:, 1], low + h / 2)
    at = [
        u[middle & np.isclose(mesh.vertices[:, 0] - mesh.vertices[:, 0].min(), x), 1].mean() for x in (0, L / 4, L / 2)
    ]
    curvature = (at[2] - 2 * at[1] + at[0]) / (L / 4) ** 2
    exact = 6 * strain * (1 + m) ** 2 / (h * (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n))))
    assert curvature == pytest.approx(exact, rel=2e-3)  # a quarter of L / h away from where layers end


def test_a_press_fit_of_two_tubes():
    """The inner one, radii 1 to 2, would be larger by strain e: pressure and growth of the outer one, to 3, by Lame."""
    E, nu, e, a, c, b = 1e6, 0.3, 1e-5, 1.0, 2.0, 3.0
    mesh = ds.TetrahedralMesh.create_box((5, 4, 2), (2.0, np.pi / 2, 0.3), origin=(a, 0, 0)).quadratic()
    r, angle, z = mesh.vertices.T
    rolled = np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)
    sides = {axis: np.abs(rolled[:, k]) < 1e-9 for k, axis in enumerate("xy")} | {"z": np.ones(len(rolled), bool)}
    mesh = ds.TetrahedralMesh(rolled, mesh.elements, vertex_sets=sides)
    inner = np.hypot(*rolled[mesh.tetrahedra].mean(1)[:, :2].T) < c
    E_, nu_ = E / (1 - nu**2), nu / (1 - nu)  # plane strain
    stress = np.zeros((len(inner), 6))
    stress[inner, :2] = -e * E_ / (1 - nu_)
    u = relaxed(mesh, ds.InitialStress(ds.StVenantKirchhoff(E, nu), stress), fixed={axis: axis for axis in sides})
    flexibility = (c**2 + a**2) / (c**2 - a**2) - nu_ + (b**2 + c**2) / (b**2 - c**2) + nu_
    pressure = e * E_ / flexibility
    outside = np.isclose(r, b)
    grown = np.einsum("ij,ij->i", u[outside], rolled[outside]) / b
    np.testing.assert_allclose(grown, 2 * pressure * c**2 * b / (E_ * (b**2 - c**2)), rtol=5e-3)


def test_tension_raises_frequencies_at_rest():
    """A strip between clamps is a stiff string: f = sqrt(S / rho) / (2 L) (1 + 2 s + (4 + pi^2 / 2) s^2), s^2 = E h^2 /
    (12 S L^2). Fletcher 1964, Normal vibration frequencies of a stiff piano string, J. Acoust. Soc. Am. 36, 203."""
    E, S, L, h = 1e6, 1e5, 1.0, 0.02
    mesh = ds.TetrahedralMesh.create_box((21, 2, 2), (L, h, 2 * h)).quadratic()
    material = ds.InitialStress(ds.StVenantKirchhoff(E, 0.0), [S, 0, 0, 0, 0, 0])
    ends = np.abs(mesh.vertices[:, 0] - mesh.vertices[:, 0].mean()) > L / 2 - 1e-9
    scene = ds.Scene(mesh, material, 1000.0, fixed=ends, precision="f64")
    s = np.sqrt(E * h**2 / (12 * S)) / L
    exact = np.sqrt(S / 1000.0) / (2 * L) * (1 + 2 * s + (4 + np.pi**2 / 2) * s**2)
    assert ds.modes(scene, 1).frequencies[0] == pytest.approx(exact, rel=3e-3)


def test_what_grew_with_directions_takes_its_size_without_stress():
    """F_g by strain, as it was given; and the same strain held back is a stress of -C : e, for small ones."""
    mesh, e = ds.TetrahedralMesh.create_cube(2, 1.0), np.array([2e-2, -1e-2, 5e-3, 4e-3, -3e-3, 8e-3])
    F = np.eye(3) + e[[[0, 5, 4], [5, 1, 3], [4, 3, 2]]]
    matter = ds.StVenantKirchhoff(1e6, 0.3)
    grown, small = ds.Grown(matter, strain=e), ds.Grown(matter, strain=1e-6 * e)
    p, q = (m.coefficients(m.values(mesh)) for m in (grown, small))
    assert np.abs(evaluate(grown.law("f64"), F[None], p)[1]).max() < 1e-8
    held = evaluate(small.law("f64"), np.eye(3)[None], q)[1][0]
    stress = evaluate(matter.law("f64"), np.eye(3)[None] + 1e-6 * (F - np.eye(3)), q[6:])[1][0]
    np.testing.assert_allclose(held, -stress, rtol=0, atol=1e-6 * np.abs(stress).max())
    with pytest.raises(ValueError, match="least principal value of growth_strain must be > -1, got -1.2"):
        ds.Grown(matter, strain=[-1.2, 0, 0, 0, 0, 0])
    with pytest.raises(ValueError, match="needs growth or strain, got neither"):
        ds.Grown(matter)


def test_a_second_stress_at_rest_is_refused():
    once = ds.InitialStress(ds.StableNeoHookean(1e4, 0.3), np.ones(6))
    with pytest.raises(ValueError, match="has a stress at rest already; add both up"):
        ds.InitialStress(once, np.ones(6))
    with pytest.raises(ValueError, match="initial_stress must be 6 numbers or 6 per tetrahedron"):
        ds.InitialStress(ds.StableNeoHookean(1e4, 0.3), 1.0)
