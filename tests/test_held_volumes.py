"""Volumes that explicit steps hold, work of held volumes, and both in ten-node tetrahedra."""

import numpy as np
import pytest
import taichi as ti
from chamber_meshes import hollow_cube
from test_chambers import assert_outputs_transposed, assert_tangents, hollow, pitted
from test_every_adjoint import assert_transposed

import diffsim_ti as ds
from diffsim_ti.mechanics.corrections import CorrectionAdjoint

EXPLICIT = [ds.SemiImplicitSolver, ds.VelocityVerletSolver]
EVERY = [*EXPLICIT, ds.ImplicitEulerSolver, ds.StaticSolver]
named = pytest.mark.parametrize("kind", EXPLICIT, ids=lambda s: s.__name__)


def oil(volume) -> ds.FilledChamber:
    return ds.FilledChamber(volume, "cavity", name="oil")


def pumped(of, *terms, rise=1.01, time=1e-3, **options) -> ds.Scene:
    """The volume at rest, which rises within a time."""
    V = of([oil(1.0), *terms], **options).chamber_volume("oil")
    return of([oil(([0.0, time], [V, rise * V])), *terms], **options)


def rollout_of(kind, scene, steps=3, **options) -> ds.Rollout:
    given = dict(dt=2e-4, substeps=2) if kind is not ds.StaticSolver else dict(dt=2e-4, load_steps=2)
    given |= {} if kind in EXPLICIT else dict(tolerance=1e-12)
    outputs = [ds.ChamberPressure("oil"), ds.WorkOfLoads()]
    return ds.Rollout(kind(scene, **given), steps, **dict(save_every=1, outputs=outputs, gradients="all") | options)


def ten_nodes(terms, **options) -> ds.Scene:
    mesh = hollow_cube().quadratic()
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [*terms, ds.Gravity()], "bottom", precision="f64")


@pytest.mark.parametrize("of", [pitted, hollow], ids=["in planes", "closed"])
@named
def test_every_number(kind, of):
    """Pressure and work among the outputs, drag, a rim that slides in planes, checkpoints."""
    terms = (ds.Drag(3.0),) if of is pitted else ()
    rollout = rollout_of(kind, pumped(of, *terms), checkpoint_every=2)
    assert_transposed(rollout, 1e-11)
    assert_outputs_transposed(rollout, 1e-11)


def test_tangents_against_differences():
    keys, scene = ("youngs_modulus", "oil.volume", "rest_positions", "density"), pumped(pitted, rise=1.05)
    assert_tangents(rollout_of(EXPLICIT[1], scene, steps=2, outputs=ds.WorkOfLoads()), keys, 1e-5)


@named
def test_volumes_and_their_rates(kind):
    """To round-off; in float32 to its own. The velocities that Verlet shows agree with the rate."""
    for precision, gate in (("f64", 1e-14), ("f32", 1e-7)):
        scene = pumped(pitted, precision=precision)
        frames, V = rollout_of(kind, scene, steps=4).forward(), scene.chamber_volume("oil")
        inside = np.array([scene.chamber_volume("oil", x) for x in frames.positions])
        assert np.allclose(inside / V, 1 + 0.002 * np.arange(5), rtol=0, atol=gate)
        if kind is ds.VelocityVerletSolver and precision == "f64":
            enclosure = scene.terms_of(ds.FilledChamber)[0].enclosure
            rates = [(enclosure.gradient(x) * v).sum() for x, v in zip(frames.positions, frames.velocities)]
            assert rates[1:] == pytest.approx(np.full(4, 10 * V), rel=1e-11)


def test_faces_of_the_same_run():
    """Checkpoints, clip and a second sweep give the same bits or nearly so; a simulator and a tape go the same way."""
    scene = pumped(pitted)
    plain, parts, clipped = (
        rollout_of(EXPLICIT[1], scene, **o) for o in ({}, dict(checkpoint_every=2), dict(clip=1e30))
    )
    frames, rng = plain.forward(), np.random.default_rng(0)
    seeds = dict(positions=rng.normal(size=frames.positions.shape), chamber_pressure=rng.normal(size=4))
    expected = plain.vjp(frames, **seeds)
    for other, gate in ((plain, 0), (parts, 0), (clipped, 1e-9)):
        found = other.vjp(other.forward(), **seeds)
        for name, wanted in expected.items():
            assert np.abs(found[name] - wanted).max() <= gate * np.abs(wanted).max(), name
    pressure, total = plain.field("chamber_pressure"), ti.field(ti.f64, (), needs_grad=True)

    @ti.kernel
    def add(x: ti.template()):
        for f in x:
            total[None] += x[f]

    with ti.ad.Tape(total):
        plain.run()
        add(pressure)
    taped, expected = plain.gradients, plain.vjp(plain.forward(), chamber_pressure=np.ones(4))
    for name, wanted in expected.items():
        np.testing.assert_array_equal(taped[name], wanted, err_msg=name)
    simulator = ds.Simulator(plain.solver)
    for k in range(1, 4):
        simulator.step()
        assert np.allclose(simulator.positions, frames.positions[k], rtol=0, atol=1e-15)
        assert np.allclose(simulator.velocities, frames.velocities[k], rtol=0, atol=1e-12)
        assert simulator.output(ds.ChamberPressure("oil")) == pytest.approx(frames["chamber_pressure"][k], rel=1e-7)


def test_it_comes_to_rest_in_equilibrium():
    slow = ds.VelocityVerletSolver(pumped(pitted, ds.Drag(20.0), rise=1.05, time=0.05), dt=3e-3)
    end = ds.Rollout(slow, 400, save_every=400, outputs=ds.ChamberPressure("oil")).forward()
    V = slow.scene.chamber_volume("oil")
    still = rollout_of(ds.StaticSolver, pitted([oil(1.05 * V)]), steps=1).forward()
    assert end["chamber_pressure"][-1] == pytest.approx(still["chamber_pressure"][-1], rel=1e-6)
    assert (
        np.abs(end.positions[-1] - still.positions[-1]).max() < 1e-7 < 1e-4 < np.ptp(still.positions[:, :, 0], 0).max()
    )


def test_a_held_volume_keeps_the_energy():
    """What holds it does no work; nor does the watch over energy see any come from nowhere."""
    V, v = pitted([oil(1.0)]).chamber_volume("oil"), np.zeros_like(pitted([]).mesh.vertices)
    x = pitted([]).mesh.vertices
    v[:, 0] = np.where(x[:, 0] > 0.05, 2 * np.sin(9 * x[:, 1]), 0)
    rollout = ds.Rollout(ds.VelocityVerletSolver(pitted([oil(V)], initial_velocities=v), dt=4e-4), 800, save_every=50)
    energy = [ds.ElasticEnergy(), ds.KineticEnergy()]
    rollout = ds.Rollout(rollout.solver, 800, save_every=50, outputs=energy)
    frames = rollout.forward()
    total = frames["elastic_energy"] + frames["kinetic_energy"]
    assert np.abs(total[1:] / total[1] - 1).max() < 2e-4 and frames["elastic_energy"].max() > 0.2 * total[1]
    assert rollout.sweep.workspace.energy_watch.share < 1e-4


@pytest.mark.parametrize("kind", EVERY, ids=lambda s: s.__name__)
def test_ten_nodes(kind):
    """In implicit steps this short, inertia is all: a rough solve must not drown what the pressure balances."""
    scene = pumped(ten_nodes)
    rollout = rollout_of(kind, scene, steps=2 if kind in EXPLICIT else 1, outputs=ds.ChamberPressure("oil"))
    frames, V = rollout.forward(), scene.chamber_volume("oil")
    inside = [scene.chamber_volume("oil", x) for x in frames.positions[1:]]
    assert inside == pytest.approx(V * np.array([1.002, 1.004])[: len(inside)], rel=1e-11)
    assert_transposed(rollout, 1e-11 if kind in EXPLICIT else 1e-8)


def test_work_converges_to_the_energy():
    """In equilibria the pressures' work is what the body stores, with an error that falls as the square of the steps."""
    V, off = pitted([oil(1.0)]).chamber_volume("oil"), []
    for n in (4, 8):
        scene = pitted([oil(V * (1 + 0.1 * np.arange(1, n + 1) / n))])
        outputs = [ds.WorkOfLoads(), ds.ElasticEnergy()]
        frames = ds.Rollout(ds.StaticSolver(scene), n, save_every=1, outputs=outputs).forward()
        off.append(frames["work"][-1] / frames["elastic_energy"][-1] - 1)
    assert off[1] == pytest.approx(off[0] / 4, rel=0.1) and abs(off[1]) < 0.02


def test_a_volume_that_cannot_be_reached_is_said():
    V = pitted([oil(1.0)]).chamber_volume("oil")
    with pytest.raises(FloatingPointError, match="no pressure leads in one substep .* by keyframes"):
        ds.Rollout(ds.VelocityVerletSolver(pitted([oil(30 * V)]), dt=2e-4), 3).forward()


def test_a_forgotten_multiplier_would_be_found(monkeypatch):
    """The mutation that the dot products of held volumes are there for."""
    rollout = rollout_of(EXPLICIT[0], pumped(pitted), outputs=ds.ChamberPressure("oil"))
    rollout.forward()
    monkeypatch.setattr(CorrectionAdjoint, "_add", lambda self, run, by_u: None)
    assert ds.dot_product_test(rollout) > 1e-6
