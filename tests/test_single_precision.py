"""Rollouts in float32 with contact, friction, a moving obstacle and checkpoints, on every backend: Vulkan knows no other."""

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.solvers.explicit import solver as explicit

pytestmark = pytest.mark.backends
# relative size of the step by which a gradient is compared with the motion's slope
INPUTS = {"youngs_modulus": 0.01, "gravity": 0.01, "friction": 0.02, "ground_path": 0.002}


def rollout_of(solver, checkpoint_every=None) -> ds.Rollout:
    """A cube of 10 cm that is pressed onto a ground, which slides beneath it."""
    mesh = ds.TetrahedralMesh.create_cube(2, 0.1)
    ground = ds.Ground(-2e-3, 300.0, 0.01, friction=0.4, friction_speed=0.05, path=lambda t: [0.3 * t, 0, 0])
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(2e4, 0.3),
        500.0,
        [ds.Gravity(), ground],
        initial_velocities=[0.1, -0.2, 0],
        precision="f32",
    )
    solver = solver(scene, dt=4e-3, substeps=8 if solver.explicit else 1)
    return ds.Rollout(solver, 4, 2, gradients=list(INPUTS), checkpoint_every=checkpoint_every)


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_gradients_are_the_slopes_of_runs_and_checkpoints_change_no_bit(solver):
    rollout, pieces, rng = rollout_of(solver), rollout_of(solver, checkpoint_every=2), np.random.default_rng(0)
    frames, again = rollout.forward(), pieces.forward()
    w = rng.normal(size=frames.positions.shape)
    gradients, found = rollout.vjp(frames, w), pieces.vjp(again, w)
    np.testing.assert_array_equal(frames.positions, again.positions)
    values = {name: np.asarray(rollout.values[name], float) for name in INPUTS}
    for name in INPUTS:
        np.testing.assert_array_equal(found[name], gradients[name], name)
    ways = {
        name: share * np.sign(gradients[name]) * np.abs(values[name]).max() * rng.uniform(0.5, 1, values[name].shape)
        for name, share in INPUTS.items()
    }
    ends = [
        rollout.forward(**{name: values[name] + sign * ways[name] for name in INPUTS}).positions.astype(float)
        for sign in (1, -1)
    ]
    parts = {name: (gradients[name] * ways[name]).sum() for name in INPUTS}
    assert min(parts.values()) > 0.005 * sum(parts.values())  # each counts
    assert sum(parts.values()) == pytest.approx((w * (ends[0] - ends[1])).sum() / 2, rel=5e-3)


def test_substeps_of_a_launch_have_the_same_bits_however_many_they_are(monkeypatch):
    """Kernels for a GPU do up to 16 of them in a launch; here two, and with a change of steps within a launch."""
    found = []
    for most in (2, 16):
        monkeypatch.setattr(explicit, "MOST_PASSES", most)
        rollout = rollout_of(ds.VelocityVerletSolver)
        assert rollout.solver.passes_per_launch() in (1, most)
        frames = rollout.forward()
        gradients = rollout.vjp(frames, frames.displacements, frames.velocities)
        found.append([frames.positions, frames.velocities, *gradients.values()])
    for two, sixteen in zip(*found):
        np.testing.assert_array_equal(two, sixteen)
