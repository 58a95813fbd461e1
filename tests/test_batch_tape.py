"""Batches inside `ti.ad.Tape`, between kernels of the user's."""

from functools import cache

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds

MESH = ds.TetrahedralMesh.create_box(3, 0.1)
MESH = ds.TetrahedralMesh(MESH.vertices, MESH.tetrahedra, tetrahedron_sets=dict(soft=np.arange(20)))
B, STEPS = 3, 4


@cache
def total():
    """One field for all tests: kernels compile anew for each."""
    return ti.field(ti.f64, (), needs_grad=True)


@ti.kernel
def spread(positions: ti.template(), velocities: ti.template(), displacements: ti.template(), total: ti.template()):
    """Some loss over all frames of all scenes."""
    for b, f, i in positions:
        x, v, u = positions[b, f, i], velocities[b, f, i], displacements[b, f, i]
        total[None] += (0.1 + f + ti.sin(1.0 * i + b)) * x.norm_sqr() + 0.1 * v.dot(x) + u.norm_sqr()


def loss_and_seeds(frames):
    """The same in NumPy: the loss, and its gradients by frames."""
    x, v, u = frames.positions, frames.velocities, frames.displacements
    b, f, i = np.indices(x.shape[:3])
    w = (0.1 + f + np.sin(i + b))[..., None]
    loss = (w * x**2).sum() + 0.1 * (v * x).sum() + (u**2).sum()
    return loss, dict(positions=2 * w * x + 0.1 * v, velocities=0.1 * x, displacements=2 * u)


def batch(**options) -> ds.Batch:
    terms = [ds.Gravity(-9.8), ds.Drag(0.4)]
    scene = ds.Scene(MESH, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=terms, precision="f64")
    solver = ds.SemiImplicitSolver(scene, dt=2e-3, substeps=1)
    return ds.Batch(solver, STEPS, B, save_every=2, **dict(gradients="all") | options)


def taped(batch, k=None):
    names = "positions", "velocities", "displacements"
    fields = [batch.field(name) for name in names]
    with ti.ad.Tape(total()):
        batch.run() if k is None else batch.run(k)
        spread(*fields, total())


@pytest.mark.parametrize("lanes", [None, False], ids=["side by side", "by turns"])
def test_a_tape_gives_what_vjp_gives(lanes):
    by_tape, by_hand, rng = batch(lanes=lanes), batch(lanes=lanes), np.random.default_rng(0)
    given = dict(
        youngs_modulus=np.array([1e4, 2e4, 3e4]),
        initial_velocities=0.1 * rng.normal(size=(B, MESH.num_vertices, 3)),
        gravity=rng.normal(size=(B, 3)),
        density=np.array(900.0),
        rest_positions=MESH.vertices + 1e-3 * rng.normal(size=MESH.vertices.shape),
    )
    shared = "density", "rest_positions"
    for name, value in given.items():
        by_tape.field(name, shared=name in shared).from_numpy(value)
    untouched = by_tape.field("drag_rate", shared=True), by_tape.field("initial_positions")
    taped(by_tape)
    frames = by_hand.forward(**given)
    loss, seeds = loss_and_seeds(frames)
    assert total()[None] == pytest.approx(loss, rel=1e-12)
    np.testing.assert_array_equal(by_tape.positions.to_numpy(), frames.positions)
    np.testing.assert_array_equal(by_tape.velocities.to_numpy(), frames.velocities)
    np.testing.assert_array_equal(by_tape.frames.alive, True)
    gradients = by_hand.vjp(frames, **seeds)
    for name in given:
        grad, by = by_tape.field(name, shared=name in shared).grad.to_numpy(), gradients[name]
        assert grad.shape == by.shape
        np.testing.assert_allclose(grad, by, rtol=1e-10, atol=1e-12 * np.abs(by).max(), err_msg=name)
        np.testing.assert_array_equal(by_tape.gradients[name], grad)
    assert untouched[0].grad[None] == pytest.approx(gradients["drag_rate"], rel=1e-10)
    by = gradients["initial_positions"]
    np.testing.assert_allclose(untouched[1].grad.to_numpy().sum(0), by, rtol=1e-10, atol=1e-12 * np.abs(by).max())


@ti.kernel
def hand_over(frames: ti.template(), speeds: ti.template(), x: ti.template(), v: ti.template()):
    """The start of run 1 from the end of run 0."""
    for b, i in x:
        x[b, i] = frames[0, b, 2, i]
        v[b, i] = speeds[0, b, 2, i] * 0.5


@ti.kernel
def of_run(positions: ti.template(), k: ti.i32, total: ti.template()):
    for b, i in ti.ndrange(positions.shape[1], positions.shape[3]):
        total[None] += (1.0 + b) * positions[k, b, 2, i].norm_sqr()


def test_kernels_close_a_loop_between_runs():
    """Differences in the stiffness of each scene, through two runs in one tape, the second from the end of the first."""
    chain, E = batch(runs=2, gradients=None), np.array([1e4, 2e4, 3e4])
    field = chain.field("youngs_modulus")
    x, v = chain.field("initial_positions"), chain.field("initial_velocities")
    start = 0.2 * np.random.default_rng(1).normal(size=(B, MESH.num_vertices, 3))

    def loss(E):
        field.from_numpy(E)
        x.from_numpy(np.broadcast_to(MESH.vertices, start.shape).copy())
        v.from_numpy(start)
        with ti.ad.Tape(total()):
            chain.run(0)
            hand_over(chain.positions, chain.velocities, x, v)
            chain.run(1)
            of_run(chain.positions, 0, total())
            of_run(chain.positions, 1, total())
        return total()[None]

    loss(E)
    slope, along, h = field.grad.to_numpy(), np.array([1.0, -0.5, 0.7]), 30.0
    np.testing.assert_allclose(chain.gradients["youngs_modulus"], slope, rtol=1e-14)
    differences = (loss(E + h * along) - loss(E - h * along)) / (2 * h)
    assert slope @ along == pytest.approx(differences, rel=1e-6)
    assert (slope != 0).all()


def test_numbers_of_named_sets():
    by_tape, by_hand = batch(), batch()
    soft, rest = by_tape.field("youngs_modulus[soft]"), by_tape.field("youngs_modulus[default]", shared=True)
    assert soft.shape == (B,) and rest.shape == ()
    soft.from_numpy(np.array([1e4, 1.5e4, 2e4]))
    rest[None] = 3e4
    v = by_tape.field("initial_velocities", shared=True)
    speed = 0.1 * np.random.default_rng(2).normal(size=(MESH.num_vertices, 3))
    v.from_numpy(speed)
    taped(by_tape)
    numbers = dict(soft=np.array([1e4, 1.5e4, 2e4]), default=3e4)
    frames = by_hand.forward(youngs_modulus=numbers, initial_velocities=speed)
    gradients = by_hand.vjp(frames, **loss_and_seeds(frames)[1])
    np.testing.assert_allclose(soft.grad.to_numpy(), gradients["youngs_modulus"]["soft"], rtol=1e-9)
    assert rest.grad[None] == pytest.approx(gradients["youngs_modulus"]["default"], rel=1e-9)
    np.testing.assert_allclose(v.grad.to_numpy(), gradients["initial_velocities"], rtol=1e-8, atol=1e-12)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_scene_that_dies_leaves_the_others_their_gradients():
    by_tape, alone = batch(), batch()
    E, v = (by_tape.field(name) for name in ("youngs_modulus", "initial_velocities"))
    E.from_numpy(np.array([2e4, 1e11, 1e4]))
    speed = 0.1 * np.random.default_rng(0).normal(size=(B, MESH.num_vertices, 3))
    v.from_numpy(speed)
    with pytest.warns(UserWarning, match=r"scenes \[1\] did not come to their end"):
        taped(by_tape)
    np.testing.assert_array_equal(by_tape.frames.alive, [True, False, True])
    grad = E.grad.to_numpy()
    assert grad[1] == 0 and (grad[[0, 2]] != 0).all() and np.isfinite(by_tape.positions.to_numpy()).all()
    frames = alone.forward(youngs_modulus=np.array([2e4, 2e4, 1e4]), initial_velocities=speed)
    by = alone.vjp(frames, **loss_and_seeds(frames)[1])["youngs_modulus"]
    np.testing.assert_allclose(grad[[0, 2]], by[[0, 2]], rtol=1e-11)


def test_what_is_refused():
    one, three = batch(), batch(runs=3)
    with pytest.raises(ValueError, match="this batch has"):
        one.field("speed")
    one.field("gravity", shared=True)
    with pytest.raises(ValueError, match="gravity: its field is already one for all scenes"):
        one.field("gravity")
    with pytest.raises(ValueError, match="this batch has no numbered runs: make the Batch with runs"):
        one.run(0)
    with pytest.raises(ValueError, match="give a whole number of 0 .. 2"):
        three.run(3)
    with pytest.raises(RuntimeError, match="make a second Batch"), ti.ad.Tape(total()):
        one.run()
        one.run()
    one.field("youngs_modulus")
    one.field("youngs_modulus[soft]")
    with pytest.raises(ValueError, match="of the whole and of named sets"):
        one.run()


def test_outside_a_tape():
    """Runs fill the fields, and fields of shared inputs are read at each."""
    plain = batch()
    plain.run()
    np.testing.assert_array_equal(plain.positions.to_numpy(), plain.one.forward().positions[None].repeat(B, 0))
    plain.field("gravity", shared=True).from_numpy(np.zeros(3))
    plain.run()
    np.testing.assert_allclose(plain.positions.to_numpy(), np.broadcast_to(MESH.vertices, plain.positions.shape + (3,)))
