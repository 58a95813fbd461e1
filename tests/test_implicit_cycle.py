"""The preconditioner of implicit solves and conjugate gradients on the device; equilibria by load stepping."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse
import taichi as ti

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.mechanics.stress.projection import Projection
from diffsim_ti.solvers.implicit import cycle, multigrid
from diffsim_ti.solvers.implicit.contact_kernels import ContactKernels
from diffsim_ti.solvers.implicit.cycle import Cycle, upload_rows
from diffsim_ti.solvers.implicit.linear import Operator, conjugate_gradients, gmres
from diffsim_ti.solvers.implicit.multigrid import Multigrid
from diffsim_ti.solvers.implicit.rounds import Rounds


def beam(precision="f64", **more) -> ds.Scene:
    mesh = ds.TetrahedralMesh.create_box((17, 5, 5), (1.0, 0.25, 0.25))
    own = dict(fixed=mesh.vertices_where(lambda X: X[:, 0] < 1e-9), precision=precision)
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.45), 1000.0, [ds.Gravity()], **own | more)


@pytest.fixture(scope="module")
def static():
    """A workspace whose body hangs far down."""
    solver = ds.StaticSolver(beam(), preconditioner="multigrid")
    workspace = solver.workspace(solver.start_values())
    workspace.advance(0, 1, 1)
    return workspace


def preconditioner_at(workspace, u):
    workspace.potential.place(u)
    found, _ = workspace.preconditioner(np.zeros((len(u), 1)))
    found.update(u)
    return found


@pytest.mark.parametrize("spread", [0.3, 0.9], ids=["a few products", "several starts"])
@pytest.mark.parametrize("n", [1, 2, 7, 300])
@pytest.mark.parametrize("singular", [False, True])
def test_gmres_solves_what_is_neither_symmetric_nor_small(n, spread, singular):
    """With room for its basis that grows, started again, to less than it spans; of singular systems that have a solution."""
    rng = np.random.default_rng(n)
    A = np.eye(3 * n) + spread * rng.standard_normal((3 * n, 3 * n)) / np.sqrt(3 * n)
    if singular:
        A[:, 0] = A[:, 1]
    b = (A @ rng.standard_normal(3 * n)).reshape(n, 3)
    x, residual, count = gmres(lambda w: (A @ w.ravel()).reshape(n, 3), b, lambda r: 0.7 * r, 1e-9, 5000)
    assert residual <= 1e-9 and np.linalg.norm(A @ x.ravel() - b.ravel()) <= 2e-9 * np.linalg.norm(b)
    assert count > 80 or n < 300 or spread < 0.5  # what one basis spans


def test_gmres_says_what_it_cannot():
    b = np.ones((4, 3))
    x, residual, _ = gmres(lambda w: 0 * w, b, lambda r: r, 1e-6, 50)
    assert residual == 1 and np.all(np.isfinite(x))
    with pytest.raises(FloatingPointError, match="not finite"):
        gmres(lambda w: np.nan * w, b, lambda r: r, 1e-6, 50)
    assert gmres(lambda w: w, 0 * b, lambda r: r, 1e-6, 50)[2] == 0


def operators(precision: str):
    """(name, operator, preconditioner) at a state that is pulled about, for each thing that joins products on the device."""
    box, law = ds.TetrahedralMesh.create_box((5, 3, 3), (0.4, 0.2, 0.2)), ds.StableNeoHookean(1e5, 0.4)
    slides = {"xmin": "x", "ymin": [0.0, 1.0, 1.0]}
    foundation = ds.ElasticFoundation(1e6, 1e5, "ymax")
    cases = {  # much: supports in some directions, a consistent mass, a host force
        "nothing else": dict(mesh=box, fixed="xmin"),
        "much": dict(mesh=box.quadratic(), fixed=slides, terms=[foundation]),
        "self-contact": dict(mesh=box, fixed="xmin", terms=[ds.SelfContact()]),
        "a correction": dict(mesh=box, fixed="xmin"),
    }
    for name in cases if precision == "f64" else ["much"]:
        own = cases[name]
        mesh, fixed, terms = own["mesh"], own["fixed"], own.get("terms", [])
        solver = ds.ImplicitEulerSolver(ds.Scene(mesh, law, 1000.0, terms, fixed, precision=precision), dt=0.01)
        workspace = solver.workspace(solver.start_values())
        workspace.advance(0, 1, 1)
        stretch = np.array([0.5, -0.4, -0.4] if name == "a correction" else [0.2, -0.1, 0.05])
        workspace.potential.place(mesh.vertices * stretch * (mesh.vertices[:, :1] / 0.4))
        mass = 1e4 * workspace.mass
        preconditioner, _ = workspace.preconditioner(mass)
        preconditioner.update(workspace.potential.held_at)
        A = Operator(workspace.potential, mass, workspace.free)
        if name == "a correction":
            A.correction = Projection(workspace.potential)
            assert len(A.correction.C)
        yield name, A, preconditioner, workspace


@pytest.mark.parametrize("precision, most", [("f64", 1e-10), ("f32", 2e-4)])
def test_what_joins_products_on_the_device_is_what_joins_them_on_the_host(precision, most):
    """To a residual of 1e-11 or, with products in float32, 1e-5, of systems whose condition is some 1e2."""
    for name, A, preconditioner, workspace in operators(precision):
        b = np.random.default_rng(0).standard_normal((len(workspace.potential.held_at), 3)) * workspace.free
        assert A.on_device(), name
        how = dict(tolerance=1e-11 if precision == "f64" else 1e-5, max_iterations=500, eps=1e-16)
        x, residual, _, negative = conjugate_gradients(A, b, preconditioner, **how)
        A.on_device = lambda: None
        y, *_ = conjugate_gradients(A, b, preconditioner, **how)
        assert negative is None and residual <= how["tolerance"], name
        assert np.abs(x - y).max() < most * np.abs(y).max(), name
        np.testing.assert_allclose(A(x), b, rtol=0, atol=1e-4 * np.abs(b).max() if precision == "f32" else 1e-9)


@pytest.mark.parametrize("what", ["fixed", "floor", "slides", "foundation", "self-contact"])
def test_all_preconditioners_and_threads_find_the_same_steps(what):
    """Of bodies of random size, stiffness and step, across the rule that chooses: states and gradients."""
    rng = np.random.default_rng([ord(letter) for letter in what])
    for _ in range(2):
        n = rng.integers(2, 6, 3)
        mesh = ds.TetrahedralMesh.create_box(tuple(map(int, n)), tuple(0.1 * (n - 1))).translated((0, 0.012, 0))
        more = {
            "floor": [ds.Ground(friction=0.3, width=0.01)],
            "foundation": [ds.ElasticFoundation(10 ** rng.uniform(4, 7), 1e4, "ymin")],
            "self-contact": [ds.SelfContact()],
        }.get(what, [])
        fixed = dict(fixed="xmin", slides={"xmin": "x", "ymin": "y"}).get(
            what, "xmin" if what == "self-contact" else None
        )
        law, dt = ds.StableNeoHookean(10 ** rng.uniform(3.5, 7), 0.4), 10 ** rng.uniform(-3.5, -1.3)
        scene = ds.Scene(mesh, law, 1000.0, [ds.Gravity(), *more], fixed, precision="f64")
        found = []
        for options in (dict(), dict(parallel=True), dict(preconditioner="block_jacobi")):
            rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt, tolerance=1e-9, **options), 2)
            frames = rollout.forward()
            gradient = rollout.vjp(frames, np.ones_like(frames.positions))["youngs_modulus"]
            found.append((frames.displacements[-1], gradient))
        for u, gradient in found[:2]:
            assert np.abs(u - found[2][0]).max() < 1e-6 * np.abs(found[2][0]).max()
            np.testing.assert_allclose(gradient, found[2][1], rtol=1e-4)


def test_a_cycle_is_symmetric_and_positive_definite(static):
    u, rng = static.u_star, np.random.default_rng(0)
    M = preconditioner_at(static, u)
    assert len(M.cycle.levels) == 2 and np.abs(u).max() > 0.3
    assert np.abs(M.frames.matrices()[-1] - np.eye(3)).max() > 0.3
    for _ in range(4):
        a, b = (rng.standard_normal(u.shape) * static.free for _ in range(2))
        Ma, Mb = M(a), M(b)
        sizes = np.sqrt((a * Ma).sum() * (b * Mb).sum())
        assert abs((a * Mb).sum() - (b * Ma).sum()) < 2e-6 * sizes
        assert (a * Ma).sum() > 0 and not Ma[static.free[:, 0] == 0].any()


@pytest.mark.parametrize("levels", [1, 2])
def test_threads_that_share_rows_of_a_cycle_find_what_one_thread_does(static, monkeypatch, levels):
    """As on a card, up to rounding in single precision."""
    monkeypatch.setattr(Multigrid, "direct", 500 if levels == 1 else 200)
    r, found = np.random.default_rng(1).standard_normal(static.potential.held_at.shape) * static.free, {}
    for threads in (1, 8):
        monkeypatch.setattr(cycle, "threads_of", lambda M, threads=threads: threads)
        own = Multigrid(static.potential, np.zeros((len(r), 1)), static.free)
        assert len(own.cycle.levels) == levels
        found[threads] = own(r)
    assert np.abs(found[8] - found[1]).max() <= 1e-5 * np.abs(found[1]).max()


def test_a_cycle_solves_nearly(static):
    M, A = preconditioner_at(static, static.u_star), static.newton.operator()
    b = np.random.default_rng(1).standard_normal(static.u_star.shape) * static.free
    x, residual, count, negative = conjugate_gradients(A, b, M, 1e-8, 500, 1e-16)
    assert negative is None and residual <= 1e-8 and count < 40
    assert np.linalg.norm(b - A(x)) < 2e-8 * np.linalg.norm(b)


def test_conjugate_gradients_on_the_device_are_those_of_the_host(static):
    M = preconditioner_at(static, static.u_star)
    b = np.random.default_rng(2).standard_normal(static.u_star.shape) * static.free
    here = conjugate_gradients(static.newton.operator(), b, M, 1e-6, 500, 1e-16)
    there = conjugate_gradients(static.newton.operator(), b, lambda r: M(r), 1e-6, 500, 1e-16)
    assert abs(here[2] - there[2]) <= 1
    np.testing.assert_allclose(here[0], there[0], atol=1e-5 * np.abs(there[0]).max())


@pytest.mark.backends
def test_single_precision_takes_as_many_iterations_on_every_backend():
    """On Vulkan vectors have float32 and elsewhere float64; on the host they always have float64."""
    solver = ds.StaticSolver(beam("f32"), preconditioner="multigrid")
    workspace = solver.workspace(solver.start_values())
    u = 0.05 * np.sin(3 * workspace.scene.mesh.vertices[:, [1, 0, 2]]) * workspace.free
    M, b = preconditioner_at(workspace, u), np.random.default_rng(2).standard_normal(u.shape) * workspace.free
    counts = []
    for how in (M, lambda r: M(r)):
        A = Operator(workspace.potential, np.zeros((len(u), 1)), workspace.free)
        _, residual, count, negative = conjugate_gradients(A, b, how, 1e-4, 500, 1e-7)
        assert negative is None and residual <= 1e-4
        counts.append(count)
    assert counts[0] <= 1.1 * counts[1]


def test_conjugate_gradients_stop_at_negative_curvature(static):
    M = preconditioner_at(static, 0 * static.u_star)
    mass = np.full((len(static.u_star), 1), -1e3)  # far below the stiffness of slow motions
    A = Operator(static.potential, mass, static.free)
    b = np.random.default_rng(3).standard_normal(static.u_star.shape) * static.free
    found = [conjugate_gradients(A, b, how, 1e-6, 500, 1e-16) for how in (M, lambda r: M(r))]
    for x, _, _, p in found:
        assert p is not None and (p * A(p)).sum() < 0 < (b * x).sum()
    assert found[0][2] == found[1][2]
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-4 * np.abs(found[1][0]).max())


def final(solver, steps=1):
    return ds.Rollout(solver, steps).forward().positions[-1]


def test_equilibria_are_those_of_block_jacobi_and_come_with_the_same_bits(static):
    other = final(ds.StaticSolver(beam(), preconditioner="block_jacobi"))
    again = final(ds.StaticSolver(beam(), preconditioner="multigrid"))
    own = static.scene.mesh.vertices + static.u_star
    np.testing.assert_allclose(own, other, atol=1e-7)
    np.testing.assert_array_equal(own, again)


@pytest.mark.parametrize("precision, near", [("f64", 1e-7), ("f32", 2e-5)])
def test_steps_and_gradients_are_those_of_block_jacobi(precision, near):
    scene, found = beam(precision), []
    for kind in ("multigrid", "block_jacobi"):
        tolerance = 1e-8 if precision == "f64" else 1e-5
        solver = ds.ImplicitEulerSolver(scene, dt=0.02, tolerance=tolerance, preconditioner=kind)
        rollout = ds.Rollout(solver, 3, gradients=["youngs_modulus"])
        frames = rollout.forward()
        seed = np.zeros_like(frames.positions)
        seed[-1, :, 1] = 1.0
        gradient = rollout.vjp(frames, seed)
        found.append((frames.positions[-1], float(np.sum(gradient["youngs_modulus"]))))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=near)
    assert found[0][1] == pytest.approx(found[1][1], rel=1e3 * near)


def test_a_floor_keeps_the_cycle_symmetric():
    scene = beam()
    mesh = scene.mesh
    floor = ds.Ground(height=-0.02, width=0.03, stiffness=1e5)
    scene = ds.Scene(mesh, scene.material, 1000.0, [ds.Gravity(), floor], fixed=scene.fixed, precision="f64")
    solver = ds.StaticSolver(scene, preconditioner="multigrid")
    workspace = solver.workspace(solver.start_values())
    workspace.advance(0, 1, 1)
    M, rng = preconditioner_at(workspace, workspace.u_star), np.random.default_rng(0)
    assert workspace.potential.contact_blocks().any()
    a, b = (rng.standard_normal((mesh.num_vertices, 3)) * workspace.free for _ in range(2))
    Ma, Mb = M(a), M(b)
    assert abs((a * Mb).sum() - (b * Ma).sum()) < 2e-6 * np.sqrt((a * Ma).sum() * (b * Mb).sum())


# ---- what Newton's method does not find at once -------------------------------------------------------------------------


def squashed(height: float, cells: int = 5, **more) -> ds.StaticSolver:
    """A cube between plates that go together at once."""
    mesh = ds.TetrahedralMesh.create_box(cells + 1, size=1.0)
    held = mesh.vertices_where(lambda X: (X[:, 1] < 1e-9) | (X[:, 1] > 1 - 1e-9))
    top = mesh.vertices[held, 1] > 0.5

    def motion(t):
        out = np.zeros((len(held), 3))
        out[top, 1] = (height - 1) * min(t, 1.0)
        return out

    material = ds.StableNeoHookean(1e5, 0.499)
    scene = ds.Scene(mesh, material, 1000.0, [], fixed=held, motion=motion, volume="patches", precision="f64")
    return ds.StaticSolver(scene, **more)


@pytest.mark.parametrize("height", [3.0, 0.3])
@pytest.mark.filterwarnings("ignore")
def test_nearly_incompressible_cubes_are_stretched_and_squashed_in_one_load_step(height):
    x = final(squashed(height, cells=4))
    assert np.all(np.isfinite(x)) and x[:, 1].max() >= height - 1e-9


@pytest.mark.filterwarnings("ignore")
def test_an_equilibrium_that_is_not_found_at_once_is_found_in_parts():
    at_once = final(squashed(0.6))
    few = squashed(0.6, max_iterations=20)
    workspace = few.workspace(few.start_values())
    solve, calls = workspace.newton.solve, []

    def fails_at_first(*arguments, **named):
        calls.append(arguments)
        if len(calls) == 1:
            solve(*arguments, rounds=1)
            raise ds.NotConverged("made to fail", [1.0])
        return solve(*arguments, **named)

    workspace.newton.solve = fails_at_first
    workspace.advance(0, 1, 1)
    assert len(calls) > 2
    np.testing.assert_allclose(workspace.scene.mesh.vertices + workspace.u_star, at_once, atol=1e-6)


@pytest.mark.filterwarnings("ignore")
def test_what_no_part_leads_to_is_said_in_terms_of_the_problem():
    solver = squashed(0.6, max_iterations=20)
    workspace = solver.workspace(solver.start_values())
    solve = workspace.newton.solve

    def fails(*arguments, **named):
        solve(*arguments, rounds=1)
        raise ds.NotConverged("made to fail", [1.0])

    workspace.newton.solve = fails
    with pytest.raises(ds.NotConverged, match="path of equilibria .* goes to 0% of the step's loads.*limit point"):
        workspace.advance(0, 1, 1)


MODULUS = 1e5
LIMIT = MODULUS / 27**0.5  # the most that St Venant-Kirchhoff bears in compression without side motion [Pa], at nu = 0


def pressed_beyond(load: str, stress: float, load_steps: int = 1) -> ds.Rollout:
    """A block that is pressed along x in three steps, in which loads grow in time, or in one, without side motion."""
    rising = lambda t: stress * min(t / 3, 1.0)  # noqa: E731
    terms = {
        "traction": ds.Traction((-stress, 0, 0), "xmax"),
        "pressure": ds.Pressure(stress, "xmax"),
        "rising traction": ds.Traction(lambda t: (-rising(t), 0, 0), "xmax"),
        "rising pressure": ds.Pressure(rising, "xmax"),
        "weight": ds.Gravity((-stress / 50.0, 0, 0)),
    }
    fixed = {"xmin": "x", "ymin": "y", "zmin": "z", "ymax": "y", "zmax": "z"}
    material = ds.StVenantKirchhoff(MODULUS, 0.0)
    scene = ds.Scene(ds.TetrahedralMesh.create_box(2, 0.1), material, 1000.0, terms[load], fixed, precision="f64")
    return ds.Rollout(ds.StaticSolver(scene, load_steps=load_steps), 3 if "rising" in load else 1)


def share_named(rollout: ds.Rollout) -> float:
    with pytest.raises(ds.NotConverged, match="of the step's loads and prescribed motion") as error:
        rollout.forward()
    return float(re.search(r"goes to ([\d.e+-]+)% of the step's loads", str(error.value))[1]) / 100


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "load, times, share, load_steps",
    [
        ("traction", 1.02, 1 / 1.02, 7),
        ("traction", 300.0, 1 / 300, 1),
        ("pressure", 3.0, 1 / 3, 1),
        ("rising traction", 20.0, 0.15, 1),  # in the first of three steps
        ("rising pressure", 20.0, 0.15, 7),
        ("rising pressure", 1.02, 1 / 1.02, 1),  # in the last
    ],
)
def test_what_is_beyond_a_limit_load_says_the_share_that_is_borne(load, times, share, load_steps):
    assert share_named(pressed_beyond(load, times * LIMIT, load_steps)) == pytest.approx(share, rel=0.02)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("load", ["traction", "pressure", "weight"])
def test_a_little_less_than_the_share_that_is_named_is_borne(load):
    share = share_named(pressed_beyond(load, 3 * LIMIT))
    u = pressed_beyond(load, 0.99 * share * 3 * LIMIT).forward().displacements[-1]
    assert -0.05 < u[:, 0].min() < -0.02
    assert share_named(pressed_beyond(load, 1.02 * share * 3 * LIMIT)) > 0.97


def moving(name: str) -> ds.Rollout:
    shape = ((2, 2, 3), 0.1) if name == "blocks" else ((3, 3, 4), (0.2, 0.2, 0.3))
    mesh = ds.TetrahedralMesh.create_box(*shape).translated((0.0, 0.006, 0.0))
    terms, fixed = [ds.Gravity(), ds.Ground(friction=0.3, width=5e-3)], None
    if name in ("slides", "balance"):
        terms, fixed = [ds.Gravity()], {"xmin": "x", "ymin": [0.0, 1.0, 1.0], "zmin": "z"}
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.4), 1000.0, terms, fixed, precision="f64")
    return ds.Rollout(ds.StaticSolver(scene) if name == "balance" else ds.ImplicitEulerSolver(scene, dt=0.01), 1)


def as_one_kernel(monkeypatch) -> None:
    """Rounds of small bodies."""


def in_turn(monkeypatch) -> None:
    monkeypatch.setattr(Rounds, "small", 0)


def solved_on_the_host(monkeypatch) -> None:
    monkeypatch.setattr(Rounds, "_limit", lambda self: 0)


FORMS = as_one_kernel, in_turn, solved_on_the_host


@pytest.mark.parametrize("name", ["blocks", "multigrid", "slides", "balance"])
def test_rounds_lead_to_the_same_in_each_form(name, monkeypatch):
    found = []
    for form in FORMS:
        with monkeypatch.context() as changed:
            form(changed)
            rollout = moving(name)
            frames = rollout.forward()
            found.append((frames.positions, rollout.vjp(frames, frames.positions)["youngs_modulus"]))
    x, by_E = found[0]
    for other, by_other_E in found[1:]:
        assert np.abs(x - other).max() <= 1e-9 * np.ptp(x, 0).max() and abs(by_E - by_other_E) <= 1e-6 * abs(by_other_E)


def test_rounds_go_on_where_the_hessian_is_indefinite(monkeypatch):
    """A column that is pressed beyond its buckling load: the same minimum in each form."""
    mesh, runs = ds.TetrahedralMesh.create_box((9, 2, 2), (0.8, 0.1, 0.1)), []
    pressed = [ds.Traction([-6e3, 0.0, 1.0], "xmax")]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, pressed, "xmin", precision="f64")
    solver = ds.ImplicitEulerSolver(scene, dt=0.5)
    for form in FORMS:
        with monkeypatch.context() as changed:
            form(changed)
            workspace = solver.workspace(solver.start_values())
            workspace.advance(0, 1, 1)
            runs.append((workspace.u_star, workspace.newton.report.indefinite))
    assert all(indefinite > 0 for _, indefinite in runs)
    for u, _ in runs[1:]:
        assert np.abs(runs[0][0] - u).max() < 1e-4 * np.abs(u).max()


def stretched() -> ds.StaticSolver:
    """A plate that gets eight times as thick in six steps."""
    mesh = ds.TetrahedralMesh.create_box((5, 11, 11), (0.4, 1.0, 1.0), pattern="five")
    fixed = {"xmin": "x", "xmax": "x", "ymin": "y", "zmin": "z"}
    motion = {"xmax": lambda t: [0.4 * (8 ** (t / 6) - 1), 0.0, 0.0]}
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e3, 0.3), 1.0, fixed=fixed, motion=motion, precision="f64")
    return ds.StaticSolver(scene, dt=1.0, preconditioner="multigrid")


def test_contact_holds_a_loose_body_on_coarse_levels(monkeypatch):
    """An equilibrium on a floor, where nothing else stiffens rigid motions, takes a third of the products or less."""
    mesh = ds.TetrahedralMesh.create_box(4, 0.2, origin=(0.0, 0.0005, 0.0))
    terms = [ds.Gravity(), ds.Ground(friction=0.4)]
    scene, found = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.4), terms=terms, precision="f64"), []
    for loose in (multigrid.is_loose, lambda _: False):
        monkeypatch.setattr(multigrid, "is_loose", loose)
        rollout = ds.Rollout(ds.StaticSolver(scene), 1, gradients=["youngs_modulus"])
        with pytest.warns(UserWarning, match="free to move rigidly"):
            frames = rollout.forward()
        gradient = rollout.vjp(frames, frames.displacements)["youngs_modulus"]
        found.append((frames.displacements[-1], gradient, rollout.report.products))
    (u, g, few), (v, h, many) = found
    assert few <= many / 3
    np.testing.assert_allclose(u, v, atol=1e-7 * np.abs(v).max())
    np.testing.assert_allclose(g, h, rtol=1e-6)


def test_what_is_held_altogether_is_not_loose():
    """Its coarse levels have no numbers."""
    assert not multigrid.is_loose(scipy.sparse.bsr_matrix((6, 6)))


def test_matrices_of_the_strained_state(monkeypatch):
    """They save iterations, come back with a state to the bit, and leave results as they are."""
    found = {}
    for price in ((10, 0), (1e9, 0)):
        monkeypatch.setattr(Multigrid, "price", price)
        rollout = ds.Rollout(stretched(), 6, gradients=["poissons_ratio"])
        frames = rollout.forward()
        assert (rollout.sweep.workspace.preconditioner.following.place is not None) == (price[0] == 10)
        gradient = rollout.vjp(frames, frames.displacements)["poissons_ratio"]
        found[price[0]] = frames.displacements[-1], gradient, rollout.report.products
        again = rollout.forward()
        assert np.array_equal(frames.displacements, again.displacements)
        assert gradient == rollout.vjp(again, again.displacements)["poissons_ratio"]
    (u, g, few), (v, h, many) = found.values()
    assert few < 0.8 * many
    np.testing.assert_allclose(u, v, atol=1e-7 * np.abs(v).max())
    np.testing.assert_allclose(g, h, rtol=1e-6)
    monkeypatch.setattr(Multigrid, "price", (10, 0))
    with monkeypatch.context() as refusing:  # entries in other places: as at rest from there on
        refusing.setattr(Cycle, "put", lambda *_: False)
        rollout = ds.Rollout(stretched(), 6, gradients=["poissons_ratio"])
        frames = rollout.forward()
        np.testing.assert_allclose(frames.displacements[-1], v, atol=1e-7 * np.abs(v).max())
        np.testing.assert_allclose(rollout.vjp(frames, frames.displacements)["poissons_ratio"], h, rtol=1e-6)
    simulator, other = (ds.Simulator(stretched()) for _ in range(2))
    simulator.run(5)
    state = {name: x.copy() for name, x in simulator.state.items()}
    simulator.step()
    other.resume(state)
    other.step()
    assert len(state["preconditioner"]) > 2 and np.array_equal(simulator.displacements, other.displacements)
    with pytest.raises(ValueError, match="preconditioner: expected 2 finite numbers, or 1817"):
        other.resume(state | dict(preconditioner=np.zeros(3)))


def test_the_inverse_of_a_single_level_follows_the_strained_state(monkeypatch):
    monkeypatch.setattr(Multigrid, "direct", 1000)
    found = []
    for price in ((10, 0), (1e9, 0)):
        monkeypatch.setattr(Multigrid, "price", price)
        rollout = ds.Rollout(stretched(), 6)
        found.append((rollout.forward().displacements[-1], rollout.report.products))
    (u, few), (v, many) = found
    assert few < 0.6 * many
    np.testing.assert_allclose(u, v, atol=1e-7 * np.abs(v).max())


def test_coarse_levels_take_stiff_contact_of_those_scenes_that_have_it():
    """Of five cubes two are thrown at a rough floor: its stiffness is in their inverse, the others keep what they have."""
    mesh = ds.TetrahedralMesh.create_cube(6, 0.1)
    terms = [ds.Gravity(), ds.Ground(-4e-3, 1e3, 2e-3, friction=0.3)]
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), 1000.0, terms, precision="f64")
    batch, n = ds.Batch(ds.ImplicitEulerSolver(scene, dt=5e-3), 1, 5), mesh.num_vertices
    thrown = np.array([False, True, False, False, True])
    batch.forward(
        initial_velocities=np.where(thrown[:, None, None], [0.5, -1.0, 0], [0.5, 0.1, 0]) * np.ones((5, n, 3))
    )
    own = batch.sweep.workspace.newton.preconditioner
    inverse, before, k = own.cycle.inverse, own._made[0][-1].toarray(), own.cycle.levels[-1].nodes // 5
    start, column, rows = (runtime.fetch(x) for x in (inverse.start, inverse.column, inverse.values))
    found = np.zeros((5 * k, 6, 5 * k, 6))
    found[np.repeat(np.arange(5 * k), np.diff(start)), :, column] = rows.reshape(-1, 6, 8)[..., :6].swapaxes(1, 2)
    found, M = found.reshape(30 * k, -1), own._below[-1].toarray()
    np.testing.assert_allclose(found, np.linalg.inv(M), atol=1e-6 * np.abs(found).max())
    changed = np.abs(M - before).reshape(5, 6 * k, -1).max((1, 2)) > 0.1 * np.abs(before).max()
    assert list(changed) == list(thrown)


def test_contact_joins_the_finest_level_turned_back_without_what_is_negative():
    """Blocks of full rank, of rank one, none; an axis that is held; a block that only the host can invert."""
    rng, n = np.random.default_rng(0), 60
    C, B, normal = rng.standard_normal((n, 3, 3)), rng.standard_normal((n, 3, 3)), rng.standard_normal((20, 3))
    C, B = C + np.swapaxes(C, 1, 2), B @ np.swapaxes(B, 1, 2) + np.eye(3)
    C[:20], C[20:30], B[59], C[59] = normal[:, :, None] * normal[:, None], 0, 0, -np.eye(3)
    R = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0].astype(np.float32).astype(float)
    P = np.tile(np.eye(3), (n, 1, 1))
    P[40:50, 0, 0] = 0
    blocks, own = (runtime.array(runtime.array_types("f64")["vectors"].dtype, 3, n) for _ in range(2))
    runtime.fill(blocks, np.moveaxis(C, 2, 0))
    runtime.fill(own, np.moveaxis(B, 2, 0))
    marks = [runtime.array(ti.i32, n) for _ in range(3)]
    level = SimpleNamespace(diagonal=upload_rows(np.zeros((n, 3, 3))), inverse=upload_rows(np.zeros((n, 3, 3))))
    ContactKernels("f64", "f64", False).join.bind(
        at=SimpleNamespace(blocks=blocks),
        frames=SimpleNamespace(turned=upload_rows(R), allowed=upload_rows(P)),
        turning=SimpleNamespace(hard=marks[0]),
        level=level,
        body=SimpleNamespace(own=own, touched=marks[1], hard=marks[2]),
    )(vertices=n, theta=2.0)
    values, vectors = np.linalg.eigh(C)
    positive = (vectors * np.maximum(values, 0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    D, on = B + np.swapaxes(R, 1, 2) @ P @ positive @ P @ R, C.any((1, 2))
    found, inverse = (np.swapaxes(runtime.fetch(x).reshape(-1, 3, 3), 1, 2) for x in (level.diagonal, level.inverse))
    np.testing.assert_allclose(found[on], D[on], atol=1e-6 * np.abs(D).max())
    np.testing.assert_allclose(inverse[on][:-1], np.linalg.inv(D[on][:-1]) / 2, atol=1e-6)
    assert np.array_equal(runtime.fetch(marks[1]) > 0, on)
    assert np.flatnonzero(runtime.fetch(marks[2])).tolist() == [59]
