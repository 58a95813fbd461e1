"""Motion against closed forms: oscillators, free fall, momentum, patch test, modes, waves, contact."""

import numpy as np
import pytest
from contact_scenes import FORCE, KEEPING, RESTING

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.materials import MATERIALS
from diffsim_ti.monitor.stability import Stiffness
from diffsim_ti.solvers import SOLVERS as ALL_SOLVERS

SOLVERS = [s for s in ALL_SOLVERS if s.explicit]  # the implicit ones: test_implicit*.py
E, RHO, G = 1e5, 1000.0, 9.81
MU = E / 2  # at nu = 0
solvers = pytest.mark.parametrize("solver", SOLVERS)
materials = pytest.mark.parametrize("material", MATERIALS)
turning = pytest.mark.parametrize("material", [m for m in MATERIALS if m is not ds.LinearElastic])
backends = pytest.mark.backends


@pytest.fixture(params=["f64", "f32"])
def precision(request):
    if request.param == "f64" and runtime.arch_name() == "vulkan":
        pytest.skip("Vulkan has no f64 logarithm: f32 only")
    return request.param


def within(precision, f64, f32):
    """The tolerance of a precision."""
    return f64 if precision == "f64" else f32


def few(steps, less):
    """Fewer steps where each launch is slow: a software Vulkan takes milliseconds."""
    return less if runtime.arch_name() == "vulkan" else steps


def run(scene, solver, dt, steps, **options):
    return ds.Rollout(solver(scene, dt=dt, **options), steps, save_every=1).forward()


def masses(scene):
    return scene.inputs.derive(scene.inputs.values).mass


def one_tetrahedron(height=0.5):
    """Base on z = 0, apex `height` above."""
    return ds.TetrahedralMesh([[0, 0, 0], [0.6, 0, 0], [0.1, 0.5, 0], [0.2, 0.2, height]], [[0, 1, 2, 3]])


def oscillator(nu=0.3, amplitude=0.4, height=0.5, material=ds.StableNeoHookean, **options):
    """The base is held, the apex starts moved sideways."""
    mesh = one_tetrahedron(height)
    start = mesh.vertices.copy()
    start[3, 0] += amplitude
    return ds.Scene(mesh, material(E, nu), RHO, fixed=[0, 1, 2], initial_positions=start, **options)


def closed_form(solver, amplitude, omega, dt, n):
    """Apex displacement after n steps from rest: exact for the discrete scheme."""
    theta = 2 * np.arcsin(omega * dt / 2)
    if solver.order == 1:
        return amplitude * np.cos((n + 0.5) * theta) / np.cos(theta / 2)
    return amplitude * np.cos(n * theta)


def apex(frames):
    return frames.positions[:, 3].astype(np.float64) - one_tetrahedron().vertices[3]


def rotations(count, seed=0):
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((count, 3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


# ---- the one-tetrahedron shear oscillator -------------------------------------------------------------------------------


@pytest.mark.parametrize("nu, u", [(0.0, -0.399914771245), (0.3, 0.380625161974), (0.45, -0.024327235124)])
def test_oscillator_table(nu, u):
    frames = run(oscillator(nu), ds.SemiImplicitSolver, 1e-3, 1000)
    assert apex(frames)[-1] == pytest.approx([u, 0, 0], abs=1e-11)  # the table has twelve digits


@backends
@solvers
@pytest.mark.parametrize("material", [ds.StableNeoHookean, ds.LinearElastic])  # the laws whose shear force is linear
def test_oscillator_follows_its_closed_form(solver, material, precision):
    steps = 1000 if precision == "f64" else few(100, 20)
    frames = run(oscillator(0.3, material=material, precision=precision), solver, 1e-3, steps)
    omega = 2 * np.sqrt(E / 2.6 / RHO) / 0.5
    expected = closed_form(solver, 0.4, omega, 1e-3, np.arange(steps + 1))
    # f32: the frames' positions carry half an ulp of 0.6, and a phase of 2.5 as many roundings as steps
    assert apex(frames)[:, 0] == pytest.approx(expected, abs=within(precision, 1e-11, 2e-6))
    assert np.abs(apex(frames)[:, 1:]).max() <= within(precision, 1e-14, 1e-6)  # the shear force has no other component


@solvers
def test_large_amplitude_over_ten_thousand_steps(solver):
    """u0 / h = 0.8 is no small strain: the force is linear in u at any amplitude."""
    frames = run(oscillator(0.3, amplitude=0.4), solver, 1e-3, 10_000)
    expected = closed_form(solver, 0.4, 2 * np.sqrt(E / 2.6 / RHO) / 0.5, 1e-3, 10_000)
    assert apex(frames)[-1, 0] == pytest.approx(expected, abs=1e-11)


@solvers
def test_frequency_and_energy_of_a_coarse_step(solver):
    """omega dt = 0.9: the frequency rises by (2 / omega dt) asin(omega dt / 2), the energy stays in its band."""
    omega = 2 * np.sqrt(MU / RHO) / 0.5
    dt, amplitude = 0.9 / omega, 0.1
    scene = oscillator(0.0, amplitude)
    frames = run(scene, solver, dt, 400)
    u, v = apex(frames)[:, 0], frames.velocities[:, 3, 0]
    ratio = np.arccos(((u[2:] + u[:-2]) * u[1:-1]).sum() / (2 * (u[1:-1] ** 2).sum())) / (omega * dt)
    assert ratio == pytest.approx(2 / 0.9 * np.arcsin(0.45), rel=1e-10)
    energy = (v**2 + omega**2 * u**2) / (omega * amplitude) ** 2
    low, high = (
        (1 / 1.45, 1 / 0.55) if solver.order == 1 else (1 - 0.45**2, 1.0)
    )  # SE: 1 / (1 +- w dt / 2), Verlet: 1 - (w dt / 2)^2
    assert low - 1e-10 <= energy.min() and energy.max() <= high + 1e-10
    assert energy.max() - energy.min() > 0.9 * (high - low)  # the band is reached, so that the bound means something


# ---- free bodies --------------------------------------------------------------------------------------------------------


def gravity_steps(solver, n):
    """x_n / (g dt^2) of free fall."""
    return n * (n + 1) / 2 if solver.order == 1 else n * n / 2


@backends
@solvers
def test_free_fall_is_exact(solver, precision):
    mesh = ds.TetrahedralMesh.create_box(2, pattern="five")
    steps = 1000 if precision == "f64" else few(100, 20)
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), RHO, terms=[ds.Gravity()], precision=precision)
    solution = ds.Rollout(solver(scene, dt=1e-3), steps).forward()
    fall = solution.positions[-1].astype(np.float64) - mesh.vertices
    expected = -G * 1e-6 * gravity_steps(solver, steps)
    if solver.order == 1 and steps == 1000:
        assert expected == pytest.approx(-4.909905, abs=1e-12)
    assert fall[:, 1] == pytest.approx(
        np.full(8, expected), abs=within(precision, 4e-14, 1e-6)
    )  # 1000 roundings of half an ulp of 5
    assert np.abs(fall - fall[0]).max() <= within(precision, 1e-13, 1e-6)  # rigid
    assert solution.velocities[-1, :, 1] == pytest.approx(
        np.full(8, -G * steps * 1e-3), rel=within(precision, 1e-12, 1e-5)
    )


@solvers
def test_default_is_undamped_and_unloaded(solver):
    """No gravity, no damping unless listed: a free body's velocity stays."""
    mesh = ds.TetrahedralMesh.create_box(2)
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), RHO, initial_velocities=[1.0, -2.0, 0.5])
    frames = run(scene, solver, 1e-3, 1000)
    assert np.abs(frames.velocities[-1] - [1.0, -2.0, 0.5]).max() <= 1e-11  # a thousand kicks of round-off


@solvers
@turning
def test_momentum_of_a_tumbling_block_over_1e5_steps(solver, material):
    mesh = ds.TetrahedralMesh.create_box(2)
    X = mesh.vertices - mesh.vertices.mean(0)
    spin = np.cross([1.0, 2.0, 3.0], X) + [0.3, -0.1, 0.2] + 0.1 * X
    scene = ds.Scene(mesh, material(E, 0.3), RHO, initial_velocities=spin)
    dt, m = 2e-3, masses(scene)[:, None]
    frames = ds.Rollout(solver(scene, dt=dt), 100_000, save_every=10_000).forward()
    linear = (m * frames.velocities).sum(1)
    angular = (m * np.cross(frames.positions, frames.velocities)).sum(1)
    tumbled = np.abs(frames.positions[:, 0] - frames.positions[0, 0]).max()
    # relative to the size of what is summed; 1e5 kicks of one rounding each, of random sign, make 3e-14
    size = (m * np.linalg.norm(frames.velocities[0], axis=1)[:, None]).sum()
    assert np.abs(linear - linear[0]).max() <= 1e-12 * size
    # positions drift away to 0.3 * 200 = 75 m, and so do the terms of the sum
    assert np.abs(angular - angular[0]).max() <= 1e-12 * size * np.abs(frames.positions).max()
    assert tumbled > 1  # it moved


@solvers
def test_energy_of_a_tumbling_block_stays_in_its_band(solver):
    mesh = ds.TetrahedralMesh.create_box(2)
    X = mesh.vertices - mesh.vertices.mean(0)
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), RHO, initial_velocities=np.cross([1.0, 2.0, 3.0], X) + 0.3 * X)
    simulator = ds.Simulator(solver(scene, dt=2e-3))
    start, energies = simulator.compute_energy(), []
    for _ in range(200):
        simulator.run(10)
        energies.append(simulator.compute_energy())
    # dt is 0.04 of the limit: the band is O(omega dt) for symplectic Euler, O((omega dt)^2) for Verlet, and does not drift
    width = 0.05 if solver.order == 1 else 2e-3
    assert np.abs(np.array(energies) / start - 1).max() <= width
    assert max(e.parts["elastic"] for e in energies) > 0.01 * start  # energy went back and forth
    assert abs(np.mean(energies[150:]) / np.mean(energies[:50]) - 1) <= width / 5


# ---- rest states and homogeneous states ---------------------------------------------------------------------------------


def forces_at(scene, positions):
    """Forces on the vertices, from the velocities after one step."""
    solver = ds.SemiImplicitSolver(scene, dt=1e-3, allow_unstable=True)
    simulator = ds.Simulator(solver)
    simulator.set_state(positions, np.zeros_like(positions))
    simulator.step()
    return masses(scene)[:, None] * simulator.velocities.astype(np.float64) / 1e-3


@backends
@turning
def test_rotated_rest_shape_is_free_of_force(material, precision):
    mesh = ds.TetrahedralMesh.create_box(2)
    scene = ds.Scene(mesh, material(E, 0.3), RHO, precision=precision)
    for R in rotations(20 if precision == "f64" else 1):
        force = forces_at(scene, mesh.vertices @ R.T)
        assert np.abs(force).max() <= within(precision, 1e-12, 2e-6) * E  # faces of area 1; f32: 17 ulp of the strain
    if precision == "f64":  # and the gate can fail
        assert np.abs(forces_at(scene, 1.001 * mesh.vertices)).max() > 1e-5 * E


def test_linear_elasticity_is_not_frame_indifferent():
    mesh = ds.TetrahedralMesh.create_box(2)
    scene = ds.Scene(mesh, ds.LinearElastic(E, 0.3), RHO)
    assert np.abs(forces_at(scene, mesh.vertices @ rotations(1)[0].T)).max() > 1e-3 * E


def fields_of(F, material, precision="f64"):
    mesh = ds.TetrahedralMesh.create_box(2, pattern="five")
    scene = ds.Scene(mesh, material, RHO, precision=precision, initial_positions=mesh.vertices @ np.asarray(F, float).T)
    return ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3)).tetrahedron_fields()


@backends
@pytest.mark.parametrize(
    "nu, s, t, P11, psi",
    [
        (0.0, 1.5, 1, 41666.666667, 10976.744595),
        (0.3, 0.8, 1.063056609, -23561.988190, 2224.535063),
        (0.3, 1.5, 0.871868464, 38201.163631, 10333.526022),
        (0.3, 2, 0.779503187, 65237.976567, 36439.407882),
        (0.45, 1.5, 0.830036766, 35885.953285, 9865.483031),
        (0.45, 2, 0.724651756, 59911.721253, 34050.329301),
    ],
)
def test_uniaxial_stretch(nu, s, t, P11, psi, precision):
    """R1. The stress is uniaxial, so that von Mises is |P11| / t^2."""
    fields = fields_of(np.diag([s, t, t]), ds.StableNeoHookean(E, nu), precision)
    rel = within(precision, 1e-8, 2e-5)  # the table's t has ten digits
    assert fields.energy_density == pytest.approx(np.full(5, psi), rel=rel)
    assert fields.von_mises == pytest.approx(np.full(5, abs(P11) / t**2), rel=rel)
    assert fields.J == pytest.approx(np.full(5, s * t * t), rel=rel)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("gamma", [1e-6, 0.1, 2.0])
def test_simple_shear(nu, gamma):
    """R2: psi = mu gamma^2 / 2 at any gamma and nu."""
    F = np.eye(3)
    F[0, 1] = gamma
    mu = E / (2 * (1 + nu))
    # F - I is known to one ulp of 1 (positions are stored), so that gamma = 1e-6 carries ten digits
    assert fields_of(F, ds.StableNeoHookean(E, nu)).energy_density == pytest.approx(
        np.full(5, mu * gamma**2 / 2), rel=1e-9
    )


@pytest.mark.parametrize("s", [0.5, 0.9, 1.3, 2.0])
def test_uniform_scaling(s):
    """R3: F = s I; the integral of P = mu (s - 1/s) + lam (s^3 - 1) s^2, thrice."""
    mu, lam = E / 2.6, E * 0.3 / (1.3 * 0.4)
    fields = fields_of(s * np.eye(3), ds.StableNeoHookean(E, 0.3))
    psi = 3 * mu / 2 * (s * s - 1) - 3 * mu * np.log(s) + lam / 2 * (s**3 - 1) ** 2
    assert fields.energy_density == pytest.approx(np.full(5, psi), rel=1e-12)
    assert np.abs(fields.von_mises).max() <= 1e-11 * E  # a pressure has no von Mises stress


@materials
@pytest.mark.parametrize("s", [0.9, 1.1])
def test_uniaxial_bar_has_young_s_modulus(material, s):
    """Small strains: every law has the E and nu it was given. Strain 1e-4 leaves 1e-4 of nonlinearity."""
    e = 1e-4 * np.sign(s - 1)
    fields = fields_of(np.diag([1 + e, 1 - 0.3 * e, 1 - 0.3 * e]), material(E, 0.3))
    assert fields.energy_density == pytest.approx(np.full(5, E * e * e / 2), rel=5e-4)
    assert fields.von_mises == pytest.approx(np.full(5, E * abs(e)), rel=5e-4)


def distorted_mesh(slivers=True):
    """A cube of 3 cells a side with its inner vertices shaken, and inner vertices a hair's breadth above a face."""
    rng = np.random.default_rng(3)
    box = ds.TetrahedralMesh.create_box(4, pattern="five")
    X, tets = box.vertices.copy(), box.tetrahedra.copy()
    inner = np.setdiff1d(np.arange(len(X)), box.surface_vertices)
    X[inner] += rng.uniform(-0.06, 0.06, (len(inner), 3))
    for eta in (1e-1, 1e-2, 1e-3, 1e-4) if slivers else ():
        e = int(rng.integers(len(tets)))
        corners = tets[e]
        new = np.array([eta, *(np.array([0.4, 0.33, 0.27]) * (1 - eta))]) @ X[corners]
        X = np.vstack([X, new])
        split = np.repeat(corners[None], 4, 0)
        split[np.arange(4), np.arange(4)] = len(X) - 1
        tets = np.vstack([np.delete(tets, e, 0), split])
    return X, tets


@backends
@materials
def test_affine_patch(material, precision):
    """Whatever the affine state, no force acts on vertices inside; tetrahedra are distorted, some are slivers."""
    with pytest.warns(UserWarning, match="sliver"):
        mesh = ds.TetrahedralMesh(*distorted_mesh())
    assert mesh.quality.min() < 1e-2
    scene = ds.Scene(mesh, material(1e6, 0.25), RHO, precision=precision)
    inner = np.setdiff1d(np.arange(mesh.num_vertices), mesh.surface_vertices)
    rng = np.random.default_rng(1)
    for size in (0.3, 1e-3):
        F = np.eye(3) + size * rng.uniform(-1, 1, (3, 3))
        force = forces_at(scene, mesh.vertices @ F.T)
        # forces on the surface set the scale. The slivers' displacement gradient loses 1 / altitude of its digits,
        # so the strain's own size comes in: eps / (altitude size)
        lost = np.finfo(within(precision, np.float64, np.float32)).eps / mesh.altitudes.min() / size
        assert np.abs(force[inner]).max() <= 2 * lost * np.abs(force).max()
        if precision == "f64":
            assert np.abs(force[inner]).max() <= 1e-8 * np.abs(force).max()


def test_mac_neal_harder_patch():
    """u = (2x + y + z, x + 2y + z, x + y + 2z) 1e-3 / 2: normal stress 2000, shear 400."""
    mesh = ds.TetrahedralMesh(*distorted_mesh(slivers=False), vertex_sets={"xmax": range(48, 64)})
    H = (np.ones((3, 3)) + np.eye(3)) * 1e-3 / 2
    scene = ds.Scene(mesh, ds.LinearElastic(1e6, 0.25), RHO, initial_positions=mesh.vertices @ (np.eye(3) + H).T)
    fields = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-4)).tetrahedron_fields()
    sigma = np.full((3, 3), 400.0) + 1600 * np.eye(3)
    assert fields.energy_density == pytest.approx(0.5 * (sigma * H).sum(), rel=1e-11)
    cauchy = sigma @ (np.eye(3) + H).T / np.linalg.det(np.eye(3) + H)
    deviator = cauchy - np.eye(3) * np.trace(cauchy) / 3
    assert fields.von_mises == pytest.approx(np.sqrt(1.5 * (deviator**2).sum()), rel=1e-10)
    force = forces_at(scene, mesh.vertices @ (np.eye(3) + H).T)
    x = mesh.vertices
    virtual = force[:, :, None] * x[:, None, :]  # virtual work of a linear displacement: - stress x volume
    assert virtual.sum(0) == pytest.approx(-sigma, rel=1e-9)


# ---- order in time ------------------------------------------------------------------------------------------------------


def orders(errors):
    return np.log2(np.array(errors[:-1]) / errors[1:])


@solvers
def test_order_on_the_oscillator(solver):
    omega, T = 2 * np.sqrt(E / 2.6 / RHO) / 0.5, 0.5
    errors = []
    for steps in (250, 500, 1000, 2000):
        frames = ds.Rollout(solver(oscillator(0.3), dt=T / steps), steps).forward()
        errors.append(abs(apex(frames)[-1, 0] - 0.4 * np.cos(omega * T)))
    assert orders(errors) == pytest.approx(np.full(3, float(solver.order)), abs=0.1)


@solvers
@materials
def test_order_on_a_nonlinear_cube(solver, material):
    mesh = ds.TetrahedralMesh.create_box(2)
    X = mesh.vertices
    start = X * [1.2, 1.0, 0.9] + 0.1 * X[:, [1, 2, 0]]
    scene = ds.Scene(mesh, material(E, 0.3), RHO, fixed="xmin", initial_positions=start, terms=[ds.Gravity()])
    T = 0.1

    def final(which, steps):
        return ds.Rollout(which(scene, dt=T / steps), steps).forward().positions[-1]

    reference = final(ds.VelocityVerletSolver, 12800)
    errors = [np.abs(final(solver, steps) - reference).max() for steps in (200, 400, 800)]
    assert orders(errors) == pytest.approx(np.full(2, float(solver.order)), abs=0.1)


@pytest.mark.parametrize("terms", [(), (ds.Drag(3.0),)], ids=["free", "drag"])
def test_simulator_and_rollout_agree(terms):
    """Steps one by one make the same motion as a run. Velocity Verlet splits the shared kick: two roundings for one."""
    for solver in SOLVERS:
        scene = oscillator(0.3, terms=terms)
        frames = run(scene, solver, 2e-3, 100, substeps=2)
        simulator = ds.Simulator(solver(scene, dt=2e-3, substeps=2))
        simulator.run(100)
        assert simulator.time == pytest.approx(frames.times[-1])
        tolerance = 0 if solver.order == 1 else 1e-12
        assert np.abs(simulator.positions - frames.positions[-1]).max() <= tolerance
        assert np.abs(simulator.velocities - frames.velocities[-1]).max() <= 100 * tolerance
        simulator.reset()
        assert np.array_equal(simulator.positions, frames.positions[0]) and simulator.time == 0


# ---- modes and waves ----------------------------------------------------------------------------------------------------


def measured_frequency(scene, mode, solver, cycles_of):
    """Frequency [Hz] of the mode's amplitude in a run, from its zero crossings, freed of the scheme's own shift."""
    dt = 0.5 * solver(scene, dt=1e-5).stable_dt(tight=True).dt
    frames = run(scene, solver, dt, int(5 / cycles_of / dt))
    q = np.einsum("tij,ij,i->t", frames.positions - scene.mesh.vertices, mode, masses(scene))
    before = np.nonzero(q[1:] * q[:-1] < 0)[0]
    crossing = (before + q[before] / (q[before] - q[before + 1])) * dt
    per_step = np.pi * (len(crossing) - 1) / (crossing[-1] - crossing[0]) * dt
    return 2 * np.sin(per_step / 2) / dt / (2 * np.pi)


def lame_mode(n, pattern, nu, material=ds.StableNeoHookean):
    mesh = ds.TetrahedralMesh.create_box(n + 1, 1.0, pattern)
    x, y = np.pi * mesh.vertices[:, 0], np.pi * mesh.vertices[:, 1]
    mode = np.stack([np.cos(x) * np.sin(y), -np.sin(x) * np.cos(y), 0 * x], 1)
    return ds.Scene(mesh, material(E, nu), RHO, initial_positions=mesh.vertices + 1e-5 * mode), mode


@solvers
@pytest.mark.parametrize("nu, exact", [(0.0, 5.0), (0.3, 4.385290)])
def test_lame_mode_converges(solver, nu, exact):
    """R13. Five: lumped masses make it slow, -4 % at 4 cells, falling as h^2. Kuhn: +-2 % at 4 cells, stiffer by locking."""
    five = [measured_frequency(*lame_mode(n, "five", nu), solver, exact) / exact - 1 for n in (4, 8)]
    assert -0.045 < five[0] < -0.03 and -0.012 < five[1] < -0.006
    assert np.log2(five[0] / five[1]) == pytest.approx(2.0, abs=0.2)
    # Kuhn cells break the cube's symmetry and mix its three equal modes, so that five cycles show a blend
    kuhn = [measured_frequency(*lame_mode(n, "kuhn", nu), solver, exact) / exact - 1 for n in (4, 8)]
    assert abs(kuhn[0]) < 0.05 and abs(kuhn[1]) < 0.01


@pytest.mark.parametrize("pattern", ["kuhn", "five"])
@pytest.mark.parametrize("nu, exact", [(0.0, 5.0), (0.3, 4.385290)])
def test_lame_mode_s_rayleigh_quotient_converges(pattern, nu, exact):
    """The mode's own frequency, sqrt(u K u / u M u), on both patterns: its error falls as h^2."""
    errors = []
    for n in (4, 8, 16):
        scene, mode = lame_mode(n, pattern, nu)
        solver = ds.SemiImplicitSolver(scene.replace(initial_positions=None), dt=1e-5, parallel=False)
        stiffness = Stiffness(solver.workspace(solver.start_values()))
        x = mode / stiffness.root
        omega2 = (x * stiffness.product(x)).sum() / (x * x).sum()
        errors.append(abs(np.sqrt(omega2) / (2 * np.pi) / exact - 1))
    assert orders(errors)[-1] == pytest.approx(2.0, abs=0.1) and orders(errors)[0] > 1.6


@materials
def test_small_motion_is_the_same_for_all_laws(material):
    """Amplitude 1e-5: laws differ from linear elasticity by their nonlinearity only, 1e-5 pi relative."""
    exact = 4.385290
    linear = measured_frequency(*lame_mode(4, "five", 0.3, ds.LinearElastic), ds.VelocityVerletSolver, exact)
    assert measured_frequency(*lame_mode(4, "five", 0.3, material), ds.VelocityVerletSolver, exact) == pytest.approx(
        linear, rel=1e-4
    )


@pytest.mark.parametrize("pattern", ["kuhn", "five"])
def test_wave_in_a_fixed_free_bar(pattern):
    """R14: nu = 0, L = 1: c = 10 m/s, f1 = c / 4 L = 2.5 Hz."""
    errors = []
    for n in (10, 40):
        mesh = ds.TetrahedralMesh.create_box((n + 1, 2, 2), (1, 1 / n, 1 / n), pattern)
        mode = np.zeros_like(mesh.vertices)
        mode[:, 0] = np.sin(np.pi * mesh.vertices[:, 0] / 2)
        scene = ds.Scene(mesh, ds.LinearElastic(E, 0), RHO, fixed="xmin", initial_positions=mesh.vertices + 1e-5 * mode)
        errors.append(abs(measured_frequency(scene, mode, ds.VelocityVerletSolver, 2.5) / 2.5 - 1))
    assert errors[1] < 2e-4 and errors[1] < errors[0] / 10  # h falls by 4, the error by 16


# ---- damping, loads, prescribed motion ----------------------------------------------------------------------------------


@backends
@solvers
@pytest.mark.parametrize("dt", [1e-3, 0.05, 1.0])
def test_drag_is_a_rate(solver, dt, precision):
    """v = v0 exp(-c t) for any dt and any number of substeps; the body is soft, so that large steps are stable."""
    mesh = one_tetrahedron()
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e-3, 0.3),
        RHO,
        terms=[ds.Drag(0.7)],
        initial_velocities=[1, 2, 3],
        precision=precision,
    )
    for substeps in (1, 3):
        frames = run(scene, solver, dt, few(10, 3), substeps=substeps)
        expected = np.exp(-0.7 * frames.times)[:, None, None] * np.array([1.0, 2, 3])
        tolerance = within(precision, 1e-12, 1e-5)
        assert frames.velocities == pytest.approx(np.broadcast_to(expected, frames.velocities.shape), rel=tolerance)


@solvers
def test_drag_damps_an_oscillation_at_half_its_rate(solver):
    """u ~ exp(-c t / 2) cos(...): the documented law dv/dt = f/m - c v, to the order of the step."""
    c, omega, dt = 0.5, 2 * np.sqrt(E / 2.6 / RHO) / 0.5, 1e-4
    frames = run(oscillator(0.3, terms=[ds.Drag(c)]), solver, dt, 20_000)
    u = apex(frames)[:, 0]
    peaks = 1 + np.nonzero((u[1:-1] > u[:-2]) & (u[1:-1] >= u[2:]))[0]
    rate = -np.polyfit(frames.times[peaks], np.log(u[peaks]), 1)[0]
    assert rate == pytest.approx(c / 2, rel=1e-3)  # peaks are found to a step: (omega dt)^2 / 8 of their height
    period = np.diff(frames.times[peaks]).mean()
    assert period == pytest.approx(2 * np.pi / np.sqrt(omega**2 - c * c / 4), rel=1e-3)


@backends
@solvers
@pytest.mark.parametrize("how", ["function", "keyframes"])
def test_prescribed_motion_is_followed(solver, how, precision):
    mesh, dt, steps = ds.TetrahedralMesh.create_box(2), 5e-3, few(20, 6)

    def function(t):
        return [0.1 * np.sin(7 * t), 0.2 * t, -0.05 * t * t]

    times = np.array([0.0, 0.021, 0.05, 0.2])
    keyframes = (times, np.array([[0, 0, 0], [0.02, -0.01, 0], [0.03, 0, 0.01], [0, 0.1, 0]]))
    motion = function if how == "function" else keyframes
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(E, 0.3),
        RHO,
        fixed="ymin",
        motion=motion,
        initial_positions=mesh.vertices + [0, 0.3, 0],
        precision=precision,
    )
    frames = run(scene, solver, dt, steps, substeps=2)
    if how == "function":
        path = np.array([function(t) for t in frames.times])
    else:
        path = np.stack([np.interp(frames.times, times, column) for column in keyframes[1].T], 1)
    expected = mesh.vertices[scene.fixed] + [0, 0.3, 0] + path[:, None]
    assert np.abs(frames.positions[:, scene.fixed] - expected).max() <= within(precision, 1e-15, 1e-6) * 2
    moved = frames.velocities[1:, scene.fixed]
    assert moved == pytest.approx(
        np.broadcast_to(np.diff(path, axis=0)[:, None] / dt, moved.shape), abs=within(precision, 1e-12, 1e-4)
    )
    free = np.setdiff1d(np.arange(8), scene.fixed)
    assert np.abs(frames.positions[-1, free] - frames.positions[0, free]).max() > 1e-5  # the rest is dragged along
    simulator = ds.Simulator(solver(scene, dt=dt, substeps=2))
    simulator.run(steps)
    assert np.abs(simulator.positions - frames.positions[-1]).max() <= within(precision, 1e-12, 1e-5)


@solvers
def test_prescribed_motion_is_linear_within_a_step(solver):
    """Four substeps of dt do what four steps of dt / 4 along the same straight line do."""
    scene = oscillator(0.3, motion=lambda t: [0.1 * np.sin(9 * t), 0, 0])
    coarse = run(scene, solver, 8e-3, 50, substeps=4)
    knots = np.arange(51) * 8e-3
    line = (knots, np.array([[0.1 * np.sin(9 * t), 0, 0] for t in knots]))
    fine = run(scene.replace(motion=line), solver, 2e-3, 200)
    assert np.abs(coarse.positions - fine.positions[::4]).max() <= 1e-13


def test_fixed_vertices_stay():
    scene = oscillator(0.3, terms=[ds.Gravity()], initial_velocities=[1.0, 1.0, 1.0])
    for solver in SOLVERS:
        frames = run(scene, solver, 1e-3, 50)
        assert np.array_equal(frames.positions[:, :3], np.broadcast_to(scene.mesh.vertices[:3], (51, 3, 3)))
        assert not frames.velocities[:, :3].any()


@backends
@solvers
def test_external_force_constant(solver, precision):
    """Forces in proportion to the masses move the body as gravity does."""
    mesh = ds.TetrahedralMesh.create_box(2)
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), RHO, precision=precision)
    force = masses(scene)[:, None] * [1.0, -2.0, 3.0]
    frames = run(scene.replace(terms=[ds.ExternalForce(force)]), solver, 1e-3, few(50, 10))
    expected = mesh.vertices + 1e-6 * gravity_steps(solver, few(50, 10)) * np.array([1.0, -2.0, 3.0])
    assert np.abs(frames.positions[-1] - expected).max() <= within(precision, 1e-13, 1e-6)


@backends
@solvers
def test_external_force_per_step(solver, precision):
    """The body's momentum is the sum of the impulses dt f, whatever the substeps."""
    mesh, rng = ds.TetrahedralMesh.create_box(2), np.random.default_rng(0)
    forces = rng.standard_normal((10, 2, 3))
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(E, 0.3), RHO, terms=[ds.ExternalForce(forces, [1, 6])], precision=precision
    )
    for substeps in (1, 3):
        frames = run(scene, solver, 2e-3, 10, substeps=substeps)
        momentum = (masses(scene)[:, None] * frames.velocities).sum(1)
        assert momentum[-1] == pytest.approx(2e-3 * forces.sum((0, 1)), abs=within(precision, 1e-14, 1e-5))
        if solver.order == 1:  # frames in between show half of a shared kick with velocity Verlet
            assert momentum[7] == pytest.approx(2e-3 * forces[:7].sum((0, 1)), abs=within(precision, 1e-14, 1e-5))
    simulator = ds.Simulator(solver(scene, dt=2e-3, substeps=3))
    simulator.run(10)
    assert np.abs(simulator.positions - frames.positions[-1]).max() <= within(precision, 1e-13, 1e-6)
    with pytest.raises(ValueError, match="given for 10 steps, this is step 10"):
        simulator.step()


# ---- the ground ---------------------------------------------------------------------------------------------------------


def standing_tetrahedron(height):
    """Three vertices at y = height, the fourth above their middle."""
    base = np.array([[0, height, 0], [0.25, height, 0.45], [0.5, height, 0]])
    return ds.TetrahedralMesh(np.vstack([base, base.mean(0) + [0, 0.5, 0]]), [[0, 1, 2, 3]], fix_orientation=True)


@backends
@solvers
def test_ground_beyond_its_width_does_not_act(solver, precision):
    """Exactly nothing at and beyond the width, a push within."""
    for gap, acts in ((0.01 * (1 + 1e-6), False), (0.05, False), (0.0099, True)):
        mesh = standing_tetrahedron(0.0)
        scene = ds.Scene(
            mesh,
            ds.StableNeoHookean(E, 0.3),
            RHO,
            terms=[ds.Ground(stiffness=1e4, height=-gap, width=0.01)],
            precision=precision,
        )
        simulator = ds.Simulator(solver(scene, dt=1e-3))
        simulator.run(3)
        assert simulator.velocities.any() == acts
        assert simulator.compute_energy().parts["contact"] > 0 if acts else simulator.compute_energy() == 0


@pytest.mark.parametrize("solver", FORCE + RESTING)
@pytest.mark.parametrize(
    "mass, gap", [(1e-3, 9.9429e-3), (1e-2, 9.8203e-3), (1e-1, 9.4391e-3), (1.0, 8.3006e-3), (10.0, 5.3589e-3)]
)
def test_weight_at_rest_on_the_ground(solver, mass, gap):
    """R22: each of three vertices carries m g; the body settles with drag."""
    mesh = standing_tetrahedron(0.009)
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(E, 0.3),
        3 * mass / mesh.volume,
        terms=[ds.Gravity(-G), ds.Drag(20.0), ds.Ground(stiffness=1e4, width=0.01)],
    )
    dt = 0.3 * solver(scene, dt=1e-9).stable_dt().dt
    end = ds.Rollout(solver(scene, dt=dt, allow_unstable=True), int(4 / dt)).forward()
    assert end.positions[-1, :3, 1] == pytest.approx(np.full(3, gap), abs=1e-7)  # the table's last digit is 1e-7
    assert np.abs(end.velocities[-1]).max() < 1e-10


@pytest.mark.parametrize("solver", FORCE + KEEPING)
@pytest.mark.parametrize("v, d_min, omega", [(1.0, 3.292e-3, 381.0), (2.0, 8.956e-4, 1220.0)])
def test_barrier_bounce(solver, v, d_min, omega):
    """R23: vertices of 1 kg, nearly free of each other, fly into the barrier and come back as fast."""
    mesh = standing_tetrahedron(0.02)
    scene = ds.Scene(
        mesh,
        ds.LinearElastic(1e-6, 0.0),
        4 / mesh.volume,
        terms=[ds.Ground(stiffness=1e4, width=0.01)],
        initial_velocities=[0, -v, 0],
    )
    dt = 0.05 / omega
    frames = run(scene, solver, dt, int(0.04 / v / dt))
    y = frames.positions[:, :3, 1]
    assert y.min() == pytest.approx(d_min, rel=2e-3)  # the path is sampled every dt
    assert frames.velocities[-1, :3, 1] == pytest.approx(np.full(3, v), rel=2e-2 if solver.order == 1 else 1e-4)


@pytest.mark.parametrize("solver", FORCE + KEEPING)
def test_block_bounces_without_losing_energy(solver):
    mesh = ds.TetrahedralMesh.create_box(2).translated([0, 0.1, 0])
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(E, 0.3), 100.0, terms=[ds.Gravity(), ds.Ground(stiffness=1e4, width=0.05)]
    )
    simulator = ds.Simulator(solver(scene, dt=1e-4))
    start, energies, heights = simulator.compute_energy(), [], []
    for _ in range(100):
        simulator.run(50)
        energies.append(simulator.compute_energy())
        heights.append(simulator.positions[:, 1].min())
    exchanged = max(e.parts["kinetic"] for e in energies)
    assert max(e.parts["contact"] for e in energies) > 0.1 * exchanged and min(heights) > 0  # it hit and stayed above
    tolerance = 0.03 if solver.order == 1 else 1e-4
    assert np.abs(np.array(energies) - start).max() <= tolerance * exchanged


def test_energy_adds_up():
    scene = oscillator(
        0.3, terms=[ds.Gravity(), ds.Ground(stiffness=1e4, width=0.01, height=-1.0)], initial_velocities=[0.5, 0, 0]
    )
    energy = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3)).compute_energy()
    m, mu, volume = masses(scene)[3], E / 2.6, scene.mesh.volume
    assert energy.parts["kinetic"] == pytest.approx(0.5 * m * 0.25, rel=1e-14)
    assert energy.parts["elastic"] == pytest.approx(mu * (0.4 / 0.5) ** 2 / 2 * volume, rel=1e-13)
    assert energy.parts["gravity"] == pytest.approx(
        m * G * scene.inputs.values["initial_positions"][:, 1].sum(), rel=1e-13
    )
    assert energy.parts["contact"] == 0 and energy == pytest.approx(sum(energy.parts.values()))
