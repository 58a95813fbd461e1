"""Every adjoint by itself: <w, J d> = <J^T w, d> for each input alone, in every solver, on bodies of a few tetrahedra.

Fast and broad: what `mutations.py` runs first.
"""

from functools import cache

import numpy as np
import pytest
from test_gradients import random_mesh
from test_term_order import IMPLICIT, SOLVERS, crowd, rollout_of

import diffsim_ti as ds

STEPS = 4
every = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.__name__)


@cache
def loaded(volume="tetrahedra", precision="f64") -> ds.Scene:
    """A cube of six tetrahedra: moduli and density of each, forces per step, moving supports, a floor, a deformed start."""
    mesh, rng = random_mesh(2), np.random.default_rng(0)
    m, shape = mesh.num_tetrahedra, mesh.vertices.shape
    terms = [
        ds.Ground(-0.15, 1e3, 0.2),
        ds.Gravity(),
        ds.Drag(2.0),
        ds.ExternalForce(50 * rng.normal(size=(STEPS, 3, 3)), [1, 5, 6]),
    ]
    return ds.Scene(
        mesh,
        ds.StableNeoHookean(1e5 * rng.uniform(0.7, 1.3, m), rng.uniform(0.2, 0.35, m)),
        1000 * rng.uniform(0.8, 1.2, m),
        terms,
        fixed="xmin",
        precision=precision,
        volume=volume,
        motion=lambda t: np.array([0.02 * t, 0.05 * np.sin(20 * t), 0.02 * t * t]),
        initial_positions=mesh.vertices + rng.normal(size=shape) * 0.01,
        initial_velocities=rng.normal(size=shape) * 0.2,
    )


def loaded_rollout(solver, volume="tetrahedra", precision="f64", **options) -> ds.Rollout:
    static = solver is ds.StaticSolver
    tolerance = {} if solver.explicit else dict(tolerance=1e-12 if precision == "f64" else 1e-5)
    scene = loaded(volume=volume, precision=precision)
    made = solver(scene, **tolerance) if static else solver(scene, dt=2e-3, substeps=2, **tolerance)
    return ds.Rollout(made, 2 if static else STEPS, save_every=1 if static else 2, gradients="all", **options)


def assert_transposed(rollout, gate, unfelt=()) -> None:
    """A small input cannot hide behind a large one: each has a tangent of its own."""
    rng, frames = np.random.default_rng(5), rollout.forward()
    w, z = rng.standard_normal((2, *frames.positions.shape))
    gradients = rollout.vjp(frames, w, z)
    for name in rollout.wanted:
        direction = rng.standard_normal(rollout.values[name].shape)
        dx, dv = rollout.jvp(frames, **{name: direction})
        forward, backward = (w * dx).sum() + (z * dv).sum(), (gradients[name] * direction).sum()
        size = np.abs(w * dx).sum() + np.abs(z * dv).sum()
        assert (size > 0) != (name in unfelt), name
        assert abs(forward - backward) <= gate * size, f"{name}: {forward} against {backward}"


STILL = ("drag_rate",)  # which equilibria do not know


@every
def test_loads_and_supports(solver):
    gate = 1e-12 if solver.explicit else 1e-9
    assert_transposed(loaded_rollout(solver, checkpoint_every=3), gate, STILL if solver is ds.StaticSolver else ())


@every
def test_contacts(solver):
    gate = 1e-12 if solver.explicit else 1e-8
    assert_transposed(rollout_of(list(crowd()), solver), gate, STILL if solver is ds.StaticSolver else ())


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_patches(solver):
    assert_transposed(loaded_rollout(solver, "patches"), 1e-12 if solver.explicit else 1e-9)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, *IMPLICIT], ids=lambda s: s.__name__)
def test_frames_and_schedules_do_not_matter(solver):
    """A loss of the last frame alone: the same bits however many frames are saved and states kept, and again and again."""
    expected = None
    w, z = np.random.default_rng(6).standard_normal((2, 8, 3))
    for save_every, options in ((4, {}), (1, {}), (2, dict(checkpoint_every=1)), (1, dict(checkpoint_every=3))):
        rollout = rollout_of(list(crowd()), solver, save_every=save_every, **options)
        frames = rollout.forward()
        adjoints = np.zeros((2, *frames.positions.shape))
        adjoints[:, -1] = w, z
        for then in ("at first", "twice", "after another run", "anew"):
            if then == "after another run":
                rollout.forward(gravity=[1.0, -5.0, 0.0])
            if then == "anew":
                frames = rollout.forward()
            got = rollout.vjp(frames, *adjoints)
            expected = expected or got
            for name in expected:
                np.testing.assert_array_equal(
                    got[name], expected[name], err_msg=f"{name} {save_every} {options} {then}"
                )
