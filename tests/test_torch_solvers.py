"""Every solver of the core through the PyTorch interface: gradcheck of its motion, and what it refuses."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

import diffsim_ti as ds
from diffsim_ti.diff_physics import DifferentiableBarrierContact, TorchMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver, rollout_frames

pytestmark = pytest.mark.filterwarnings("ignore:dt = .* is divided")
GATE = dict(eps=1e-6, atol=1e-8, rtol=1e-5)
MESH = ds.TetrahedralMesh.create_cube(2, 0.5)
N = MESH.num_vertices
NOISE = torch.tensor(np.random.default_rng(0).normal(size=(3, N, 3)))
TIGHT = dict(tolerance=1e-12)  # differences see the solve's tolerance over their eps of 1e-6
METHODS = {
    ds.VelocityVerletSolver: {},
    ds.ImplicitEulerSolver: TIGHT,
    ds.ImplicitMidpointSolver: TIGHT,
    ds.BDF2Solver: TIGHT,
}
by_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__name__)


class Given(TorchMaterial):
    """Moduli that a test hands over."""

    def __init__(self, E, nu):
        super().__init__()
        self.E, self.nu = E, nu


def simulator(method, **options):
    """Damped, and in contact from the start."""
    solver = DifferentiableSolver(0.01, -9.8, damping=0.95, substeps=2, method=method, **METHODS[method])
    material = Given(torch.tensor(1e5).double(), torch.tensor(0.3).double())
    options.setdefault("contact", DifferentiableBarrierContact(1e4, 0.1, ground_height=-0.05))
    return DifferentiableSimulator(MESH, material, solver, **options)


@by_method
def test_gradcheck(method):
    sim = simulator(method)

    def run(E, nu, density, gravity, velocities, forces):
        sim.material, sim.density, sim.solver.gravity = Given(1e5 * E, nu), 1e3 * density, gravity
        sim.reset(velocities=0.1 * velocities * NOISE[0])
        frames = sim.rollout(3, save_every=1, external_forces=10 * forces * NOISE[1])
        weights = NOISE[2]  # a few numbers of the frames: gradcheck runs one reverse sweep for each
        return (weights * frames.positions).sum((1, 2)), (weights * frames.velocities).sum((1, 2))

    inputs = (1.0, 0.3, 1.0, [0.5, -9.8, 1.0], 1.0, 1.0)
    inputs = tuple(torch.tensor(x).double().requires_grad_() for x in inputs)
    assert gradcheck(run, inputs, **GATE)


@by_method
def test_steps_equal_a_rollout_or_are_refused(method):
    sim = simulator(method)
    if method is ds.BDF2Solver:
        before = sim.positions.clone()
        with pytest.raises(ValueError, match=r"starts afresh.*BDF2Solver.*rollout\(n\)"):
            sim.step()
        assert torch.equal(sim.positions, before)
        return
    for _ in range(4):
        sim.step()
    stepped = sim.positions.clone()
    sim.reset()
    whole = sim.rollout(4).positions[-1]
    assert torch.allclose(stepped, whole, rtol=0, atol=1e-10)


def test_implicit_steps_are_not_divided():
    """A step of 0.1 s, two hundred times the explicit one: no substeps are chosen, and none is warned of."""
    solver = DifferentiableSolver(0.1, method=ds.ImplicitEulerSolver)
    sim = DifferentiableSimulator(MESH, Given(torch.tensor(1e8), torch.tensor(0.3)), solver, contact=False)
    sim.step()
    assert "ImplicitEulerSolver: dt 0.1 s, 1 substeps" in sim.describe()
    assert sim.positions.mean(0)[1].item() == pytest.approx(0.25 - 9.8 * 0.1**2, rel=1e-5)


def test_gradcheck_of_an_equilibrium():
    scene = ds.Scene(MESH, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], fixed="xmin", precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1)

    def run(E, nu, density, gravity):
        frames = rollout_frames(
            rollout, youngs_modulus=1e5 * E, poissons_ratio=nu, density=1e3 * density, gravity=gravity
        )
        return (NOISE * frames.displacements[-1]).sum((1, 2))

    inputs = tuple(torch.tensor(x).double().requires_grad_() for x in (1.0, 0.3, 1.0, [0.5, -9.8, 1.0]))
    assert gradcheck(run, inputs, **GATE)


def test_what_is_no_method_is_refused():
    with pytest.raises(ValueError, match="StaticSolver has no steps; use rollout_frames"):
        DifferentiableSolver(method=ds.StaticSolver)
    with pytest.raises(ValueError, match="method must be a solver class such as ImplicitEulerSolver, got 'implicit'"):
        DifferentiableSolver(method="implicit")
    with pytest.raises(ValueError, match="tolerance must lie between 0 and 1"):
        solver = DifferentiableSolver(method=ds.ImplicitEulerSolver, tolerance=2.0)
        DifferentiableSimulator(MESH, Given(torch.tensor(1e5), torch.tensor(0.3)), solver).step()
