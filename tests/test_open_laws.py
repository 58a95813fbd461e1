"""Laws by their energy, of the package and of users, against mpmath and every gate of gradients."""

from dataclasses import dataclass
from functools import lru_cache

import mpmath as mp
import numpy as np
import pytest
import taichi as ti
from open_laws.power_law import Knowles
from open_laws.viscous import ViscousRubber

import diffsim_ti as ds
from diffsim_ti import runtime, verify
from diffsim_ti.differentiation import x_minus_log1p
from diffsim_ti.materials import (
    EnergyLaw,
    FibreReinforced,
    Gent,
    Grown,
    InitialStress,
    Material,
    Ogden,
    Orthotropic,
    Yeoh,
)
from diffsim_ti.materials.calculus.tensor import Tensor, invariants
from diffsim_ti.materials.gent import GentLaw
from diffsim_ti.materials.ogden import OgdenLaw
from diffsim_ti.mechanics.stress.items import Block, Single
from diffsim_ti.runtime import traced

COUNT = 8  # states, one for each lane

# ---- the same energies in mpmath, written from the papers -------------------------------------------------------------


def squares(A):
    return mp.fsum(x * x for x in A)


def isochoric(F):
    return mp.det(F), squares(F) / mp.det(F) ** (mp.mpf(2) / 3) - 3


def gent(F, mu, limit, bulk):
    J, i = isochoric(F)
    return -mu / 2 * limit * mp.log(1 - i / limit) + bulk / 2 * (J - 1) ** 2


def yeoh(F, c10, c20, c30, bulk):
    J, i = isochoric(F)
    return c10 * i + c20 * i**2 + c30 * i**3 + bulk / 2 * (J - 1) ** 2


def knowles(F, mu, lam, b, n):
    J, I1 = mp.det(F), squares(F)
    return mu / (2 * b) * ((1 + b / n * (I1 - 3 - 2 * (J - 1))) ** n - 1) + lam / 2 * (J - 1) ** 2


def fibres(F, k1, k2, *a):
    a = mp.matrix(a)
    e = max(squares(F * a) / squares(a) - 1, mp.mpf(0))
    return k1 / (2 * k2) * (mp.exp(k2 * e**2) - 1)


def tissue(F, k1, k2, ax, ay, az, *matrix):
    return fibres(F, k1, k2, ax, ay, az) + gent(F, *matrix)


def ogden(F, mu_1, mu_2, a_1, a_2, bulk):
    J, squared = mp.det(F), mp.eigsy(F.T * F, eigvals_only=True)
    scale = J ** (mp.mpf(2) / 3)
    terms = (mu / a * (mp.fsum((c / scale) ** (a / 2) for c in squared) - 3) for mu, a in ((mu_1, a_1), (mu_2, a_2)))
    return mp.fsum(terms) + bulk / 2 * (J - 1) ** 2


def grown(F, growth, mu, lam):
    e = (F + F.T) / (2 * (1 + growth)) - mp.eye(3)
    trace = e[0, 0] + e[1, 1] + e[2, 2]
    return (1 + growth) ** 3 * (mu * squares(e) + lam / 2 * trace**2)


def six(F):
    E = (F.T * F - mp.eye(3)) / 2
    return [E[0, 0], E[1, 1], E[2, 2], 2 * E[1, 2], 2 * E[0, 2], 2 * E[0, 1]]


def hooke(F, *c):
    e, rest = six(F), iter(c)
    return mp.fsum(next(rest) * e[i] * e[j] / (1 + (i == j)) for i in range(6) for j in range(i, 6))


def tensioned(F, *numbers):
    return mp.fsum(s * e for s, e in zip(numbers, six(F))) + yeoh(F, *numbers[6:])


def swollen(F, xx, yy, zz, yz, xz, xy, mu, lam):
    G = mp.eye(3) + mp.matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    E = (F * G**-1).T * (F * G**-1) / 2 - mp.eye(3) / 2
    return mp.det(G) * (mu * squares(E) + lam / 2 * (E[0, 0] + E[1, 1] + E[2, 2]) ** 2)


WOOD = dict(E1=9.0, E2=2.0, E3=1.0, nu12=0.4, nu23=0.5, nu13=0.3, G12=1.5, G23=0.3, G13=1.0)
TENSION = [0.3, -0.2, 0.1, 0.2, -0.1, 0.4]

OWN = {  # material, the energy again, one set of coefficients
    "yeoh": (Yeoh(1.0, -0.1, 0.05, 3.0), yeoh, [1.0, -0.1, 0.05, 3.0]),
    "gent": (Gent(2.0, 6.0, 3.0), gent, [2.0, 6.0, 3.0]),
    "knowles": (Knowles(1.0, 0.3, 0.5, 0.7), knowles, [2.0, 3.0, 0.5, 0.7]),
    "tissue": (
        FibreReinforced(Gent(2.0, 6.0, 3.0), 1.5, 0.8, [1.0, 0.5, -0.3]),
        tissue,
        [1.5, 0.8, 1, 0.5, -0.3, 2, 6, 3],
    ),
    "grown": (Grown(ds.LinearElastic(mu=1.0, lam=2.0), 0.1), grown, [0.1, 1.0, 2.0]),
    "ogden": (Ogden([2.0, -0.5], [1.3, -2.0], 3.0), ogden, [2.0, -0.5, 1.3, -2.0, 3.0]),
    "orthotropic": (Orthotropic(**WOOD), hooke, np.linspace(3.0, -1.0, 21).tolist()),
    "swollen": (Grown(ds.StVenantKirchhoff(mu=1.0, lam=2.0), strain=TENSION), swollen, [*TENSION, 1.0, 2.0]),
    "tensioned": (InitialStress(Yeoh(1.0, -0.1, 0.05, 3.0), TENSION), tensioned, [*TENSION, 1.0, -0.1, 0.05, 3.0]),
}
every_own = pytest.mark.parametrize("name", OWN)


def states() -> tuple[np.ndarray, np.ndarray]:
    """Displacement gradients up to 0.4, one of them at rest, and directions."""
    rng = np.random.default_rng(5)
    H, dH = rng.uniform(-0.25, 0.25, (COUNT, 3, 3)), rng.standard_normal((COUNT, 3, 3))
    H[0] = 0
    H[1] = np.diag([0.4, -0.1, -0.1])
    return H, dH


@lru_cache(maxsize=None)
def exact(name: str) -> list:
    """The FUNCTIONS at each state by differences with fifty digits."""
    _, psi, p = OWN[name]
    return [exact_at(psi, H, dH, p, changes(p)) for H, dH in zip(*states())]


def changes(p) -> np.ndarray:
    return np.random.default_rng(6).standard_normal(len(p))


def exact_at(psi, H, dH, p, dp) -> dict:
    h = mp.mpf(10) ** -15

    def energy(x, q):
        return psi(mp.eye(3) + mp.matrix(x), *q)

    def slope(f):
        return (f(h) - f(-h)) / (2 * h)

    def along(x, q, E):
        return slope(lambda t: energy(x + t * E, q))

    with mp.workdps(50):
        to_mp = np.vectorize(mp.mpf, otypes=[object])
        x, dx, q, dq, units, basis = (to_mp(a) for a in (H, dH, p, dp, np.eye(9).reshape(9, 3, 3), np.eye(len(p))))
        dP = [slope(lambda t, E=E: along(x + t * dx, q, E)) for E in units]
        by_p = [slope(lambda t, E=E: along(x, q + t * dq, E)) for E in units]
        out = dict(
            psi=[energy(x, q)],
            P=[along(x, q, E) for E in units],
            dP=dP,
            by_p=by_p,
            jvp=[a + b for a, b in zip(dP, by_p)],
            products=dP + [slope(lambda t, e=e: along(x, q + t * e, dx)) for e in basis],
            psi_by_p=[slope(lambda t, e=e: energy(x, q + t * e)) for e in basis],
        )
        return {key: np.array(value, dtype=np.float64) for key, value in out.items()}


# ---- a law evaluated, one state at a time or eight in lanes ----------------------------------------------------------


FUNCTIONS = {  # what a law offers, as numbers
    "psi": lambda law, h, dh, q, dq: [law.energy_density(h, q)],
    "P": lambda law, h, dh, q, dq: law.stress(h, q).numbers,
    "dP": lambda law, h, dh, q, dq: law.stress_differential(h, dh, q).numbers,
    "by_p": lambda law, h, dh, q, dq: law.stress_change(h, q, dq).numbers,
    "jvp": lambda law, h, dh, q, dq: law.stress_jvp(h, dh, q, dq).numbers,
    "products": lambda law, h, dh, q, dq: numbers_of(*law.stress_differential_and_products(h, dh, q)),
    "psi_by_p": lambda law, h, dh, q, dq: law.energy_by_coefficients(h, q),
}


def numbers_of(dP, products):
    return [*dP.numbers, *products]


@lru_cache(maxsize=None)
def kernel(law, name, in_lanes: bool):
    items, K = (Block if in_lanes else Single)(law.fp), len(law.coefficient_names)
    blocks = ti.types.ndarray(ti.types.vector(8, law.fp), 1)

    @traced
    def numbers(e, H, dH, p, dp, out):
        h, dh = (Tensor(items.numbers(a, 0, 9, 9, e)) for a in (H, dH))
        q, dq = (items.numbers(a, 0, K, K, e) for a in (p, dp))
        items.put(out, 9 + K, e, 0, FUNCTIONS[name](law, h, dh, q, dq))

    @ti.kernel
    def evaluate(H: blocks, dH: blocks, p: blocks, dp: blocks, out: blocks, n: ti.i32):
        ti.loop_config(serialize=True)
        for e in range(n):
            numbers(e, H, dH, p, dp, out)

    return evaluate


def evaluate(law, name, H, dH, p, dp, in_lanes) -> np.ndarray:
    """One of the FUNCTIONS at eight states, shape (8, 9 + K), zero where it has no numbers; lanes are of a CPU."""
    in_lanes = in_lanes and runtime.arch_name() == "cpu"  # Taichi's CUDA stops at some functions of vectors
    lanes = ti.types.vector(8, law.fp)
    rows = [x.reshape(COUNT, -1).T for x in (H, dH, np.tile(p, (COUNT, 1)), np.tile(dp, (COUNT, 1)))]
    arrays, out = [runtime.upload(x, lanes) for x in rows], runtime.upload(np.zeros((9 + len(p), 8)), lanes)
    runtime.Launch(kernel(law, name, in_lanes), *arrays, out, vectorized=in_lanes)(1 if in_lanes else COUNT)
    return runtime.fetch(out).T.astype(np.float64)


@pytest.mark.parametrize("precision, in_lanes", [("f64", True), ("f32", False)], ids=["f64-lanes", "f32-single"])
@every_own
def test_everything_follows_from_the_energy(name, precision, in_lanes):
    material, _, p = OWN[name]
    H, dH = states()
    law, first = material.law(precision), int(name == "tissue")  # at rest its curvature jumps
    want = exact(name)[first:]
    tolerance = 1e-13 if precision == "f64" else 3e-5  # round-off, where 1 - (I_C - 3)/limit is as small as 0.7
    for key in FUNCTIONS:
        got = evaluate(law, key, H, dH, np.array(p), changes(p), in_lanes)[first:]
        right = np.zeros_like(got)
        for k, state in enumerate(want):
            right[k, : len(state[key])] = state[key]
        error, size = np.abs(got - right).max(1), np.abs(right).max(1)
        assert np.all(error <= tolerance * np.maximum(10, size)), (key, error)


@pytest.mark.parametrize("name", ["yeoh", "gent", "tissue", "ogden"])
def test_small_strains_keep_their_digits_in_float32(name):
    """Strains of 1e-4: I_C - 3, J - 1 and powers of stretches less 1 never come from differences with 3 and 1."""
    H, dH = states()
    material, _, p = OWN[name]
    single, double = (
        evaluate(material.law(x), "P", 1e-4 * H, dH, np.array(p), np.zeros(len(p)), x == "f64") for x in ("f32", "f64")
    )
    assert np.abs(single - double).max() <= 1e-5 * np.abs(double).max()


# ---- principal stretches -----------------------------------------------------------------------------------------------


def coincident() -> np.ndarray:
    """Turned stretches of which two or three are equal, nearly equal, or on both sides of what counts as near."""
    rng = np.random.default_rng(12)
    gaps = [(0.3, 0.3), (0.3, 0.0), (1e-12, 1.0), (1e-7, 1e-7), (1e-3, 2e-3), (0.0067, 0.0073), (0.0, 1.5)]
    out = [np.zeros((3, 3))]  # F = I
    for a, b in gaps:
        (R, Q), scale = np.linalg.qr(rng.standard_normal((2, 3, 3)))[0], rng.uniform(0.7, 1.3)
        F = R @ np.diag(scale * np.array([1, 1 + a, 1 + b])) @ Q
        out.append(F * np.sign(np.linalg.det(F)) - np.eye(3))
    return np.stack(out)


@pytest.mark.parametrize("precision, in_lanes", [("f64", True), pytest.param("f32", True, marks=pytest.mark.thorough)])
def test_stretches_may_coincide(precision, in_lanes):
    """Stress, its change and both derivatives by moduli and exponents, against differences of fifty digits."""
    H, (_, dH), (_, psi, p) = coincident(), states(), OWN["ogden"]
    tolerance = 1e-13 if precision == "f64" else 3e-5
    got = {
        key: evaluate(OgdenLaw(precision, terms=2), key, H, dH, np.array(p), changes(p), in_lanes)
        for key in ("P", "products", "jvp")
    }
    for k in range(COUNT):
        right = exact_at(psi, H[k], dH[k], p, changes(p))
        for key, found in got.items():
            size = max(10, np.abs(right[key]).max())
            np.testing.assert_allclose(
                found[k, : len(right[key])], right[key], rtol=0, atol=tolerance * size, err_msg=(k, key)
            )


@pytest.mark.parametrize("c10, c01", [(0.7, 0.4), (0.7, 0.0)])  # the latter neo-Hookean
def test_ogden_with_exponents_2_and_minus_2_is_mooney_rivlin_at_constant_volume(c10, c01):
    """Its energy there, and the part of F^T P that no pressure can add."""
    H = np.concatenate([states()[0][:4], coincident()[:4]])
    F = np.eye(3) + H
    H = F / np.cbrt(np.linalg.det(F))[:, None, None] - np.eye(3)
    one = OgdenLaw("f64", terms=2), np.array([2 * c10, -2 * c01, 2.0, -2.0, 3.0])
    other = ds.MooneyRivlin(c10=c10, c01=c01, bulk_modulus=5.0).law("f64"), np.array([c10, c01, 3.0])
    found = []
    for law, p in (one, other):
        psi, P = (evaluate(law, key, H, H, p, 0 * p, False) for key in ("psi", "P"))
        S = P[:, :9].reshape(-1, 3, 3) @ np.swapaxes(np.eye(3) + H, 1, 2)
        found.append(np.append(psi[:, 0], S - np.trace(S, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)))
    np.testing.assert_allclose(*found, rtol=0, atol=1e-13)


# ---- the same law twice ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SmithEnergy(EnergyLaw):
    """SmithNeoHookean by its energy alone."""

    coefficient_names = ("m", "l")
    last_without_lam = (5 / 8,)

    def psi(self, H, p):
        _, j, s = invariants(H)
        return p[0] / 2 * (3 * s / 4 + x_minus_log1p((s + 2 * j) / 4)) + p[1] / 2 * j * j

    def theta(self, H):
        return invariants(H)[1]


class SmithByEnergy(ds.SmithNeoHookean):
    def law(self, precision):
        return SmithEnergy(precision)


def scene(material, **changes) -> ds.Scene:
    """A cube held at one face, stretched and shaken, so that every number matters."""
    mesh = ds.TetrahedralMesh.create_cube(2, 1.0)
    noise = 0.02 * np.random.default_rng(3).standard_normal(mesh.vertices.shape)
    start = dict(initial_positions=mesh.vertices * [1.3, 1, 1] + noise, fixed="xmin", precision="f64")
    return ds.Scene(mesh, material, 1000.0, [ds.Gravity()], **start | changes)


def rollout(scene: ds.Scene, solver=ds.SemiImplicitSolver, steps: int = 2, **options) -> ds.Rollout:
    options = dict(substeps=4) | options if solver in EXPLICIT else dict(tolerance=1e-12) | options
    return ds.Rollout(solver(scene, dt=8e-3, **options), steps, gradients="all")


EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)


@pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
def test_a_law_by_its_energy_moves_like_the_one_written_by_hand(volume):
    """Motion and gradients agree to round-off, also with the change of volume averaged over patches."""
    found = []
    for material in (SmithByEnergy, ds.SmithNeoHookean):
        r = rollout(scene(material(1e4, 0.4), volume=volume))
        frames = r.forward()
        found.append((frames.positions, r.vjp(frames, np.ones_like(frames.positions) * np.arange(3))))
    (x, g), (y, h) = found
    np.testing.assert_allclose(x, y, rtol=0, atol=1e-13)
    for name in g:
        np.testing.assert_allclose(g[name], h[name], rtol=0, atol=1e-11 * np.abs(h[name]).max())


# ---- gates -------------------------------------------------------------------------------------------------------------


def per_tetrahedron(low, high):
    return np.random.default_rng(0).uniform(low, high, ds.TetrahedralMesh.create_cube(2, 1.0).num_tetrahedra)


def directions():
    return np.random.default_rng(1).standard_normal((ds.TetrahedralMesh.create_cube(2, 1.0).num_tetrahedra, 3))


def orthotropic() -> Orthotropic:
    axes = dict(direction_1=directions(), direction_2=directions()[::-1])
    moduli = {name: x if name[0] == "n" else 1e4 * x for name, x in WOOD.items()}
    return Orthotropic(**moduli | {"E3": per_tetrahedron(1e4, 1.2e4)}, **axes)


MATERIALS = {
    "yeoh": lambda: Yeoh(5e3, -500.0, per_tetrahedron(50, 200), 3e4),
    "gent": lambda: Gent(mu=1e4, limit=per_tetrahedron(5, 8), bulk_modulus=3e4),
    "knowles": lambda: Knowles(1e4, 0.3, 0.5, per_tetrahedron(0.6, 0.9)),
    "tissue": lambda: FibreReinforced(ds.StableNeoHookean(mu=1e4, lam=2e4), 5e3, 2.0, directions()),
    "orthotropic": orthotropic,
    "transversely isotropic": lambda: Orthotropic(
        E1=9e4, E2=per_tetrahedron(1e4, 2e4), nu12=0.4, nu23=0.3, G12=1e4, direction_1=(1.0, 0.5, -0.3)
    ),
    "swollen": lambda: Grown(ds.StableNeoHookean(1e4, 0.3), strain=per_tetrahedron(-0.1, 0.1)[:, None] * TENSION),
    "tensioned": lambda: InitialStress(ds.StableNeoHookean(1e4, 0.3), per_tetrahedron(-1e3, 1e3)[:, None] * TENSION),
    "ogden": lambda: Ogden([8e3, -2e3], np.stack([per_tetrahedron(1.2, 2.5), per_tetrahedron(-3, -2)], 1), 3e4),
}


def gates(r: ds.Rollout, round_off: float = 1e-12) -> None:
    assert verify.dot_product_test(r) <= round_off
    report = ds.check_gradients(r, verbose=False)
    assert report.passed, report
    assert {*r.scene.material.inputs} <= {row.input for row in report.rows}


@pytest.mark.parametrize(
    "name, solver",
    [(name, ds.SemiImplicitSolver) for name in MATERIALS]
    + [(x, ds.ImplicitEulerSolver) for x in ("tissue", "tensioned")],
)
def test_gradients_by_every_number(name, solver):
    gates(rollout(scene(MATERIALS[name]()), solver), 1e-12 if solver in EXPLICIT else 1e-10)


@pytest.mark.parametrize("name", ["gent", "tissue", "tensioned"])
def test_gradients_on_patches(name):
    gates(rollout(scene(MATERIALS[name](), volume="patches")))


def test_gradients_in_float32():
    gates(rollout(scene(MATERIALS["tissue"](), precision="f32")), 1e-5)


def tissue_with(fibre) -> FibreReinforced:
    return FibreReinforced(ds.StableNeoHookean(mu=1e4, lam=2e4), 5e3, 2.0, fibre)


def test_one_direction_for_all_takes_the_sum_of_the_gradients():
    m = directions()
    uniform, each = (rollout(scene(tissue_with(a))) for a in (m[0], np.tile(m[0], (len(m), 1))))
    one, many = (r.vjp(frames := r.forward(), np.ones_like(frames.positions))["fibre"] for r in (uniform, each))
    assert one.shape == (3,) and many.shape == m.shape
    np.testing.assert_allclose(one, many.sum(0), rtol=1e-10)


def test_fibres_per_set():
    mesh = ds.TetrahedralMesh.create_cube(2, 1.0)
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, tetrahedron_sets={"up": [0, 2]})
    fibre = tissue_with({"up": (0, 1, 0), "default": (1, 0, 0)}).values(mesh)["fibre"]
    np.testing.assert_array_equal(fibre[:3], [[0, 1, 0], [1, 0, 0], [0, 1, 0]])


def test_moduli_and_exponents_may_go_by_other_sets():
    """Which are compared on the mesh alone, where each tetrahedron has its own."""
    mesh = ds.TetrahedralMesh.create_cube(2, 1.0)
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, tetrahedron_sets={"a": [0], "b": [1]})
    exponents = {"a": [2.0], "b": [3.0], "default": [4.0]}
    material = Ogden({"a": [1.0], "default": [2.0]}, exponents, 5.0)
    np.testing.assert_allclose(material.lame(material.values(mesh))[0][:3], [1.0, 3.0, 4.0])
    with pytest.raises(ValueError, match=r"exponents / 2 must be > 0, got -1 in tetrahedron 1.*: the shear modulus"):
        Ogden({"a": [1.0], "default": [2.0]}, exponents | {"b": [-1.0]}, 5.0).values(mesh)


def test_two_families_of_fibres():
    """The stress of both adds up, and inputs of the second have names of their own."""
    a, b = [1.0, 0.3, 0], [0.2, 1.0, 0.5]
    plain = ds.StableNeoHookean(mu=1e4, lam=2e4)
    both = FibreReinforced(FibreReinforced(plain, 5e3, 2.0, a), 3e3, 1.0, b)
    assert both.inputs == ("k1_2", "k2_2", "fibre_2", "k1", "k2", "fibre", "mu", "lam")
    H, dH = states()

    def stress(material):
        p = material.coefficients({name: np.asarray(x) for name, x in material._numbers.items()})
        return evaluate(material.law("f64"), "P", H, dH, p, 0 * p, False)[:, :9]

    one, other = (FibreReinforced(plain, *numbers) for numbers in ((5e3, 2.0, a), (3e3, 1.0, b)))
    np.testing.assert_allclose(stress(both) + stress(plain), stress(one) + stress(other), rtol=0, atol=1e-9)


def uniaxial(material, stretch: float) -> tuple[float, float]:
    """(force per area at rest, stretch across) of a bar without load on its sides, by the package's statics."""
    mesh = ds.TetrahedralMesh.create_cube(2, 1.0)
    sides = dict(fixed={"xmin": "x", "ymin": "y", "zmin": "z", "xmax": "x"})
    motion = {"xmax": lambda t: [(stretch - 1) * min(t, 1.0), 0, 0]}
    s = ds.Scene(mesh, material, 1000.0, motion=motion, precision="f64", **sides)
    solver = ds.StaticSolver(s, load_steps=8, tolerance=1e-10)
    frames = ds.Rollout(solver, 1, outputs=ds.Reaction("xmax")).forward()
    x = frames.positions[-1]
    return abs(frames["reaction"][-1].ravel()[0]), float(np.ptp(x[:, 1]))


@pytest.mark.filterwarnings("ignore:Poisson")
@pytest.mark.parametrize(
    "material, energy",
    [
        (Yeoh(5e4, -2e3, 300.0, 1e7), lambda l: 5e4 * l - 2e3 * l**2 + 300 * l**3),
        (Gent(1e5, 20.0, 1e7), lambda l: -1e5 / 2 * 20 * np.log(1 - l / 20)),
    ],
    ids=["yeoh", "gent"],
)
def test_uniaxial_force_is_that_of_the_closed_form(material, energy):
    """Nearly incompressible: force per area at rest = (dpsi/di) 2 (l - 1/l^2), within mu / K."""
    stretch = 1.6
    i = stretch**2 + 2 / stretch - 3
    slope = (energy(i + 1e-6) - energy(i - 1e-6)) / 2e-6
    force, across = uniaxial(material, stretch)
    assert across == pytest.approx(stretch**-0.5, rel=5e-3)
    assert force == pytest.approx(slope * 2 * (stretch - stretch**-2), rel=0.02)


# ---- a law that sees the velocity's gradient ---------------------------------------------------------------------------


def test_viscous_stress_is_that_of_its_formula():
    """One substep from a homogeneous state: dv = h f / m with P = mu (F - K) + lam (J - 1) K + F 2 eta E_dot, K = cof F."""
    rng = np.random.default_rng(4)
    F, L = np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3)), rng.standard_normal((3, 3))
    mesh, mu, lam, eta = ds.TetrahedralMesh.create_cube(2, 1.0), 2e3, 3e3, 40.0
    x, v = mesh.vertices @ F.T, mesh.vertices @ L.T
    material = ViscousRubber(mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu)), eta)
    s = ds.Scene(mesh, material, 1000.0, initial_positions=x, initial_velocities=v, precision="f64")
    frames = ds.Rollout(ds.SemiImplicitSolver(s, dt=1e-4), 1).forward()
    K, E_dot = np.linalg.det(F) * np.linalg.inv(F).T, (F.T @ L + L.T @ F) / 2
    P = mu * (F - K) + lam * (np.linalg.det(F) - 1) * K + F @ (2 * eta * E_dot)
    derived, force = s.inputs.derive(s.inputs.values), np.zeros_like(v)
    N = np.concatenate([-derived.gradients.sum(1, keepdims=True), derived.gradients], 1)
    np.add.at(force, mesh.tetrahedra, -derived.volumes[:, None, None] * (N @ P.T))
    change = frames.velocities[-1] - v
    np.testing.assert_allclose(change, 1e-4 * force / derived.mass[:, None], rtol=0, atol=1e-11 * np.abs(change).max())


def shaken(**changes) -> ds.Scene:
    velocities = np.random.default_rng(7).standard_normal((8, 3))
    eta = per_tetrahedron(20, 40)
    motion = changes.pop("motion", lambda t: [0, 0.3 * t, 0])
    return scene(ViscousRubber(1e4, 0.3, eta), initial_velocities=velocities, motion=motion, **changes)


@pytest.mark.parametrize("solver", EXPLICIT)
def test_gradients_through_viscosity(solver):
    gates(rollout(shaken(), solver))


@dataclass(frozen=True)
class ReadsTime(EnergyLaw):
    reads = ("t",)


@pytest.mark.parametrize(
    "build, words",
    [
        (
            lambda: Ogden([1.0, 1.0], [-2.0, 1.0], 1.0),
            r"moduli \* exponents / 2 must be > 0, got -0.5: the shear modulus",
        ),
        (lambda: Ogden([1.0, 1.0], [2.0], 1.0), r"one number for each term"),
        (lambda: Ogden({"a": [1.0], "b": [2.0]}, {"a": [2.0], "b": [-2.0]}, 1.0), r"exponents / 2 must be > 0"),
        (lambda: Ogden(1.0, 2.0, 1.0), r"one number for each term"),
        (lambda: Yeoh(-1.0, 0.0, 0.0, 1.0), r"c10 must be > 0"),
        (lambda: Gent(1.0, 0.0, 1.0), r"limit must be > 0"),
        (
            lambda: FibreReinforced(ViscousRubber(1e4, 0.3, 1.0), 1.0, 1.0, [1, 0, 0]),
            r"a state or a viscosity of its own",
        ),
        (lambda: FibreReinforced(1e4, 1.0, 1.0, [1, 0, 0]), r"material must be a material such as"),
        (lambda: tissue_with([1.0, 2.0]), r"fibre must be 3 numbers or 3 per tetrahedron"),
        (lambda: tissue_with([0.0, 0, 0]), r"length of fibre must be > 0"),
        (lambda: tissue_with({"up": 1.0}), r"fibre\['up'\] must be 3 numbers"),
        (lambda: scene(tissue_with(np.ones((2, 3)))), r"shape \(\d+, 3\), got shape \(2, 3\)"),
        (
            lambda: scene(MATERIALS["knowles"](), volume="patches").law,
            r"PowerLaw does not say what its theta is; write",
        ),
        (
            lambda: rollout(shaken(), ds.ImplicitEulerSolver),
            r"ViscousLaw reads H, H_dot, but ImplicitEulerSolver supports",
        ),
        (lambda: ReadsTime("f64"), r"ReadsTime: reads must be .* got \('t',\)"),
        (lambda: shaken(volume="patches").law, r"averages energies, but ViscousLaw reads H, H_dot; take"),
        (lambda: rollout(scene(MATERIALS["tissue"]())).forward(fibre=np.ones(2)), r"fibre: expected shape"),
    ],
)
def test_what_does_not_fit_is_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize(
    "material, units, wrong",
    [
        (
            MATERIALS["tissue"](),
            "k1 [Pa], k2 [-], fibre [-], mu [Pa], lam [Pa],",
            "k2 must be finite: .* its unit is -",
        ),
        (
            MATERIALS["gent"](),
            "mu [Pa], limit [-], bulk_modulus [Pa],",
            "bulk_modulus must be finite: .* its unit is Pa",
        ),
        (MATERIALS["knowles"](), "poissons_ratio [-], b [-], n [-],", "n must be finite: .* its unit is -"),
        (ViscousRubber(1e4, 0.3, 5.0), "viscosity [Pa s],", "viscosity must be finite: .* its unit is Pa s"),
    ],
)
def test_numbers_have_units_of_their_own(material, units, wrong):
    of = scene(material)
    assert units in of.describe()
    name = wrong.split(" ")[0]
    with pytest.raises(ValueError, match=wrong):
        rollout(of).forward(**{name: np.full(of.inputs.values[name].shape, np.nan)})


def test_a_material_must_say_its_moduli():
    class Silent(Material):
        spellings = (("c", "limit", "bulk"),)

        def law(self, precision):
            return GentLaw(precision)

    with pytest.raises(NotImplementedError, match=r"Silent does not say its moduli .* write lame\(self, values\)"):
        scene(Silent(1.0, 2.0, 3.0))


@pytest.mark.parametrize("volume, steps, share", [("tetrahedra", 1, 1e-6), ("patches", 1, 1e-6), ("patches", 2, 1e-3)])
def test_gradients_of_fibres_that_are_just_slack_are_the_mean_of_both_sides(volume, steps, share):
    """Of a body that begins at rest, by where it begins and by its rest shape: what central differences give, of one
    substep; in the next fibres are not as far from being slack on one side as on the other."""
    mesh = ds.TetrahedralMesh.create_cube(2, size=0.1)
    tissue = FibreReinforced(ds.StableNeoHookean(1e4, 0.3), k1=5e4, k2=1.0, fibre=(0.6, 0.5, -0.4))
    solver = ds.SemiImplicitSolver(ds.Scene(mesh, tissue, volume=volume), dt=2e-4)
    rollout, rng = ds.Rollout(solver, steps, gradients="all"), np.random.default_rng(0)
    frames, d, e = rollout.forward(), rng.standard_normal(mesh.vertices.shape), 1e-9
    w = np.zeros(frames.positions.shape)
    w[-1] = rng.standard_normal(w[-1].shape)
    gradients = rollout.vjp(frames, velocities=w)
    for name in ("initial_positions", "rest_positions"):
        there = [(w * rollout.forward(**{name: mesh.vertices + s * d}).velocities).sum() for s in (e, -e)]
        assert (gradients[name] * d).sum() == pytest.approx((there[0] - there[1]) / (2 * e), rel=share)
