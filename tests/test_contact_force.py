"""Forces of obstacles on the body, as a loss names them: balances, and derivatives in every solver."""

from functools import lru_cache

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify

G = 9.81
EXPLICIT = [ds.SemiImplicitSolver, ds.VelocityVerletSolver]


def cube(height=0.004):
    return ds.TetrahedralMesh.create_box(2, size=0.1, origin=(0, height, 0))


def pressed(precision="f64", round_one=False, **options) -> ds.Scene:
    """A cube within the barriers of a floor, or of a ball that reaches into its lowest faces, and of a wall."""
    rough = dict(stiffness_per_area=3e5, width=0.01, friction=0.4, friction_speed=0.3, name="floor")
    floor = ds.Sphere((0.05, -0.06, 0.05), 0.06, **rough) if round_one else ds.Ground(0, **rough)
    wall = ds.HalfSpace([-0.006, 0, 0], [1, 0.1, 0], stiffness_per_area=3e5, width=0.01, friction=0.2, name="wall")
    given = dict(initial_velocities=(0.1, -0.3, 0.2), precision=precision, terms=[ds.Gravity(), floor, wall, ds.Drag(0.5)])
    return ds.Scene(cube(), ds.StableNeoHookean(youngs_modulus=2e5, poissons_ratio=0.3), **given | options)


def outputs():
    return [
        ds.ContactForce("floor", name="held"),
        ds.ContactForce("floor", "friction", name="dragged"),
        ds.ContactForce("wall", "normal", name="turned", about=(0, 0.1, 0)),
        ds.ContactForce("wall", name="each", per_vertex=True),
    ]


def path(t):
    return 0.0, 0.2 * t, 0.1 * t


@lru_cache(maxsize=None)
def rollout_of(case: str) -> ds.Rollout:
    kind, *more = case.split()
    tight = dict(tolerance=1e-12)
    moved = dict(terms=[ds.Gravity(), ds.Ground(0, stiffness_per_area=3e5, friction=0.4, friction_speed=0.3, path=path, name="floor")])
    held = dict(fixed="ymax", motion=lambda t: (0.001 * t, -0.001 * t, 0.0), initial_velocities=None)
    alone = dict(terms=[t for t in pressed().terms if t.name != "wall"]) if "round" in more else {}
    if "round" in more:
        alone = dict(terms=[ds.Gravity(), pressed(round_one=True).terms[1]])
    options = (moved if "moved" in more else {}) | alone | (held if kind == "static" else {})
    scene = pressed("f32" if "f32" in more else "f64", **options)
    solver = {
        "euler": lambda: ds.ImplicitEulerSolver(scene, dt=2e-3, **tight),
        "middle": lambda: ds.ImplicitMidpointSolver(scene, dt=2e-3, **tight),
        "bdf": lambda: ds.BDF2Solver(scene, dt=2e-3, substeps=2, **tight),
        "static": lambda: ds.StaticSolver(scene, load_steps=2, tolerance=1e-12),
        "semi": lambda: ds.SemiImplicitSolver(scene, dt=2e-3, substeps=3),
        "verlet": lambda: ds.VelocityVerletSolver(scene, dt=2e-3, substeps=2),
    }[kind]()
    named = outputs() if len(scene.obstacles) > 1 else outputs()[:2]
    return ds.Rollout(solver, 4, save_every=2, outputs=named, gradients="all")


CASES = ["semi", "verlet", "euler", "middle moved", "bdf", "static", "semi moved", "semi round", "euler round"]


@pytest.mark.parametrize("case", CASES)
def test_seeds_are_the_transpose_of_tangents(case):
    """For every input by itself, and every output."""
    rollout, rng = rollout_of(case), np.random.default_rng(1)
    frames, gate = rollout.forward(), 1e-11 if rollout.solver.explicit else 1e-8
    assert np.abs(frames["held"]).max(0).min() > 0.1  # all components
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = {name: rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()}
    for key in rollout.inputs:
        direction = rng.normal(size=rollout.values[key].shape) * verify.input_scale(rollout, key)
        if key == "initial_velocities":
            direction[rollout.scene.fixed] = 0
        tangents = rollout.tangents(frames, **{key: direction})
        for name, seed in seeds.items():
            terms = tangents[name] * seed
            pushed, pulled = terms.sum(), (gradients[name][key] * direction).sum()
            assert abs(pushed - pulled) <= gate * max(abs(pushed), np.linalg.norm(terms), 1e-12), (key, name)


KEYS = ("youngs_modulus", "poissons_ratio", "floor.friction", "floor.stiffness_per_area", "rest_positions", "density")


@pytest.mark.parametrize("case", CASES)
def test_gradients_agree_with_differences(case):
    """All outputs at once: what they are seeded with is random."""
    rollout, rng = rollout_of(case), np.random.default_rng(2)
    frames = rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = rollout.vjp(frames, **seeds)

    def loss(**values):
        got = rollout.forward(**values)
        return sum((got[name] * seed).sum() for name, seed in seeds.items())

    for key in KEYS + ("floor.path",) * ("moved" in case):
        base = rollout.values[key]
        direction = rng.normal(size=base.shape) * verify.input_scale(rollout, key)
        slope = (gradients[key] * direction).sum()
        step = 1e-4
        coarse, fine = ((loss(**{key: base + s * direction}) - loss(**{key: base - s * direction})) / (2 * s) for s in (step, step / 2))
        assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-6, abs=1e-7 * abs(loss())), key
