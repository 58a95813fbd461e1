"""Every adjoint by itself: <w, J d> = <J^T w, d> for each input alone, in every solver, on bodies of a few tetrahedra.

Fast and broad: what `mutations.py` runs first.
"""

from functools import cache

import numpy as np
import pytest
import torch
from test_gradients import random_mesh
from test_term_order import IMPLICIT, SOLVERS, crowd, rollout_of

import diffsim_ti as ds
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.materials import MATERIALS
from diffsim_ti.materials.material import Coefficients

STEPS = 4
every = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.__name__)


@cache
def loaded(volume="tetrahedra", precision="f64") -> ds.Scene:
    """A cube of six tetrahedra: moduli and density of each, forces per step, moving supports, a floor, a deformed start."""
    mesh, rng = random_mesh(2), np.random.default_rng(0)
    m, shape = mesh.num_tetrahedra, mesh.vertices.shape
    terms = [
        ds.Gravity(),
        ds.Drag(2.0),
        ds.Ground(-0.15, 1e3, 0.2),  # in the order of test_gradients.py, whose kernels these are
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


def assert_transposed(rollout, gate, without=()) -> None:
    """A small input cannot hide behind a large one: each has a tangent of its own."""
    rng, frames = np.random.default_rng(5), rollout.forward()
    w, z = rng.standard_normal((2, *frames.positions.shape))
    gradients = rollout.vjp(frames, w, z)
    for name in rollout.wanted:
        direction = rng.standard_normal(rollout.values[name].shape)
        dx, dv = rollout.jvp(frames, **{name: direction})
        forward, backward = (w * dx).sum() + (z * dv).sum(), (gradients[name] * direction).sum()
        size = np.abs(w * dx).sum() + np.abs(z * dv).sum()
        assert (size > 0) != (name in without), name
        assert abs(forward - backward) <= gate * size, f"{name}: {forward} against {backward}"


STILL = ("drag_rate",)  # which equilibria do not know


@pytest.mark.parametrize("uniform", [True, False])
@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.__name__)
def test_coefficients(material, uniform):
    """From what a user names to the law's coefficients, in every spelling."""
    rng, m = np.random.default_rng(3), 5
    sizes = dict(youngs_modulus=1e5, poissons_ratio=0.3, mu=4e4, lam=6e4, c10=1e4, c01=5e3, bulk_modulus=1e5)
    for names in material.spellings:
        values = {n: np.array(sizes[n]) if uniform else sizes[n] * rng.uniform(0.8, 1.2, m) for n in names}
        made = material(**values)
        weights = rng.standard_normal((m, np.shape(made.coefficients(values))[-1]))
        link, x = Coefficients(made), [*values.values()]
        gradients = dict(zip(link.reads, link.vjp(x, (weights,))))
        for name in names:
            direction = sizes[name] * rng.standard_normal(values[name].shape)
            forward = (weights * link.jvp(x, [direction if n == name else 0 * values[n] for n in names])[0]).sum()
            assert forward == pytest.approx((gradients[name] * direction).sum(), rel=1e-12)
            step = 1e-4 * direction
            ends = [made.coefficients(values | {name: values[name] + s * step}) for s in (-1, 1)]
            assert forward == pytest.approx((weights * (ends[1] - ends[0])).sum() / 2e-4, rel=1e-6)


@every
def test_loads_and_supports(solver):
    gate = 1e-12 if solver.explicit else 1e-9
    assert_transposed(loaded_rollout(solver, checkpoint_every=3), gate, STILL if solver is ds.StaticSolver else ())


def as_tensors(rollout, **changes) -> dict[str, torch.Tensor]:
    """All inputs that the torch face copies, displacements for positions, in the graph."""
    values = rollout.values | changes
    values["initial_displacements"] = values["initial_positions"] - values["rest_positions"]
    names = set(values) - {"initial_positions", "rest_positions"}
    return {name: torch.tensor(values[name], dtype=torch.float64, requires_grad=True) for name in sorted(names)}


@pytest.mark.parametrize("truncate", [None, 1])
@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_torch_gives_the_same_gradients(solver, truncate):
    """Copied on the device (explicit) or by way of the host; of some inputs alone, and after another run."""
    ours, theirs = (rollout_of(list(crowd()), solver, truncate=truncate) for _ in range(2))
    frames = ours.forward()
    w, z = np.random.default_rng(7).standard_normal((2, *frames.positions.shape))
    expected = ours.vjp(frames, w, z)
    expected["initial_displacements"] = expected.pop("initial_positions")
    tensors = as_tensors(theirs)
    for names in (tensors, ("friction", "initial_velocities"), ("sphere_path",)):
        for tensor in tensors.values():
            tensor.grad = None
        frames = rollout_frames(theirs, **{name: tensors[name] for name in names})
        rollout_frames(theirs, **as_tensors(theirs, gravity=np.array([1.0, -5.0, 0.0])))
        ((torch.from_numpy(w) * frames.positions).sum() + (torch.from_numpy(z) * frames.velocities).sum()).backward()
        for name in names:
            np.testing.assert_allclose(tensors[name].grad, expected[name], rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("truncate", [None, 1])
@pytest.mark.parametrize("name", ["rest_positions", "initial_positions"])
def test_torch_gives_the_same_gradients_by_places(name, truncate):
    """What the start has, or hands on to the rest shape, is cut off where the sweep does not come so far."""
    ours, theirs = (rollout_of(list(crowd()), ds.SemiImplicitSolver, truncate=truncate) for _ in range(2))
    frames = ours.forward()
    w = np.random.default_rng(8).standard_normal(frames.positions.shape)
    expected = ours.vjp(frames, w, 0 * w)[name]
    places = torch.tensor(theirs.values[name], dtype=torch.float64, requires_grad=True)
    velocities = torch.tensor(theirs.values["initial_velocities"], dtype=torch.float64, requires_grad=True)
    moved = rollout_frames(theirs, **{name: places}, initial_velocities=velocities).positions
    (torch.from_numpy(w) * moved).sum().backward()
    np.testing.assert_allclose(places.grad, expected, rtol=1e-12, atol=1e-12 * np.abs(w).sum())


@every
def test_contacts(solver):
    gate = 1e-12 if solver.explicit else 1e-8
    assert_transposed(rollout_of(list(crowd()), solver), gate, STILL if solver is ds.StaticSolver else ())


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


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_patches(solver):
    assert_transposed(loaded_rollout(solver, "patches"), 1e-12 if solver.explicit else 1e-9)
