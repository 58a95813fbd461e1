"""Orthotropic elasticity: its constants one by one, any direction, rotations, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import diffsim_ti as ds
from diffsim_ti.differentiation.arrays import Recorded, forward
from diffsim_ti.materials.evaluate import evaluate

SPRUCE = dict(E1=11.0, E2=0.9, E3=0.5, nu12=0.4, nu23=0.5, nu13=0.35, G12=0.7, G23=0.04, G13=0.6)  # GPa
FIBRES = dict(E1=140.0, E2=10.0, nu12=0.3, nu23=0.45, G12=5.0)  # GPa
TURNS = Rotation.random(3, random_state=4).as_matrix()  # columns: the directions


def strain_of(stress: np.ndarray, c: dict) -> np.ndarray:
    """Strains of a stress in the material's directions, from what the constants are called."""
    c = dict(E3=c["E2"], nu13=c["nu12"], G13=c["G12"], G23=c["E2"] / (2 + 2 * c["nu23"])) | c
    s, e = stress, np.zeros((3, 3))
    e[0, 0] = s[0, 0] / c["E1"] - c["nu12"] * c["E2"] / c["E1"] * s[1, 1] / c["E2"] - c["nu13"] / c["E1"] * s[2, 2]
    e[1, 1] = -c["nu12"] / c["E1"] * s[0, 0] + s[1, 1] / c["E2"] - c["nu23"] / c["E2"] * s[2, 2]
    e[2, 2] = -c["nu13"] / c["E1"] * s[0, 0] - c["nu23"] / c["E2"] * s[1, 1] + s[2, 2] / c["E3"]
    for i, j in ((0, 1), (1, 2), (0, 2)):
        e[i, j] = e[j, i] = s[i, j] / (2 * c[f"G{i + 1}{j + 1}"])
    return e


@pytest.mark.parametrize("constants", [SPRUCE, FIBRES], ids=["orthotropic", "transversely isotropic"])
@pytest.mark.parametrize("Q", TURNS, ids=["a", "b", "c"])
def test_every_stress_needs_the_strain_that_the_constants_say(constants, Q):
    """In any direction and turned: F^T F = 1 + 2 E gives P = F S, exactly."""
    second = {} if constants is FIBRES else dict(direction_2=2 * Q[:, 1] + Q[:, 0])  # its part along 1 does not count
    material = ds.Orthotropic(**constants, direction_1=3 * Q[:, 0], **second)
    p = material.coefficients(material.values(ds.TetrahedralMesh.create_cube(2)))
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)):
        stress = np.zeros((3, 3))
        stress[i, j] = stress[j, i] = 0.02
        E = Q @ strain_of(stress, constants) @ Q.T
        F = TURNS[0] @ np.linalg.cholesky(np.eye(3) + 2 * E).T
        psi, P, _ = evaluate(material.law("f64"), F[None], p)
        S = Q @ stress @ Q.T
        np.testing.assert_allclose(P[0], F @ S, rtol=0, atol=1e-13)
        assert psi[0] == pytest.approx((S * E).sum() / 2, rel=1e-10)


def test_equal_directions_are_isotropic():
    """In energy, and in the moduli that the stable step takes."""
    mesh, (E, nu) = ds.TetrahedralMesh.create_cube(2), (5.0, 0.3)
    one, other = ds.Orthotropic(E1=E, E2=E, nu12=nu, nu23=nu, G12=E / (2 + 2 * nu)), ds.StVenantKirchhoff(E, nu)
    F = np.eye(3) + np.random.default_rng(0).uniform(-0.3, 0.3, (4, 3, 3))
    (psi, P, _), (same, Q, _) = (evaluate(m.law("f64"), F, m.coefficients(m.values(mesh))) for m in (one, other))
    np.testing.assert_allclose(psi, same, rtol=0, atol=1e-14)
    np.testing.assert_allclose(P, Q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(one.lame(one.values(mesh)), other.lame(other.values(mesh)), rtol=1e-13)


@pytest.mark.parametrize("constants", [SPRUCE, FIBRES], ids=["orthotropic", "transversely isotropic"])
def test_moduli_bound_every_strain_and_have_derivatives(constants):
    """2 mu |e|^2 + lam tr(e)^2 >= e : C : e, as sharp as can be; what viscosity takes by them has a gradient."""
    rng, material = np.random.default_rng(1), ds.Orthotropic(**constants, direction_1=TURNS[0][:, 0])
    values = material.values(ds.TetrahedralMesh.create_cube(2))
    mu, lam = material.lame(values)
    e = rng.standard_normal((20000, 3, 3))
    e = e + np.swapaxes(e, 1, 2) + 20 * rng.standard_normal((20000, 1, 1)) * np.outer(*[TURNS[0][:, 0]] * 2)
    psi, _, _ = evaluate(material.law("f64"), np.eye(3) + 1e-7 * e, material.coefficients(values))
    share = 2e14 * psi / (2 * mu * (e**2).sum((1, 2)) + lam * np.trace(e, axis1=1, axis2=2) ** 2)
    assert 0.95 < share.max() < 1 + 1e-4
    along = {name: rng.standard_normal(np.shape(x)) * x for name, x in values.items()}
    there = [material.lame({name: x + s * along[name] for name, x in values.items()}) for s in (1e-6, -1e-6)]
    leaves = {name: Recorded(x) for name, x in values.items()}
    change = [forward(part, ((leaves[name], along[name]) for name in leaves)) for part in material.lame(leaves)]
    np.testing.assert_allclose(change, (np.array(there[0]) - there[1]) / 2e-6, rtol=1e-7)


@pytest.mark.parametrize("order", [1, 2])
def test_patch(order):
    """Equilibrium between boundary vertices that moved by one turned F is F everywhere, whatever the direction."""
    mesh, rng = ds.TetrahedralMesh.create_cube(3, 1.0), np.random.default_rng(2)
    mesh = mesh if order == 1 else mesh.quadratic()
    inside = np.all((mesh.vertices > 1e-6 + mesh.vertices.min(0)) & (mesh.vertices < mesh.vertices.max(0) - 1e-6), 1)
    F = TURNS[1] @ (np.eye(3) + 0.03 * rng.standard_normal((3, 3)))
    start = mesh.vertices @ F.T
    start[inside] += 0.02 * rng.standard_normal((inside.sum(), 3))
    material = ds.Orthotropic(**SPRUCE, direction_1=TURNS[0][:, 0], direction_2=TURNS[0][:, 1])
    scene = ds.Scene(mesh, material, 1.0, fixed=~inside, initial_positions=start, precision="f64")
    x = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-13), 1).forward().positions[-1]
    np.testing.assert_allclose(x, mesh.vertices @ F.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "changes, words",
    [
        (dict(nu12=4.0), r"nu12\^2 E2 / E1 must lie in \(0, 1\), got 1.3.*\|nu12\| < sqrt\(E1 / E2\).*times E1 / E2"),
        (dict(nu12=2.0, nu23=1.0, nu13=3.0), r"1 - nu12 nu21 .* must be > 0, got .* positive definite"),
        (dict(G23=0.0), r"G23 must be > 0, got 0: a stiffness \[Pa\]"),
        (dict(direction_1=(0, 0, 0)), r"length of direction_1 must be > 0"),
        (dict(direction_2=(2, 0, 0)), r"sine between direction_1 and direction_2 must be > 1e-06, got 0"),
        (dict(G13=None), r"needs exactly one of \(E1, E2, E3, .*\) or \(E1, E2, nu12, nu23, G12, direction_1\)"),
    ],
)
def test_what_no_material_can_have_is_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        ds.Orthotropic(**SPRUCE | changes)


def test_constants_of_sets_are_compared_on_the_mesh():
    """nu12 = 2 fits what is stiff along 1 alone; the order of sets has no meaning."""
    mesh = ds.TetrahedralMesh.create_cube(2)
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, tetrahedron_sets={"a": [0], "b": np.arange(1, 6)})
    of_sets = dict(E1={"a": 140.0, "b": 10.0}, E2=10.0, nu23=0.3, G12=5.0)
    ds.Orthotropic(**of_sets, nu12={"b": 0.3, "a": 2.0}).values(mesh)
    with pytest.raises(ValueError, match=r"nu12\^2 E2 / E1 must lie in .*, got 4 in tetrahedron 1"):
        ds.Orthotropic(**of_sets, nu12={"b": 2.0, "a": 0.3}).values(mesh)
