"""Work of loads, as a loss names it: where it is exact, that it balances energies, and its derivatives."""

from functools import lru_cache

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.mechanics.loads.interaction import DeadLoads


def mesh():
    return ds.TetrahedralMesh.create_box((3, 2, 2), size=(0.2, 0.1, 0.1))


def scene_of(*terms, **options):
    given = dict(density=900.0, fixed="xmin", precision="f64", terms=terms)
    return ds.Scene(mesh(), ds.StableNeoHookean(5e4, 0.3), **given | options)


@lru_cache(maxsize=None)
def rollout_of(kind):
    slow = 1e-3 if kind == "static" else 1.0  # whose steps take a second
    terms = [
        ds.Gravity((1.0, -9.81, 2.0)),
        ds.Traction(lambda t: (300 * np.sin(200 * slow * t), -5e4 * slow * t, 100.0), "xmax"),
        ds.BodyForce(np.random.default_rng(0).normal(size=(4, 3)) * 3e3),
        ds.Pressure(lambda t: 400 + 1e5 * slow * t, "ymax"),
    ]
    start = dict(initial_velocities=(0.1, -0.3, 0.2))
    if kind == "alone":  # one external force is no sum of loads
        terms, start = [ds.ExternalForce(np.random.default_rng(0).normal(size=(4, 4, 3)), "xmax")], {}
    scene = scene_of(*terms, **({} if kind == "static" else start))
    solver = {
        "static": lambda: ds.StaticSolver(scene, tolerance=1e-12),
        "euler": lambda: ds.ImplicitEulerSolver(scene, dt=2e-3, tolerance=1e-12),
        "semi": lambda: ds.SemiImplicitSolver(scene, dt=1e-3, substeps=2),
        "alone": lambda: ds.VelocityVerletSolver(scene, dt=1e-3),
    }[kind]()
    named = [ds.WorkOfLoads()] + ([ds.WorkOfLoads(weight=True, name="with_weight")] if kind != "alone" else [])
    return ds.Rollout(solver, 4, save_every=2, outputs=named, gradients="all")


@pytest.mark.parametrize("kind", ["semi", "alone", "euler", "static"])
def test_derivatives(kind):
    """Seeds are the transpose of tangents, and these agree with differences, for each input by itself."""
    rollout, rng = rollout_of(kind), np.random.default_rng(1)
    frames, gate = rollout.forward(), 1e-11 if kind in ("semi", "alone") else 1e-8
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = {name: rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()}
    for key in rollout.inputs:
        direction = rng.normal(size=rollout.values[key].shape) * verify.input_scale(rollout, key)
        if key in ("initial_velocities", "initial_positions"):
            direction[rollout.scene.fixed] = 0
        if kind == "static" and key.startswith("initial"):
            continue  # where the way begins, the first frame is as it is given
        tangents = rollout.tangents(frames, **{key: direction})
        base, s = rollout.values[key], 1e-4
        got = [rollout.forward(**{key: base + t * direction}) for t in (s, -s, s / 2, -s / 2)]
        for name, seed in seeds.items():
            terms = tangents[name] * seed
            pulled = (gradients[name][key] * direction).sum()
            assert abs(terms.sum() - pulled) <= gate * max(abs(pulled), np.linalg.norm(terms), 1e-12), (key, name)
            d = [(g[name] * seed).sum() for g in got]
            difference = (4 * (d[2] - d[3]) / s - (d[0] - d[1]) / (2 * s)) / 3
            assert terms.sum() == pytest.approx(difference, rel=1e-6, abs=1e-7 * np.abs(frames[name]).max()), (
                key,
                name,
            )


def test_constant_dead_loads_are_exact_whatever_the_way():
    scene = scene_of(ds.Traction((100.0, -300.0, 50.0), "xmax"), ds.Gravity())
    solver = ds.SemiImplicitSolver(scene, dt=1e-3)
    few, many = (ds.Rollout(solver, 40, save_every=n, outputs=ds.WorkOfLoads(weight=True)).forward() for n in (40, 1))
    derived = scene.inputs.derive(scene.inputs.values)
    force = derived.mass[:, None] * [0, -9.81, 0]
    force[scene.interaction(DeadLoads).acts_at] += derived.forces[0]
    exact = (force * (many.positions[-1] - many.positions[0])).sum()
    assert few["work"][-1] == pytest.approx(exact, rel=1e-12) and many["work"][-1] == pytest.approx(exact, rel=1e-12)
    assert exact > 1e-3


def test_constant_pressure_on_all_of_a_body_is_minus_p_times_the_change_of_volume():
    scene = scene_of(ds.Pressure(2e3), fixed=None, initial_velocities=np.random.default_rng(0).normal(size=(12, 3)))
    outputs = [ds.WorkOfLoads(), ds.EnclosedVolume()]
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 30, save_every=10, outputs=outputs).forward()
    change = frames["volume"] - frames["volume"][0]
    assert np.abs(change).max() > 0.01 * frames["volume"][0]
    assert frames["work"] == pytest.approx(-2e3 * change, rel=1e-10, abs=1e-13)


def test_what_loads_do_is_what_the_energy_gains():
    """Of a follower pressure on one side and a growing traction; the gap falls with the steps, by order 2."""
    gaps = []
    for n in (100, 200):
        pulled = lambda t: (4e4 * t, 0, -2e4 * t)  # noqa: E731
        scene = scene_of(ds.Traction(pulled, "xmax"), ds.Pressure(300.0, "zmax"))
        outputs = [ds.WorkOfLoads(), ds.KineticEnergy(), ds.ElasticEnergy()]
        rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=0.04 / n), n, save_every=1, outputs=outputs)
        frames = rollout.forward()
        gained = frames["kinetic_energy"] + frames["elastic_energy"]
        gaps.append(np.abs(frames["work"] - gained + gained[0]).max() / gained.max())
    assert gaps[0] < 1e-2 and gaps[0] / gaps[1] == pytest.approx(4, rel=0.3)


def test_a_scene_without_loads_is_refused():
    solver = ds.SemiImplicitSolver(scene_of(ds.Gravity()), dt=1e-4)
    with pytest.raises(ValueError, match="the scene has no load"):
        ds.Rollout(solver, 1, outputs=ds.WorkOfLoads())
    assert ds.Rollout(solver, 1, outputs=ds.WorkOfLoads(weight=True)).forward()["work"].shape == (2,)
