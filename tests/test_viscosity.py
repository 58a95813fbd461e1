"""Bodies that damp and relax: closed forms, what is never lost or gained, every gate of gradients, recovery from motion."""

import warnings

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.materials.material import Coefficients
from diffsim_ti.monitor.energy_balance import EnergyGained
from diffsim_ti.outputs.forces_at_frames import BodyForces

EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)
IMPLICIT = (ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver)
every_solver = pytest.mark.parametrize("solver", [*EXPLICIT, *IMPLICIT])
CUBE = ds.TetrahedralMesh.create_cube(2, 1.0)
ONE = ds.TetrahedralMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 1, 2, 3]]))
E, NU = 1e4, 0.3
ELASTIC = ds.StableNeoHookean(E, NU)
DASHPOTS = dict(shear_viscosity=30.0, bulk_viscosity=90.0)


def scene(material, mesh=CUBE, **options) -> ds.Scene:
    return ds.Scene(mesh, material, **dict(density=1000.0, precision="f64") | options)


def made(solver, body, dt, **options):
    return solver(body, dt=dt, **({} if solver.explicit else dict(tolerance=1e-12)) | options)


# ---- closed forms ------------------------------------------------------------------------------------------------------


def slowest_mode(material) -> tuple[np.ndarray, float]:
    """(displacements of a tetrahedron's free corner in its slowest motion, omega [1/s])"""
    body = scene(material, ONE, fixed=[0, 1, 2])
    K, m = body.stiffness_matrix().toarray()[9:, 9:], 1000.0 / 6 / 4
    values, vectors = np.linalg.eigh(K / m)
    return np.concatenate([np.zeros((3, 3)), vectors[:, :1].T]), float(np.sqrt(values[0]))


@pytest.mark.parametrize("solver, most", [(s, 1e-2) for s in EXPLICIT] + [(ds.BDF2Solver, 4e-3), (IMPLICIT[2], 1e-3)])
def test_a_tetrahedron_swings_as_an_oscillator_does(solver, most):
    """exp(-tau omega^2 t / 2) and the frequency omega sqrt(1 - xi^2)."""
    mode, omega = slowest_mode(ELASTIC)
    tau, xi = 0.2 / omega, 0.1
    start = ONE.vertices + 1e-6 * mode
    body = scene(ds.KelvinVoigt(ELASTIC, time=tau), ONE, fixed=[0, 1, 2], initial_positions=start)
    substeps = 20 if solver.explicit else 2
    frames = ds.Rollout(made(solver, body, 0.1 / omega, substeps=substeps), 120, save_every=1).forward()
    got, t = (frames.displacements * mode).sum((1, 2)) / 1e-6, frames.times
    damped = omega * np.sqrt(1 - xi * xi)
    want = np.exp(-tau * omega**2 * t / 2) * (np.cos(damped * t) + xi * omega / damped * np.sin(damped * t))
    np.testing.assert_allclose(got, want, rtol=0, atol=most)


def test_relations_beside_viscosity_go_on_from_a_saved_state_with_the_same_bits():
    """Matrices that a pass begins with have its own rates, not those of a pass before."""
    hold = ds.MultiPointConstraint([5, 7], [[1.0, 0, 0.2], [-1.0, 0.3, 0]], value=lambda t: 2 * t)
    body = scene(ds.KelvinVoigt(ELASTIC, time=0.1), terms=[hold, ds.Gravity()], fixed="zmin")
    one, other = (ds.Simulator(made(ds.BDF2Solver, body, 0.02)) for _ in range(2))
    one.run(3)
    kept = {name: x.copy() for name, x in one.state.items()}
    one.step()
    other.resume(kept)
    other.step()
    np.testing.assert_array_equal(other.velocities, one.velocities)


def test_time_times_moduli_is_the_two_viscosities():
    """And negative lam has a bulk viscosity, too."""
    for nu in (NU, -0.3):
        elastic = ds.StableNeoHookean(E, nu)
        body, tau = scene(ds.KelvinVoigt(elastic, time=0.02)), 0.02
        mu, lam = elastic.lame(elastic.values(CUBE))
        other = scene(ds.KelvinVoigt(elastic, shear_viscosity=tau * mu, bulk_viscosity=tau * (lam + 2 / 3 * mu)))
        u, v = 0.2 * np.random.default_rng(0).standard_normal((2, 8, 3))
        np.testing.assert_allclose(viscous_forces(body, u, v), viscous_forces(other, u, v), rtol=1e-12)


def viscous_forces(body, u, v) -> np.ndarray:
    forces = BodyForces(body)
    forces.load(body.inputs.values)
    out = []
    for velocity in (v, 0 * v):
        forces.place(u, velocity)
        out.append(forces.forces())
    return out[0] - out[1]


def test_viscous_work_is_never_positive():
    """Of any velocity, also where elements are crushed and turned inside out; none of a rigid motion."""
    rng = np.random.default_rng(1)
    body = scene(ds.KelvinVoigt(ELASTIC, **DASHPOTS))
    for size in (1e-3, 0.3, 3.0):
        u, v = rng.standard_normal((2, 8, 3)) * [[[size]], [[1]]]
        f = viscous_forces(body, u, v)
        assert (f * v).sum() < 0
        rigid = np.cross([1.0, -2, 0.5], CUBE.vertices + u) + [1, 2, 3]
        assert np.abs(viscous_forces(body, u, rigid)).max() <= 1e-12 * np.abs(f).max()


@every_solver
def test_a_spin_is_not_damped(solver):
    """A stiff cube turns about itself, with a viscosity of periods of its own: once it breathes no more, what it was set off
    with, it keeps its energy as it does without."""
    mesh = ds.TetrahedralMesh.create_box(2, (1.0, 1.0, 1.0), "five")  # which does not tumble
    X, m = mesh.vertices - 0.5, np.bincount(mesh.tetrahedra.ravel(), np.repeat(mesh.volumes, 4))[:, None]
    start, kept = np.cross([0, 0, 1.0], X), []
    for material in (ds.StableNeoHookean(1e5, NU), ds.KelvinVoigt(ds.StableNeoHookean(1e5, NU), time=0.05)):
        body = scene(material, mesh, initial_velocities=start)
        simulator, energies = ds.Simulator(made(solver, body, 0.02, substeps=200 if solver.explicit else 1)), []
        for _ in range(2):
            simulator.run(150)
            energies.append(float(simulator.compute_energy()))
        kept.append(energies[1] / energies[0])
    assert kept[1] > kept[0] - 1e-5  # an elastic body goes on to ring, and some solvers damp that
    spun = (m * np.cross(simulator.positions - 0.5, simulator.velocities)).sum(0)
    if solver is not ds.ImplicitEulerSolver and solver is not ds.BDF2Solver:  # they damp a spin by themselves
        np.testing.assert_allclose(spun, (m * np.cross(X, start)).sum(0), atol=1e-9)


@pytest.mark.parametrize("solver", IMPLICIT)
def test_a_rigid_turn_in_one_step_has_no_rate(solver):
    """However far it goes: forces of the step are those of the elastic body."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    forces = []
    for material in (ELASTIC, ds.KelvinVoigt(ELASTIC, time=10.0)):
        u = 0.1 * np.random.default_rng(2).standard_normal((8, 3))
        ws = made(solver, scene(material, initial_positions=CUBE.vertices + u), 1e-2)
        ws = ws.workspace(ws.start_values())
        stage = ws.solver.stage(0.0, True, 0)
        ws.begin(0, stage, u, u)
        if ws.strains:
            ws.strains.hold(stage, u, None)
        ws.potential.place((CUBE.vertices + u) @ turn.T - CUBE.vertices)
        forces.append(ws.potential.forces()[0])
    np.testing.assert_allclose(forces[1], forces[0], atol=1e-9 * np.abs(forces[0]).max())


def test_energy_falls_in_every_implicit_step():
    """However long the step is, and no gain is counted."""
    rng = np.random.default_rng(3)
    start = dict(
        initial_positions=CUBE.vertices * [1.3, 0.8, 1] + 0.05 * rng.standard_normal((8, 3)),
        initial_velocities=rng.standard_normal((8, 3)),
    )
    for solver in IMPLICIT:
        simulator = ds.Simulator(made(solver, scene(ds.KelvinVoigt(ELASTIC, time=0.1), **start), 0.05))
        energies = [float(simulator.compute_energy())]
        with warnings.catch_warnings():
            warnings.simplefilter("error", EnergyGained)
            for _ in range(20):
                simulator.step()
                energies.append(float(simulator.compute_energy()))
        assert np.all(np.diff(energies) <= 1e-9 * energies[0])
        watch = simulator.workspace.energy_watch
        assert watch is None or watch.share < 0.1


@every_solver
@pytest.mark.parametrize("steps_in_time", [40, 0.5])
def test_held_strain_relaxes_exponentially(solver, steps_in_time):
    """Two branches: S = S_lasting + sum g_i exp(-t / tau_i) C : E, whatever the step."""
    F = np.eye(3) + np.random.default_rng(4).uniform(-0.2, 0.2, (3, 3))
    shares, times = np.array([0.7, 0.3]), np.array([0.02, 0.1])
    body = scene(
        ds.Prony(ELASTIC, shares, times), fixed=np.arange(8), initial_positions=CUBE.vertices @ F.T, density=1.0
    )
    lasting = ds.Simulator(made(solver, body.replace(material=ELASTIC), 1.0 if not solver.explicit else 1e-5))
    psi = lasting.tetrahedron_fields().energy_density
    mu, lam = ELASTIC.lame(ELASTIC.values(CUBE))
    strain = (F.T @ F - np.eye(3)) / 2
    stored = mu * (strain**2).sum() + lam / 2 * np.trace(strain) ** 2
    dt = times[0] / steps_in_time
    simulator = ds.Simulator(made(solver, body, dt, substeps=2))
    for step in range(4):
        left = shares @ np.exp(-2 * step * dt / times)
        np.testing.assert_allclose(simulator.tetrahedron_fields().energy_density, psi + left * stored, rtol=1e-12)
        simulator.step()


# ---- the stable step ---------------------------------------------------------------------------------------------------


def test_the_limit_of_a_step_knows_viscosity():
    """(2 / omega) (sqrt(1 + xi^2) - xi) where damping is that of stiffness; both limits."""
    tau = 0.03
    bodies = [scene(m) for m in (ELASTIC, ds.KelvinVoigt(ELASTIC, time=tau))]
    for tight in (False, True):
        free, damped = (float(ds.stable_dt(body, tight=tight)) for body in bodies)
        omega = 2 / free
        xi = tau * omega / 2
        assert damped == pytest.approx(2 / omega * (np.sqrt(1 + xi**2) - xi), rel=2e-3)
    assert float(ds.stable_dt(bodies[1], tight=False)) <= damped


@pytest.mark.parametrize("numbers", [dict(time=0.03), dict(shear_viscosity=300.0, bulk_viscosity=10.0)], ids=str)
def test_steps_are_stable_up_to_the_limit(numbers):
    """Also where damping is not that of stiffness: 1 % below it motion dies, 1 % above it grows; beyond is refused."""
    start = 1e-6 * np.random.default_rng(5).standard_normal((8, 3))
    body = scene(ds.KelvinVoigt(ELASTIC, **numbers), initial_velocities=start)
    limit = float(ds.stable_dt(body))
    grown = []
    for share in (0.99, 1.01):
        solver = ds.SemiImplicitSolver(body, dt=share * limit, allow_unstable=True)
        try:
            last = ds.Rollout(solver, 500, save_every=500).forward().velocities[-1]
        except ds.Divergence:
            last = np.inf * start
        grown.append(np.abs(last - start.mean(0)).max())
    assert grown[0] < 1e-5 and grown[1] > 100 * grown[0]
    with pytest.raises(ValueError, match="exceeds the stable step"):
        ds.VelocityVerletSolver(body, dt=1.01 * limit, substeps=1)


# ---- gradients ---------------------------------------------------------------------------------------------------------


def each(seed: int, low: float, high: float, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (CUBE.num_tetrahedra, *shape))


MATERIALS = {
    "time": lambda: ds.KelvinVoigt(ds.StableNeoHookean(E=each(1, 8e3, 2e4), nu=NU), time=each(2, 0.01, 0.03)),
    "dashpots": lambda: ds.KelvinVoigt(ds.SmithNeoHookean(E, NU), **DASHPOTS),
    "prony": lambda: ds.Prony(ds.StableNeoHookean(mu=4e3, lam=5e3), each(3, 0.1, 0.6, 2), [0.01, 0.05]),
    "both": lambda: ds.KelvinVoigt(ds.Prony(ELASTIC, [0.5], [0.02]), time=each(4, 0.01, 0.03)),
}


def swung(material, mesh=CUBE, **options) -> ds.Scene:
    """Held at a face that is drawn along, stretched, falling and slowed down."""
    rng = np.random.default_rng(6)
    start = mesh.vertices * [1.2, 1, 1] + 0.02 * rng.standard_normal(mesh.vertices.shape)
    speed = rng.standard_normal(mesh.vertices.shape)
    usual = dict(initial_positions=start, initial_velocities=speed, terms=[ds.Gravity(), ds.Drag(0.3)])
    return scene(material, mesh, **usual | options)


def gates(r: ds.Rollout, round_off: float, *inputs: str) -> None:
    """Tangent and adjoint are each other's transposed in all inputs; central differences of those named."""
    assert verify.dot_product_test(r) <= round_off
    report = ds.check_gradients(r, inputs=inputs, verbose=False)
    assert report.passed, report


@pytest.mark.parametrize(
    "name, solver",
    [
        pytest.param("time", ds.SemiImplicitSolver, marks=pytest.mark.thorough),
        ("dashpots", ds.VelocityVerletSolver),
        ("both", ds.VelocityVerletSolver),
        ("prony", ds.SemiImplicitSolver),
        ("time", ds.ImplicitEulerSolver),
        ("dashpots", ds.ImplicitMidpointSolver),
        ("both", ds.BDF2Solver),
    ],
)
def test_gradients_by_every_number(name, solver):
    body = swung(MATERIALS[name](), fixed="xmin", motion=lambda t: [0, 0.3 * t, 0])
    results = dict(
        prony=[ds.ElasticEnergy(), ds.Stress()], both=[ds.Reaction("xmin")]
    )  # which know the state of the law
    r = ds.Rollout(made(solver, body, 4e-3), 3, save_every=1, outputs=results.get(name, ()), gradients="all")
    own = [x for x in body.material.inputs if x != "poissons_ratio"]
    gates(r, 1e-12 if solver.explicit else 1e-10, *own, "initial_positions", "rest_positions")


@pytest.mark.parametrize("solver", [pytest.param(ds.SemiImplicitSolver, marks=pytest.mark.thorough), ds.BDF2Solver])
def test_gradients_of_ten_nodes(solver):
    body = swung(ds.KelvinVoigt(ds.LinearElastic(E, NU), **DASHPOTS), ONE.quadratic(), fixed=[0])
    r = ds.Rollout(made(solver, body, 4e-3), 3, gradients="all")
    gates(r, 1e-10, "shear_viscosity", "bulk_viscosity", "rest_positions")


def test_unequal_steps_and_checkpoints():
    """Of BDF2, whose rates of strain take two steps: same gradients whatever is kept, right ones on other steps."""
    body = swung(MATERIALS["both"]())
    whole, parts = (
        ds.Rollout(made(ds.BDF2Solver, body, 4e-3), 6, gradients="all", **own) for own in ({}, dict(checkpoint_every=2))
    )
    w = np.random.default_rng(7).standard_normal((2, 8, 3))
    want, got = (r.vjp(r.forward(), w) for r in (whole, parts))
    for name in want:
        assert got[name].tobytes() == want[name].tobytes(), name
    unequal = ds.Rollout(made(ds.BDF2Solver, body, 4e-3), [2e-3, 4e-3, 3e-3], gradients="all")
    gates(unequal, 1e-10, "viscous_time", "prony_times", "initial_positions")


@pytest.mark.parametrize("elastic", [ds.Yeoh(2e3, -100.0, 50.0, 1e4), ds.Ogden([3e3, -500.0], [1.5, -2.0], 1e4)])
def test_time_takes_the_moduli_of_any_law(elastic):
    """Coefficients and their derivatives; fibres and growth have those of what they are made around."""
    for inner in (elastic, ds.FibreReinforced(elastic, 1e3, 1.0, [1.0, 0, 0]), ds.Grown(elastic, 0.1)):
        material = ds.KelvinVoigt(inner, time=0.02)
        values = material.values(CUBE)
        mu, lam = elastic.lame(elastic.values(CUBE))
        np.testing.assert_allclose(material.coefficients(values)[:2], [0.02 * mu, 0.02 * lam], rtol=1e-14)
        rng = np.random.default_rng(8)
        change = {name: 0.1 * x * rng.standard_normal(np.shape(x)) for name, x in values.items()}
        link, x = Coefficients(material), [*values.values()]
        (dp,), seed = link.jvp(x, [*change.values()]), rng.standard_normal((6, len(material.coefficients(values))))
        h = 1e-6
        ends = [material.coefficients({n: x + s * h * change[n] for n, x in values.items()}) for s in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), dp, rtol=1e-6, atol=1e-7 * np.abs(dp).max())
        back = dict(zip(link.reads, link.vjp(x, (seed,))))
        assert sum((back[n] * change[n]).sum() for n in values) == pytest.approx(float((seed * dp).sum()), rel=1e-12)


def test_statics_leave_viscosity_out():
    ends = []
    for material in (ELASTIC, ds.KelvinVoigt(ELASTIC, time=0.1)):
        body = scene(material, fixed="xmin", terms=[ds.Gravity()])
        r = ds.Rollout(ds.StaticSolver(body, tolerance=1e-12), 1, gradients="all")
        frames = r.forward()
        ends.append((frames.positions[-1], r.vjp(frames, np.ones((2, 8, 3)))))
    np.testing.assert_allclose(ends[1][0], ends[0][0], rtol=0, atol=1e-12)
    assert ends[1][1]["viscous_time"] == 0
    np.testing.assert_allclose(ends[1][1]["youngs_modulus"], ends[0][1]["youngs_modulus"], rtol=1e-9)


def test_steps_are_those_of_a_rollout():
    simulator = ds.Simulator(made(ds.ImplicitEulerSolver, swung(MATERIALS["both"](), fixed="xmin"), 4e-3))
    frames = ds.Rollout(simulator.solver, 3, save_every=1).forward().positions
    for k in range(3):
        simulator.step()
        np.testing.assert_array_equal(simulator.positions, frames[k + 1])


# ---- recovery ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, pytest.param(ds.BDF2Solver, marks=pytest.mark.thorough)])
def test_stiffness_and_viscosity_are_found_from_motion(solver):
    """E, nu and tau to 1 %, from places measured to 1e-4 of the size, by a few steps of Gauss and Newton."""
    true = dict(youngs_modulus=1e4, poissons_ratio=0.33, viscous_time=0.02)
    material = ds.KelvinVoigt(ds.StableNeoHookean(1e4, 0.33), time=0.02)
    body = swung(material, fixed="xmin", terms=[ds.Gravity()])
    r = ds.Rollout(made(solver, body, 1e-2), 60, save_every=2)
    rng = np.random.default_rng(9)
    data = r.forward().positions + 1e-4 * rng.standard_normal((31, 8, 3))
    guesses = dict(
        youngs_modulus=ds.Unknown(1.6e4), poissons_ratio=ds.Unknown(0.2, range=(0, 0.49)), viscous_time=ds.Unknown(0.05)
    )
    found = ds.identify(r, dict(positions=data), guesses, noise=1e-4, check_mesh=False)
    for name, value in true.items():
        assert found.estimates[name] == pytest.approx(value, rel=0.01), found


def test_two_branches_are_found_from_creep():
    """Shares and times to 2 %, from how a cube goes on to sag under its weight."""
    shares, times = np.array([0.5, 0.3]), np.array([0.03, 0.3])
    body = scene(ds.Prony(ELASTIC, shares, times), fixed="ymax", terms=[ds.Gravity(), ds.Drag(5.0)])
    r = ds.Rollout(ds.SemiImplicitSolver(body, dt=1e-2), 200, save_every=4)
    rng = np.random.default_rng(10)
    data = r.forward().positions + 1e-5 * rng.standard_normal((51, 8, 3))
    guesses = dict(prony_shares=ds.Unknown(np.array([0.3, 0.5]), regions=np.array([0, 1])))
    guesses |= dict(prony_times=ds.Unknown(np.array([0.02, 0.5]), regions=np.array([0, 1])))
    found = ds.identify(r, dict(positions=data), guesses, noise=1e-5, check_mesh=False)
    np.testing.assert_allclose(found.estimates["prony_shares"], shares, rtol=0.02)
    np.testing.assert_allclose(found.estimates["prony_times"], times, rtol=0.02)


# ---- what does not work says so ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "build, words",
    [
        (lambda: ds.KelvinVoigt(ELASTIC), r"needs time, or shear_viscosity and bulk_viscosity, got \(nothing\)"),
        (
            lambda: ds.KelvinVoigt(ELASTIC, time=0.1, **DASHPOTS),
            r"got \(viscous_time, shear_viscosity, bulk_viscosity\)",
        ),
        (
            lambda: ds.KelvinVoigt(ELASTIC, time=-0.1),
            r"viscous_time must be >= 0, got -0.1: viscosity takes energy away",
        ),
        (lambda: ds.KelvinVoigt(1e4, time=0.1), r"must be a material such as StableNeoHookean, got 10000.0"),
        (lambda: ds.KelvinVoigt(ds.KelvinVoigt(ELASTIC, time=0.1), time=0.1), r"has a state or a viscosity of its own"),
        (lambda: ds.Prony(ds.Prony(ELASTIC, [1], [1]), [1], [1]), r"has a state or a viscosity of its own"),
        (lambda: ds.Prony(ELASTIC, [1, 2], [1]), r"one number for each branch, got shapes \(2,\) and \(1,\)"),
        (lambda: ds.Prony(ELASTIC, 0.5, 1.0), r"one number for each branch, got shapes \(\) and \(\)"),
        (lambda: ds.Prony(ELASTIC, [0.5], [0.0]), r"prony_times must be > 0, got 0 .*: a time \[s\]"),
        (lambda: scene(ds.KelvinVoigt(ELASTIC, time=0.1), volume="patches").law, r'take volume="tetrahedra"'),
        (
            lambda: ds.StaticSolver(scene(ds.Prony(ELASTIC, [1], [1]))),
            r"Prony\(StableNeoHookean\) has a state .* the material inside with the same numbers",
        ),
    ],
)
def test_what_does_not_fit_is_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_the_energy_of_a_viscous_body_on_a_floor_has_that_of_the_contact(kind):
    mesh = ds.TetrahedralMesh.create_box(2, 0.1).translated((0, 0.005, 0))
    law = ds.KelvinVoigt(ds.StableNeoHookean(3e4, 0.35), time=3e-4)
    scene = ds.Scene(mesh, law, 1000.0, [ds.Gravity(), ds.Ground(stiffness=2e3, width=0.01)], precision="f64")
    simulator = ds.Simulator(kind(scene, dt=1e-4))
    floor = -2e3 * (0.005 - 0.01) ** 2 * np.log(0.5) * 4  # four vertices at half of the width
    assert simulator.compute_energy().parts["contact"] == pytest.approx(floor, rel=1e-12)
