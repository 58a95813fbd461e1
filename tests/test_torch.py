"""The PyTorch interface: each input's gradient by gradcheck, what a training loop does to it, and what it refuses."""

import copy

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

import diffsim_ti as ds
from diffsim_ti import Rollout, Scene, SemiImplicitSolver, StableNeoHookean, TetrahedralMesh, verify
from diffsim_ti.diff_physics import (
    DifferentiableBarrierContact,
    DifferentiableMaterial,
    SpatiallyVaryingMaterial,
    TorchMaterial,
)
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver, rollout_frames
from diffsim_ti.monitor.guard import Guard

pytestmark = pytest.mark.filterwarnings("ignore:dt = .* is divided")
GATE = dict(eps=1e-6, atol=1e-8, rtol=1e-5, fast_mode=True)  # along random directions of inputs and outputs
MESH = TetrahedralMesh.create_cube(2, 0.5)
N, M = MESH.num_vertices, MESH.num_tetrahedra
RNG = np.random.default_rng(0)
NOISE = torch.tensor(RNG.normal(size=(4, N, 3)))
SHARES = torch.tensor(RNG.uniform(0.8, 1.2, M))


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


class Given(TorchMaterial):
    """Moduli that a test hands over."""

    def __init__(self, E, nu):
        super().__init__()
        self.E, self.nu = torch.as_tensor(E), torch.as_tensor(nu)


def simulator(mesh=MESH, E=1e5, nu=0.3, gravity=-9.8, dt=0.01, damping=0.98, substeps=2, **options):
    """In contact from the start, damped."""
    options.setdefault("contact", DifferentiableBarrierContact(1e4, 0.1, ground_height=-0.05))
    return DifferentiableSimulator(
        mesh, DifferentiableMaterial(E, nu), DifferentiableSolver(dt, gravity, damping, substeps), **options
    )


def start(scale=1.0):
    return torch.tensor(MESH.vertices) + 0.01 * NOISE[0], scale * NOISE[1]


def loss_of(sim) -> torch.Tensor:
    return (NOISE[2] * sim.positions).sum() + (NOISE[3] * sim.velocities**2).sum()


def variable(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone().requires_grad_()


# ---- gradients --------------------------------------------------------------------------------------------------------

SIM = {}


def moved(
    E=1.0, nu=0.3, density=1.0, gravity=-9.8, positions=None, velocities=None, forces=None, contact=None, rollout=False
):
    """Four steps of one simulator from scaled inputs of order one -> positions and velocities."""
    if "sim" not in SIM:
        SIM["sim"] = simulator()
    sim = SIM["sim"]
    sim.material, sim.density = Given(1e5 * torch.as_tensor(E), nu), 1e3 * torch.as_tensor(density)
    sim.solver.gravity = gravity
    kappa, width, height = (1.0, 0.1, -0.05) if contact is None else contact
    sim._contact = DifferentiableBarrierContact(1e4 * kappa, width, ground_height=height)
    x, v = start()
    sim.reset(x if positions is None else positions, v if velocities is None else velocities)
    if rollout:
        frames = sim.rollout(4, save_every=2, checkpoint_every=1, external_forces=forces)
        return frames.positions, frames.velocities
    for step in range(4):
        sim.step(None if forces is None else 100 * forces[step])
    return sim.positions, sim.velocities


SCALARS = dict(E=1.0, nu=0.3, density=1.0, gravity=[0.5, -9.8, 1.0])
PER_TETRAHEDRON = dict(E=SHARES, nu=0.3 * SHARES, density=SHARES.flip(0))


@pytest.mark.parametrize(
    "name, value",
    [*SCALARS.items(), *PER_TETRAHEDRON.items(), ("gravity", -9.8)],
    ids=[*SCALARS, *(f"{n} per tetrahedron" for n in PER_TETRAHEDRON), "gravity along y"],
)
def test_gradcheck_of_numbers(name, value):
    assert gradcheck(lambda x: moved(**{name: x}), variable(value), **GATE)


@pytest.mark.parametrize("name", ["positions", "velocities"])
def test_gradcheck_of_start(name):
    assert gradcheck(lambda x: moved(**{name: x}), variable(start()[name == "velocities"]), **GATE)


def test_gradcheck_of_forces_per_step():
    assert gradcheck(lambda f: moved(forces=f), variable(NOISE[:, :, :]), **GATE)


def test_gradcheck_of_contact_numbers():
    assert gradcheck(lambda *c: moved(contact=c), tuple(variable(x) for x in (1.0, 0.1, -0.05)), **GATE)


def test_gradcheck_of_contact_with_friction():
    def run(friction, speed, stiffness):
        contact = DifferentiableBarrierContact(
            1e4 * stiffness, 0.1, ground_height=-0.05, friction=friction, friction_speed=speed
        )
        sim = simulator(contact=contact)
        sim.reset(*start())
        sim.rollout(5)
        return sim.positions, sim.velocities

    assert gradcheck(run, tuple(variable(x) for x in (0.4, 0.3, 1.0)), **GATE)
    moved, unmoved = run(0.4, 0.3, 1.0)[0], run(0.0, 0.3, 1.0)[0]
    assert (moved - unmoved).abs().max() > 1e-4


def test_gradcheck_of_numbers_of_terms():
    """Tensors that terms are made of get gradients, in simulators and in the functional face, under any name."""

    def terms(radius, center, stiffness, friction):
        ball = ds.Sphere(center, radius, stiffness=1e4 * stiffness, width=0.2, friction=friction, friction_speed=0.3)
        return [ball, ds.HalfSpace((-0.1, 0, 0), (1, 0, 0), stiffness=2e4 * stiffness, width=0.2, name="wall")]

    def simulated(*numbers):
        sim = simulator(contact=False, terms=terms(*numbers))
        sim.reset(*start())
        sim.rollout(2)
        sim.step()
        return sim.positions, sim.velocities

    def rolled(*numbers):
        scene = Scene(MESH, StableNeoHookean(1e5, 0.3), terms=terms(*numbers), precision="f64")
        return tuple(
            rollout_frames(Rollout(SemiImplicitSolver(scene, dt=0.002), 6), initial_displacements=0.01 * NOISE[0])
        )

    inputs = tuple(variable(x) for x in (0.36, [0.25, -0.4, 0.25], 1.0, 0.4))
    assert gradcheck(simulated, inputs, **GATE)
    assert all(g.abs().max() > 0 for g in torch.autograd.grad(rolled(*inputs)[0].pow(2).sum(), inputs))
    grads = torch.autograd.grad(simulated(*inputs)[0].pow(2).sum(), inputs)
    assert all(g.abs().max() > 0 for g in grads), grads


def test_numbers_of_terms_follow_an_optimiser():
    """Changed in place between runs, as optimisers do; one simulator, one scene."""
    radius = torch.nn.Parameter(torch.tensor(0.3))
    sim = simulator(contact=False, terms=[ds.Sphere((0.25, -0.4, 0.25), radius, stiffness=1e4, width=0.2)])
    ends = []
    for value in (0.3, 0.32):
        with torch.no_grad():
            radius.fill_(value)
        sim.reset(*start())
        sim.rollout(3)
        fresh = simulator(contact=False, terms=[ds.Sphere((0.25, -0.4, 0.25), value, stiffness=1e4, width=0.2)])
        fresh.reset(*start())
        fresh.rollout(3)
        assert torch.equal(sim.positions, fresh.positions)
        ends.append(sim.positions)
    assert not torch.equal(*ends)


@pytest.mark.filterwarnings("default:dt = .* is divided")
@pytest.mark.parametrize("contact", ["stage", "force"])
def test_substeps_count_barriers_of_terms_as_those_of_contact(contact):
    counts = []
    for options in (
        dict(contact=DifferentiableBarrierContact(1e6, 0.1, ground_height=-0.2)),
        dict(contact=False, terms=[ds.Ground(-0.2, 1e6, 0.1)]),
        dict(contact=False, terms=[ds.Ground(-0.2, torch.tensor(1e6), 0.1, name="floor")]),
        dict(contact=False),
        dict(contact=False, terms=[ds.Ground(-0.2, width=0.1, stiffness_per_area=torch.tensor(1e8))]),
    ):
        solver = DifferentiableSolver(0.01, contact=contact)
        sim = DifferentiableSimulator(MESH, DifferentiableMaterial(1e5, 0.3), solver, **options)
        counts.append(sim._substeps)
    assert counts[0] == counts[1] == counts[2] > counts[3] < counts[4]


@pytest.mark.parametrize(
    "inputs",
    [dict(E=1.0, nu=0.3, density=1.0, gravity=[0.5, -9.8, 1.0]), dict(velocities=NOISE[1]), dict(forces=NOISE)],
    ids=["numbers", "velocities", "forces per step"],
)
def test_gradcheck_of_rollout_frames(inputs):
    def run(*values):
        return moved(**dict(zip(inputs, values)), rollout=True)

    assert gradcheck(run, tuple(variable(x) for x in inputs.values()), **GATE)


def test_gradcheck_of_the_functional_face():
    terms = [ds.Gravity(), ds.Ground(-0.05, 1e4, 0.1)]
    scene = Scene(MESH, StableNeoHookean(1e5, 0.3), terms=terms, fixed="ymax", precision="f64")
    rollout = Rollout(SemiImplicitSolver(scene, dt=0.002), 6, save_every=3, gradients="all")

    def run(E, density, rest, height):
        numbers = dict(youngs_modulus=1e5 * E, density=1e3 * density, ground_height=height)
        frames = rollout_frames(rollout, rest_positions=rest, **numbers)
        return frames.positions, frames.velocities, frames.displacements

    inputs = (variable(1.0), variable(1.0), variable(np.array(MESH.vertices)), variable(-0.05))
    assert gradcheck(run, inputs, **GATE)


@pytest.mark.executed_ptx
def test_gradients_agree_with_the_cores():
    """One reverse sweep serves both: the numbers of the seeds' first block, against `Rollout.vjp` to the last digit."""
    sim = simulator()
    frames = sim.rollout(10)
    frames.positions[-1].sum().backward()
    core = sim._rollout(10, False, None, None)
    adjoint = np.zeros((2, N, 3))
    adjoint[-1] = 1
    expected = core.vjp(core.forward(youngs_modulus=1e5, poissons_ratio=0.3), adjoint)
    assert sim.material.E.grad.item() == expected["youngs_modulus"]
    assert sim.material.nu.grad.item() == expected["poissons_ratio"]


# ---- steps, rollouts, and graphs --------------------------------------------------------------------------------------


def gradients_of(run, sim, forces):
    x, v = (variable(a) for a in start())
    f = variable(forces)
    sim.reset(x, v)
    run(f)
    values = torch.cat([sim.positions, sim.velocities]).detach()
    return values, torch.autograd.grad(loss_of(sim), (sim.material.E, sim.material.nu, x, v, f))


def test_steps_equal_a_rollout():
    sim = simulator()
    ways = [
        lambda f: [sim.step(row) for row in f],
        lambda f: sim.rollout(4, external_forces=f),
        lambda f: sim.rollout(4, checkpoint_every=2, external_forces=f),
        lambda f: sim.rollout(4, save_every=1, external_forces=f),
        lambda f: (sim.rollout(2, external_forces=f[:2]), sim.rollout(2, external_forces=f[2:])),
    ]
    values, gradients = gradients_of(ways[0], sim, 100 * NOISE)
    for way in ways[1:]:
        others, same = gradients_of(way, sim, 100 * NOISE)
        assert torch.allclose(values, others, rtol=1e-13, atol=1e-14)
        for a, b in zip(gradients, same):
            assert torch.allclose(a, b, rtol=1e-11, atol=1e-13 * float(a.abs().max()))


def test_frames_are_the_steps():
    sim = simulator()
    frames = sim.rollout(6, save_every=2)
    assert frames.positions.shape == (4, N, 3) and torch.equal(frames.positions[-1], sim.positions)
    sim.reset()
    for k in range(1, 4):
        sim.step(), sim.step()
        assert torch.allclose(sim.positions, frames.positions[k], rtol=0, atol=1e-15)


def test_two_backwards_are_equal_and_accumulate():
    sim = simulator()
    x, v = (variable(a) for a in start())
    sim.reset(x, v)
    sim.step(), sim.step()
    loss = loss_of(sim)
    first = torch.autograd.grad(loss, (sim.material.E, x, v), retain_graph=True)
    second = torch.autograd.grad(loss, (sim.material.E, x, v), retain_graph=True)
    assert all(torch.equal(a, b) for a, b in zip(first, second))
    loss.backward(retain_graph=True)
    loss.backward()
    assert torch.equal(sim.material.E.grad, 2 * first[0])


def test_inputs_without_gradient_get_none():
    sim = simulator()
    sim.material.nu.requires_grad_(False)
    x, v = start()
    v = v.requires_grad_()
    sim.reset(x, v)
    sim.step()
    loss_of(sim).backward()
    assert x.grad is None and sim.material.nu.grad is None
    assert v.grad is not None and sim.material.E.grad is not None
    with torch.no_grad():
        sim.step()
    assert not sim.positions.requires_grad


def test_non_contiguous_inputs():
    plain, forces = start(), 100 * NOISE[3]
    results = []
    for wrap in (
        lambda a: variable(a),
        lambda a: variable(a.T.contiguous()).T,
        lambda a: variable(a).expand(2, N, 3)[1],
    ):
        sim = simulator()
        x, v, f = (wrap(a) for a in (*plain, forces))
        sim.reset(x, v)
        sim.step(f)
        results.append((sim.positions.detach(), *torch.autograd.grad(loss_of(sim), (x, v, f))))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))
    assert not variable(plain[0].T.contiguous()).T.is_contiguous()
    spread = torch.zeros(2 * M).index_copy(0, torch.arange(0, 2 * M, 2), 1e5 * SHARES)[::2]
    by_element = simulator(E=spread)
    by_element.step()
    again = simulator(E=1e5 * SHARES)
    again.step()
    assert torch.equal(by_element.positions, again.positions)


def test_two_forwards_before_one_backward():
    sim, alone = simulator(), []
    for E in (1e5, 5e4):
        sim.material = Given(variable(E), 0.3)
        sim.reset()
        sim.rollout(5)
        alone.append(torch.autograd.grad(loss_of(sim), sim.material.E)[0])
    inputs, losses = [], []
    for E in (1e5, 5e4):
        sim.material = Given(variable(E), 0.3)
        sim.reset()
        sim.rollout(5)
        inputs.append(sim.material.E)
        losses.append(loss_of(sim))
    together = torch.autograd.grad(losses[0] + 2 * losses[1], inputs)
    assert torch.equal(together[0], alone[0]) and torch.equal(together[1], 2 * alone[1])


def test_parameters_changed_in_place_after_the_run():
    """A node keeps what it ran with: an optimiser may move the parameters before backward is called."""
    sim = simulator()
    x, v = start()
    sim.reset(x, v)
    sim.rollout(3)
    loss = loss_of(sim)
    (expected,) = torch.autograd.grad(loss, sim.material.E, retain_graph=True)
    with torch.no_grad():
        sim.material.E.mul_(2)
        x.zero_()
    (after,) = torch.autograd.grad(loss, sim.material.E)
    sim.rollout(3)  # and a run in between
    assert torch.equal(after, expected)


def test_two_simulators_of_different_meshes_in_one_graph():
    other = TetrahedralMesh.create_cube(3, 0.4)
    E = variable(1e5)

    def run(mesh):
        sim = simulator(mesh)
        sim.material = Given(E, 0.3)
        sim.reset()
        for _ in range(3):
            sim.step()
        return sim.positions.sum()

    (first,), (second,) = (torch.autograd.grad(run(mesh), E) for mesh in (MESH, other))
    (both,) = torch.autograd.grad(run(MESH) * run(other), E)
    assert torch.allclose(both, first * run(other) + second * run(MESH), rtol=1e-12)


def test_a_simulator_used_twice_in_one_graph():
    """The second run starts where a function of the first one's end says."""

    def run(E, sims):
        for sim in sims:
            sim.material = Given(2.0**17 * E, 0.3)  # a power of two: its product with a sum is the sum of products
        sims[0].reset()
        sims[0].rollout(4)
        carried = sims[0].velocities.roll(1, 0)
        sims[1].reset(velocities=carried)
        sims[1].rollout(4)
        return sims[1].positions, carried

    one = simulator()
    E = variable(1.0)
    assert gradcheck(lambda e: run(e, (one, one)), E, **GATE)
    (shared,) = torch.autograd.grad(run(E, (one, one))[0].square().sum(), E)
    (apart,) = torch.autograd.grad(run(E, (simulator(), simulator()))[0].square().sum(), E)
    assert torch.equal(shared, apart)


def interrupt(*_):
    raise RuntimeError("in the middle")


@pytest.mark.parametrize("where", ["check", "sweep", "backward"])
def test_an_exception_in_the_middle_leaves_the_next_step_right(where, monkeypatch):
    sim, untouched = simulator(), simulator()
    for s in (sim, untouched):
        s.step()
    (expected,) = torch.autograd.grad(loss_of(untouched), untouched.material.E)
    with pytest.raises((ValueError, FloatingPointError, RuntimeError)):
        if where == "check":
            sim.step(torch.full((N, 3), torch.nan))
        elif where == "sweep":
            with monkeypatch.context() as patch:
                patch.setattr(Guard, "advance", interrupt)
                sim.step()
        else:
            (sim.positions.sum() * torch.nan).backward()
    assert torch.equal(sim.positions, untouched.positions)
    (after,) = torch.autograd.grad(loss_of(sim), sim.material.E, retain_graph=True)
    assert torch.equal(after, expected)
    for s in (sim, untouched):
        s.step()
    assert torch.equal(sim.positions, untouched.positions)
    loss_of(sim).backward(), loss_of(untouched).backward()
    assert torch.equal(sim.material.E.grad, untouched.material.E.grad)


def test_a_run_that_outgrows_its_substeps_raises_and_keeps_its_state():
    sim = simulator(contact=False)
    before = sim.positions.clone()
    with torch.no_grad():
        sim.material.E.fill_(1e12)
    with pytest.raises(FloatingPointError, match="step"):
        sim.rollout(200)
    assert torch.equal(sim.positions, before)
    with torch.no_grad():
        sim.material.E.fill_(1e5)
    sim.step()
    fresh = simulator(contact=False)
    fresh.step()
    assert torch.equal(sim.positions, fresh.positions)


def test_errors_of_steps_name_the_step_of_the_simulator():
    """After three steps at rest one that diverges, and one that Newton's method gives up on."""
    for method, options, size, error in (
        (SemiImplicitSolver, {}, 1e200, ds.Divergence),
        (ds.ImplicitEulerSolver, dict(max_iterations=2), 0.4, ds.NotConverged),
    ):
        solver = DifferentiableSolver(gravity=0.0, method=method, **options)
        sim = DifferentiableSimulator(MESH, DifferentiableMaterial(1e5, 0.3), solver, contact=False)
        for _ in range(3):
            sim.step()
        sim._displacements = size * NOISE[0]
        with pytest.raises(error, match=r"^step 3, t = 0\.03 s: ") as raised:
            sim.step()
        assert raised.value.step == 3


def test_truncated_backpropagation():
    whole, cut = simulator(), simulator()
    for sim in (whole, cut):
        sim.rollout(3)
    cut.detach()
    assert not cut.positions.requires_grad
    x, v = whole.positions.detach(), whole.velocities.detach()
    cut.rollout(2)
    (last_window,) = torch.autograd.grad(loss_of(cut), cut.material.E)
    whole.reset(x, v)
    whole.rollout(2)
    (expected,) = torch.autograd.grad(loss_of(whole), whole.material.E)
    assert torch.allclose(last_window, expected, rtol=1e-12)
    assert torch.allclose(cut.positions, whole.positions, rtol=0, atol=1e-14)


@pytest.mark.parametrize("loss", [loss_of, lambda sim: sim.positions.sum()], ids=["curved", "linear"])
def test_double_backward_is_refused(loss):
    sim = simulator()
    sim.rollout(2)
    (first,) = torch.autograd.grad(loss(sim), sim.material.E, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives.*hessian_product"):
        torch.autograd.grad(first, sim.material.E)


def test_first_derivatives_with_create_graph_are_the_same():
    sim = simulator()
    sim.rollout(2)
    loss, E = loss_of(sim), sim.material.E
    assert torch.equal(*(torch.autograd.grad(loss, E, create_graph=c, retain_graph=True)[0] for c in (True, False)))


# ---- modules, optimisers ----------------------------------------------------------------------------------------------


def test_state_dict_round_trip(tmp_path):
    for made in (
        lambda E: DifferentiableMaterial(E, 0.3),
        lambda E: DifferentiableMaterial(torch.full((M,), E), 0.3),
        lambda E: SpatiallyVaryingMaterial(M, E, 0.3),
        lambda E: SpatiallyVaryingMaterial(base_E=E, base_nu=0.3, grid_resolution=(2, 3, 2), E_range=(1e4, 1e6)),
    ):
        torch.save(made(7e4).state_dict(), tmp_path / "material.pt")
        other = made(1e5)
        other.load_state_dict(torch.load(tmp_path / "material.pt"))
        E = other.tensors(MESH)["youngs_modulus"]
        assert torch.allclose(E, torch.tensor(7e4))


def test_to_dtype_changes_the_precision():
    torch.set_default_dtype(torch.float32)
    sim = simulator()
    sim.step()
    assert sim.positions.dtype == torch.float32 and "precision f32" in sim.describe()
    sim.material.to(torch.float64)
    sim.step()  # goes on in float64
    assert sim.positions.dtype == torch.float64 and "precision f64" in sim.describe()
    sim.positions.sum().backward()
    assert sim.material.E.grad.dtype == torch.float64
    assert DifferentiableMaterial(torch.tensor(1e5, dtype=torch.float64), 0.3).nu.dtype == torch.float64
    with pytest.raises(ValueError, match="float32 or float64, got torch.float16"):
        sim.material.to(torch.float16)
        sim.reset()


@pytest.mark.executed_ptx
def test_float32_gradients_agree_with_float64():
    gradients = []
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        sim = simulator()
        sim.rollout(10)
        (sim.positions**2).sum().backward()
        gradients.append([float(p.grad) for p in sim.material.parameters()])
    assert np.allclose(*gradients, rtol=1e-3)


def test_copies_and_pickles_leave_the_graph():
    sim = simulator()
    sim.step()
    other = copy.deepcopy(sim)
    assert not other.positions.requires_grad and torch.equal(other.positions, sim.positions)
    for s in (sim, other):
        s.step()
    assert torch.equal(other.positions, sim.positions)
    sim.positions.sum().backward()
    assert sim.material.E.grad is not None and other.material.E.grad is None


def identification(make_optimizer, iterations):
    """log E of a body held at its top, from where it hangs after a while."""
    sim = simulator(contact=False, fixed_vertices="ymax", damping=0.95)
    sim.rollout(20)
    target = sim.positions.detach()
    log_E = torch.nn.Parameter(torch.tensor(np.log(2e5)))
    optimizer = make_optimizer([log_E])

    def closure():
        optimizer.zero_grad()
        sim.material = Given(torch.exp(log_E), 0.3)
        sim.reset()
        sim.rollout(20)
        loss = 1e6 * (sim.positions - target).square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([log_E], 1e4)
        return loss

    for _ in range(iterations):
        optimizer.step(closure)
    return float(log_E.detach().exp())


@pytest.mark.parametrize(
    "make, iterations, gate",
    [
        (lambda p: torch.optim.LBFGS(p, lr=1, max_iter=20, line_search_fn="strong_wolfe"), 1, 1e-5),
        (lambda p: torch.optim.Adam(p, lr=0.1), 100, 1e-2),
        (lambda p: torch.optim.SGD(p, lr=0.02, momentum=0.5), 50, 1e-2),
    ],
    ids=["LBFGS", "Adam", "SGD"],
)
def test_optimisers(make, iterations, gate):
    assert identification(make, iterations) == pytest.approx(1e5, rel=gate)


# ---- refusals ---------------------------------------------------------------------------------------------------------


def test_wrong_shapes_and_types_name_expected_and_got():
    sim = simulator()
    for call, expected in (
        (lambda: sim.reset(torch.zeros(3, 3)), r"positions: expected shape \(8, 3\), got \(3, 3\)"),
        (lambda: sim.reset(velocities=torch.zeros(3, 8)), r"velocities: expected shape \(8, 3\), got \(3, 8\)"),
        (lambda: sim.step(torch.zeros(3)), r"external_forces: expected shape \(8, 3\).*, got \(3,\)"),
        (
            lambda: sim.rollout(5, external_forces=torch.zeros(4, N, 3)),
            r"external_forces: .*\(5, 8, 3\), got \(4, 8, 3\)",
        ),
        (lambda: sim.step(torch.zeros(N, 3).int()), "external_forces: expected a floating point.*got torch.int32"),
        (lambda: sim.reset(torch.zeros(N, 3).cfloat()), "positions: expected a floating point.*got torch.complex64"),
        (lambda: simulator(density=torch.ones(5)), r"density: expected one number or shape \(6,\), got \(5,\)"),
        (lambda: simulator(E=torch.full((5,), 1e5)), r"5.*6|6.*5"),
        (lambda: simulator(gravity=[0.0, 1.0]), r"gravity must be a number .* got shape \(2,\)"),
        (lambda: simulator(E=-1.0), "(?i)young"),
        (lambda: simulator(nu=0.5), "(?i)poisson"),
        (lambda: simulator(density=torch.tensor(-1.0)), "density must be > 0"),
        (lambda: simulator(contact="floor"), 'contact must be "ground", False or a DifferentiableBarrierContact'),
        (lambda: simulator(dt=0.0), "dt must be > 0"),
        (lambda: simulator(damping=1.5), "damping is the share of velocity kept"),
        (lambda: DifferentiableMaterial(1e5, 0.3, E=1e5), "exactly one of its spellings"),
        (lambda: SpatiallyVaryingMaterial(), "num_elements .* or grid_resolution"),
        (
            lambda: SpatiallyVaryingMaterial(M, 1e5, 0.3).energy_density(torch.eye(3).expand(2, 3, 3)),
            "expected 6 matrices",
        ),
        (lambda: simulator().material.energy_density(torch.eye(3)), r"F: expected shape \(m, 3, 3\), got \(3, 3\)"),
        (lambda: DifferentiableBarrierContact(1e4, 0.1, barrier_distance=0.1), "two spellings"),
    ):
        with pytest.raises(ValueError, match=expected):
            call()
    with pytest.raises(ValueError, match="2 tetrahedra|6 tetrahedra, the material 5"):
        DifferentiableSimulator(MESH, SpatiallyVaryingMaterial(5, 1e5, 0.3), DifferentiableSolver())


def test_an_optimiser_that_leaves_the_range_is_told():
    """Adam with a large step may make E negative: ValueError before any kernel, and the state stays."""
    sim = simulator()
    before = sim.positions.clone()
    with torch.no_grad():
        sim.material.E.fill_(-3.0)
    with pytest.raises(ValueError, match="(?i)young.*-3"):
        sim.step()
    assert torch.equal(sim.positions, before)
    with torch.no_grad():
        sim.material.E.fill_(torch.nan)
    with pytest.raises(ValueError, match="finite"):
        sim.step()


def test_functional_face_refuses():
    scene = Scene(MESH, StableNeoHookean(1e5, 0.3), precision="f64")
    rollout = Rollout(SemiImplicitSolver(scene, dt=1e-3), 1)
    x = torch.tensor(np.array(MESH.vertices))
    with pytest.raises(ValueError, match="no input named 'stiffness'"):
        rollout_frames(rollout, stiffness=torch.tensor(1.0))
    with pytest.raises(ValueError, match="two spellings of one input"):
        rollout_frames(rollout, initial_positions=x, initial_displacements=x)
    with pytest.raises(ValueError, match="with rest_positions, give initial_positions"):
        rollout_frames(rollout, rest_positions=x, initial_displacements=x)
    with pytest.raises(ValueError, match="floating point tensor, got torch.int64"):
        rollout_frames(rollout, youngs_modulus=torch.tensor(100000))
    assert rollout_frames(rollout, youngs_modulus=1e5).positions.shape == (2, N, 3)  # numbers are fine


# ---- other processes --------------------------------------------------------------------------------------------------


class Motions(torch.utils.data.Dataset):
    """Simulates in the worker."""

    def __init__(self, sim):
        self.sim = sim

    def __len__(self):
        return 2

    def __getitem__(self, k):
        self.sim.reset(velocities=torch.full((N, 3), float(k)))
        self.sim.step()
        return self.sim.positions.detach()


def test_workers_by_fork_are_refused_with_a_remedy():
    simulator().step()  # Taichi runs here
    loader = torch.utils.data.DataLoader(
        Motions(simulator()), num_workers=1, multiprocessing_context="fork", timeout=60
    )
    with pytest.raises(RuntimeError, match="forked after Taichi had started.*spawn"):
        list(loader)


@pytest.mark.executed_ptx
def test_workers_by_spawn():
    data = Motions(simulator())
    loader = torch.utils.data.DataLoader(
        data, batch_size=None, num_workers=1, multiprocessing_context="spawn", timeout=120
    )
    for got, k in zip(loader, range(2)):
        rounding = 0 if ds.runtime.arch_name() == "cpu" else 1e-15  # where other kernels ran before
        torch.testing.assert_close(got, data[k], rtol=0, atol=rounding)


def spawned(rank, sim, results):
    sim.reset()
    sim.step()
    sim.positions.sum().backward()
    results[rank] = sim.material.E.grad.detach()


def test_multiprocessing_spawn():
    sim, results = simulator(), torch.zeros(1).share_memory_()
    torch.multiprocessing.spawn(spawned, (sim, results), nprocs=1)
    sim.step()
    sim.positions.sum().backward()
    assert results[0] == sim.material.E.grad


def test_verify_serves_the_same_rollout():
    """What proves the core proves the torch face: its Rollout is the core's."""
    sim = simulator()
    assert verify.dot_product_test(sim._rollout(4, False, None, None)) < 1e-12


def test_torch_compile_breaks_its_graph_at_a_rollout():
    """And functorch's transforms are refused in one line."""
    scene = ds.Scene(ds.TetrahedralMesh.create_box(2, 0.1), ds.StableNeoHookean(1e4, 0.3), precision="f64")
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, 1e-3), 2)

    def loss(E):
        return (
            2
            * rollout_frames(rollout, youngs_modulus=3 * E, initial_velocities=torch.eye(8, 3)).positions.square().sum()
        )

    numbers = [torch.tensor(3e3, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    for one, called in zip(numbers, (loss, torch.compile(loss, backend="eager"))):
        called(one).backward()
    assert numbers[0].grad == numbers[1].grad != 0
    with pytest.raises(RuntimeError, match="take diffsim_ti.Batch"):
        torch.func.vmap(loss)(torch.tensor([1e3, 2e3], dtype=torch.float64))
