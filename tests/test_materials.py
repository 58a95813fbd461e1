"""Materials: derivatives, limits, rest, inversion and errors, for every law in both precisions."""

import warnings
from functools import lru_cache
from types import SimpleNamespace

import hyperdual
import numpy as np
import pytest
import taichi as ti

from diffsim_ti import Scene, TetrahedralMesh
from diffsim_ti.materials import (
    MATERIALS,
    Corotated,
    LinearElastic,
    MooneyRivlin,
    SmithNeoHookean,
    StableNeoHookean,
    StVenantKirchhoff,
    moduli,
)
from diffsim_ti.materials.calculus.tensor import tensor
from diffsim_ti.materials.material import Coefficients

E, NU, N = 1e5, 0.3, 200
INDIFFERENT = [m for m in MATERIALS if m is not LinearElastic]
CONTINUED = [StableNeoHookean, MooneyRivlin]
PRECISIONS = ["f64", "f32"]
every_law = pytest.mark.parametrize("material", MATERIALS)
both_precisions = pytest.mark.parametrize("precision", PRECISIONS)


# --- evaluation: one kernel per law and precision ---------------------------------------------------------------------


@lru_cache(maxsize=None)
def kernel(law):
    k = len(law.coefficient_names)
    matrices = ti.types.ndarray(ti.types.matrix(3, 3, law.fp), 1)
    vectors, scalars = ti.types.ndarray(ti.types.vector(k, law.fp), 1), ti.types.ndarray(law.fp, 1)

    @ti.kernel
    def evaluate(H: matrices, dH: matrices, p: vectors, psi: scalars, P: matrices, dP: matrices, products: vectors):
        ti.loop_config(serialize=True)
        for i in range(H.shape[0]):
            h, dh = tensor(H[i]), tensor(dH[i])
            coefficients = [p[i][c] for c in ti.static(range(k))]
            psi[i] = law.energy_density(h, coefficients)
            P[i] = law.stress(h, coefficients).matrix()
            change, work = law.stress_differential_and_products(h, dh, coefficients)
            dP[i] = change.matrix()
            for c in ti.static(range(k)):
                products[i][c] = work[c]

    return evaluate


def evaluate(material, H, dH=None, precision="f64", p=None, **options):
    """psi, P, dP, products for displacement gradients H of shape (n, 3, 3)."""
    if isinstance(material, type):
        material = material(E, NU, **options)
    law = material.law(precision)
    dtype = np.float64 if precision == "f64" else np.float32
    if p is None:
        p = material.coefficients({name: np.asarray(v) for name, v in material._numbers.items()})
    n, k = len(H), len(law.coefficient_names)
    H = np.ascontiguousarray(H, dtype)
    dH = np.zeros_like(H) if dH is None else np.ascontiguousarray(dH, dtype)
    p = np.ascontiguousarray(np.broadcast_to(p, (n, k)), dtype)
    out = SimpleNamespace(
        psi=np.zeros(n, dtype), P=np.zeros_like(H), dP=np.zeros_like(H), products=np.zeros((n, k), dtype)
    )
    kernel(law)(H, dH, p, out.psi, out.P, out.dP, out.products)
    return out


# --- the formulas of the docstrings, for the oracle -------------------------------------------------------------------


def invariants(F):
    """I_C, II_C = |cof F|^2, J of nested lists."""
    r, after = range(3), (1, 2, 0)

    def minor(k, m, n, o):
        return F[k][n] * F[m][o] - F[k][o] * F[m][n]

    cof = [[minor(after[i], after[after[i]], after[j], after[after[j]]) for j in r] for i in r]
    total = [sum((A[i][j] * A[i][j] for i in r for j in r), 0.0) for A in (F, cof)]
    return total[0], total[1], sum((F[0][j] * cof[0][j] for j in r), 0.0)


def log_above(J, floor=0.01):
    """log J, continued by its second-order Taylor polynomial below the floor."""
    x = (J - floor) / floor
    inside = hyperdual.log(hyperdual.HyperDual(np.maximum(J.parts[0], floor), *J.parts[1:]))
    outside = x - x * x * 0.5
    above = J.parts[0] >= floor
    return hyperdual.HyperDual(*(np.where(above, a, b) for a, b in zip(inside.parts, (outside + np.log(floor)).parts)))


def neo_hookean(F, mu, lam):
    I_C, _, J = invariants(F)
    return mu / 2 * (I_C - 3) - mu * log_above(J) + lam / 2 * (J - 1) * (J - 1)


def smith(F, mu, lam):
    I_C, _, J = invariants(F)
    m, l = 4 / 3 * mu, lam + 5 / 6 * mu
    alpha = 1 + m / l - m / (4 * l)
    at_rest = l / 2 * (1 - alpha) ** 2 - m / 2 * np.log(4)
    return m / 2 * (I_C - 3) + l / 2 * (J - alpha) * (J - alpha) - m / 2 * hyperdual.log(I_C + 1) - at_rest


def linear(F, mu, lam):
    e = [[0.5 * (F[i][j] + F[j][i]) - float(i == j) for j in range(3)] for i in range(3)]
    trace = e[0][0] + e[1][1] + e[2][2]
    return mu * sum((x * x for row in e for x in row), 0.0) + lam / 2 * trace * trace


def corotated(F, mu, lam):
    I_C, II_C, J = invariants(F)
    plain = np.array([[F[i][j].parts[0][:, 0] for j in range(3)] for i in range(3)], float)
    U, s, V = np.linalg.svd(plain.transpose(2, 0, 1))
    s[:, 2] *= np.sign(np.linalg.det(U @ V))
    f = hyperdual.HyperDual(s.sum(1)[:, None].astype(np.longdouble))
    for _ in range(4):  # tr S solves this quartic; Newton in hyper-dual numbers turns the SVD's value into derivatives
        g = f * f - I_C
        f = f - (g * g - 4 * II_C - 8 * J * f) / (4 * f * g - 8 * J)
    return mu * (I_C - 2 * f + 3) + lam / 2 * (f - 3) * (f - 3)


def kirchhoff(F, mu, lam):
    green = [
        [0.5 * (sum((F[k][i] * F[k][j] for k in range(3)), 0.0) - float(i == j)) for j in range(3)] for i in range(3)
    ]
    trace = green[0][0] + green[1][1] + green[2][2]
    return mu * sum((x * x for row in green for x in row), 0.0) + lam / 2 * trace * trace


def mooney_rivlin(F, mu, lam):
    I_C, II_C, J = invariants(F)
    c10, c01 = 0.8 * mu / 2, 0.2 * mu / 2
    return c10 * (I_C - 3 - 2 * log_above(J)) + c01 * (II_C - 3 - 4 * (J - 1)) + lam / 2 * (J - 1) * (J - 1)


FORMULAS = dict(zip(MATERIALS, (neo_hookean, smith, linear, corotated, kirchhoff, mooney_rivlin)))


def oracle(material, H, dH, nu=NU):
    mu, lam = moduli.lame(E, nu)
    F = np.asarray(H, np.longdouble) + np.eye(3)
    return hyperdual.derivatives(lambda F: FORMULAS[material](F, mu, lam), F, dH)


# --- states -----------------------------------------------------------------------------------------------------------


def rotations(n, seed=0):
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, 3, 3)))[0]
    return Q * np.linalg.det(Q)[:, None, None]


def with_stretches(stretches, seed=0):
    n = len(stretches)
    return rotations(n, seed) @ (np.asarray(stretches)[:, :, None] * rotations(n, seed + 1))


@lru_cache(maxsize=None)
def states(kind):
    rng = np.random.default_rng(3)
    if kind == "random":  # J in [0.05, 5], stretches within a factor 10
        s = np.exp(rng.normal(size=(N, 3)) * 0.35)
        J = np.exp(rng.uniform(np.log(0.05), np.log(5), N))
        s *= (J / s.prod(1))[:, None] ** (1 / 3)
    elif kind == "rest":
        return np.tile(np.eye(3), (2, 1, 1))
    elif kind == "rotations":
        return rotations(N)
    elif kind == "equal stretches":
        s = np.repeat(rng.uniform(0.5, 1.5, (N, 1)), 3, 1)
        s[::2, 2] *= 1.3
    else:  # stretches apart by 1e-14
        s = rng.uniform(0.5, 1.5, (N, 1)) + np.array([0, 1e-14, -1e-14])
    return with_stretches(s)


KINDS = ["random", "rest", "rotations", "equal stretches", "nearly equal stretches"]


def directions(n, seed=5):
    return np.random.default_rng(seed).normal(size=(n, 3, 3))


def norm(A):
    return np.sqrt((np.asarray(A, np.float64) ** 2).sum((-2, -1)))


# --- derivatives ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@every_law
def test_stress_and_differential_are_the_derivatives_of_the_documented_energy(material, kind):
    H, dH = states(kind) - np.eye(3), directions(len(states(kind)))
    got, (psi, P, dP) = evaluate(material, H, dH), oracle(material, H, dH)
    # gate 1e-10, relative to the stiffness times 1, the size of F, where the stress itself vanishes
    assert np.all(np.abs(got.psi - psi) <= 1e-12 * (np.abs(psi) + E))
    assert np.all(norm(got.P - P) <= 1e-12 * (norm(P) + E))
    assert np.all(norm(got.dP - dP) <= 1e-10 * norm(dP))


@every_law
def test_float32_agrees_with_the_oracle_in_large_deformation(material):
    H, dH = (states("random") - np.eye(3)).astype(np.float32), directions(N).astype(np.float32)
    got, (psi, P, dP) = evaluate(material, H, dH, "f32"), oracle(material, H, dH)
    # gate 1e-4; J - 1 carries an error of 1e-7, which 1/J and 1/J^2 amplify by up to 20 and 400 at J = 0.05
    assert np.all(np.abs(got.psi - psi) <= 1e-4 * (np.abs(psi) + 1e-2 * E))
    assert np.all(norm(got.P - P) <= 1e-4 * (norm(P) + 1e-1 * E))
    assert np.all(norm(got.dP - dP) <= 1e-4 * norm(dP))


@every_law
def test_differential_is_symmetric(material):
    H, A, B = states("random") - np.eye(3), directions(N), directions(N, 6)
    dA, dB = evaluate(material, H, A).dP, evaluate(material, H, B).dP
    gap = np.abs((B * dA).sum((1, 2)) - (A * dB).sum((1, 2)))
    assert np.all(
        gap <= 1e-14 * (norm(A) * norm(dB) + norm(B) * norm(dA)) * 3
    )  # 3: sums of nine products of O(1) error


@both_precisions
@every_law
def test_coefficient_products_are_the_derivative_of_the_stress_by_each_coefficient(material, precision):
    H, dH = states("random") - np.eye(3), directions(N)
    tolerance = 1e-13 if precision == "f64" else 1e-4  # round-off; as above
    products = evaluate(material, H, dH, precision).products
    for k in range(products.shape[1]):  # linear in the coefficients: the derivative is the stress of a unit vector
        P = evaluate(material, H, dH, precision, p=np.eye(products.shape[1])[k]).P
        assert np.all(np.abs(products[:, k] - (P * dH).sum((1, 2))) <= tolerance * (1 + norm(P)) * norm(dH))


@pytest.mark.parametrize("material", [StableNeoHookean, MooneyRivlin, Corotated])
def test_differential_and_products_taken_alone_are_those_of_the_pair(material):
    law, k = material(E, NU).law("f64"), len(material(E, NU).law("f64").coefficient_names)
    matrices, vectors = (
        ti.types.ndarray(ti.types.matrix(3, 3, law.fp), 1),
        ti.types.ndarray(ti.types.vector(k, law.fp), 1),
    )

    @ti.kernel
    def alone(H: matrices, dH: matrices, p: vectors, dP: matrices, products: vectors):
        ti.loop_config(serialize=True)
        for i in range(H.shape[0]):
            dP[i] = law.stress_differential(
                tensor(H[i]), tensor(dH[i]), [p[0][c] for c in ti.static(range(k))]
            ).matrix()
            _, work = law.stress_differential_and_products(tensor(H[i]), tensor(dH[i]), law.unit(0))
            for c in ti.static(range(k)):
                products[i][c] = work[c]

    H, dH, p = states("random") - np.eye(3), directions(N), np.random.default_rng(0).uniform(1, 2, (1, k))
    dP, products, pair = np.zeros((N, 3, 3)), np.zeros((N, k)), evaluate(material, H, dH, p=p)
    alone(H, dH, p, dP, products)
    np.testing.assert_allclose(dP, pair.dP, rtol=1e-13, atol=1e-13)  # same operations, up to what the compiler reorders
    np.testing.assert_allclose(products, pair.products, rtol=1e-13, atol=1e-13)


@every_law
def test_energy_and_stress_are_linear_in_the_coefficients(material):
    H = states("random") - np.eye(3)
    k = len(material(E, NU).law("f64").coefficient_names)
    p, q = np.random.default_rng(1).uniform(1, 2, (2, k))
    one, two, both = (evaluate(material, H, p=x) for x in (p, q, 2 * p + 3 * q))
    assert np.all(norm(both.P - 2 * one.P - 3 * two.P) <= 1e-13 * (1 + norm(one.P) + norm(two.P)))
    assert np.all(np.abs(both.psi - 2 * one.psi - 3 * two.psi) <= 1e-12 * (1 + np.abs(one.psi) + np.abs(two.psi)))


# --- rest, rotations, small strains -----------------------------------------------------------------------------------


@both_precisions
@every_law
def test_rest_is_free_of_stress_and_energy(material, precision):
    got = evaluate(material, np.zeros((1, 3, 3)), precision=precision)
    assert np.abs(got.P).max() <= 1e-15 * E and abs(got.psi[0]) <= 1e-15 * E


@pytest.mark.parametrize("material", INDIFFERENT)
def test_rotated_rest_is_free_of_stress_and_energy(material):
    got = evaluate(material, rotations(N) - np.eye(3))
    assert norm(got.P).max() <= 1e-12 * E and np.abs(got.psi).max() <= 1e-14 * E


@pytest.mark.parametrize("material", INDIFFERENT)
def test_a_rotation_of_space_rotates_the_stress(material):
    F, R = states("random"), rotations(N, 9)
    one, two = evaluate(material, F - np.eye(3)), evaluate(material, R @ F - np.eye(3))
    assert np.all(norm(two.P - R @ one.P) <= 1e-12 * (norm(one.P) + E))  # round-off, amplified by 1/J <= 20
    assert np.all(np.abs(two.psi - one.psi) <= 1e-12 * (np.abs(one.psi) + E))


@pytest.mark.parametrize("nu", [-0.3, 0.0, 0.3, 0.45])
@every_law
def test_small_strains_are_linear_elasticity_with_the_given_moduli(material, nu):
    options = {"c01_share": 0.3} if material is MooneyRivlin else {}
    mu, lam = moduli.lame(E, nu)
    dH = directions(20)
    e = (dH + dH.transpose(0, 2, 1)) / 2
    hooke = 2 * mu * e + lam * np.trace(e, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    at_rest = evaluate(material(E, nu, **options), np.zeros_like(dH), dH)
    assert np.all(norm(at_rest.dP - hooke) <= 1e-14 * (norm(hooke) + E))
    strained = evaluate(material(E, nu, **options), 1e-7 * e)
    assert np.all(norm(strained.P - 1e-7 * hooke) <= 1e-5 * norm(1e-7 * hooke))  # second-order terms: 1e-7 x constants


@every_law
def test_uniaxial_strain_and_lateral_contraction_are_those_of_E_and_nu(material):
    small = 1e-7
    e = small * np.diag([1, -NU, -NU])[None]
    P = evaluate(material, e).P[0]
    np.testing.assert_allclose(np.diag(P), [E * small, 0, 0], atol=1e-5 * E * small)  # second-order terms


@pytest.mark.parametrize("strain", [1e-3, 1e-4])
@every_law
def test_float32_keeps_its_digits_near_rest(material, strain):
    H = (strain * directions(N)).astype(np.float32)
    single, double = evaluate(material, H, precision="f32"), evaluate(material, H)
    assert np.all(norm(single.P - double.P) <= 1e-5 * norm(double.P))
    assert np.all(np.abs(single.psi - double.psi) <= 1e-5 * double.psi)


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "nu, s, t, P11, psi",
    [
        (0.0, 1.5, 1.0, 41666.666667, 10976.744595),
        (0.3, 0.8, 1.063056609, -23561.988190, 2224.535063),
        (0.3, 1.5, 0.871868464, 38201.163631, 10333.526022),
        (0.3, 2.0, 0.779503187, 65237.976567, 36439.407882),
        (0.45, 1.5, 0.830036766, 35885.953285, 9865.483031),
        (0.45, 2.0, 0.724651756, 59911.721253, 34050.329301),
    ],
)
def test_uniaxial_stretch_matches_the_closed_form(nu, s, t, P11, psi):
    got = evaluate(StableNeoHookean(E, nu), np.diag([s - 1, t - 1, t - 1])[None])
    # R1: t is given to 9 digits, P22 = 0 to what this leaves
    np.testing.assert_allclose([got.P[0, 0, 0], got.psi[0]], [P11, psi], rtol=1e-8)
    assert abs(got.P[0, 1, 1]) <= 1e-8 * E * 10


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_simple_shear_and_dilation_match_the_closed_form(nu):
    mu, lam = moduli.lame(E, nu)
    H = np.zeros((3, 3, 3))
    H[:, 0, 1] = gamma = np.array([0.1, 1.0, 3.0])
    got = evaluate(StableNeoHookean(E, nu), H)  # R2
    np.testing.assert_allclose(got.P[:, [0, 1], [1, 0]], np.stack([mu * gamma] * 2, 1), rtol=1e-14)
    np.testing.assert_allclose(got.psi, mu * gamma**2 / 2, rtol=1e-14)
    s = np.array([0.5, 0.9, 2.0])
    got = evaluate(StableNeoHookean(E, nu), (s - 1)[:, None, None] * np.eye(3))  # R3
    np.testing.assert_allclose(got.P[:, 0, 0], mu * (s - 1 / s) + lam * (s**3 - 1) * s**2, rtol=1e-13)


# --- compression and inversion ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", CONTINUED)
def test_logarithm_is_exact_above_the_floor_and_c2_finite_and_outward_below(material):
    J = np.concatenate([np.linspace(0.5, 0.01, 30), np.geomspace(0.01, 1e-12, 20), np.linspace(0, -1, 30)])
    H = np.tile(np.diag([0.0, 0, 0]), (len(J), 1, 1))
    H[:, 0, 0] = J - 1
    dH = np.tile(np.diag([1.0, 0, 0]), (len(J), 1, 1))
    got, (psi, P, dP) = evaluate(material, H, dH), oracle(material, H, dH)
    np.testing.assert_allclose(got.psi, psi, rtol=1e-12)
    np.testing.assert_allclose(got.P[:, 0, 0], P[:, 0, 0], rtol=1e-12)  # against the continued formula
    np.testing.assert_allclose(got.dP[:, 0, 0], dP[:, 0, 0], rtol=1e-12)
    assert np.all(got.P[:, 0, 0] < 0)  # pushes outwards
    below, above = (evaluate(material, np.diag([0.01 * (1 + side) - 1, 0, 0])[None], dH[:1]) for side in (-1e-9, 1e-9))
    for name in (
        "psi",
        "P",
        "dP",
    ):  # C2: J differs by 2e-11, what is compared has slopes of at most mu / J_floor^2 = 1e4 mu
        np.testing.assert_allclose(getattr(below, name), getattr(above, name), rtol=1e-8, atol=2e-11 * 1e4 * E)


def test_the_floor_is_a_choice():
    H = np.diag([0.05 - 1, 0, 0])[None]
    mu, lam = moduli.lame(E, NU)
    exact = mu * (0.05 - 1 / 0.05) + lam * (0.05 - 1)
    assert evaluate(StableNeoHookean, H).P[0, 0, 0] == pytest.approx(exact, rel=1e-12)
    continued = mu * (0.05 - 1 / 0.1 - 0.05 / 0.1**2) + lam * (0.05 - 1)
    assert evaluate(StableNeoHookean, H, J_floor=0.1).P[0, 0, 0] == pytest.approx(continued, rel=1e-12)


@both_precisions
@every_law
def test_inverted_and_collapsed_states_give_finite_results(material, precision):
    collapsed = [
        np.zeros((3, 3)),
        np.diag([1.0, 0, 0]),
        np.diag([1.0, 1, 0]),
        np.diag([1.0, 1, -1]),
        -np.eye(3),
        np.diag([2.0, 0.5, -0.5]),
        np.diag([1.0, 1e-9, -1e-9]),
    ]
    F = np.concatenate([collapsed, rotations(20) @ with_stretches(np.random.default_rng(0).uniform(-1, 1, (20, 3)))])
    got = evaluate(material, F - np.eye(3), directions(len(F)), precision)
    for value in (got.psi, got.P, got.dP, got.products):
        assert np.all(np.isfinite(value))


def test_corotated_rotation_is_proper_and_exact_for_every_state():
    rng = np.random.default_rng(1)
    s = np.sort(np.exp(rng.normal(size=(N, 3))), 1)[:, ::-1].copy()
    s[::2, 2] *= -0.9  # inverted, the sign on the smallest stretch
    F = with_stretches(s)
    U, sigma, V = np.linalg.svd(F)
    V[:, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    R = U @ V
    got = evaluate(Corotated(mu=0.5, lam=0.0), F - np.eye(3)).P  # P = F - R
    gap = s[:, 1] + s[:, 2]
    # 1e-14 times the condition number of R, the largest stretch over the sum of the smallest two
    assert np.all(norm(F - got - R) <= 1e-14 * (1 + norm(F)) * np.maximum(1, s[:, 0] / gap))


@pytest.mark.parametrize("kind", ["sum of stretches 1e-6", "rank one", "mirrored"])
def test_corotated_stress_follows_a_valid_rotation_where_it_is_not_unique(kind):
    s = {"sum of stretches 1e-6": [1, 0.5, -0.5 + 1e-6], "rank one": [1, 0, 0], "mirrored": [1, 1, -1]}[kind]
    F = with_stretches(np.tile(np.array(s, float), (20, 1)))
    R = F - evaluate(Corotated(mu=0.5, lam=0.0), F - np.eye(3)).P
    assert np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() <= 1e-14
    np.testing.assert_allclose(np.linalg.det(R), 1, rtol=1e-14)
    assert np.abs((R * F).sum((1, 2)) - np.sum(s)).max() <= 1e-13  # tr S is the largest that a rotation can reach


@both_precisions
@every_law
def test_nan_is_passed_on(material, precision):
    H = np.zeros((9, 3, 3))
    H[np.arange(9), np.arange(9) // 3, np.arange(9) % 3] = np.nan
    got = evaluate(material, H, np.ones_like(H), precision)
    assert np.all(np.isnan(got.psi)) and np.all(np.isnan(got.P).any((1, 2)))


# --- laws and materials as objects ------------------------------------------------------------------------------------


@every_law
def test_equal_laws_are_one_key(material):
    assert material(E, NU).law("f32") == material(2 * E, 0.2).law("f32")
    assert hash(material(E, NU).law("f32")) == hash(material(E, NU).law("f32"))
    assert material(E, NU).law("f32") != material(E, NU).law("f64")


def test_laws_of_different_formula_or_floor_differ():
    laws = [m(E, NU).law("f64") for m in MATERIALS] + [StableNeoHookean(E, NU, J_floor=0.1).law("f64")]
    assert len(set(laws)) == len(laws)


SETS = {"left": np.array([0, 1]), "right": np.array([2]), "all": np.arange(4)}
MESH = SimpleNamespace(num_tetrahedra=4, tetrahedron_sets=SETS)
SPELLINGS = [(m, dict(youngs_modulus=E, poissons_ratio=NU)) for m in MATERIALS]
SPELLINGS += [(m, dict(mu=3e4, lam=5e4)) for m in MATERIALS] + [
    (MooneyRivlin, dict(c10=2e4, c01=1e4, bulk_modulus=9e4))
]


@pytest.mark.parametrize("material, numbers", SPELLINGS)
@pytest.mark.parametrize("uniform", [True, False])
def test_coefficient_derivatives_are_exact(material, numbers, uniform):
    m = material(**numbers)
    rng = np.random.default_rng(0)
    values = {n: np.asarray(v) * (1.0 if uniform else rng.uniform(0.9, 1.1, 4)) for n, v in numbers.items()}
    tangents = {n: v * rng.uniform(-1, 1, v.shape) for n, v in values.items()}
    step = 1e-30
    complex_values = {n: v + 1j * step * tangents[n] for n, v in values.items()}
    if numbers.keys() == {"youngs_modulus", "poissons_ratio"}:
        chain = np.stack(moduli.lame(*complex_values.values()), -1) @ m.from_lame.T
    else:
        chain = np.stack(list(complex_values.values()), -1) @ (m.from_own if "c10" in numbers else m.from_lame).T
    np.testing.assert_allclose(m.coefficients(values), chain.real, rtol=1e-15)
    link, x = Coefficients(m), [*values.values()]
    (jvp,) = link.jvp(x, [*tangents.values()])
    np.testing.assert_allclose(jvp, chain.imag / step, rtol=1e-12)  # complex step is exact: round-off
    (single,) = link.jvp(x, [v.astype(np.float32) for v in tangents.values()])
    np.testing.assert_allclose(single, jvp, rtol=1e-6)
    w = rng.normal(size=(4, jvp.shape[-1]))
    vjp = dict(zip(link.reads, link.vjp(x, (w,))))
    assert {n: a.shape for n, a in vjp.items()} == {n: v.shape for n, v in values.items()}
    left, right = (w * jvp).sum(), sum((vjp[n] * tangents[n]).sum() for n in values)
    assert left == pytest.approx(right, rel=1e-13)


def test_a_check_of_ones_own_reads_plain_numbers_where_derivatives_are_taken():
    class Stiff(SmithNeoHookean):
        def check(self, values):
            super().check(values)
            if values["youngs_modulus"].min() < 1e3:
                raise ValueError("too soft")

    x = np.full(3, E), np.full(3, NU)
    found, told = (Coefficients(kind(E, NU)).vjp(x, (np.ones((3, 2)),)) for kind in (Stiff, SmithNeoHookean))
    np.testing.assert_array_equal(found, told)
    with pytest.raises(ValueError, match="too soft"):
        Coefficients(Stiff(E, NU)).jvp((np.full(3, 1.0), x[1]), x)


def test_smith_constants_are_the_published_conversion():
    mu, lam = moduli.lame(E, NU)
    m, l = SmithNeoHookean(E, NU).coefficients({"youngs_modulus": np.array(E), "poissons_ratio": np.array(NU)})
    assert (m, l) == (pytest.approx(4 / 3 * mu), pytest.approx(lam + 5 / 6 * mu))


def test_mooney_rivlin_own_numbers_have_the_stated_small_strain_moduli():
    m = MooneyRivlin(c10=2e4, c01=1e4, bulk_modulus=9e4)
    mu, lam = m.lame(m.values(MESH))
    assert (mu, lam + 2 / 3 * mu) == (pytest.approx(6e4), pytest.approx(9e4))


@every_law
def test_lame_gives_back_the_small_strain_moduli(material):
    m = material(E, NU)
    assert m.lame(m.values(MESH)) == (pytest.approx(moduli.lame(E, NU)[0]), pytest.approx(moduli.lame(E, NU)[1]))


def test_moduli_convert_back_and_forth():
    for nu in (-0.9, 0.0, 0.3, 0.499):
        assert moduli.youngs_poisson(*moduli.lame(E, nu)) == (pytest.approx(E), pytest.approx(nu))
    mu, lam = moduli.lame(E, 0.3)
    assert moduli.pressure_wave_speed(mu, lam, 1000) == pytest.approx(11.6024, rel=1e-5)  # R14


def test_every_spelling_of_E_and_nu_is_the_same_material():
    for m in (StableNeoHookean(1e5, 0.3), StableNeoHookean(E=1e5, nu=0.3), StableNeoHookean(poissons_ratio=0.3, E=1e5)):
        assert repr(m) == "StableNeoHookean(youngs_modulus=1e5, poissons_ratio=0.3)"
        assert m.inputs == ("youngs_modulus", "poissons_ratio") and m.name == "StableNeoHookean"
    assert StableNeoHookean(mu=1e5, lam=2e5).inputs == ("mu", "lam")


def test_numbers_may_be_uniform_per_tetrahedron_or_per_set():
    values = StableNeoHookean({"left": 1e4, "right": 1e5, "default": 1e6}, 0.3).values(MESH)
    np.testing.assert_array_equal(values["youngs_modulus"], [1e4, 1e4, 1e5, 1e6])
    assert values["poissons_ratio"].shape == () and values["poissons_ratio"].dtype == np.float64
    m = StableNeoHookean(np.array([1e4, 2e4, 3e4, 4e4], np.float32), 0.3)
    assert m.coefficients(m.values(MESH)).shape == (4, 2)
    assert StableNeoHookean(E, NU).coefficients(StableNeoHookean(E, NU).values(MESH)).shape == (2,)
    assert repr(StableNeoHookean({"left": 1e4, "default": 1e6}, 0.3)).startswith(
        "StableNeoHookean(youngs_modulus={'left'"
    )


@pytest.mark.parametrize(
    "build, words",
    [
        (lambda: StableNeoHookean(0.0, 0.3), r"youngs_modulus must be > 0, got 0"),
        (lambda: StableNeoHookean(-1.0, 0.3), r"youngs_modulus must be > 0, got -1"),
        (lambda: StableNeoHookean(E, 0.5), r"poissons_ratio must lie in \(-1, 0.5\), got 0.5: .*incompressible"),
        (lambda: StableNeoHookean(E, -1.0), r"poissons_ratio must lie in \(-1, 0.5\), got -1"),
        (lambda: StableNeoHookean(np.nan, 0.3), r"youngs_modulus must be finite, got nan"),
        (lambda: StableNeoHookean(np.array([E, np.inf]), 0.3), r"youngs_modulus must be finite, got inf \(1 of 2"),
        (lambda: StableNeoHookean(np.array([E, -E]), 0.3), r"got -100000 in tetrahedron 1 \(1 in all\)"),
        (lambda: StableNeoHookean(E, "soft"), r"poissons_ratio must be a number"),
        (lambda: StableNeoHookean(np.ones((2, 2)), 0.3), r"one per tetrahedron, got an array of shape \(2, 2\)"),
        (lambda: StableNeoHookean(E), r"needs exactly one of \(youngs_modulus, poissons_ratio\) or \(mu, lam\)"),
        (lambda: StableNeoHookean(), r"got \(nothing\)"),
        (lambda: StableNeoHookean(E, 0.3, mu=1.0, lam=1.0), r"needs exactly one of"),
        (lambda: StableNeoHookean(E, 0.3, E=2.0), r"youngs_modulus is given twice"),
        (lambda: StableNeoHookean(E, 0.3, 0.4), r"StableNeoHookean takes at most 2 arguments without a name, got 3"),
        (lambda: StableNeoHookean(E, nuu=0.3), r"StableNeoHookean has no argument 'nuu'; did you mean 'nu'\?"),
        (lambda: StableNeoHookean(mu=-1.0, lam=1.0), r"mu must be > 0"),
        (lambda: StableNeoHookean(mu=3.0, lam=-2.5), r"bulk modulus lam \+ 2/3 mu must be > 0"),
        (lambda: StableNeoHookean(E, 0.3, J_floor=0.0), r"J_floor must lie in \(0, 1\), got 0"),
        (lambda: MooneyRivlin(c10=0.0, c01=1.0, bulk_modulus=1.0), r"c10 must be > 0"),
        (lambda: MooneyRivlin(c10=1.0, c01=-1.0, bulk_modulus=1.0), r"c01 must be >= 0"),
        (lambda: MooneyRivlin(E, 0.3, c01_share=1.0), r"c01_share must lie in \[0, 1\)"),
        (lambda: MooneyRivlin(c10=1.0, c01=1.0, bulk_modulus=9.0, c01_share=0.1), r"c01_share goes with"),
        (lambda: StableNeoHookean(np.ones(3), 0.3).values(MESH), r"shape \(4,\), got shape \(3,\)"),
        (lambda: StableNeoHookean({"up": 1.0}, 0.3).values(MESH), r"no tetrahedron set 'up' \(it has: 'left', "),
        (lambda: StableNeoHookean({"left": 1.0}, 0.3).values(MESH), r"2 tetrahedra are in none .* \"default\""),
        (lambda: StableNeoHookean({"left": 1.0, "all": 2.0}, 0.3).values(MESH), r"0 is in both 'left' and 'all'"),
        (lambda: StableNeoHookean({}, 0.3), r"the dict is empty"),
    ],
)
def test_wrong_numbers_are_refused_with_rule_value_and_remedy(build, words):
    with pytest.raises((ValueError, TypeError), match=words):
        build()


def test_coefficients_refuse_values_that_left_the_range():
    m = StableNeoHookean(E, NU)
    with pytest.raises(ValueError, match="poissons_ratio must lie"):
        m.coefficients({"youngs_modulus": np.array(E), "poissons_ratio": np.array(0.6)})


SOFT_IN_SHEAR = [dict(E=E, nu=0.49), dict(mu=1.0, lam=100.0), dict(E=E, nu={"left": 0.3, "default": 0.46})]


@pytest.mark.parametrize("numbers", SOFT_IN_SHEAR)
@every_law
def test_nearly_incompressible_materials_warn_once_of_locking(material, numbers):
    box = TetrahedralMesh.create_box(2)
    mesh = TetrahedralMesh(box.vertices, box.tetrahedra, tetrahedron_sets={"left": [0, 1]})
    with pytest.warns(UserWarning, match='linear tetrahedra lock.*volume="patches"') as record:
        Scene(mesh, material(**numbers))
    assert len(record) == 1 and record[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene(mesh, material(**numbers), volume="patches")


def test_ordinary_materials_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for nu in (-0.5, 0.0, 0.45):
            for m in (StableNeoHookean, StVenantKirchhoff, Corotated):
                Scene(TetrahedralMesh.create_box(2), m(E, nu))
                Scene(TetrahedralMesh.create_box(2), m(mu=moduli.lame(E, nu)[0], lam=moduli.lame(E, nu)[1]))
