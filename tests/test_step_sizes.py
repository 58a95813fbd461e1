"""Optimisers of torch materials: steps of each number's size, ranges with a way back, refusals before the first run."""

import pytest
import torch

from diffsim_ti import TetrahedralMesh
from diffsim_ti.diff_physics import DifferentiableMaterial, SpatiallyVaryingMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
from diffsim_ti.optimization import Optimization

MESH = TetrahedralMesh.create_cube(2, 0.5)


def losses(material, optimizer, iterations: int) -> list[float]:
    """Squared distance of a hanging cube from where a softer one hangs."""
    with torch.no_grad():
        target = simulator(DifferentiableMaterial(6e4, 0.3).double()).rollout(20).positions[-1]
    sim, out = simulator(material), []
    for _ in range(iterations):
        sim.reset()
        optimizer.zero_grad()
        loss = (sim.rollout(20).positions[-1] - target).square().mean()
        loss.backward()
        optimizer.step()
        out.append(loss.item())
    return out


def simulator(material):
    return DifferentiableSimulator(
        MESH, material, DifferentiableSolver(dt=0.01, substeps=4), fixed_vertices="ymin", contact=False
    )


def test_the_seeds_step_is_refused_before_the_first_run():
    material = DifferentiableMaterial(1e5, 0.4, requires_grad=True).double()
    optimizer = torch.optim.Adam(material.parameters(), lr=1e3)
    with pytest.raises(ValueError, match=r"moves nu by that much in each step.*material\.parameter_groups"):
        losses(material, optimizer, 1)
    assert material.nu.item() == pytest.approx(0.4) and material.E.item() == 1e5


def test_parameter_groups_run_fifty_iterations_and_lower_the_loss():
    material = DifferentiableMaterial(1e5, 0.4).double()
    groups = material.parameter_groups(relative=0.05)
    assert [group["lr"] for group in groups] == pytest.approx([5e3, 0.02])
    found = losses(material, torch.optim.Adam(groups), 50)
    assert len(found) == 50 and min(found) < 0.5 * found[0]
    with pytest.raises(ValueError, match="relative: a share between 0 and 1, got 2"):
        material.parameter_groups(2)


@pytest.mark.parametrize("outside, inside", [(6e5, 2e5), (1e4, 5e4)])
def test_a_grid_value_outside_its_range_is_led_back(outside, inside):
    material = SpatiallyVaryingMaterial(base_E=1e5, grid_resolution=(2, 2, 2), E_range=(5e4, 2e5))
    material.control.data.fill_(outside)
    sign = 1.0 if outside > inside else -1.0
    for way, expected in ((sign, True), (-sign, False)):
        material.control.grad = None
        E = material.youngs_modulus(MESH)
        (way * E).sum().backward()
        assert torch.all(E == inside) and bool(material.control.grad.abs().sum() > 0) is expected


def test_nu_outside_its_range_is_said_and_led_back():
    material = DifferentiableMaterial(1e5, 0.4)
    material.nu.data.fill_(0.7)
    with pytest.warns(UserWarning, match=r"Poisson's ratio has left \[-0.9, 0.49\]"):
        nu = material.tensors(MESH)["poissons_ratio"]
    nu.backward()
    assert nu.item() == pytest.approx(0.49) and material.nu.grad == 1


def test_clip_and_patience_of_an_optimization():
    module = torch.nn.Linear(1, 1, bias=False).double()
    module.weight.data.fill_(5.0)
    run = Optimization(module, torch.optim.SGD(module.parameters(), lr=1.0), MESH, clip=0.5, patience=3)
    run.run(lambda: module.weight.square().sum(), 100)
    # steps of half a unit to the minimum, where the gradient is zero and nothing falls any more
    assert run.losses[:3] == pytest.approx([25, 4.5**2, 16], rel=1e-4) and run.best_loss < 1e-6 and len(run.losses) < 30
