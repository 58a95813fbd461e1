"""Linear solves of equilibria that are hard, what statics leave free, and what acts together in implicit passes."""

import itertools
import warnings

import battery_of_equilibria as battery
import numpy as np
import pytest
from chamber_meshes import hollow_cube

import diffsim_ti as ds
from diffsim_ti.mechanics.stress.projection import Projection
from diffsim_ti.mechanics.supports.mobility import free_motions
from diffsim_ti.solvers.implicit.factorised import Effort, Factorised
from diffsim_ti.solvers.implicit.linear import Operator, conjugate_gradients, gmres, solve
from diffsim_ti.solvers.implicit.preconditioners import BlockJacobi

LAW = ds.StableNeoHookean(1e5, 0.3)


# ---- what is left free ------------------------------------------------------------------------------------------------


def on_a_lattice(rng) -> ds.TetrahedralMesh:
    """Up to four cells of a sheared lattice that meet at faces, edges, vertices, or not."""
    cells = [np.zeros(3, int)]
    while len(cells) < rng.integers(1, 5):
        there = cells[rng.integers(len(cells))] + rng.integers(-1, 2, 3) * (1 if rng.uniform() < 0.8 else 2)
        cells += [] if any((there == own).all() for own in cells) else [there]
    boxes = [ds.TetrahedralMesh.create_box(2, 1.0, origin=own.astype(float)) for own in cells]
    X = np.vstack([box.vertices for box in boxes])
    _, first, place = np.unique(np.round(X, 9), axis=0, return_index=True, return_inverse=True)
    tetrahedra = place.ravel()[np.vstack([box.tetrahedra + 8 * k for k, box in enumerate(boxes)])]
    shear = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    return ds.TetrahedralMesh(X[first] @ shear.T + 10 * rng.integers(2), tetrahedra, fix_orientation=True)


def held_somehow(rng, mesh: ds.TetrahedralMesh, order: int) -> ds.Scene:
    """By some springs, cables, foundations and supports, which may be enough."""
    n, terms, fixed = mesh.num_vertices, [], {}
    for k in range(rng.integers(0, 4)):
        kind, (a, b), name = rng.integers(5), map(int, rng.choice(n, 2, replace=False)), f"term_{k}"
        if kind == 0:
            terms.append(ds.Spring(a, b, 1e5, name=name))
        elif kind == 1:
            own = rng.choice(n, rng.integers(1, 7), replace=False)
            terms.append(ds.Spring(own, ds.Anchor(rng.uniform(-4, 4, (len(own), 3))), 1e5, name=name))
        elif kind == 2:
            terms.append(ds.Spring(a, ds.Anchor(mesh.vertices[a]), 1e5, name=name))
        elif kind == 3:
            c = rng.uniform(-4, 4, 3)
            rest = np.linalg.norm(np.diff([mesh.vertices[a], mesh.vertices[b], c], axis=0), axis=1).sum()
            slack = 0.2 * rng.integers(2) - 1e-10
            terms.append(ds.Cable([a, b, ds.Anchor(c)], length=rest * (1 + slack), stiffness=1e5, name=name))
        elif kind == 4:
            terms.append(ds.ElasticFoundation(*(1e5 * rng.integers(0, 2, 2)).tolist(), name=name))
    for k in range(rng.integers(0, 3)):
        mesh = mesh.with_vertex_set(f"set_{k}", rng.choice(n, rng.integers(1, 4), replace=False))
        fixed[f"set_{k}"] = str(rng.choice(["x", "y", "z", "xy", "yz", "xyz"]))
    return ds.Scene(mesh.quadratic() if order == 2 else mesh, LAW, terms=terms, fixed=fixed or None)


def test_what_is_left_free_is_the_kernel_of_the_stiffness():
    """That of dense eigenvalues, of bodies of several pieces and parts that meet at edges and vertices."""
    verdicts, hinges = [], 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        scene = held_somehow(rng, on_a_lattice(rng), 1 + seed % 2)
        n = scene.mesh.num_vertices
        K, P = scene.stiffness_matrix().toarray().reshape(n, 3, n, 3), scene.supports.freedom(n)
        K = np.einsum("aij,ajbk,bkl->aibl", P, K, P, optimize=True).reshape(3 * n, 3 * n)
        size = np.abs(K).max()
        for k in range(n):
            K[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += size * (np.eye(3) - P[k])
        said = free_motions(scene)
        verdicts.append(np.linalg.eigvalsh(K)[0] < 1e-9 * size)
        assert bool(said) == verdicts[-1], (seed, said)
        hinges += "hinge" in said
    assert 5 < sum(verdicts) < 25 and hinges > 2


def test_statics_name_pieces_that_are_joined_and_hinges():
    box = ds.TetrahedralMesh.create_cube(2)
    two = ds.TetrahedralMesh.joined([box, box.translated([1.5, 0, 0])])
    left = np.flatnonzero(two.vertices[:, 0] < 1e-9)
    bars = ds.Spring(box.vertex_indices("xmax"), box.vertex_indices("xmin") + 8, 1e3)  # along one direction
    for terms, words in (
        ([], r"piece 1 of 2 of the body is free to move rigidly \(6 rigid modes"),
        (
            [bars],
            r"piece 1 of 2 of the body is free to move rigidly \(2 translations, 1 rotation: along y and z, about x\)",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            ds.StaticSolver(ds.Scene(two, LAW, terms=terms, fixed=left))
    with pytest.raises(
        ValueError, match="pieces 0, 1 of 2 of the body, which springs or cables join, are free .*6 rigid"
    ):
        ds.StaticSolver(
            ds.Scene(two, LAW, terms=[ds.Spring(np.arange(8), np.arange(8, 16), 1e3), ds.Spring(0, 9, 1e3)])
        )
    across = ds.Spring(box.vertex_indices("xmax"), np.roll(box.vertex_indices("xmin"), 1) + 8, 1e3)
    ds.StaticSolver(ds.Scene(two, LAW, terms=[bars, across], fixed=left))


# ---- factorisations ---------------------------------------------------------------------------------------------------


def placed(terms, volume="tetrahedra", **options):
    """A workspace in its first pass, its body bent; multiplied by the Hessian."""
    mesh = ds.TetrahedralMesh.create_box((7, 3, 3), (0.6, 0.2, 0.2)).with_vertex_set("corner", [0, 8, 20, 42])
    scene = ds.Scene(mesh, LAW, 1000.0, terms, precision="f64", volume=volume, **options)
    solver = ds.StaticSolver(scene)
    workspace = solver.workspace(solver.start_values())
    u = np.zeros_like(mesh.vertices)
    workspace.begin(0, solver.stage(0.0, True, 0), u, u)
    u[:, 1] = 0.02 * mesh.vertices[:, 0] ** 2
    workspace.potential.place(u * np.linalg.norm(workspace.linear * np.ones_like(u), axis=1, keepdims=True).clip(0, 1))
    return workspace, Operator(workspace.potential, np.zeros((len(u), 1)), workspace.free, workspace.newton.others)


ATTACHED = [
    ds.Spring([5, 9, 40], ds.Anchor([0.3, 1.0, 0.1]), 300.0, tension=2.0),
    ds.Spring(10, 50, 500.0, tension=-1.0, name="strut"),
    ds.Cable([1, 30, 60], tension=5.0),
    ds.Muscle([1, 0, 0], 2e3, 1.0),
    ds.ElasticFoundation(1e5, 2e4, "ymin"),
]
SUPPORTS = {"clamp": "xmin", "roller": {"xmin": "xyz", "corner": [[0.0, 1, 1]]}, "foundation": None}
LOADS = {"closed": [ds.Pressure(500.0)], "open": [ds.Pressure(800.0, "ymax")], "none": []}


@pytest.mark.parametrize("support, load", [("clamp", "open"), ("roller", "closed"), ("foundation", "none")])
def test_factorised_is_the_whole_hessian(support, load):
    """All that couples few vertices: M^-1 A x is x, of both ways round and with what a projection adds."""
    workspace, A = placed([*ATTACHED, *LOADS[load]], fixed=SUPPORTS[support])
    x = np.random.default_rng(0).standard_normal(workspace.potential.held_at.shape) * workspace.free
    assert A.symmetric == (load != "open")
    for correction, transposed in ((None, False), (None, True), (Projection(workspace.potential), False)):
        own = Operator(A.potential, A.mass, A.free, A.others, transposed)
        own.correction = correction
        M = own.factorised()
        exact = M(own(x))
        if correction is not None:  # products of ties leave out what pushes
            assert np.abs(exact - x).max() < 0.1 * np.abs(x).max()
            continue
        assert M.negative == 0 and np.abs(exact - x).max() < 1e-7 * np.abs(x).max()
        b = x if not transposed else own(x)
        np.testing.assert_allclose(own(solve(own, b, M, 1e-12, 1e-16, 50)), b, atol=1e-9 * np.abs(b).max())


def test_a_factorisation_turns_what_is_negative_round():
    """L |D| L^T of an indefinite Hessian is positive definite, and conjugate gradients meet negative curvature at once."""
    workspace, A = placed([], fixed="xmin")
    K = np.array([A(e.reshape(-1, 3)).ravel() for e in np.eye(3 * len(A.mass))])
    free = np.repeat(workspace.free[:, 0] > 0, 3)
    values = np.linalg.eigvalsh(K[free][:, free])
    shift = 0.5 * (values[4] + values[5])
    A.mass = np.full_like(A.mass, -shift)
    M, rng = A.factorised(), np.random.default_rng(1)
    assert M.negative == 5 and A.saddle_is_known
    a, b = (rng.standard_normal(A.mass.shape[:1] + (3,)) * workspace.free for _ in range(2))
    assert abs((a * M(b)).sum() - (b * M(a)).sum()) < 1e-9 * abs((a * M(a)).sum()) and (b * M(b)).sum() > 0
    x, _, count, p = conjugate_gradients(A, b, M, 1e-10, 100, 1e-16)
    assert count <= 2 and (p * A(p)).sum() < 0 < (b * x).sum()
    found = solve(A, b, M, 1e-9, 1e-16, 100)  # which MINRES ends
    assert np.linalg.norm(b - A(found)) <= 1e-9 * np.linalg.norm(b)


class Wrong(BlockJacobi):
    """Not positive definite."""

    def __call__(self, r):
        return r * np.where(np.arange(len(r)) % 2, 1.0, -1.0)[:, None]


class Slow(BlockJacobi):
    """Worth nothing: products alone."""

    patience = 7

    def __call__(self, r):
        return r


@pytest.mark.parametrize("fits", [True, False])
@pytest.mark.parametrize("kind", [Wrong, Slow])
def test_a_preconditioner_that_fails_is_replaced_with_a_word(kind, fits, monkeypatch):
    workspace, A = placed([], fixed="xmin")
    b = np.random.default_rng(2).standard_normal((len(A.mass), 3)) * workspace.free
    right = A.factorised()(b)
    monkeypatch.setattr(Effort, "fits", property(lambda self: fits))
    monkeypatch.setattr(Effort, "large", 0)
    M, A.products = kind(A.potential, A.mass, A.free, A.mass), 0
    M.solver = None  # on the host, where their own calls count
    words = "not positive definite" if kind is Wrong else "take more than 7 products of a Hessian of 189 unknowns"
    with pytest.warns(UserWarning, match=words):
        x, residual, count, negative = conjugate_gradients(A, b, M, 1e-9, 5000, 1e-16)
    assert negative is None and residual <= 1e-9
    np.testing.assert_allclose(x, right, atol=1e-6 * np.abs(right).max())
    assert (A.products < 20) == fits
    with warnings.catch_warnings():  # said once, and not tried again in this pass
        warnings.simplefilter("error")
        before = A.products
        conjugate_gradients(A, b, M, 1e-9, 5000, 1e-16)
        assert not fits or A.products - before < 5
    if kind is Slow:
        M.begin()
        assert gmres(A, b, M, 1e-9, 5000)[1] <= 1e-9


def test_factorisations_are_those_of_one_state():
    """Of another correction another, of bodies that move by few numbers none."""
    workspace, A = placed([], fixed="xmin")
    first = A.factorised()
    assert A.factorised() is first
    A.correction = Projection(workspace.potential)
    assert A.factorised() is not first
    workspace, A = placed([ds.ElasticFoundation(1e5, 1e5)], reduced={"corner": "affine"})
    assert Factorised.of(A) is None


# ---- equilibria -------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "preconditioner, held",
    [("block_jacobi", "clamp"), ("multigrid", "foundation"), ("block_jacobi", "springs"), ("multigrid", "tied pieces")],
)
def test_slender_equilibria_end_after_few_products(held, preconditioner):
    """Of those of the battery, linear tetrahedra; conjugate gradients alone took thousands of products."""
    case = dict(element="linear", aspect=100, flat=False, nu=0.45, contrast=1e4, law=ds.StableNeoHookean, grown=0.0)
    case |= dict(cells=60, held=held, preconditioner=preconditioner, precision="f64")
    scene = battery.scene_of(case | dict(rng=np.random.default_rng(0)), 1e-4)
    expected, _ = battery.direct(scene)
    scene = battery.scene_of(case | dict(rng=np.random.default_rng(0)), 1e-11 / np.abs(expected).max())
    simulator = ds.Simulator(ds.StaticSolver(scene, preconditioner=preconditioner))
    simulator.step()
    effort = Effort.of(scene.mesh)
    assert simulator.report.products < 4 * effort.patience + 200
    u, expected = simulator.positions - scene.mesh.vertices, 1e-11 / np.abs(expected).max() / 1e-4 * expected
    assert np.abs(u - expected).max() < 1e-3 * np.abs(expected).max()


# ---- what acts together -----------------------------------------------------------------------------------------------


def test_every_two_terms_act_together_in_implicit_passes():
    """A solver for each pair, by turns; all of them are `battery_of_equilibria.py --pairs`."""
    mesh = hollow_cube()
    names = list(battery.terms_by_name(mesh))[:9]  # these need no kernels of their own
    for number, pair in enumerate(itertools.combinations(names, 2)):
        solvers = battery.IMPLICIT[-1:] if pair[0] == "filled chamber" else ()
        for solver in {battery.IMPLICIT[number % 4], *solvers}:
            said = battery.run_pair(mesh, pair, solver)
            assert not said, (pair, solver.__name__, said)
