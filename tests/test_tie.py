"""Faces that are glued though their nodes do not match: what goes through, what is kept, derivatives, refusals."""

import warnings
from functools import lru_cache

import numpy as np
import pytest
import torch
from test_term_order import SOLVERS

import diffsim_ti as ds
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.solvers.implicit.preconditioners import BodyBlocks, Preconditioner

LAW = ds.StableNeoHookean(1e5, 0.3)
box = ds.TetrahedralMesh.create_box


@lru_cache
def halves(order=1, left=3, right=4, length=1.0, layers=3):
    """A bar of two boxes whose nodes match at no inner place of where they meet."""
    parts = [
        box((layers, n, n), (length, 1.0, 1.0), pattern, origin=(x, 0, 0))
        for n, pattern, x in ((left, "kuhn", 0.0), (right, "five", length))
    ]
    parts = [part.quadratic() if order == 2 else part for part in parts]
    return ds.TetrahedralMesh.joined(dict(zip(("left", "right"), parts)))


TIE = ds.Tie("left_xmax", "right_xmin")


def scene_of(terms=(), mesh=None, tie=TIE, precision="f64", **options):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "fixed: .* contains 2 bodies")
        return ds.Scene(mesh or halves(), LAW, terms=[tie, *terms], precision=precision, **options)


def equilibrium(scene, **options):
    return ds.Rollout(ds.StaticSolver(scene, tolerance=1e-13), 1, gradients=[], **options).forward()


# ---- what goes through -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(
    "held", [{"left_xmin": "x", "ymin": "y", "zmin": "z"}, {"left_xmin": "x", "o": "yz", "p": "z"}]
)
def test_constant_stress_goes_through(order, held):
    """The patch test, of stretches of a fifth: with rollers along edges of what is glued, and with these free."""
    mesh = halves(order)
    mesh = mesh.with_vertex_set("o", mesh.vertices_where(lambda x: (x == 0).all(1)))
    mesh = mesh.with_vertex_set("p", mesh.vertices_where(lambda x: (x == [0, 1, 0]).all(1)))
    frames = equilibrium(
        scene_of([ds.Traction([2e4, 0, 0], "right_xmax")], mesh, fixed=held), outputs=[ds.Reaction(TIE)]
    )
    u, X = frames.displacements[-1], mesh.vertices
    A = np.linalg.lstsq(X, u, rcond=None)[0]
    assert A[0, 0] > 0.15 and A[1, 1] == pytest.approx(A[2, 2], abs=1e-10) and A[1, 1] < -0.03
    np.testing.assert_allclose(u, X @ A, atol=1e-10)
    np.testing.assert_allclose(frames["reaction"][-1], [-2e4, 0, 0], atol=1e-6)  # on the right half


def test_relations_hold_through_a_tie():
    """The end is pulled, and what is glued goes half as far of itself: a relation there changes nothing."""
    mesh, far = halves(), 0.2
    ends = ("right_xmax", far), ("left_xmax", far / 2)
    terms = [ds.MultiPointConstraint.mean(mesh, end, (1, 0, 0), value, name=end) for end, value in ends]
    u = equilibrium(scene_of(terms, mesh, fixed={"left_xmin": "x", "ymin": "y", "zmin": "z"})).displacements[-1]
    A = np.linalg.lstsq(mesh.vertices, u, rcond=None)[0]
    assert A[0, 0] == pytest.approx(far / 2, rel=1e-9)
    np.testing.assert_allclose(u, mesh.vertices @ A, atol=1e-9)


def test_a_beam_of_unequal_halves_bends_as_one():
    """Ten nodes, within a thousandth of the matching mesh; a hundredth was asked for."""
    drops = []
    for mesh, tie, end in (
        (box((9, 2, 2), (8.0, 1.0, 1.0)).quadratic(), (), "xmax"),
        (halves(2, 2, 3, 4.0, 5), [TIE], "right_xmax"),
    ):
        fixed = np.flatnonzero(mesh.vertices[:, 0] == 0)
        scene = ds.Scene(mesh, LAW, terms=[*tie, ds.Traction([0, -20.0, 0], end)], fixed=fixed, precision="f64")
        u = equilibrium(scene).displacements[-1]
        drops.append(u[mesh.vertex_indices(end), 1].mean())
    assert drops[0] < -0.05 and drops[1] == pytest.approx(drops[0], rel=1e-2)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.ImplicitMidpointSolver])
def test_tumbling_keeps_momentum_and_glue(solver):
    X = halves().vertices
    spin = np.cross([2.0, -3.0, 5.0], X - X.mean(0)) + [0.3, 0.2, 0.1]
    scene = scene_of(initial_velocities=spin)
    made = solver(scene, dt=5e-3) if solver.explicit else solver(scene, dt=0.02, tolerance=1e-12)
    frames = ds.Rollout(made, 20, save_every=10, gradients=[]).forward()
    m = scene.inputs.derive(scene.inputs.values).mass[:, None]
    P, L = (m * frames.velocities).sum(1), (m * np.cross(frames.positions, frames.velocities)).sum(1)
    assert np.abs(P - P[0]).max() < 1e-9 * m.sum()
    assert np.abs(L - L[0]).max() < 1e-9 * np.linalg.norm(L[0])
    u, (own,) = frames.displacements[-1], scene.reduced.bodies
    assert np.abs(u).max() > 0.5
    np.testing.assert_allclose(scene.reduced.of(u)[own.vertices], u[own.vertices], atol=1e-12)


def test_modes_are_those_of_one_body():
    """Of ten nodes: the frequencies of a matching mesh that is as coarse as the coarser half."""
    one = box((5, 2, 2), (2.0, 1.0, 1.0)).quadratic()
    tied, whole = scene_of(mesh=halves(2, 2, 3)), ds.Scene(one, LAW, precision="f64")
    found, right = (ds.modes(scene, 10).frequencies for scene in (tied, whole))
    assert np.abs(found[:6]).max() < 1e-3 * right[6]
    np.testing.assert_allclose(found[6:], right[6:], rtol=0.03)


def test_three_parts_in_a_row_and_a_shared_surface():
    """b of one tie and a of the next lie on one part, and one surface holds two others."""
    parts = dict(low=box((3, 2, 2), (2, 1, 1)), left=box((3, 3, 3), 1.0, origin=(0, 1, 0)))
    parts |= dict(right=box((4, 4, 4), 1.0, origin=(1, 1, 0)), top=box((6, 4, 6), (1, 1, 1), origin=(0, 2, 0)))
    mesh = ds.TetrahedralMesh.joined(parts)
    ties = [ds.Tie("low_ymax", name) for name in ("left_ymin", "right_ymin")] + [ds.Tie("left_ymax", "top_ymin")]
    pull = ds.Traction([0, 1e3, 0], "top_ymax")
    scene = ds.Scene(mesh, LAW, terms=[*ties, pull], fixed="low_ymin", precision="f64")
    frames = equilibrium(scene, outputs=[ds.Reaction(tie, name=f"tie{k}") for k, tie in enumerate(ties)])
    np.testing.assert_allclose([frames[f"tie{k}"][-1, 1] for k in range(3)], [-1e3, 0.0, -1e3], atol=1e-5)


@pytest.mark.parametrize("order", [1, 2])
def test_every_preconditioner_leads_to_the_same_equilibrium(order, monkeypatch):
    """Blocks and multigrid, and the factorisation that takes the place of what is too slow."""
    scene, ends = scene_of([ds.Gravity((0, -0.5, 0))], halves(order), fixed="left_xmin"), []
    for preconditioner, patience in (("block_jacobi", 10**9), ("multigrid", 10**9), ("block_jacobi", 1)):
        monkeypatch.setattr(Preconditioner, "patience", patience)
        monkeypatch.setattr(BodyBlocks, "patience", patience)
        solver = ds.StaticSolver(scene, tolerance=1e-11, preconditioner=preconditioner)
        ends.append(ds.Rollout(solver, 1, gradients=[]).forward().displacements[-1])
    assert np.abs(ends[0]).max() > 0.01
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], atol=1e-8)


# ---- derivatives -----------------------------------------------------------------------------------------------------


def loaded(solver, precision="f64"):
    """Everything that a gradient can be asked for, in a few steps."""
    mesh, rng = halves(1, 2, 3, layers=2), np.random.default_rng(1)
    m, n = mesh.num_tetrahedra, mesh.num_vertices
    law = ds.StableNeoHookean(1e5 * rng.uniform(0.7, 1.3, m), 0.3)
    loads = ds.ExternalForce(300 * rng.normal(size=(2, 3, 3)), [n - 1, n - 3, n - 5])
    scene = ds.Scene(
        mesh,
        law,
        1000 * rng.uniform(0.8, 1.2, m),
        [TIE, ds.Gravity(), ds.Drag(2.0), loads],
        fixed="left_xmin",
        motion=lambda t: np.array([0.02 * t, 0.05 * np.sin(20 * t), 0.02 * t * t]),
        initial_velocities=rng.normal(size=(n, 3)) * 0.2,
        precision=precision,
    )
    tolerance = {} if solver.explicit else dict(tolerance=1e-12 if precision == "f64" else 1e-5)
    made = solver(scene, **tolerance) if solver is ds.StaticSolver else solver(scene, 2e-3, 2, **tolerance)
    return ds.Rollout(made, 2, gradients="all", outputs=[ds.Reaction(TIE)])


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.__name__)
def test_tangent_and_adjoint_are_transposed(solver):
    assert ds.dot_product_test(loaded(solver)) < 1e-9


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_gradients_are_those_of_differences(solver):
    """By masses, which the projection of explicit steps knows, by rest places and by moduli, of places and of the force."""
    rollout = loaded(solver)
    frames, rng = rollout.forward(), np.random.default_rng(2)
    w = rng.standard_normal(frames.positions.shape)
    gradients = rollout.vjp(frames, w, reaction=1e-3 * w[:, 0])
    for name in ("density", "rest_positions", "youngs_modulus"):
        x = rollout.scene.inputs.values[name]
        way = 1e-5 * np.abs(x).max() * rng.standard_normal(x.shape)
        ends = [rollout.forward(**{name: x + sign * way}) for sign in (1, -1)]
        found = [float((w * f.positions).sum() + 1e-3 * (w[:, 0] * f["reaction"]).sum()) for f in ends]
        assert float((gradients[name] * way).sum()) == pytest.approx((found[0] - found[1]) / 2, rel=1e-5)


def test_a_sweep_that_stops_between_kicks_has_the_same_gradient():
    rollout = loaded(ds.VelocityVerletSolver)
    clipped = ds.Rollout(rollout.solver, 2, gradients="all", clip=1e12)
    found = []
    for one in (ds.Rollout(rollout.solver, 2, gradients="all"), clipped):
        frames = one.forward()
        found.append(one.vjp(frames, np.cos(np.arange(frames.positions.size)).reshape(frames.positions.shape)))
    for name, right in found[0].items():
        np.testing.assert_allclose(found[1][name], right, rtol=1e-9, atol=1e-12 * max(np.abs(right).max(), 1.0))


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver])
def test_a_batch_has_the_gradients_of_its_scenes(solver):
    rollout = loaded(solver)
    moduli = rollout.scene.inputs.values["youngs_modulus"] * np.array([[1.0], [1.5]])
    batch = ds.Batch(rollout.solver, 2, scenes=2, gradients=["youngs_modulus"])
    frames = batch.forward(youngs_modulus=moduli)
    w = np.cos(np.arange(frames.positions.size)).reshape(frames.positions.shape)
    found = batch.vjp(frames, w)["youngs_modulus"]
    for k in range(2):
        alone = rollout.forward(youngs_modulus=moduli[k])
        np.testing.assert_allclose(frames.positions[k], alone.positions, atol=1e-12)
        np.testing.assert_allclose(found[k], rollout.vjp(alone, w[k])["youngs_modulus"], rtol=1e-6, atol=1e-13)


def test_pytorch_has_the_same_gradient():
    rollout = loaded(ds.ImplicitEulerSolver)
    E = torch.tensor(rollout.scene.inputs.values["youngs_modulus"], requires_grad=True)
    rollout_frames(rollout, youngs_modulus=E).positions.sum().backward()
    plain = rollout.forward()
    right = rollout.vjp(plain, np.ones(plain.positions.shape))["youngs_modulus"]
    np.testing.assert_allclose(E.grad.numpy(), right, rtol=1e-7, atol=1e-16)


# ---- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tie, options, words",
    [
        (("left_xmax", "left_ymin"), {}, "vertex .* is in both surfaces"),
        (("left_xmin", "right_xmin"), {}, "do not meet within .*they do not face each other"),
        (("right_xmax", "left_xmin"), {}, "they do not face each other"),
        (("left_xmax", "right"), {}, "faces of b lie on a in part only.*exchange a and b"),
        (("left_xmax", "nothing"), {}, "no surface set is called 'nothing'"),
        (("left_xmax", "right_xmin", 0.0), {}, "tolerance must be > 0"),
        (None, dict(terms=[ds.Tie("left_xmax", "right_xmin")]), "is glued by .* already"),
        (None, dict(terms=[ds.Tie("right_xmin", "left_xmax")]), "follows another surface; exchange a and b of one"),
        (None, dict(terms=[ds.SelfContact(1e4, 0.01)]), "glued surfaces touch, which SelfContact refuses"),
        (None, dict(fixed="right_xmin", motion=lambda t: np.array([t, 0, 0])), "motion= moves vertex"),
        (None, dict(fixed={"left_xmax": [1.0, 1.0, 0.0]}), "may be fixed along x, y and z"),
        (None, dict(fixed=["left_xmax", "right_xmin"]), "leaves nothing to glue"),
        (None, dict(fixed="ymin", initial_positions=1.1 * halves().vertices), "from its place at rest"),
        (None, dict(reduced={"right": "affine"}), "is in a set of reduced= too"),
    ],
)
def test_refused(tie, options, words):
    with pytest.raises(ValueError, match=words):
        scene_of(tie=TIE if tie is None else ds.Tie(*tie), **options)


def test_what_is_refused_works_as_said():
    """A gap is glued with tolerance=, a small face to a large one in one order alone, obstacles as a force."""
    apart = ds.TetrahedralMesh.joined({"a": box(3, 1.0), "b": box(3, 0.5, origin=(1.05, 0.2, 0.2))})
    with pytest.raises(ValueError, match="lie up to 0.05 m apart"):
        scene_of(mesh=apart, tie=ds.Tie("a_xmax", "b_xmin"))
    with pytest.raises(ValueError, match="exchange a and b"):
        scene_of(mesh=apart, tie=ds.Tie("b_xmin", "a_xmax", tolerance=0.1))
    with pytest.warns(UserWarning, match="up to 0.05 m apart, .* does not turn with the body"):
        scene_of(mesh=apart, tie=ds.Tie("a_xmax", "b_xmin", tolerance=0.1))
    smooth, rough = ([ds.Ground(-1.0, stiffness=1e4, width=0.1, friction=mu)] for mu in (0.0, 0.5))
    with pytest.raises(ValueError, match='pass contact="force"'):
        ds.SemiImplicitSolver(scene_of(smooth), 1e-3)
    ds.SemiImplicitSolver(scene_of(smooth), 1e-3, contact="force")
    with pytest.raises(ValueError, match="no friction in Ground in explicit steps.*take an implicit solver"):
        ds.SemiImplicitSolver(scene_of(rough), 1e-3, contact="force")
    ds.ImplicitEulerSolver(scene_of(rough), 1e-3)
    with pytest.raises(ValueError, match="does not list"):
        equilibrium(scene_of(fixed="left_xmin"), outputs=[ds.Reaction(ds.Tie("left_xmax", "right_xmin"))])
    assert "Tie('left_xmax', 'right_xmin') 27 for 75" in scene_of().describe()
