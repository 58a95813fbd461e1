"""Contact between surfaces in implicit solvers: nothing passes through, gradients are right, equilibria are found."""

from functools import lru_cache

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from test_self_contact import MATERIAL, crossed_edges, momenta, two_blocks

import diffsim_ti as ds
from diffsim_ti import runtime, verify
from diffsim_ti.solvers.implicit.cycle import Cycle, diagonal_blocks, without
from diffsim_ti.solvers.implicit.multigrid import Multigrid
from diffsim_ti.solvers.implicit.rounds import Rounds

SOLVERS = (ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver)
solvers = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.__name__)


@pytest.mark.parametrize("precision", ["f32", "f64"])
@solvers
def test_large_steps_keep_bodies_apart_and_their_momentum(solver, precision):
    """Steps twenty or forty times those of the explicit test; the longer ones go twice the width."""
    tolerance, dt = 1e-10 if precision == "f64" else 1e-5, 2e-3 if solver is ds.ImplicitMidpointSolver else 4e-3
    simulator = ds.Simulator(solver(two_blocks(precision).scene, dt=dt, tolerance=tolerance))
    (p, L, size), contact, gap = momenta(simulator), 0.0, np.inf
    for _ in range(round(0.048 / dt)):
        simulator.step()
        contact = max(contact, simulator.compute_energy().parts["contact"])
        gap = min(gap, simulator.smallest_gap())
    assert contact > 0 and 0 < gap < 5e-3
    simulator.check_surfaces()
    p1, L1, _ = momenta(simulator)
    assert np.abs(p1 - p).max() <= 10 * tolerance * size
    if precision == "f64" and solver is ds.ImplicitMidpointSolver:  # the others damp rotation
        assert np.abs(L1 - L).max() <= 10 * tolerance * size


def test_directions_of_the_host_are_those_of_the_device(monkeypatch):
    """Two blocks that meet."""
    scene, found = two_blocks().scene, []
    for on_device in (True, False):
        if not on_device:
            monkeypatch.setattr(Rounds, "_limit", lambda rounds: 0)
        rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=4e-3), 10)
        found.append((rollout.forward().displacements[-1], rollout.report.iterations))
    (u, rounds), (v, others) = found
    np.testing.assert_allclose(u, v, atol=1e-6 * np.abs(v).max())
    assert abs(rounds - others) <= 0.1 * others


@lru_cache
def meeting(solver):
    """Edge across edge, met within the first two steps."""
    return ds.Rollout(solver(crossed_edges().scene, dt=1e-3, tolerance=1e-12), 5, gradients="all")


def test_gradients_agree_with_differences():
    rollout = meeting(ds.ImplicitEulerSolver)
    frames = rollout.forward()
    loss = verify.linear_loss(rollout)
    _, *adjoints = loss(frames)
    gradients = rollout.vjp(frames, *adjoints)
    assert gradients["self_contact_stiffness"] != 0
    rng = np.random.default_rng(0)
    for name in rollout.wanted:
        x = rollout.values[name]
        direction = rng.standard_normal(x.shape) * (np.abs(x).max() if x.ndim == 0 else 0.01)
        slope, step = float((gradients[name] * direction).sum()), 1e-4
        values = [loss(rollout.forward(**{name: x + s * step * direction}))[0] for s in (-1, 1)]
        assert (values[1] - values[0]) / (2 * step) == pytest.approx(slope, rel=1e-5, abs=1e-8), name


@pytest.mark.executed_ptx
@solvers
def test_tangent_and_adjoint_agree(solver):
    assert verify.dot_product_test(meeting(solver)) <= 1e-9


@pytest.mark.executed_ptx
def test_checkpoints_do_not_change_a_bit():
    scene = two_blocks().scene
    whole, pieces = (
        ds.Rollout(ds.BDF2Solver(scene, dt=2e-3), 12, checkpoint_every=k, gradients="all") for k in (None, 5)
    )
    adjoints = np.random.default_rng(1).normal(size=(2, 2, scene.mesh.num_vertices, 3))
    found = []
    for rollout in (whole, pieces):
        frames = rollout.forward()
        found.append((frames.positions, rollout.vjp(frames, *adjoints)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    for name in found[0][1]:
        np.testing.assert_array_equal(found[0][1][name], found[1][1][name], err_msg=name)


def test_products_and_diagonal_of_the_hessian():
    """The product skips what planes keep apart: same result; the convex part is positive, its diagonal as from products."""
    simulator = ds.Simulator(ds.ImplicitEulerSolver(two_blocks().scene, dt=2e-3))
    for _ in range(40):
        simulator.step()
        if simulator.compute_energy().parts["contact"] > 0:
            break
    workspace = simulator.workspace
    potential, pairs, a = workspace.potential, workspace.pairs, workspace.arrays
    u = potential.place(workspace.read(workspace.state, 0)[0])
    tail = slice(a.first_contact_corner, None)
    w = np.random.default_rng(0).standard_normal(u.shape)
    runtime.fill(potential.w, w[None])
    pairs.launch(pairs.multiplying(potential.u, potential.w, False))
    mine = runtime.fetch(a.corner)[tail].copy()
    pairs.product(potential.u, 0, potential.w, a.corner)
    other = runtime.fetch(a.corner)[tail]
    assert np.abs(other).max() > 0
    np.testing.assert_allclose(mine, other, atol=1e-12 * np.abs(other).max())
    pairs.launch(pairs.multiplying(potential.u, potential.w, True))
    assert -(runtime.fetch(a.corner)[tail] * w[a.mesh.surface_vertices]).sum() > 0
    blocks, i = potential.contact_blocks(), int(np.abs(potential.contact_blocks()).sum((1, 2)).argmax())
    for d in range(3):
        unit = np.zeros_like(u)
        unit[i, d] = 1
        runtime.fill(potential.w, unit[None])
        pairs.launch(pairs.multiplying(potential.u, potential.w, True))
        column = -runtime.fetch(a.corner)[tail][np.searchsorted(a.mesh.surface_vertices, i)]
        np.testing.assert_allclose(blocks[i][:, d], column, atol=1e-12 * np.abs(blocks[i]).max())


def stacked(cells: int = 4, order: int = 1, **more) -> ds.Scene:
    """A cube thrown down and sideways on one that is held, rough, within the reach of contact."""
    cube = ds.TetrahedralMesh.create_box(cells + 1, 0.1)
    mesh = ds.TetrahedralMesh.joined([cube, cube.translated([0.01, 0.1006, 0.013])])
    mesh = mesh.quadratic() if order == 2 else mesh
    held, upper = mesh.vertices[:, 1] < 1e-9, mesh.vertices[:, 1:2] > 0.1003
    v = upper * np.array([0.1, -1.0, 0.0])
    terms = [ds.Gravity(), ds.SelfContact(1e4, 1e-3, friction=0.5)]
    own = dict(fixed=held, initial_velocities=v, precision="f64")
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.4), 1000.0, terms, **own | more)


def bent() -> ds.Scene:
    """Of ten nodes whose faces are curved, so that pairs are those of a finer surface."""
    scene = stacked(2, order=2)
    X = scene.mesh.vertices.copy()
    X[:, 1] += 0.01 * np.sin(10 * X[:, 0])
    return scene.replace(mesh=ds.TetrahedralMesh(X, scene.mesh.elements))


@pytest.mark.parametrize("scene", [stacked, bent], ids=["flat", "curved"])
def test_the_matrix_of_contact_is_that_of_products(scene):
    """Of the convex part and of friction; it is at most `overlap` times its diagonal blocks, which bounds the smoother."""
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene(), dt=1e-3))
    simulator.step()
    workspace = simulator.workspace
    potential, pairs, a = workspace.potential, workspace.pairs, workspace.arrays
    u = potential.place(workspace.read(workspace.state, 0)[0])
    matrix, diagonal = pairs.stiffness(potential.u)
    assert pairs.inner.friction.count > 0 and matrix.data.any()
    w = np.random.default_rng(0).standard_normal(u.shape)
    runtime.fill(potential.w, w[None])
    pairs.launch(pairs.multiplying(potential.u, potential.w, True))
    product, surface = np.zeros_like(u), a.mesh.surface_vertices
    product[surface] = -runtime.fetch(a.corner)[a.first_contact_corner :][: len(surface)]
    np.testing.assert_allclose((matrix @ w.ravel()).reshape(-1, 3), product, atol=1e-12 * np.abs(product).max())
    np.testing.assert_allclose(diagonal, potential.contact_blocks(), atol=1e-12 * np.abs(diagonal).max())
    more = pairs.overlap * scipy.linalg.block_diag(*diagonal) - matrix.toarray()
    assert np.linalg.eigvalsh(more)[0] > -1e-9 * np.abs(more).max()


def test_contact_costs_few_products_and_leaves_results_as_they_are(monkeypatch):
    """With all that couples surfaces in the preconditioner, on its finest level alone, with diagonal blocks alone, and by a
    factorisation."""
    found, scene = [], stacked()
    for kind, name, value in (
        (Cycle, "most", 150),
        (Cycle, "most", 1),
        (Multigrid, "few", 1000),
        (Multigrid, "patience", 2),
    ):
        monkeypatch.setattr(kind, name, value)
        rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=1e-2), 4, gradients=["youngs_modulus"])
        frames = rollout.forward()
        products = rollout.report.products
        gradient = rollout.vjp(frames, frames.displacements)["youngs_modulus"]
        found.append((products, frames.displacements[-1], gradient))
    (few, u, g), (more, *_), (many, *_), (direct, *_) = found
    assert few < many / 3 and direct < many / 3 and few < more < many
    for _, v, h in found[1:]:
        np.testing.assert_allclose(u, v, atol=1e-6 * np.abs(v).max())
        np.testing.assert_allclose(g, h, rtol=1e-5)


@pytest.mark.parametrize("below", [False, True], ids=["finest level", "coarse levels"])
def test_kernels_are_bound_anew_where_arrays_of_contact_grow(below):
    """And not where more fits into them; preconditioned vectors follow the numbers."""
    scene = stacked(2, order=2)  # of three levels
    rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=1e-2), 1)
    rollout.forward()
    own, rng = rollout.sweep.workspace.newton.preconditioner, np.random.default_rng(0)
    cycle, r = own.cycle, rng.standard_normal((scene.mesh.num_vertices, 3)) * own.free
    matrices, _ = own._made
    level, found = cycle.levels[int(below)], []
    for density in (0.0, 0.1, 0.01):
        n, b = level.nodes, level.numbers
        B = scipy.sparse.random(4 * n, b * n, density, random_state=0, format="csr")
        M = (B.T @ B).tobsr((b, b)) * own._diagonal.max()
        before, versions, room = cycle.renewals, own.solver.version, level._room
        if below:
            cycle.put_contact_below(matrices, [M, 0 * matrices[1]])
        else:
            cycle.couple(without(M, diagonal_blocks(M)), 4)
        grows = level._room > room
        assert (cycle.renewals > before) == grows == (own.solver.version != versions)
        found.append((grows, own(r)))
    assert [grows for grows, _ in found] == [False, True, False]
    assert all(np.abs(z - y).max() > 1e-6 * np.abs(y).max() for (_, y), (_, z) in zip(found, found[1:]))


def test_states_that_are_kept_do_not_change_a_bit_of_coupled_surfaces():
    found = []
    for every in (1, 4):
        rollout = ds.Rollout(ds.ImplicitEulerSolver(stacked(), dt=1e-2), 4, checkpoint_every=every)
        frames = rollout.forward()
        found.append((frames.displacements[-1], rollout.vjp(frames, frames.displacements)["youngs_modulus"]))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])


def pressed(push, load_steps=1):
    """A block on another, the lower held at its bottom, the upper's top moved down by `push` [m]."""
    block = ds.TetrahedralMesh.create_box(2, 0.1)
    mesh = ds.TetrahedralMesh.joined([block, block.translated([0.013, 0.101, 0.007])])
    y = mesh.vertices[:, 1]
    fixed = np.nonzero((y < 1e-9) | (y > 0.2))[0]
    top = (y[fixed] > 0.2)[:, None]
    scene = ds.Scene(
        mesh,
        MATERIAL,
        density=1000.0,
        terms=[ds.SelfContact(1e4, 2e-3)],
        fixed=fixed,
        precision="f64",
        motion=lambda t: -push * t * top * np.array([0, 1.0, 0]),
    )
    return ds.StaticSolver(scene, load_steps=load_steps, tolerance=1e-10)


def test_equilibrium_of_two_bodies_pressed_together():
    """Forces balance: what the upper body presses with is what the lower one bears; and the gradient of that."""
    rollout = ds.Rollout(pressed(0.01), 1, gradients="all")
    frames = rollout.forward()
    workspace = rollout.sweep.workspace
    workspace.potential.place(frames.displacements[-1])
    forces, _ = workspace.potential.forces()
    y = rollout.solver.scene.mesh.vertices[:, 1]
    lower, upper = forces[y < 1e-9].sum(0), forces[y > 0.2].sum(0)
    assert upper[1] > 1.0  # newton: E A times about 5 % is 25 N
    np.testing.assert_allclose(lower, -upper, atol=1e-7 * upper[1])
    assert verify.dot_product_test(rollout) <= 1e-8


def test_motion_through_another_body_is_refused_and_nothing_is_lost():
    simulator = ds.Simulator(pressed(0.18))
    with pytest.raises(
        ds.NotConverged, match="prescribed motion drives surfaces through each other: take smaller steps"
    ):
        simulator.step()
    np.testing.assert_array_equal(simulator.displacements, 0)
    simulator.check_surfaces()


def test_a_step_beyond_its_middle_is_looked_at():
    """The midpoint rule takes forces in the middle; where the end lies beyond the other body it says so."""
    scene = crossed_edges(speed=20.0).scene.replace(terms=[ds.SelfContact(1e-2, 5e-3)])
    simulator = ds.Simulator(ds.ImplicitMidpointSolver(scene, dt=6e-4))
    with pytest.raises(ds.Tunnelling, match="beyond the middle of a step"):
        simulator.run(10)
    simulator.check_surfaces()
