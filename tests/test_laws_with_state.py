"""Laws that remember, as users write them: relaxation in closed form, the rule of a pass, and every gate of gradients."""

import gc
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import taichi as ti
from open_laws.relaxing import PAIRS, RelaxingLaw, RelaxingRubber

import diffsim_ti as ds
from diffsim_ti import runtime, verify
from diffsim_ti.differentiation import exp
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner, invariants
from diffsim_ti.state.pass_table import PassTable

EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)
SOLVERS = (*EXPLICIT, ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver)
every_solver = pytest.mark.parametrize("solver", SOLVERS)
MESH = ds.TetrahedralMesh.create_cube(2, 1.0)
MU, LAM, G, TAU = 4e3, 6e3, 3e3, 0.02
# what reads the state of each frame
RESULTS = dict(save_every=1, outputs=(ds.Reaction("xmin"), ds.ElasticEnergy(), ds.Stress(at="vertices")))


def rubber(each: bool = False) -> RelaxingRubber:
    """uniform, or with numbers of each tetrahedron."""
    m = MESH.num_tetrahedra if each else None
    factor = np.random.default_rng(0).uniform(0.7, 1.4, (3, m)) if each else np.ones(3)
    return RelaxingRubber(mu=MU, lam=LAM * factor[0], g=G * factor[1], tau=TAU * factor[2])


def scene(material=None, **changes) -> ds.Scene:
    """A cube held at one face that is drawn along, stretched, falling and slowed down."""
    noise = 0.02 * np.random.default_rng(3).standard_normal(MESH.vertices.shape)
    usual = dict(
        initial_positions=MESH.vertices * [1.3, 1, 1] + noise,
        initial_velocities=np.random.default_rng(7).standard_normal(MESH.vertices.shape),
        fixed="xmin",
        motion=lambda t: [0, 0.3 * t, 0],
        precision="f64",
    )
    density = np.random.default_rng(8).uniform(800, 1200, MESH.num_tetrahedra)
    return ds.Scene(MESH, material or rubber(), density, [ds.Gravity(), ds.Drag(0.3)], **usual | changes)


def rollout(scene: ds.Scene, solver=ds.SemiImplicitSolver, steps: int = 3, parallel=None, **options) -> ds.Rollout:
    own = dict(substeps=3) if solver in EXPLICIT else dict(tolerance=1e-12)
    made = solver(scene, dt=8e-3, parallel=parallel, **own)
    return ds.Rollout(made, steps, **dict(gradients="all") | options)


@pytest.mark.parametrize("solver", EXPLICIT)
def test_tables_of_passes_may_be_shorter_than_a_run(solver, monkeypatch):
    """The tables hold 1 024 passes at a time; with 4 of them the same bits come out, forward and back."""
    found = []
    for size in (1024, 4):
        monkeypatch.setattr(PassTable, "size", size)
        run = rollout(scene(), solver, **RESULTS)
        frames = run.forward()
        found.append([frames.positions, frames.law_state, *gradients(run).values()])
    for one, other in zip(*found):
        np.testing.assert_array_equal(one, other)


# ---- what the stress does ----------------------------------------------------------------------------------------------


def held(material, F, solver, dt: float, **options) -> ds.Simulator:
    """A body all of whose vertices are held at a homogeneous deformation, by a motion that shares kernels with others."""
    start = dict(initial_positions=MESH.vertices @ F.T, initial_velocities=None)
    body = scene(material, fixed=np.arange(MESH.num_vertices), motion=lambda t: np.zeros(3), **start)
    return ds.Simulator(solver(body, dt=dt, **options))


@every_solver
@pytest.mark.parametrize("steps_in_tau", [40, 0.5])
def test_stress_under_held_strain_relaxes_exponentially(solver, steps_in_tau):
    """S = S_lasting + 2 g exp(-t / tau) E, whatever the step."""
    F = np.eye(3) + np.random.default_rng(4).uniform(-0.2, 0.2, (3, 3))
    J, E, K = np.linalg.det(F), (F.T @ F - np.eye(3)) / 2, np.linalg.det(F) * np.linalg.inv(F).T
    simulator = held(rubber(), F, solver, TAU / steps_in_tau, substeps=2)
    for step in range(5):
        left = np.exp(-step / steps_in_tau)
        psi = MU / 2 * ((F**2).sum() - 3 - 2 * (J - 1)) + LAM / 2 * (J - 1) ** 2 + G * (left * E**2 * left).sum()
        P = MU * (F - K) + LAM * (J - 1) * K + F @ (2 * G * left * E)
        S = P @ F.T / J
        dev = S - np.trace(S) / 3 * np.eye(3)
        fields = simulator.tetrahedron_fields()
        np.testing.assert_allclose(fields.energy_density, psi, rtol=1e-12)
        np.testing.assert_allclose(fields.von_mises, np.sqrt(1.5 * (dev**2).sum()), rtol=1e-12)
        assert simulator.compute_energy().parts["elastic"] == pytest.approx(psi * MESH.volumes.sum(), rel=1e-12)
        np.testing.assert_allclose(
            simulator.law_state, [[(1 - left) * E[pair] for pair in PAIRS]] * len(fields.J), atol=1e-13
        )
        stress = simulator.output(ds.Stress(kind="first_piola"))
        np.testing.assert_allclose(stress, np.broadcast_to(P, stress.shape), rtol=0, atol=1e-11 * abs(P).max())
        assert simulator.output(ds.ElasticEnergy()) == pytest.approx(psi * MESH.volumes.sum(), rel=1e-12)
        force, moment = (simulator.output(ds.Reaction(about=about)) for about in (None, [0, 0, 0]))
        weight = 9.81 * simulator.scene.inputs.derive(simulator.scene.inputs.values).mass
        np.testing.assert_allclose(force, [0, weight.sum(), 0], rtol=0, atol=1e-9 * abs(P).max())
        turning = np.cross(simulator.positions, weight[:, None] * [0, 1, 0]).sum(0)  # a Cauchy stress does not turn
        np.testing.assert_allclose(moment, turning, rtol=0, atol=1e-9 * abs(P).max())
        of_side = simulator.output(ds.Reaction("xmin"))
        own = weight[MESH.vertex_indices("xmin")].sum()
        np.testing.assert_allclose(of_side - [0, own, 0], -P[:, 0], rtol=0, atol=1e-11 * abs(P).max())  # of 1 m^2
        simulator.step()


@every_solver
def test_a_pass_moves_the_state_on_once(solver):
    """z' from z and H: where an explicit pass takes its forces, where an implicit one ends."""
    body = scene(rubber(each=True))
    options = {} if solver in EXPLICIT else dict(tolerance=1e-12)
    simulator = ds.Simulator(solver(body, dt=2e-3, **options))
    z, tau = np.zeros((MESH.num_tetrahedra, 6)), body.inputs.values["tau"]
    B, tets = body.inputs.derive(body.inputs.values).gradients, MESH.tetrahedra
    for _ in range(4):
        before = simulator.displacements
        simulator.step()
        u = before if solver in EXPLICIT else simulator.displacements
        D = np.swapaxes(u[tets[:, 1:]] - u[tets[:, :1]], 1, 2)
        F = np.eye(3) + D @ B
        E = (np.swapaxes(F, 1, 2) @ F - np.eye(3)) / 2
        z += (1 - np.exp(-2e-3 / tau))[:, None] * (np.stack([E[:, i, j] for i, j in PAIRS], 1) - z)
        np.testing.assert_allclose(simulator.law_state, z, rtol=0, atol=1e-14)


@dataclass(frozen=True)
class FadingLaw(EnergyLaw):
    """A neo-Hookean body whose stiffness fades: psi = d psi_0, dd/dt = -rate d."""

    coefficient_names = ("mu", "lam", "rate")
    state_names = ("d",)
    initial_state = (1.0,)

    def psi(self, H, p, z):
        _, j, s = invariants(H)
        return z[0] * (p[0] / 2 * s + p[1] / 2 * j * j)

    def next_state(self, H, p, z, h):
        return [z[0] * exp(-h * p[2])]


class Fading(Material):
    spellings = (("mu", "lam", "rate"),)
    units = {"rate": "1/s"}

    def law(self, precision):
        return FadingLaw(precision)


def test_a_state_may_begin_elsewhere_than_at_zero():
    F = np.diag([1.2, 0.9, 1.1])
    simulator = held(Fading(MU, LAM, 30.0), F, ds.SemiImplicitSolver, 1e-2)
    first = simulator.compute_energy().parts["elastic"]
    simulator.run(3)
    assert simulator.compute_energy().parts["elastic"] == pytest.approx(first * np.exp(-0.9), rel=1e-12)
    simulator.reset()
    assert simulator.compute_energy().parts["elastic"] == first


# ---- gradients ---------------------------------------------------------------------------------------------------------


def gates(r: ds.Rollout, round_off: float, *inputs: str) -> None:
    """Tangent and adjoint are each other's transposed in all inputs; central differences, of some if they are named."""
    assert verify.dot_product_test(r) <= round_off
    report = ds.check_gradients(r, inputs=inputs or None, verbose=False)
    assert report.passed, report
    assert {*(inputs or (*r.scene.material.inputs, "rest_positions", "density"))} <= {row.input for row in report.rows}


@pytest.mark.parametrize("each", [False, True], ids=["uniform", "each"])
@pytest.mark.parametrize("solver", EXPLICIT)
def test_gradients_by_every_number(solver, each):
    gates(rollout(scene(rubber(each)), solver, **RESULTS), 1e-12)


@pytest.mark.parametrize(
    "solver, each", [(ds.ImplicitEulerSolver, True), (ds.BDF2Solver, True), (ds.ImplicitMidpointSolver, True)]
)
def test_gradients_through_implicit_steps(solver, each):
    r = rollout(scene(rubber(each)), solver, **RESULTS)
    gates(r, 1e-10, "mu", "g", "tau", "rest_positions", "initial_positions", "density")


def test_gradients_in_float32():
    gates(rollout(scene(precision="f32"), **RESULTS), 1e-5)


def test_scenes_of_a_batch_have_their_own():
    """One after the other: side by side, frames note nothing besides states."""
    solver = ds.SemiImplicitSolver(scene(), dt=2e-3)
    batch, one = ds.Batch(solver, 3, 2, **RESULTS), ds.Rollout(solver, 3, **RESULTS)
    g = np.array([G, 2 * G])
    found = batch.vjp(frames := batch.forward(g=g), reaction=np.ones((2, 4, 3)))["g"]
    for b in range(2):
        alone = one.forward(g=g[b])
        np.testing.assert_array_equal(frames["stress"][b], alone["stress"])
        assert found[b] == one.vjp(alone, reaction=np.ones((4, 3)))["g"] != 0
    with pytest.raises(ValueError, match="side by side: an output reads law_state of frames"):
        ds.Batch(solver, 3, 2, lanes=True, **RESULTS)


def test_gradients_with_one_launch_for_each_pass():
    gates(rollout(scene(rubber(each=True)), ds.VelocityVerletSolver, parallel=True, **RESULTS), 1e-12)


def test_gradients_beside_contact():
    """Two cubes that touch, on a rough floor: surfaces in contact have corners of their own, which no state fills."""
    two = ds.TetrahedralMesh.joined([MESH, MESH.translated([0.1, 1.04, 0.07])])
    terms = [ds.Ground(-0.05, stiffness=300.0, width=0.2, friction=0.3), ds.SelfContact(300.0, 0.1)]
    velocities = np.repeat([[0.3, -1, 0], [0, -2.0, 0.2]], MESH.num_vertices, 0)
    start = dict(initial_velocities=velocities, initial_positions=two.vertices * [1.1, 1, 1])  # stretched: it relaxes
    body = ds.Scene(two, rubber(), 1000.0, terms, precision="f64", **start)
    r = rollout(body, ds.ImplicitMidpointSolver, steps=2)
    gates(r, 1e-10, "tau", "rest_positions")
    assert r.sweep.workspace.pairs.list.count > 0


@dataclass(frozen=True)
class ViscousToo(RelaxingLaw):
    reads = ("H", "H_dot")

    def dissipation(self, H, H_dot, p):
        half = add_to_diagonal(H, 1).transpose() @ H_dot
        E_dot = (half + half.transpose()) * 0.5
        return p[2] * p[3] * inner(E_dot, E_dot)


@dataclass(frozen=True)
class OneByOne(RelaxingLaw):
    lanes = False


class Variant(RelaxingRubber):
    def __init__(self, law):
        self.kind = law
        super().__init__(mu=MU, lam=LAM, g=G, tau=TAU)

    def law(self, precision):
        return self.kind(precision)


def test_gradients_of_a_law_that_also_reads_the_velocity():
    gates(rollout(scene(Variant(ViscousToo)), save_every=1, outputs=ds.Reaction()), 1e-12)


@cache
def seeds(r: tuple) -> tuple:
    return np.random.default_rng(9).standard_normal((2, *r))


def gradients(r: ds.Rollout, **options) -> dict:
    frames = r.forward(**options)
    by_outputs = {name: seeds(frames[name].shape)[0] for name in r.computed}
    return r.vjp(frames, *seeds(frames.positions.shape), **by_outputs)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver])
def test_lanes_change_nothing(solver):
    """Eight tetrahedra at a time and one at a time agree to round-off."""
    pair = [gradients(rollout(scene(Variant(law)), solver, **RESULTS)) for law in (RelaxingLaw, OneByOne)]
    for name, one in pair[0].items():
        np.testing.assert_allclose(one, pair[1][name], rtol=0, atol=1e-11 * np.abs(one).max(), err_msg=name)


@pytest.mark.parametrize("solver", [*EXPLICIT, ds.BDF2Solver])
@pytest.mark.parametrize("options", [dict(checkpoint_every=2), dict(memory=0.008)], ids=str)
def test_what_is_kept_changes_no_bit(solver, options):
    whole, other = (rollout(scene(), solver, 7, **RESULTS, **own) for own in ({}, options))
    assert whole.checkpoints.num_segments == 1 and other.checkpoints.num_segments > 2
    want, got = gradients(whole), gradients(other)
    for name in want:
        assert got[name].tobytes() == want[name].tobytes(), name


@pytest.mark.parametrize("memory", [0.05, 1000.0])
def test_a_budget_holds_with_the_state(memory):
    """What is allocated for a long run, above what an idle one takes, is what the schedule says."""
    gc.collect()
    sizes, kept = [runtime.allocated_megabytes()], []
    for steps in (0, 300):
        kept.append(ds.Rollout(ds.SemiImplicitSolver(scene(motion=None), dt=2e-3), steps, memory=memory))
        frames = kept[-1].forward()
        kept[-1].vjp(frames, np.zeros_like(frames.positions))
        sizes.append(runtime.allocated_megabytes())
    idle, whole = np.diff(sizes)
    assert kept[1].memory <= memory
    assert whole - idle == pytest.approx(kept[1].memory - kept[0].memory, abs=6e-3)


@pytest.mark.parametrize("solver", [*EXPLICIT, ds.ImplicitEulerSolver])
def test_clip_scales_all_that_the_past_has_done(solver):
    """A limit that only the largest norm exceeds: what came after that step counts whole, what came before it less."""
    body, shape = scene(), (2, MESH.num_vertices, 3)
    w = seeds(shape)[0] * [[[0]], [[1]]]  # of the last frame
    whole = rollout(body, solver, 6, health=True)
    full = whole.vjp(whole.forward(), w)
    norms = {row["step"]: np.hypot(row["norm_position"], row["norm_velocity"]) for row in whole.health}
    second, largest = sorted(norms.values())[-2:]
    step, limit = next(s for s, norm in norms.items() if norm == largest), (second + largest) / 2
    assert 0 < step
    last, clipped = (rollout(body, solver, 6, **own) for own in (dict(truncate=6 - step), dict(clip=limit)))
    after, less = (r.vjp(r.forward(), w) for r in (last, clipped))
    for name in ("mu", "lam", "g", "tau"):
        expected = after[name] + limit / largest * (full[name] - after[name])
        np.testing.assert_allclose(less[name], expected, rtol=1e-9)
        assert abs(full[name] - after[name]) > 1e-3 * abs(full[name])


# ---- the other faces ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver])
def test_a_tape_finds_the_same_gradients(solver):
    r = rollout(scene(rubber(each=True)), solver, **RESULTS)
    shape = (r.num_frames, MESH.num_vertices, 3)
    w = ti.Vector.field(3, ti.f64, shape[:2])
    w.from_numpy(seeds(shape)[0])
    loss, tau = ti.field(ti.f64, (), needs_grad=True), r.field("tau")

    @ti.kernel
    def compute(x: ti.template(), energy: ti.template()):
        for f, i in x:
            loss[None] += w[f, i].dot(x[f, i])
        for f in energy:
            loss[None] += (f + 1) * energy[f]

    with ti.ad.Tape(loss):
        r.run()
        compute(r.positions, r.field("elastic_energy"))
    want = r.vjp(r.forward(), seeds(shape)[0], elastic_energy=np.arange(4.0) + 1)
    np.testing.assert_allclose(tau.grad.to_numpy(), want["tau"], rtol=1e-12)


def test_torch_finds_the_same_gradients():
    torch = pytest.importorskip("torch")
    from diffsim_ti.torch_bridge.rollout_node import rollout_frames

    r = rollout(scene(rubber(each=True)), **RESULTS)
    names = ("mu", "lam", "g", "tau", "density", "rest_positions")
    tensors = {name: torch.tensor(r.values[name], requires_grad=True) for name in names}
    frames = rollout_frames(r, **tensors)
    w, z = map(torch.from_numpy, seeds(tuple(frames.positions.shape)))
    loss = sum((torch.from_numpy(seeds(tuple(frames[name].shape))[0]) * frames[name]).sum() for name in r.computed)
    ((w * frames.positions).sum() + (z * frames.velocities).sum() + loss).backward()
    want = gradients(r)
    for name, x in tensors.items():
        np.testing.assert_allclose(x.grad.numpy(), want[name], rtol=1e-10, atol=1e-12 * np.abs(want[name]).max())


@every_solver
def test_steps_are_those_of_a_rollout(solver):
    """Also after a reset, and after a step that failed, which leaves the state before it."""
    body = scene()
    frames, simulator = ds.Rollout(solver(body, dt=2e-3), 3, **RESULTS).forward(), ds.Simulator(solver(body, dt=2e-3))
    z = []
    for again in range(2):
        for k in range(3):
            z.append(simulator.law_state)
            simulator.step()
            np.testing.assert_array_equal(simulator.positions, frames.positions[k + 1])
            for output in RESULTS["outputs"]:
                want = frames[output.name][k + 1]
                np.testing.assert_allclose(simulator.output(output), want, rtol=0, atol=1e-14 * abs(want).max())
        if not again:
            simulator.reset()
    np.testing.assert_array_equal(z[:3], z[3:])
    np.testing.assert_array_equal(z[:3], frames.law_state[:3])
    known = simulator.law_state
    runtime.fill(simulator.workspace.state.v, np.inf)  # which set_state would refuse
    with pytest.raises(FloatingPointError), np.errstate(invalid="ignore"):
        simulator.step()
    np.testing.assert_array_equal(simulator.law_state, known)


def saved(simulator, tmp_path) -> dict:
    np.savez(tmp_path / "state.npz", **simulator.state)
    return np.load(tmp_path / "state.npz")


@pytest.mark.parametrize("precision", ["f64", "f32"])
@every_solver
@pytest.mark.parametrize("remembers", [True, False])
def test_a_saved_run_goes_on_with_the_same_bits(solver, precision, remembers, tmp_path):
    """Also of what is drawn along, which depends on the time."""
    material = ds.KelvinVoigt(rubber(), time=1e-3) if remembers else ds.StableNeoHookean(MU, 0.3)
    body = scene(material, precision=precision)
    one, other = (ds.Simulator(solver(body, dt=2e-3)) for _ in range(2))
    one.run(3)
    other.run(1)  # which resume forgets
    kept = saved(one, tmp_path)
    one.run(3)
    other.resume(kept)
    other.run(3)
    assert one.time == other.time
    for name, value in one.state.items():
        np.testing.assert_array_equal(other.state[name], value, err_msg=name)


@pytest.mark.parametrize("order", [1, 2])
def test_what_a_law_remembers_can_be_set(order):
    """In a simulator and in a rollout; a run of 2 + 2 steps ends where one of 4 does, and ten nodes have it at points."""
    mesh = MESH if order == 1 else MESH.quadratic()
    usual = dict(fixed="xmin", precision="f64", initial_positions=mesh.vertices * [1.2, 1, 1])
    solver = ds.SemiImplicitSolver(ds.Scene(mesh, rubber(), terms=[ds.Gravity()], **usual), dt=2e-3)
    one, other = ds.Simulator(solver), ds.Simulator(solver)
    one.run(2)
    z = one.law_state
    assert z.shape == ((mesh.num_tetrahedra, 6) if order == 1 else (mesh.num_tetrahedra, 4, 6)) and z.std(0).min() > 0
    start = dict(positions=one.positions, velocities=one.velocities)
    other.set_state(**start, law_state=z)
    np.testing.assert_array_equal(other.law_state, z)
    r = ds.Rollout(solver, 2, outputs=ds.Stress())
    frames = r.forward(law_state=z, **{f"initial_{name}": value for name, value in start.items()})
    without = ds.Rollout(solver, 2).forward(**{f"initial_{name}": value for name, value in start.items()})
    one.run(2), other.run(2)
    for found in (other.positions, frames.positions[-1]):
        np.testing.assert_allclose(found, one.positions, rtol=0, atol=1e-13)
    assert abs(without.positions[-1] - one.positions).max() > 1e-6
    np.testing.assert_allclose(frames["stress"][-1], one.output(ds.Stress()), rtol=0, atol=1e-9)


def test_gradients_of_a_run_from_a_set_state():
    r = rollout(scene(), steps=2)
    z = 0.1 * np.random.default_rng(5).standard_normal((MESH.num_tetrahedra, 6))
    w, tau = np.cos(np.arange(3 * MESH.num_vertices)).reshape(-1, 3), float(np.max(r.values["tau"]))

    def loss(tau):
        frames = r.forward(law_state=z, tau=tau)
        return frames, (frames.positions[-1] * w).sum()

    frames, _ = loss(tau)
    found = r.vjp(frames, positions=np.stack([0 * w, w]))["tau"]
    h = 1e-5 * tau
    assert found == pytest.approx((loss(tau + h)[1] - loss(tau - h)[1]) / (2 * h), rel=1e-6)


def test_a_state_that_does_not_fit_is_refused():
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene(), dt=2e-3))
    with pytest.raises(ValueError, match=r"law_state: expected finite numbers of shape \(\d+, 6\)"):
        simulator.set_state(law_state=np.zeros((3, 6)))
    with pytest.raises(ValueError, match="law_state"):
        ds.Rollout(simulator.solver, 1).forward(law_state=np.full((MESH.num_tetrahedra, 6), np.nan))
    plain = ds.Simulator(ds.SemiImplicitSolver(scene(ds.StableNeoHookean(MU, 0.3)), dt=2e-3))
    with pytest.raises(ValueError, match="StableNeoHookean has no state"):
        plain.set_state(law_state=np.zeros((MESH.num_tetrahedra, 6)))
    for state in (simulator.state | dict(more=1), {}, plain.state):
        with pytest.raises(ValueError, match="resume: this run has the state displacements"):
            simulator.resume(state)
    with pytest.raises(ValueError, match="resume: velocities: expected finite numbers"):
        simulator.resume(simulator.state | dict(velocities=np.zeros(3)))
    with pytest.raises(ValueError, match=r"do not have what Relaxing remembers: pass Stress to Rollout\("):
        ds.Stress().settled(simulator.scene).value(ds.Rollout(simulator.solver, 1).forward())


# ---- what does not work says so ----------------------------------------------------------------------------------------


def learnable(law):
    from diffsim_ti.diff_physics import DifferentiableMaterial

    class OfTwo(law):
        """In E and nu alone, as learnable materials are."""

        def __init__(self, E, nu):
            super().__init__(mu=E / 3, lam=E / 2, g=E / 5, tau=TAU)

    return DifferentiableMaterial(1e4, 0.3, law=OfTwo)


def simulated():
    from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver

    DifferentiableSimulator(MESH, learnable(RelaxingRubber), DifferentiableSolver())


def energy_of_gradients():
    torch = pytest.importorskip("torch")
    learnable(RelaxingRubber).energy_density(torch.eye(3)[None])


@dataclass(frozen=True)
class Idle(EnergyLaw):
    state_names = ("z",)


@dataclass(frozen=True)
class TwoForOne(FadingLaw):
    initial_state = (1.0, 2.0)


@pytest.mark.parametrize(
    "build, words",
    [
        (
            lambda: ds.StaticSolver(scene(motion=None)),
            r"Relaxing has a state .* an equilibrium has none: take a solver with inertia",
        ),
        (
            lambda: scene(volume="patches").law,
            r"averages the part lam/2 theta\^2 of an energy, but RelaxingLaw does not say what its theta is; .* take",
        ),
        (simulated, r"has a state .* that DifferentiableSimulator does not support: .* rollout_frames"),
        (energy_of_gradients, r"has a state .* that energy_density\(F\) does not support: ask Simulator"),
        (lambda: Idle("f64"), r"Idle has a state \(z\) that nothing moves on: write next_state"),
        (lambda: TwoForOne("f64"), r"initial_state has 2 numbers for 1 state_names"),
    ],
)
def test_what_does_not_fit_is_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()
