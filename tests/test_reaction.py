"""Reactions of supports, and stress, as a loss names them."""

from functools import lru_cache

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify

RNG = np.random.default_rng(0)
FORCES = RNG.normal(size=(4, 8, 3))


def scene_of(precision="f64", **options):
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), size=(0.2, 0.1, 0.1))
    load = ds.ExternalForce(
        FORCES if "per_step" in options else FORCES[0, :4], vertices="xmax" if "per_step" not in options else None
    )
    options.pop("per_step", None)
    given = dict(density=900.0, terms=[ds.Gravity((1.0, -9.81, 2.0)), load], fixed=["xmin"], precision=precision)
    return ds.Scene(mesh, ds.StableNeoHookean(youngs_modulus=5e4, poissons_ratio=0.3), **given | options)


def reactions():
    return [
        ds.Reaction("xmin"),
        ds.Reaction("xmin", name="moment", about=(0, 0.05, 0.05)),
        ds.Reaction(name="each", per_vertex=True),
    ]


@lru_cache(maxsize=None)
def rollout_of(kind, precision="f64"):
    motion = lambda t: (0.002 * t, 0.0, 0.001 * t)  # noqa: E731
    fixed = ["xmin", "ymin"]  # reactions of one side alone would not depend on the modulus
    scene = scene_of(precision, motion=motion, fixed=fixed, **(dict(volume="patches") if kind == "euler" else {}))
    solver = {
        "static": lambda: ds.StaticSolver(scene, tolerance=1e-12 if precision == "f64" else 1e-5),
        "euler": lambda: ds.ImplicitEulerSolver(scene, dt=5e-3, tolerance=1e-12),
        "verlet": lambda: ds.VelocityVerletSolver(scene, dt=5e-4),
    }[kind]()
    return ds.Rollout(solver, 2, save_every=1, outputs=reactions(), gradients="all")


@pytest.mark.parametrize("kind, precision", [("static", "f64"), ("euler", "f64"), ("verlet", "f64"), ("static", "f32")])
def test_seeds_are_the_transpose_of_tangents(kind, precision):
    rollout, rng = rollout_of(kind, precision), np.random.default_rng(1)
    # f32: Newton stops at 1e-5, and reactions are sums of stresses that cancel
    frames, gate = rollout.forward(), 2e-3 if precision == "f32" else 1e-11 if kind == "verlet" else 1e-8
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
            assert abs(pushed - pulled) <= gate * max(abs(pushed), np.linalg.norm(terms), 1e-9), (key, name)


@pytest.mark.parametrize("kind", ["static", "euler", "verlet"])
def test_gradients_agree_with_differences(kind):
    rollout, rng = rollout_of(kind), np.random.default_rng(2)
    frames = rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = rollout.vjp(frames, **seeds)

    def loss(**values):
        got = rollout.forward(**values)
        return sum((got[name] * seed).sum() for name, seed in seeds.items())

    for key in (
        "youngs_modulus",
        "poissons_ratio",
        "density",
        "rest_positions",
        "gravity",
        "external_forces",
        "prescribed_motion",
    ):
        base = rollout.values[key]
        direction = rng.normal(size=base.shape) * verify.input_scale(rollout, key)
        slope, s = (gradients[key] * direction).sum(), 1e-3
        coarse, fine = (
            (loss(**{key: base + t * direction}) - loss(**{key: base - t * direction})) / (2 * t) for t in (s, s / 2)
        )
        assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-6, abs=1e-8 * abs(loss())), key


def test_reactions_balance_weight_and_loads():
    """In equilibrium, with the moments of both about a point."""
    scene = scene_of()
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1, outputs=reactions())
    frames = rollout.forward()
    mass, x = scene.inputs.derive(scene.inputs.values).mass, frames.positions[-1]
    loads = mass[:, None] * np.array([1.0, -9.81, 2.0])
    loads[scene.mesh.vertex_indices("xmax")] += FORCES[0, :4]
    assert frames["reaction"][-1] == pytest.approx(-loads.sum(0), rel=1e-10)
    assert frames["each"][-1].sum(0) == pytest.approx(frames["reaction"][-1])
    moment = np.cross(x - [0, 0.05, 0.05], loads).sum(0)
    assert frames["moment"][-1] == pytest.approx(-moment, rel=1e-9)


def test_a_simulator_has_them_step_by_step():
    """As a run's frames have them: reactions under loads that change within steps, contact forces of each step."""
    keyed = ds.Traction(lambda t: (2e5 * t, 0.0, -100.0), "xmax")
    floor = ds.Ground(-0.004, stiffness_per_area=3e5, width=0.01, friction=0.4, name="floor")
    named = [ds.Reaction("xmin", per_vertex=True), ds.Reaction(name="all"), ds.Stress(von_mises=True)]
    named += [ds.ContactForce("floor", per_vertex=True), ds.ContactTraction("floor", "friction", "slowed")]
    options = dict(terms=[ds.Gravity(), keyed, floor], initial_velocities=(0.3, -0.4, 0.0))
    for kind in (ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.ImplicitEulerSolver):
        solver = kind(scene_of(**options), dt=5e-4, substeps=2)
        frames = ds.Rollout(solver, 6, save_every=1, outputs=named).forward()
        simulator = ds.Simulator(solver, contact_forces=True)
        for _ in range(2):
            for k in range(7):
                for output in named:
                    assert np.array_equal(simulator.output(output), frames[output.name][k]), (kind, k, output)
                if k < 6:
                    simulator.step()
            simulator.reset()
        assert np.abs(frames["contact_force"][-1]).max() > 0 and np.abs(frames["slowed"][-1]).max() > 0
    plain = ds.Simulator(solver)
    assert np.array_equal(plain.output(named[1]), frames["all"][0])
    with pytest.raises(ValueError, match="contact_forces=True"):
        plain.output(named[3])
    with pytest.raises(ValueError, match="counts from the start of a run"):
        plain.output(ds.WorkOfLoads())


def test_what_does_not_fit_is_refused():
    solver = ds.StaticSolver(scene_of())
    with pytest.raises(ValueError, match="among the fixed vertices, but 4 of its 4 vertices are free"):
        ds.Rollout(solver, 1, outputs=ds.Reaction("xmax"))
    with pytest.raises(ValueError, match="about= or per_vertex=True"):
        ds.Reaction(about=(0, 0, 0), per_vertex=True)
