"""Batches inside `ti.ad.Tape`, between kernels of the user's."""

from functools import cache

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds

M = 48
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


def batch(solver=ds.SemiImplicitSolver, terms=(ds.Gravity(-9.8), ds.Drag(0.4)), **options) -> ds.Batch:
    scene = ds.Scene(MESH, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=list(terms), precision="f64")
    options = dict(gradients="all") | options
    return ds.Batch(solver(scene, dt=2e-3), STEPS, B, save_every=2, **options)


def taped(batch, k=None):
    names = "positions", "velocities", "displacements"
    fields = [batch.field(name) for name in names]
    with ti.ad.Tape(total()):
        batch.run() if k is None else batch.run(k)
        spread(*fields, total())


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver], ids=["side by side", "by turns"])
def test_a_tape_gives_what_vjp_gives(solver):
    by_tape, by_hand, rng = batch(solver), batch(solver), np.random.default_rng(0)
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
