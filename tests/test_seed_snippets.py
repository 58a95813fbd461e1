"""Every code block of the seeds' two documents, as written but for the package's name, and what one of them is worth.

Undefined names get their obvious meaning: `compute_loss` is a squared distance, the visualiser shows the simulated mesh.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from diffsim_ti import TetrahedralMesh
from diffsim_ti.diff_physics import DifferentiableMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "tests" / "seed_snippets.md").read_text()
BLOCKS = dict(re.findall(r"^## (.+?)\n+```python\n(.*?)```", TEXT, re.S | re.M))
SUBSTEPS = "ignore:dt = .* is divided into"
pytestmark = pytest.mark.filterwarnings(SUBSTEPS)


@pytest.fixture(scope="module")
def names():
    """One namespace, filled as a reader would fill it, block by block."""
    return {"compute_loss": lambda positions: (positions**2).sum()}


def run(title: str, names: dict) -> None:
    exec(compile(BLOCKS[title], f"seed_snippets.md, {title}", "exec"), names)


def test_simple_simulation(names, capsys):
    run("Creating a Simple Simulation", names)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"Step {i}" for i in range(0, 100, 10)]
    energies = [float(line.split("=")[1]) for line in lines]
    # symplectic Euler in free fall: energy errs by g dt / 2 of the potential energy's change, half of g v t dt at most
    assert np.isfinite(energies).all()
    assert names["mesh"].num_vertices == 125 and names["mesh"].volume == pytest.approx(1.0)
    height = names["simulator"].solver.positions.mean(0)[1].item()
    assert height == pytest.approx(0.5 - 9.8 / 2 * (1 + 0.01 / names["simulator"].solver.substeps), rel=1e-4)


def test_custom_mesh(names, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)  # the block names its file from there
    run("Loading Custom Meshes", dict(names))
    assert re.fullmatch(r"Vertices: \d{3,}, Tetrahedra: \d{3,}\n", capsys.readouterr().out)


def test_visualization(names, caplog, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    run("Visualization", names)
    assert "picture written to output/simulation.png" in caplog.text
    assert (tmp_path / "output" / "simulation.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert not names["viz"].has_window and np.array_equal(names["viz"].positions.shape, (125, 3))
    with pytest.raises(ValueError, match=r"positions: expected shape \(125, 3\), got \(3,\)"):
        names["viz"].update(np.zeros(3))


def test_basic_differentiable_example(names, capsys):
    run("Basic Differentiable Example", names)
    assert "Gradient w.r.t. Young's modulus: " in capsys.readouterr().out
    E = names["material"].E
    assert torch.isfinite(E.grad) and E.grad != 0
    assert "Ground(ground_height=-0.01" in names["simulator"].describe()


def test_material_parameter_optimization(names, capsys):
    run("Material Parameter Optimization", names)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"Iter {i}" for i in range(0, 50, 10)]
    assert abs(names["material"].E.grad) > 0
    # Adam's eps swallows the gradient: fifty steps of "5e3" move E by half a per cent, and away from its 8e4 (see below)
    assert 2e5 < names["material"].E.item() < 2.02e5


def test_spatially_varying_materials(names):
    run("Spatially Varying Materials", names)
    parameters = list(names["spatial_material"].parameters())
    assert [tuple(p.shape) for p in parameters] == [(4, 4, 4)]  # so that Adam with lr = 1e3 means 1e3 Pa
    assert torch.all(names["spatial_material"].youngs_modulus(names["mesh"]) == 1e5)
    names["simulator"].step()
    (1e9 * names["simulator"].positions ** 2).sum().backward()
    before = parameters[0].detach().clone()
    names["optimizer"].step()
    assert 500 < (parameters[0] - before).abs().max() <= 1001
    names["simulator"].reset()


def test_memory_efficient_rollouts(names):
    run("Memory-Efficient Rollouts", names)
    assert torch.isfinite(names["loss"]) and names["spatial_material"].control.grad.abs().max() > 0
    kept = names["simulator"]._rollout(1000, False, 10, None).checkpoints
    assert kept.num_segments == 100


def test_contact_and_collision(names):
    run("Contact and Collision", names)
    assert names["contact_forces"].shape == names["positions"].shape
    assert (names["contact"].ground_height, names["contact"].kappa, names["contact"].d_hat) == (-1.0, 1e6, 0.01)
    # "automatically included": a contact handed to the simulator acts there, and so does the one it has by itself
    mesh, material = TetrahedralMesh.create_cube(2, 0.5), DifferentiableMaterial(1e5, 0.4)
    for contact, floor, start in ((names["contact"], -1.0, mesh.translated((0, -0.98, 0))), (None, -0.01, mesh)):
        simulator = DifferentiableSimulator(start, material, DifferentiableSolver(damping=0.9), contact=contact)
        simulator.rollout(100)
        assert floor < simulator.positions[:, 1].min() < floor + 0.01


def test_api_page_examples(names):
    run("DifferentiableMaterial (API page)", names)
    assert [tuple(p.shape) for p in names["material"].parameters()] == [(), ()]
    run("SpatiallyVaryingMaterial (API page)", names)
    assert names["material"].log_E.shape == names["material"].nu.shape == (names["mesh"].num_tetrahedra,)
    assert torch.allclose(names["material"].E, torch.tensor(1e5), rtol=1e-5)


def test_every_block_is_run():
    source = Path(__file__).read_text()
    assert len(BLOCKS) == TEXT.count("```python") == 10
    assert all(f'run("{title}"' in source for title in BLOCKS)


# ---- what the identification block can and cannot do ------------------------------------------------------------------


def loss_of(E: float, target=None, with_gradient=False):
    """The block's loss, in float64."""
    mesh = TetrahedralMesh.create_cube(resolution=4, size=0.5)
    material = DifferentiableMaterial(torch.tensor(E, dtype=torch.float64), 0.4)
    solver = DifferentiableSolver(dt=0.01, gravity=-9.8, damping=0.98, substeps=12)  # what the block's 2 are raised to
    simulator = DifferentiableSimulator(mesh, material, solver)
    simulator.rollout(20)
    if target is None:
        return simulator.positions.detach()
    loss = torch.mean((simulator.positions - target) ** 2)
    return (loss.item(), *torch.autograd.grad(loss, material.E)) if with_gradient else loss.item()


def test_gradient_of_the_identification_block():
    """Right, and far under Adam's eps of 1e-8; the loss is not monotone on the way."""
    target = loss_of(8e4)
    _, gradient = loss_of(2e5, target, with_gradient=True)
    differences = (loss_of(2e5 + 20, target) - loss_of(2e5 - 20, target)) / 40
    assert gradient.item() == pytest.approx(differences, rel=1e-6)
    assert gradient.item() == pytest.approx(-4.08e-11, rel=0.01)
    losses = [loss_of(E, target) for E in np.linspace(2e5, 8e4, 13)]
    assert losses[-1] == 0 and np.any(np.diff(losses) > 0)
