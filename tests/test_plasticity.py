"""Finite-strain J2 plasticity: closed forms of one element, what does not depend on the observer, energies, gradients."""

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.optimize import brentq

import diffsim_ti as ds
from diffsim_ti import verify

MESH = ds.TetrahedralMesh.create_cube(2, 1.0)
E, NU, FIRST = 200.0, 0.3, 1.0
MU = E / (2 * (1 + NU))
LINEAR = dict(hardening=5.0)
VOCE = dict(hardening=5.0, saturation_stress=1.6, saturation_exponent=12.0)
SIMPLE = ds.J2Plasticity(E, NU, FIRST, hardening=5.0)
BOTH = VOCE | dict(kinematic_hardening=8.0)
OUTPUTS = (ds.Reaction("xmax"), ds.ElasticEnergy(), ds.Dissipation(), ds.PlasticStrain(), ds.Stress())


def metal(hardening=1.0, saturation_stress=FIRST, saturation_exponent=1.0, kinematic_hardening=0.0) -> ds.J2Plasticity:
    """One compiled law for all hardenings: a saturation stress that is the yield stress is none."""
    return ds.J2Plasticity(
        E,
        NU,
        FIRST,
        hardening,
        saturation_stress=saturation_stress,
        saturation_exponent=saturation_exponent,
        kinematic_hardening=kinematic_hardening,
    )


def flow_stress(a, hardening=1.0, saturation_stress=FIRST, saturation_exponent=1.0, **_):
    return FIRST + hardening * a + (saturation_stress - FIRST) * (1 - np.exp(-saturation_exponent * a))


def dissipated(a, hardening=1.0, saturation_stress=FIRST, saturation_exponent=1.0, **_):
    rate = saturation_exponent
    return FIRST * a + hardening * a**2 / 2 + (saturation_stress - FIRST) * (a - (1 - np.exp(-rate * a)) / rate)


def volume_ratio(frames) -> np.ndarray:
    """Of each tetrahedron, shape (frames, num_tetrahedra)."""
    x = frames.positions[:, MESH.tetrahedra]
    return np.linalg.det(x[:, :, 1:] - x[:, :, :1]) / (6 * MESH.volumes)


def pulled(material, stretches, volume="patches", mesh=MESH) -> ds.Scene:
    """A cube between frictionless plates, of which xmax goes to these stretches step by step."""
    return ds.Scene(
        mesh,
        material,
        fixed=dict(xmin="x", ymin="y", zmin="z", xmax="x"),
        motion=dict(
            xmax=lambda t: [np.interp(t, np.arange(len(stretches) + 1), [0, *(np.array(stretches) - 1)]), 0, 0]
        ),
        precision="f64",
        volume=volume,
    )


@pytest.mark.parametrize("law", [LINEAR, VOCE, LINEAR | dict(kinematic_hardening=8.0), BOTH], ids=str)
def test_tension_and_compression_in_cycles(law):
    """Of one axis: Kirchhoff's stress tau = E (log stretch - plastic), |tau - k plastic| <= Y(a)."""
    stretches = [1.02, 1.05, 1.02, 0.96, 1.03, 1.1]
    k, a, plastic, rows = law.get("kinematic_hardening", 0.0), 0.0, 0.0, []
    for stretch in stretches:
        trial = E * (np.log(stretch) - plastic) - k * plastic
        q = abs(trial)
        if q > flow_stress(a, **law):
            x = brentq(lambda x, q=q, a=a: q - (E + k) * x - flow_stress(a + x, **law), 0, 1, xtol=1e-16)
            a, plastic = a + x, plastic + np.sign(trial) * x
        tau = E * (np.log(stretch) - plastic)
        rows.append((tau / stretch, a, dissipated(a, **law), tau**2 / (2 * E) + k / 2 * plastic**2))
    solver = ds.StaticSolver(pulled(metal(**law), stretches), tolerance=1e-12)
    frames = ds.Rollout(solver, len(stretches), save_every=1, outputs=OUTPUTS).forward()
    force, a, lost, stored = np.array(rows).T
    np.testing.assert_allclose(frames["reaction"][1:, 0], force, rtol=0, atol=1e-10)
    np.testing.assert_allclose(frames["plastic_strain"][1:], np.tile(a[:, None], 6), rtol=0, atol=1e-12)
    np.testing.assert_allclose(frames["dissipation"][1:], lost, rtol=0, atol=1e-12)
    np.testing.assert_allclose(frames["elastic_energy"][1:], stored, rtol=0, atol=1e-12)
    tau = np.tile((force * stretches)[:, None], 6)
    np.testing.assert_allclose(frames["stress"][1:, :, 0, 0] * volume_ratio(frames)[1:], tau, rtol=0, atol=1e-9)


SIX = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def six_to_tensor(numbers) -> np.ndarray:
    out = np.zeros((3, 3))
    for x, (i, j) in zip(numbers, SIX):
        out[i, j] = out[j, i] = x
    return out


def deviator(A) -> np.ndarray:
    return A - np.trace(A) / 3 * np.eye(3)


def after(law: dict, F, z) -> np.ndarray:
    """The state after a pass, by a return mapping of its own."""
    k, f, a, b = law.get("kinematic_hardening", 0.0), np.eye(3) + z[:9].reshape(3, 3), z[9], six_to_tensor(z[10:])
    xi = 2 * MU * deviator(logm((F @ f).T @ F @ f).real / 2) - 2 / 3 * k * b
    q = np.sqrt(1.5) * np.linalg.norm(xi)
    if q <= flow_stress(a, **law):
        return z
    x = brentq(lambda x: q - (3 * MU + k) * x - flow_stress(a + x, **law), 0, q / (3 * MU), xtol=1e-16)
    A = 1.5 * x / q * xi
    return np.r_[(f @ expm(-A) - np.eye(3)).ravel(), a + x, [(b + A)[pair] for pair in SIX]]


def held(material, Fs) -> tuple[np.ndarray, np.ndarray]:
    """(P, state) of a body all of whose vertices are held at deformation gradients, after a pass at each."""
    body = ds.Scene(MESH, material, fixed=np.arange(MESH.num_vertices), precision="f64", volume="patches")
    simulator, found = ds.Simulator(ds.VelocityVerletSolver(body, dt=1.0, substeps=1)), []
    for F in Fs:
        simulator.set_state(positions=MESH.vertices @ F.T)
        simulator.step()
        found.append((simulator.output(ds.Stress(kind="first_piola"))[0], simulator.law_state[0]))
    return tuple(map(np.array, zip(*found)))


def turns(count: int) -> list:
    return [expm(w - w.T) for w in np.random.default_rng(5).standard_normal((count, 3, 3))]


def test_pure_shear():
    """One pass, in a turned frame: a = (2 sqrt(3) mu log stretch - Y) / (3 mu + h)."""
    (Q,) = turns(1)
    for log in (0.004, 0.1, 1.0):  # elastic, plastic
        _, z = held(metal(**LINEAR), [Q @ np.diag(np.exp([log, -log, 0])) @ Q.T])
        expected = max(2 * np.sqrt(3) * MU * log - FIRST, 0) / (3 * MU + LINEAR["hardening"])
        assert z[0, 9] == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("law", [VOCE, BOTH], ids=["isotropic", "kinematic"])
def test_any_path_whoever_looks(law):
    """Shear to and fro while the axes turn; a turn of each moment leaves the state, and turns the stress."""
    rng = np.random.default_rng(2)
    Fs = [
        np.eye(3) + rng.uniform(-0.02, 0.02, (3, 3)) + np.eye(3)[[0]].T * [0, s, 0] for s in (0.2, 0.6, 1.0, 0.3, -0.5)
    ]
    P, z = held(metal(**law), Fs)
    state = np.zeros(16)
    for F, own_P, own_z in zip(Fs, P, z):
        state = after(law, F, state)
        np.testing.assert_allclose(own_z, state, rtol=0, atol=1e-13)
        assert np.linalg.det(np.eye(3) + own_z[:9].reshape(3, 3)) == pytest.approx(1, abs=1e-13)
        if law is VOCE:  # flow in the axes of the elastic strain: the stress after it is that of Hencky's energy
            elastic = F @ (np.eye(3) + own_z[:9].reshape(3, 3))
            tau = MU * deviator(logm(elastic @ elastic.T).real) + E / (3 * (1 - 2 * NU)) * np.log(
                np.linalg.det(F)
            ) * np.eye(3)
            np.testing.assert_allclose(own_P @ F.T, tau, rtol=0, atol=1e-11)
    Qs = turns(len(Fs))
    turned, same = held(metal(**law), [Q @ F for Q, F in zip(Qs, Fs)])
    np.testing.assert_allclose(same, z, rtol=0, atol=1e-13)
    np.testing.assert_allclose(turned, Qs @ P, rtol=0, atol=1e-11)


def thrown(dt: float, steps: int, law=BOTH, precision="f64", **options) -> ds.Rollout:
    """A cube that is held at a face and set in motion, so that it yields."""
    velocities = 8 * MESH.vertices * [1, 0.5, -0.2] * MESH.vertices[:, :1]
    body = ds.Scene(
        MESH, metal(**law), 1.0, fixed="xmin", initial_velocities=velocities, precision=precision, volume="patches"
    )
    return ds.Rollout(ds.VelocityVerletSolver(body, dt=dt, substeps=4), steps, save_every=1, **options)


def test_energy_goes_where_it_is_said_to():
    """Motion, strain and dissipation together stay, to the second order of the steps."""
    outputs, drifts = (ds.KineticEnergy(), ds.ElasticEnergy(), ds.Dissipation()), []
    for refine in (1, 2, 4):
        frames = thrown(8e-3 / refine, 20 * refine, outputs=outputs).forward()
        kinetic, stored, lost = (frames[x.name][::refine] for x in outputs)
        drifts.append(abs(kinetic + stored + lost - kinetic[0]).max() / kinetic[0])
    assert lost[-1] > 0.2 * kinetic[0] and np.all(np.diff(lost) >= 0)
    assert drifts[1] < drifts[0] / 3 and drifts[2] < drifts[1] / 3 and drifts[2] < 1e-3


def test_the_watch_of_energies_counts_what_is_dissipated():
    """At 0.8 of the stable step a bar that yields gains a twentieth of its energy, and that is what is noted."""
    mesh = ds.TetrahedralMesh.create_box((5, 3, 3), (2.0, 1, 1))
    velocities = 0.6 * mesh.vertices * [1, 0.5, -0.2] * mesh.vertices[:, :1]
    body = ds.Scene(mesh, SIMPLE, 1.0, fixed="xmin", initial_velocities=velocities, precision="f64", volume="patches")
    simulator = ds.Simulator(ds.VelocityVerletSolver(body, dt=8 * ds.stable_dt(body).dt, substeps=10))
    start, watch = simulator.compute_energy(), simulator.workspace.energy_watch
    watch.every = 50
    simulator.run(60)
    end = simulator.compute_energy()
    assert end.parts["dissipated"] > 0.9 * start and 0.05 * start < end - start < 0.1 * start
    assert watch.gained == pytest.approx(end - start, rel=0.05)


# ---- gradients ---------------------------------------------------------------------------------------------------------

NUMBERS = ("youngs_modulus", "poissons_ratio", "yield_stress", "hardening", "saturation_stress", "saturation_exponent")
NUMBERS += ("kinematic_hardening", "rest_positions")


def gates(r: ds.Rollout, round_off: float, *inputs: str) -> None:
    """Tangent and adjoint are each other's transposed in all inputs; central differences of some."""
    assert r.forward().law_state[-1, ..., 9].min() > 1e-3
    assert verify.dot_product_test(r) <= round_off
    report = ds.check_gradients(r, inputs=inputs, verbose=False)
    assert report.passed, report


@pytest.mark.thorough
def test_gradients_through_explicit_steps():
    gates(thrown(8e-3, 3, gradients="all", outputs=OUTPUTS[1:4]), 1e-12, *NUMBERS, "initial_velocities", "density")


@pytest.mark.parametrize(
    "material, inputs",
    [(SIMPLE, (*NUMBERS[:4], "rest_positions")), pytest.param(metal(**BOTH), NUMBERS, marks=pytest.mark.thorough)],
    ids=["linear", "all"],
)
def test_gradients_of_equilibria(material, inputs):
    """Also of what is drawn on and back, whose state goes on from step to step."""
    solver = ds.StaticSolver(pulled(material, [1.03, 1.07, 1.01]), tolerance=1e-12)
    outputs = OUTPUTS[1:] if len(inputs) > 5 else OUTPUTS[2:4]
    gates(ds.Rollout(solver, 3, save_every=1, gradients="all", outputs=[OUTPUTS[0], *outputs]), 1e-12, *inputs)


@pytest.mark.thorough
def test_gradients_of_ten_nodes():
    """A beam that is bent by a load, by implicit steps, of the law without saturation and kinematic hardening."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (2.0, 1.0, 1.0)).quadratic()
    load = ds.Traction([0, -1.0, 0], "xmax")
    body = ds.Scene(mesh, SIMPLE, 1.0, load, fixed="xmin", precision="f64")
    r = ds.Rollout(ds.ImplicitEulerSolver(body, dt=0.2, tolerance=1e-12), 3, gradients="all", outputs=OUTPUTS[2])
    assert r.forward().law_state is not None
    assert verify.dot_product_test(r) <= 1e-10
    report = ds.check_gradients(r, inputs=("yield_stress", "hardening", "youngs_modulus"), verbose=False)
    assert report.passed, report
    assert r.forward()["dissipation"][-1] > 0


def test_gradients_of_explicit_steps_are_those_of_differences():
    """By all numbers together, of a law with all hardenings."""
    r, rng = thrown(8e-3, 3, gradients=NUMBERS, outputs=OUTPUTS[2]), np.random.default_rng(1)
    frames = r.forward()
    seed = rng.standard_normal(frames.positions.shape)
    assert frames.law_state[-1, ..., 9].min() > 1e-3
    way = {name: rng.uniform(0.5, 1, np.shape(x)) * np.abs(x) for name, x in frames.inputs.items() if name in NUMBERS}
    analytic = sum((x * way[name]).sum() for name, x in r.vjp(frames, seed).items())

    def loss(t):
        there = r.forward(**{name: frames.inputs[name] + t * change for name, change in way.items()})
        return (there.positions * seed).sum()

    assert (loss(1e-5) - loss(-1e-5)) / 2e-5 == pytest.approx(analytic, rel=1e-6)


@pytest.mark.thorough
def test_gradients_in_single_precision():
    """Those of float64 to a few of float32's roundings, each of which a stretch of a hundredth makes a hundred times as
    large."""
    w = np.cos(np.arange(3 * MESH.num_vertices)).reshape(-1, 3)
    found = []
    for precision in ("f64", "f32"):
        r = thrown(8e-3, 3, precision=precision, gradients=NUMBERS)
        frames = r.forward()
        seed = np.zeros(frames.positions.shape)
        seed[-1] = w
        found.append(r.vjp(frames, seed))
    for name in NUMBERS:
        exact, single = (np.asarray(x[name]) for x in found)
        assert abs(exact).max() > 0
        np.testing.assert_allclose(single, exact, rtol=0, atol=1e-3 * abs(exact).max(), err_msg=name)


def test_first_yield_is_a_kink():
    """The force of a bar by its yield stress: 0 before it yields, d/dY of (E log stretch) E h / (E + h) + ... after."""
    for stretch, slope in ((1 + 0.99 * FIRST / E, 0.0), (1.02, E / (E + 5.0) / 1.02)):
        r = ds.Rollout(
            ds.StaticSolver(pulled(SIMPLE, [stretch]), tolerance=1e-12), 1, gradients="all", outputs=OUTPUTS[0]
        )
        frames = r.forward()
        seed = np.zeros(frames["reaction"].shape)
        seed[-1, 0] = 1
        found = r.vjp(frames, reaction=seed)
        assert found["yield_stress"] == pytest.approx(slope, abs=1e-9)


@pytest.mark.thorough
def test_scenes_of_a_batch_and_torch():
    """Scenes of a batch, side by side too, are those of single runs; a torch tensor takes the same gradient."""
    solver, first = thrown(8e-3, 3).solver, np.array([1.0, 1.3])
    one = ds.Rollout(solver, 3)
    w = np.cos(np.arange(2 * 3 * MESH.num_vertices)).reshape(2, -1, 3)
    alone = [one.vjp(one.forward(yield_stress=y), w)["yield_stress"] for y in first]
    for lanes in (False, True):
        batch = ds.Batch(solver, 3, 2, lanes=lanes)
        found = batch.vjp(batch.forward(yield_stress=first), np.stack([w, w]))["yield_stress"]
        np.testing.assert_allclose(found, alone, rtol=1e-11)
        assert abs(found).min() > 0
    torch = pytest.importorskip("torch")
    from diffsim_ti.torch_bridge.rollout_node import rollout_frames

    y = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    (rollout_frames(one, yield_stress=y).positions * torch.from_numpy(w)).sum().backward()
    assert y.grad.item() == pytest.approx(alone[1], rel=1e-12)


# ---- what is said ------------------------------------------------------------------------------------------------------


def test_linear_tetrahedra_lock_and_the_remedies_do_not(recwarn):
    pulled(metal(), [1.1], volume="tetrahedra")
    (said,) = (str(w.message) for w in recwarn.list)
    assert "linear tetrahedra lock" in said and "mesh.quadratic()" in said and 'volume="patches"' in said
    recwarn.clear()
    pulled(metal(), [1.1])
    pulled(metal(), [1.1], "tetrahedra", MESH.quadratic())
    assert not recwarn.list


@pytest.mark.parametrize(
    "build, words",
    [
        (lambda: ds.J2Plasticity(E, NU), "J2Plasticity: needs exactly one of .*yield_stress"),
        (lambda: ds.J2Plasticity(E, NU, 0.0), r"yield_stress must lie|yield_stress must be > 0"),
        (lambda: ds.J2Plasticity(E, NU, 1.0, -1.0), "hardening must be >= 0, got -1: what softens"),
        (lambda: ds.J2Plasticity(E, NU, 1.0, saturation_stress=2.0), "needs exactly one of .*saturation_exponent"),
        (lambda: metal(saturation_stress=0.5), "saturation_stress - yield_stress must be >= 0, got -0.5: raise"),
        (lambda: ds.PlasticStrain().settled(pulled(ds.StableNeoHookean(1.0, 0.3), [1.1])), "has no plastic flow; take"),
        (lambda: ds.Dissipation().settled(pulled(ds.StableNeoHookean(1.0, 0.3), [1.1])), "has no plastic flow; take"),
    ],
)
def test_what_does_not_fit_is_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()
