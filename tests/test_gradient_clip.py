"""Clip and truncate against their definitions: single steps, each a rollout of its own, chained by hand."""

from functools import lru_cache

import numpy as np
import pytest
from test_gradients import random_mesh

import diffsim_ti as ds

STEPS = 6
solvers = pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.ImplicitMidpointSolver])


@lru_cache(maxsize=None)
def solver_of(kind):
    """A body held at one vertex that presses on a floor; substeps, so that passes are more than steps."""
    mesh, rng = random_mesh(), np.random.default_rng(0)
    floor = ds.Ground(height=float(mesh.vertices[:, 1].min()) - 0.02, stiffness=500.0, width=0.05, friction=0.3)
    terms = [ds.Gravity(), ds.Drag(0.5), floor]
    speed = rng.standard_normal(mesh.vertices.shape)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, fixed=[0], initial_velocities=speed)
    options = dict(tolerance=1e-12) if kind is ds.ImplicitMidpointSolver else {}
    return kind(scene, dt=2e-3, substeps=3, **options)


def by_hand(solver, w, z, limit, last=STEPS):
    """Gradients of the last steps and the norms of the adjoint after each, going back."""
    states = ds.Rollout(solver, STEPS, save_every=1).forward()
    single, total, norms = ds.Rollout(solver, 1, gradients="all"), {}, []
    p, q = w[-1], z[-1]
    for k in range(STEPS - 1, STEPS - last - 1, -1):
        frames = single.forward(initial_positions=states.positions[k], initial_velocities=states.velocities[k])
        part = single.vjp(frames, np.stack([0 * p, p]), np.stack([0 * q, q]))
        p, q = part["initial_positions"] + w[k], part["initial_velocities"] + z[k]
        q[solver.scene.fixed] = 0
        total = {name: total.get(name, 0.0) + g for name, g in part.items()}
        norms.append(np.hypot(np.linalg.norm(p), np.linalg.norm(q)))
        share = min(1.0, limit / norms[-1])
        p, q = share * p, share * q
    return total | dict(initial_positions=p, initial_velocities=q), norms


def weights(solver):
    shape = (STEPS + 1, solver.scene.mesh.num_vertices, 3)
    rng = np.random.default_rng(1)
    return rng.standard_normal(shape), 1e-2 * rng.standard_normal(shape)


def assert_near(found, expected, tolerance, leave_out=()):
    for name, value in expected.items():
        if name not in ("rest_positions", *leave_out):
            assert np.abs(found[name] - value).max() <= tolerance * np.abs(value).max(), name


@solvers
def test_clip_is_that_of_single_steps(solver):
    """The whole adjoint is measured, forces of tetrahedra included, and only between steps."""
    made = solver_of(solver)
    w, z = weights(made)
    limit = 0.7 * np.median(by_hand(made, w, z, np.inf)[1])
    expected, norms = by_hand(made, w, z, limit)
    assert sum(norm > limit for norm in norms) >= STEPS // 2
    rollout = ds.Rollout(made, STEPS, save_every=1, gradients="all", clip=limit)
    found = rollout.vjp(rollout.forward(), w, z)
    seen = [np.hypot(h["norm_position"], h["norm_velocity"]) for h in rollout.health]
    assert [h["step"] for h in rollout.health] == list(range(STEPS))[::-1]
    np.testing.assert_allclose(seen, norms, rtol=1e-7)
    assert_near(found, expected, 1e-7)


@solvers
def test_clip_does_not_depend_on_the_schedule(solver):
    """A budget cuts the run within steps, where the adjoint is not looked at."""
    made = solver_of(solver)
    w, z = weights(made)
    limit = 0.7 * np.median(by_hand(made, w, z, np.inf)[1])
    state = 4 * 8 * made.scene.mesh.num_vertices / 1e6
    results = []
    for options in ({}, dict(checkpoint_every=1), dict(checkpoint_every=4), dict(memory=18.5 * state)):
        rollout = ds.Rollout(made, STEPS, save_every=1, clip=limit, **options)
        results.append(rollout.vjp(rollout.forward(), w, z))
        assert len(rollout.health) == STEPS
    for other in results[1:]:
        assert all(np.array_equal(results[0][name], other[name]) for name in other)


@solvers
@pytest.mark.parametrize("last", [1, 4])
def test_truncate_is_the_gradient_of_the_last_steps_alone(solver, last):
    made = solver_of(solver)
    w, z = weights(made)
    for x in (w, z):
        x[: STEPS - last + 1] = 0  # frames up to the cut are not differentiated
    expected, _ = by_hand(made, w, z, np.inf, last)
    for options in ({}, dict(checkpoint_every=2), dict(clip=1e12)):
        rollout = ds.Rollout(made, STEPS, save_every=1, gradients="all", truncate=last, **options)
        found = rollout.vjp(rollout.forward(), w, z)
        assert_near(found, expected, 1e-7, leave_out=("initial_positions", "initial_velocities"))
        assert not found["initial_positions"].any() and not found["initial_velocities"].any()
