"""diff_physics by itself: materials, barrier, implicit differentiation, CG, checkpointed rollouts, smooth functions."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from diffsim_ti import Ground, SmithNeoHookean, TetrahedralMesh
from diffsim_ti.diff_physics import (
    CheckpointedRollout,
    DifferentiableBarrierContact,
    DifferentiableMaterial,
    ImplicitDifferentiation,
    SpatiallyVaryingMaterial,
    TorchMaterial,
    conjugate_gradient,
    log_barrier,
    smooth_step,
)
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver

pytestmark = pytest.mark.filterwarnings("ignore:dt = .* is divided")
GATE = dict(eps=1e-6, atol=1e-8, rtol=1e-5)
RNG = np.random.default_rng(1)
GRADIENTS = torch.tensor(np.eye(3) + 0.15 * RNG.normal(size=(5, 3, 3)))


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def variable(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone().requires_grad_()


# ---- materials --------------------------------------------------------------------------------------------------------


class Given(TorchMaterial):
    def __init__(self, E, nu, law=None):
        super().__init__()
        self.E, self.nu = E, nu
        self.material = law or self.material


@pytest.mark.parametrize("law", [None, SmithNeoHookean])
@pytest.mark.parametrize(
    "E, nu", [(2.0, 0.3), (RNG.uniform(1, 2, 5), RNG.uniform(0.1, 0.4, 5)), (2.0, RNG.uniform(0.1, 0.4, 5))]
)
def test_gradcheck_of_energy_density(law, E, nu):
    def energy(F, E, nu):
        return Given(E, nu, law).energy_density(F)

    assert gradcheck(energy, (variable(GRADIENTS), variable(E), variable(nu)), **GATE)


def test_energy_density_is_the_formula():
    material = DifferentiableMaterial(2.0, 0.3)
    F = GRADIENTS
    J, squares = torch.linalg.det(F), (F**2).sum((1, 2))
    formula = material.mu / 2 * (squares - 3) - material.mu * J.log() + material.lam / 2 * (J - 1) ** 2
    assert torch.allclose(material.energy_density(F), formula, rtol=1e-13)
    assert float(material.mu.detach()) == pytest.approx(2 / 2.6)
    assert float(material.lam.detach()) == pytest.approx(0.6 / (1.3 * 0.4))
    inverted = torch.diag(torch.tensor([-0.5, 1.0, 1.0]))[None]
    assert torch.isfinite(material.energy_density(inverted)).all()


def test_energy_density_refuses_second_derivatives():
    material, F = DifferentiableMaterial(2.0, 0.3), variable(GRADIENTS)
    (P,) = torch.autograd.grad(material.energy_density(F).sum(), F, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        P.sum().backward()


def test_energy_density_of_non_contiguous_and_float32():
    material = DifferentiableMaterial(2.0, 0.3)
    turned = GRADIENTS.transpose(1, 2).contiguous().transpose(1, 2)
    assert not turned.is_contiguous() and torch.equal(
        material.energy_density(turned), material.energy_density(GRADIENTS)
    )
    double = material.energy_density(GRADIENTS)
    single = material.float().energy_density(GRADIENTS.float())
    assert single.dtype == torch.float32 and torch.allclose(single.double(), double, rtol=1e-4)


def test_spellings_of_materials():
    for m in (
        DifferentiableMaterial(8e4, 0.4),
        DifferentiableMaterial(E=8e4, nu=0.4),
        DifferentiableMaterial(youngs_modulus=8e4, poissons_ratio=0.4),
    ):
        assert m.E.item() == 8e4 and m.nu.item() == 0.4 and set(m.state_dict()) == {"E", "nu"}
    assert not DifferentiableMaterial(8e4, 0.4, requires_grad=False).E.requires_grad


def test_grid_of_control_values_is_trilinear_and_clamped():
    mesh = TetrahedralMesh.create_cube(4, 2.0)
    material = SpatiallyVaryingMaterial(base_E=1e5, base_nu=0.4, grid_resolution=(3, 2, 4), E_range=(5e4, 2e5))
    assert [name for name, _ in material.named_parameters()] == ["control"]
    corners = torch.cartesian_prod(*(torch.linspace(0, 2, n) for n in (3, 2, 4))).reshape(3, 2, 4, 3)
    slope = torch.tensor([1e4, 2e4, -5e3])
    with torch.no_grad():
        material.control.copy_(1e5 + corners @ slope)  # a linear field is interpolated exactly
    E = material.tensors(mesh)["youngs_modulus"]
    assert torch.allclose(E, 1e5 + torch.tensor(mesh.centroids) @ slope, rtol=1e-12)
    assert gradcheck(
        lambda c: torch.func.functional_call(Moduli(material, mesh), {"material.control": 1e5 * c}, ()) / 1e5,
        variable(material.control.detach() / 1e5),
        **GATE,
    )
    with torch.no_grad():
        material.control.fill_(1e9)
    assert torch.all(material.tensors(mesh)["youngs_modulus"] == 2e5)


class Moduli(torch.nn.Module):
    def __init__(self, material, mesh):
        super().__init__()
        self.material, self.mesh = material, mesh

    def forward(self):
        return self.material.tensors(self.mesh)["youngs_modulus"]


# ---- contact ----------------------------------------------------------------------------------------------------------


def test_barrier_derivatives_and_continuity():
    wide = DifferentiableBarrierContact(1.0, 10.0)
    d = variable([-5.0, 2e-3, 1.5e-2, 1.0, 5.0, 9.9, 20.0])
    assert gradcheck(wide.barrier_potential, d, **GATE) and gradgradcheck(wide.barrier_potential, d)
    contact = DifferentiableBarrierContact(10.0, 0.1)
    for at in (0.1, 1e-4):  # C2 at the width and where the polynomial begins
        values = []
        for side in (-1, 1):
            x = variable(at * (1 + side * 1e-9))
            value = contact.barrier_potential(x)
            (slope,) = torch.autograd.grad(value, x, create_graph=True)
            (curvature,) = torch.autograd.grad(slope, x)
            values.append([v.item() for v in (value, slope, curvature)])
        assert np.allclose(*values, rtol=1e-6, atol=1e-6)
    assert contact.barrier_potential(torch.tensor([0.1, 3.0])).tolist() == [0.0, 0.0]
    exact = -10.0 * (0.03 - 0.1) ** 2 * np.log(0.3)
    assert contact.barrier_potential(torch.tensor(0.03)).item() == pytest.approx(exact, rel=1e-14)


def test_friction_of_the_formula():
    """Coulomb's law beyond the friction speed, a smooth way there, nothing at rest; derivatives by everything."""
    floor = dict(ground_height=0.0, barrier_stiffness=1e3, barrier_distance=0.1)
    x = torch.full((4, 3), 0.05)
    v = torch.tensor([[0.0, 1.0, 0.0], [3.0, -5.0, 4.0], [0.005, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    contact = DifferentiableBarrierContact(**floor, friction=0.5, friction_speed=0.01)
    force = contact.compute_forces(x, v)
    push = force[0, 1].item()
    assert force[:, 1].allclose(force[0, 1]) and push > 0 and not force[0, [0, 2]].any()
    assert force[1, [0, 2]].allclose(-0.5 * push * torch.tensor([0.6, 0.8])) and force[3, 0].item() == 0.5 * push
    assert force[2, 0].item() == pytest.approx(-0.5 * push * 0.75)
    assert torch.equal(contact.compute_forces(x), DifferentiableBarrierContact(**floor).compute_forces(x, v))

    def by_numbers(x, v, mu, eps, kappa):
        numbers = dict(barrier_stiffness=kappa, barrier_distance=0.1, friction=mu, friction_speed=eps)
        return DifferentiableBarrierContact(**numbers).compute_forces(x, v)

    at = (x, v[1:].repeat(2, 1)[:4], 0.5, 0.01, 1e3)
    assert gradcheck(by_numbers, tuple(variable(a) for a in at), **GATE)


def test_contact_forces():
    contact = DifferentiableBarrierContact(ground_height=-1.0, barrier_stiffness=1e3, barrier_distance=0.1)
    x = torch.tensor([[0.0, -0.95, 0.0], [1.0, -0.5, 2.0], [0.0, -1.01, 0.0]])
    force = contact.compute_forces(x, torch.zeros_like(x))
    assert force[0, 1] > 0 and force[2, 1] > force[0, 1] and not force[1].any() and not force[:, [0, 2]].any()
    assert not force.requires_grad
    assert gradcheck(lambda x: contact.ground_contact_force(x, None), variable(x), **GATE)

    def by_numbers(height, kappa, width):
        return DifferentiableBarrierContact(kappa, width, ground_height=height).compute_forces(x)

    assert gradcheck(by_numbers, tuple(variable(v) for v in (-1.03, 2.0, 0.1)), **GATE)
    ground = contact.term()
    assert isinstance(ground, Ground) and ground.values["ground_height"] == -1.0


# ---- implicit differentiation, conjugate gradients --------------------------------------------------------------------

MATRIX = torch.tensor(np.eye(6) * 4 + RNG.normal(size=(6, 6)))  # not symmetric


def newton(residual, x, params):
    for _ in range(50):
        J = torch.autograd.functional.jacobian(lambda y: residual(y, *params), x).reshape(x.numel(), -1)
        x = x - torch.linalg.solve(J, residual(x, *params).reshape(-1)).reshape(x.shape)
    return x.detach()


def cubic(x, a, b):
    """Six equations for x of shape (2, 3), not symmetric, not linear."""
    return (MATRIX @ x.reshape(-1)) + 0.3 * x.reshape(-1) ** 3 - a * torch.sin(b)


def solution(a, b, **options):
    x = newton(cubic, torch.zeros(2, 3), (a.detach(), b.detach()))
    return ImplicitDifferentiation.implicit_backward(cubic, x, (a, b), **{"atol": 1e-13} | options)


def test_gradcheck_of_implicit_differentiation():
    inputs = (variable(1.3), variable(RNG.normal(size=6)))
    assert gradcheck(solution, inputs, **GATE)


def test_implicit_differentiation_in_the_seeds_words():
    """forward_fn(x, params) with one tensor; the gradient of a small loss is as right as that of a large one."""
    p = variable([2.0, 3.0])
    A = torch.tensor([[3.0, 1.0], [0.0, 2.0]])
    exact = torch.linalg.solve(A.T, torch.ones(2)) * 2 * p.detach()
    for scale in (1.0, 1e-12):
        x = ImplicitDifferentiation.implicit_backward(
            lambda x, p: A @ x - p**2, torch.linalg.solve(A, p.detach() ** 2), p
        )
        (gradient,) = torch.autograd.grad(scale * x.sum(), p)
        assert torch.allclose(gradient, scale * exact, rtol=1e-6, atol=0)
    x = ImplicitDifferentiation.implicit_backward(lambda x, _: A @ x - p**2, x.detach(), p)  # p by closure
    assert torch.allclose(torch.autograd.grad(x.sum(), p)[0], exact)


def test_implicit_differentiation_of_intermediate_and_constant_parameters():
    a, b = variable(0.7), torch.tensor(RNG.normal(size=6))
    assert gradcheck(lambda a: solution(a**2, b), a, **GATE)
    assert solution(a, b).requires_grad and not solution(a.detach(), b).requires_grad


def test_implicit_differentiation_of_an_explicit_equation():
    """dF/dx = 1, so that autograd hands GMRES its own vectors back."""
    assert gradcheck(
        lambda p: ImplicitDifferentiation.implicit_backward(lambda x, p: x - p**2, p.detach() ** 2, p),
        variable([1.0, 2.0, 3.0]),
        **GATE,
    )


def test_implicit_differentiation_refuses():
    p, x = variable(1.0), torch.zeros(2)
    with pytest.raises(RuntimeError, match="GMRES did not reach .* singular"):
        ImplicitDifferentiation.implicit_backward(lambda x, p: x.sum() * p * torch.ones(2), x, p)[0].backward()
    with pytest.raises(ValueError, match="square: 2 unknowns, but 1 equations"):
        ImplicitDifferentiation.implicit_backward(lambda x, p: (x.sum() - p)[None], x, p).sum().backward()
    with pytest.raises(ValueError, match="does not depend on one of params"):
        ImplicitDifferentiation.implicit_backward(lambda x, p: x - 1, torch.ones(2), p).sum().backward()
    y = ImplicitDifferentiation.implicit_backward(lambda x, p: x**2 - p, torch.ones(1), p)
    (g,) = torch.autograd.grad(y.sum(), p, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        g.backward()


def test_conjugate_gradient():
    A = MATRIX @ MATRIX.T
    b = torch.tensor(RNG.normal(size=6))
    x = conjugate_gradient(lambda v: A @ v, b, atol=1e-10)
    assert (A @ x - b).norm() <= 1e-9 and torch.allclose(x, torch.linalg.solve(A, b), atol=1e-8)
    assert torch.equal(conjugate_gradient(lambda v: A @ v, b, x0=x, atol=1e-8), x)
    shaped = conjugate_gradient(lambda v: (A @ v.reshape(-1)).reshape(2, 3), b.reshape(2, 3), atol=1e-10)
    assert torch.allclose(shaped.reshape(-1), x)
    with pytest.warns(UserWarning, match=r"did not converge: \|b - A x\| = .* after 2 iterations"):
        conjugate_gradient(lambda v: A @ v, b, max_iters=2, atol=1e-12)
    with pytest.warns(UserWarning, match="not positive definite"):
        conjugate_gradient(lambda v: -v, b)
    assert not conjugate_gradient(lambda v: A @ v, torch.zeros(6)).any()


def test_gradcheck_of_conjugate_gradient():
    def solve(s, b):
        A = MATRIX @ MATRIX.T + s * torch.eye(6)
        return conjugate_gradient(lambda v: A @ v, b, atol=1e-12)

    assert gradcheck(solve, (variable(1.0), variable(RNG.normal(size=6))), **GATE)


# ---- checkpointed rollouts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 4, 10, 100])
def test_checkpointed_rollout_of_any_step_function(every):
    W = variable(0.3 * RNG.normal(size=(3, 3)))

    def run(W, s0):
        states = CheckpointedRollout.rollout(lambda s: torch.tanh(s @ W), s0, 10, every)
        assert len(states) == 11
        return torch.stack(states)

    s0 = variable(RNG.normal(size=3))
    assert gradcheck(run, (W, s0), **GATE)
    plain = s0
    for _ in range(10):
        plain = torch.tanh(plain @ W)
    assert torch.equal(run(W, s0)[-1], plain)


def test_checkpointed_rollout_of_pairs_and_of_nothing():
    x, v = variable([1.0]), variable([0.0])
    states = CheckpointedRollout.rollout(lambda s: (s[0] + 0.1 * s[1], s[1] - 0.1 * s[0]), (x, v), 7, 3)
    assert len(states) == 8 and all(len(s) == 2 for s in states)
    assert torch.autograd.grad(states[-1][0], (x, v))[0].shape == (1,)
    assert CheckpointedRollout.rollout(lambda s: s, x, 0)[0] is x
    with pytest.raises(ValueError, match="checkpoint_every >= 1"):
        CheckpointedRollout.rollout(lambda s: s, x, 3, 0)


def test_checkpointed_rollout_of_a_simulator():
    mesh, results = TetrahedralMesh.create_cube(2, 0.5), []
    for every in (3, 10, None):
        solver = DifferentiableSolver(dt=0.01, damping=0.98)
        simulator = DifferentiableSimulator(mesh, DifferentiableMaterial(1e5, 0.3), solver)
        if every:
            final = CheckpointedRollout(simulator, checkpoint_every=every)(num_steps=20)
        else:
            for _ in range(20):
                simulator.step()
            final = simulator.positions
        (gradient,) = torch.autograd.grad((final**2).sum(), simulator.material.E)
        results.append((final.detach(), gradient))
    assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1], results[1][1])  # bitwise
    assert torch.allclose(results[0][0], results[2][0], rtol=1e-12)
    assert torch.allclose(results[0][1], results[2][1], rtol=1e-9)


# ---- smooth functions -------------------------------------------------------------------------------------------------


def test_smooth_step():
    x = variable(np.linspace(-1.3, 2.3, 14))
    assert gradcheck(lambda x: smooth_step(x, edge=0.5, width=1.7), x, **GATE)
    values = smooth_step(torch.tensor([-9.0, 0.5, 9.0]), edge=0.5, width=2.0)
    assert values.tolist() == [0.0, 0.5, 1.0]
    rising = smooth_step(torch.linspace(-1, 1, 101))
    assert torch.all(rising.diff() >= 0) and torch.allclose(rising + rising.flip(0), torch.ones(101))


def test_log_barrier():
    x = variable([-0.5, 0.0, 5e-4, 9e-4, 1.1e-3, 0.3, 4.0])
    assert gradcheck(log_barrier, x, eps=1e-8, atol=1e-6, rtol=1e-5)  # its curvature is 1 / eps^2: finer differences
    assert gradcheck(lambda x: log_barrier(x, eps=0.1), x, **GATE) and gradgradcheck(lambda x: log_barrier(x, 0.1), x)
    assert torch.equal(log_barrier(x[-2:]), -torch.log(x[-2:]))
    below, above = variable(0.1 - 1e-12), variable(0.1 + 1e-12)
    slopes = [torch.autograd.grad(log_barrier(v, 0.1), v)[0] for v in (below, above)]
    assert torch.allclose(*slopes, rtol=1e-9)
    assert torch.isfinite(log_barrier(torch.tensor([-10.0, 0.0]))).all()
