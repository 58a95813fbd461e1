"""Substeps of several kicks for strong viscosity: what is stable, closed forms, every gate of gradients, faces, errors."""

import numpy as np
import pytest
from test_viscosity import CUBE, ELASTIC, MATERIALS, ONE, gates, scene, slowest_mode, swung

import diffsim_ti as ds
from diffsim_ti.state.viscous_stages import MOST, ViscousStages

STAGES = 3


@pytest.mark.parametrize("stages", [2, 3, 5, 8, 13, MOST])
def test_any_stiffness_with_any_damping_is_bounded_up_to_the_limit(stages):
    """Random symmetric matrices, of any rank, whose motions need not be the same; kick by kick."""
    rng, kicks = np.random.default_rng(stages), ViscousStages(stages)
    assert kicks.kicks.sum() == pytest.approx(1, rel=1e-12) and kicks.beta > stages**2
    for trial in range(60):
        n = int(rng.integers(1, 7))
        K, C = (
            (A @ A.T) * 10 ** rng.uniform(-2, 2) for A in (rng.normal(size=(n, rng.integers(1, n + 1))) for _ in "KC")
        )
        C = K * 10 ** rng.uniform(-2, 2) if trial % 3 == 0 else C
        omega2, c = (np.linalg.eigvalsh(M)[-1] for M in (K, C))
        h = 2 / np.sqrt(kicks.squared_rate(omega2, c))
        step, zero, one = np.eye(2 * n), np.zeros((n, n)), np.eye(n)
        for t in kicks.kicks:
            step = np.block([[one, zero], [-h * t * K, one - h * t * C]]) @ step
        step = np.block([[one, h * one], [zero, one]]) @ step
        assert np.abs(np.linalg.eigvals(step)).max() < 1 + 1e-6  # double roots on the unit circle


@pytest.mark.parametrize(
    "xi, kicks, less", [(2, 3, 1.2), (5, 4, 2.1), (10, 6, 2.9), (20, 8, 4.1), (50, 13, 6.6), (100, 18, 9.2)]
)
def test_the_table_of_the_page(xi, kicks, less):
    """benchmarks/README.md: time gone by in an evaluation of forces, at the best number of kicks, against one kick."""
    gone = {n: 2 / np.sqrt(ViscousStages(n).squared_rate(1.0, 2.0 * xi)) / n for n in range(1, MOST + 1)}
    assert max(gone, key=gone.get) == kicks and gone[kicks] / gone[1] == pytest.approx(less, abs=0.05)


def test_one_stage_is_an_ordinary_kick():
    """Bit for bit, and its limit that of an oscillator."""
    body = swung(MATERIALS["time"]())
    plain, one = (ds.SemiImplicitSolver(body, dt=2e-3, **own) for own in ({}, dict(viscous_stages=1)))
    ends = [ds.Rollout(solver, 3).forward().positions.tobytes() for solver in (plain, one)]
    assert ends[0] == ends[1] and plain.stable_dt(tight=True) == one.stable_dt(tight=True)
    assert 2 / np.sqrt(ViscousStages().squared_rate(4.0, 3.0)) == pytest.approx(np.sqrt(1 + 0.75**2) - 0.75)


@pytest.mark.parametrize("numbers", [dict(time=3.5), dict(shear_viscosity=2e4, bulk_viscosity=1e3)], ids=str)
def test_steps_are_stable_up_to_the_limit(numbers):
    """Also where damping is not that of stiffness; at damping ratios of some 20 four times less work than one kick takes."""
    start = 1e-6 * np.random.default_rng(5).standard_normal((8, 3))
    body = scene(ds.KelvinVoigt(ELASTIC, **numbers), initial_velocities=start)
    limits = {n: ds.SemiImplicitSolver(body, dt=1e-9, viscous_stages=n).stable_dt(tight=True).dt for n in (1, 4, 8)}
    assert limits[8] / 8 > 3 * limits[1] and limits[4] / 4 > 2 * limits[1]
    for n in (4, 8):
        solver = ds.SemiImplicitSolver(body, dt=0.99 * limits[n], viscous_stages=n, check_start=False)
        last = ds.Rollout(solver, 400, save_every=400).forward().velocities[-1]
        assert np.abs(last - start.mean(0)).max() < 1e-5
        with pytest.raises(ValueError, match="exceeds the stable step"):
            ds.SemiImplicitSolver(body, dt=1.01 * limits[n], substeps=1, viscous_stages=n)
    assert ds.SemiImplicitSolver(body, dt=1e-9, viscous_stages=8).stable_dt() <= limits[8]


def test_a_step_that_has_been_outgrown_is_noticed():
    """Where a run is given stronger viscosity than the step was made for."""
    body = scene(ds.KelvinVoigt(ELASTIC, time=0.03), initial_positions=CUBE.vertices * [1.2, 1, 1])
    limit = ds.SemiImplicitSolver(body, dt=1e-9, viscous_stages=4).stable_dt(tight=True).dt
    rollout = ds.Rollout(ds.SemiImplicitSolver(body, dt=0.9 * limit, substeps=1, viscous_stages=4), 100, save_every=100)
    rollout.forward()
    with pytest.raises(ds.Divergence, match="outgrown the stable step"):
        rollout.forward(viscous_time=1.0)


def test_a_tetrahedron_swings_as_an_oscillator_does():
    """exp(-xi omega t), of first order in the step, whatever the kicks."""
    errors = []
    for dt in (2e-3, 1e-3):
        mode, omega = slowest_mode(ELASTIC)
        xi = 0.3
        body = scene(
            ds.KelvinVoigt(ELASTIC, time=2 * xi / omega),
            ONE,
            fixed=[0, 1, 2],
            initial_positions=ONE.vertices + 1e-6 * mode,
        )
        n = round(0.5 / dt)
        solver = ds.SemiImplicitSolver(body, dt=dt, viscous_stages=4)
        u = ds.Rollout(solver, n, save_every=1).forward().displacements[:, 3] @ mode[3] * 1e6
        t, damped = dt * np.arange(n + 1), omega * np.sqrt(1 - xi**2)
        exact = np.exp(-xi * omega * t) * (np.cos(damped * t) + xi / np.sqrt(1 - xi**2) * np.sin(damped * t))
        errors.append(np.abs(u - exact)[:: round(0.02 / dt)].max())
    assert errors[1] < 0.02 and 1.8 < errors[0] / errors[1] < 2.2


def case(name: str, **options) -> ds.Scene:
    """Drawn along, falling, slowed down, on a rough obstacle, pulled and pressed."""
    terms = [ds.Gravity(), ds.Drag(0.3), ds.Ground(-0.05, stiffness=2e3, width=0.1, friction=0.3, name="floor")]
    terms += [ds.ExternalForce(np.random.default_rng(8).normal(size=(3, 8, 3)))]
    return swung(MATERIALS[name](), terms=terms, **options)


@pytest.mark.parametrize("name", ["dashpots", "both"])
def test_gradients_by_every_number(name):
    body = case(name, fixed="xmin", motion=lambda t: [0, 0.3 * t, 0])
    r = ds.Rollout(ds.SemiImplicitSolver(body, dt=4e-3, substeps=2, viscous_stages=STAGES), 3, gradients="all")
    own = [x for x in body.material.inputs if x != "poissons_ratio"]
    gates(r, 1e-12, *own, "drag_rate", "floor.stiffness", "external_forces", "initial_velocities", "rest_positions")


def test_single_precision_gradients():
    """Against those of double precision where there is any, and by a dot product."""
    from diffsim_ti import verify

    body = case("dashpots").replace(precision="f32")
    r = ds.Rollout(ds.SemiImplicitSolver(body, dt=4e-3, viscous_stages=STAGES), 3, gradients="all")
    assert verify.dot_product_test(r) <= 1e-4


def test_unequal_steps_and_checkpoints():
    body = case("time")
    solver = ds.SemiImplicitSolver(body, dt=4e-3, substeps=2, viscous_stages=STAGES)
    whole, parts = (ds.Rollout(solver, 3, gradients="all", **own) for own in ({}, dict(checkpoint_every=1)))
    w = np.random.default_rng(7).standard_normal(whole.forward().positions.shape)
    want, got = (r.vjp(r.forward(), w) for r in (whole, parts))
    for name in want:
        assert got[name].tobytes() == want[name].tobytes(), name
    unequal = ds.Rollout(solver, [2e-3, 4e-3, 3e-3], save_every=1, gradients="all")
    assert unequal.schedule is not None and np.allclose(unequal.times, [0, 2e-3, 6e-3, 9e-3])
    gates(unequal, 1e-12, "viscous_time", "initial_positions")
    same = ds.Rollout(solver, [4e-3] * 3, gradients="all")
    np.testing.assert_allclose(same.forward().positions, whole.forward().positions, rtol=0, atol=1e-14)


def test_steps_and_batches_are_those_of_a_rollout():
    body = case("time")
    solver = ds.SemiImplicitSolver(body, dt=4e-3, substeps=2, viscous_stages=STAGES)
    assert solver.describe().endswith("3 kicks in each substep")
    want = ds.Rollout(solver, 3).forward()
    simulator = ds.Simulator(solver)
    simulator.run(3)
    assert simulator.positions.tobytes() == want.positions[-1].tobytes()
    batch = ds.Batch(solver, 3, scenes=2)
    assert all(x.tobytes() == want.positions.tobytes() for x in batch.forward().positions)


@pytest.mark.parametrize(
    "material, stages, words",
    [
        (ELASTIC, 4, "StableNeoHookean has no viscosity"),
        (ds.KelvinVoigt(ELASTIC, time=0.1), 0, "viscous_stages must be a whole number >= 1, got 0"),
        (ds.KelvinVoigt(ELASTIC, time=0.1), MOST + 1, "viscous_stages must be at most 32"),
    ],
)
def test_what_does_not_fit_is_refused(material, stages, words):
    with pytest.raises(ValueError, match=words):
        ds.SemiImplicitSolver(scene(material), dt=1e-5, viscous_stages=stages)
