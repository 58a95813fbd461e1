"""Every code block of the seeds' two documents, as written but for the package's name, and what one of them is worth.

Undefined names get their obvious meaning: `compute_loss` is a squared distance, the visualiser shows the simulated mesh.
"""

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

import diffsim_ti as ds
from diffsim_ti import TetrahedralMesh
from diffsim_ti.common import answers
from diffsim_ti.diff_physics import DifferentiableMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
from diffsim_ti.visualizer import SimulationVisualizer

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
    for contact, floor, start in ((names["contact"], -1.0, mesh.translated((0, -0.98, 0))), ("ground", -0.01, mesh)):
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


# ---- every name that these documents and the pages of the same system teach ----------------------------------------------

HERE = {  # of the package and of its modules: what is there
    "diffsim_ti": "TetrahedralMesh StableNeoHookean SemiImplicitSolver Simulator DifferentiableBarrierContact "
    "ImplicitDifferentiation CheckpointedRollout DifferentiableMaterial SpatiallyVaryingMaterial DifferentiableSolver "
    "DifferentiableSimulator smooth_step log_barrier conjugate_gradient",
    "diffsim_ti.diff_physics": "DifferentiableBarrierContact ImplicitDifferentiation conjugate_gradient smooth_step "
    "CheckpointedRollout DifferentiableMaterial SpatiallyVaryingMaterial log_barrier",
    "diffsim_ti.diff_simulator": "DifferentiableSolver DifferentiableSimulator",
    "diffsim_ti.visualizer": "SimulationVisualizer",
}
ATTRIBUTES = {  # of an object: what is there
    "mesh": "vertices tetrahedra num_vertices num_tetrahedra num_elements rest_volume compute_deformation_gradient "
    "_compute_rest_state create_cube from_file load_from_msh",
    "simulator": "positions velocities time solver step reset compute_energy",
    "semi_implicit": "dt substeps positions set_fixed_vertices",
    "learnable": "E nu mu lam energy_density parameters to",
    "varying": "log_E E nu mu lam energy_density",
    "solver": "dt gravity damping substeps",
    "differentiable": "mesh material solver device positions velocities fixed_vertices time step rollout reset "
    "set_fixed_vertices",
    "contact": "kappa d_hat barrier_potential ground_contact_force compute_forces",
    "visualizer": "update show",
}
OWNERS = {  # of a table of answers: an object that it is for
    "SeedNames": "mesh",
    "Material": "material",
    "SemiImplicitSolver": "semi_implicit",
    "Simulator": "simulator",
    "DifferentiableSimulator": "differentiable",
    "DifferentiableSolver": "solver",
    "SimulationVisualizer": "visualizer",
}
ARGUMENTS = {  # that those pages teach and that are answered
    ds.SemiImplicitSolver: "enable_self_collision collision_method",
    ds.Simulator: "density device use_compile",
    DifferentiableSolver: "use_implicit_diff",
}


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """An object of each kind, made as those pages make them."""
    mesh = TetrahedralMesh.create_cube(resolution=2, size=0.5, device="cpu")
    file = tmp_path_factory.mktemp("mesh") / "cube.msh"
    mesh.save(file)
    mesh, material = (
        TetrahedralMesh.from_file(file, device="cpu"),
        ds.StableNeoHookean(youngs_modulus=1e5, poissons_ratio=0.45),
    )
    semi_implicit = ds.SemiImplicitSolver(dt=0.01, gravity=-9.8, damping=0.9, substeps=4)
    semi_implicit.set_fixed_vertices(mesh.vertex_indices("ymin"))
    learnable, solver = DifferentiableMaterial(1e5, 0.4), DifferentiableSolver(dt=0.01, gravity=-9.8, damping=0.98)
    return dict(
        mesh=mesh,
        material=material,
        semi_implicit=semi_implicit,
        simulator=ds.Simulator(mesh, material, semi_implicit),
        learnable=learnable,
        varying=ds.SpatiallyVaryingMaterial(mesh.num_elements, base_youngs=1e5, base_poisson=0.4),
        solver=solver,
        differentiable=DifferentiableSimulator(mesh, learnable, solver, density=1000.0, device="cpu"),
        contact=ds.DifferentiableBarrierContact(barrier_stiffness=1e4, barrier_width=0.01),
        visualizer=SimulationVisualizer(mesh),
    )


def test_every_name_is_there_or_is_answered(taught):
    for module, names in HERE.items():
        assert all(callable(getattr(import_module(module), name)) for name in names.split())
    for owner, names in ATTRIBUTES.items():
        assert [name for name in names.split() if not hasattr(taught[owner], name)] == []
    assert answers.ANSWERS.keys() == OWNERS.keys() | {"diffsim_ti"}
    for table, owner in [*OWNERS.items(), ("diffsim_ti", None)]:
        for name, said in answers.ANSWERS[table].items():
            with pytest.raises(AttributeError, match=re.escape(f"has no {name!r}: {said}")):
                getattr(ds if owner is None else taught[owner], name)
    for kind, names in ARGUMENTS.items():
        for name in names.split():
            with pytest.raises(TypeError, match=f"{kind.__name__} has no argument '{name}': "):
                kind(**{name: True})
    with pytest.raises(AttributeError, match="'Simulator' object has no attribute 'nothing'"):
        taught["simulator"].nothing  # noqa: B018


def test_what_the_answers_say_works(taught):
    """Followed literally, as far as they are expressions."""
    mesh, material, simulator = taught["mesh"], taught["material"], taught["simulator"]
    before = simulator.velocities
    simulator.set_state(velocities=simulator.velocities + [0.0, 0.1, 0.0])
    free = np.setdiff1d(np.arange(8), simulator.scene.fixed)
    np.testing.assert_allclose((simulator.velocities - before)[free, 1], 0.1, rtol=1e-6)
    assert np.array_equal(simulator.scene.fixed, mesh.vertex_indices("ymin"))
    assert simulator.scene.mass_matrix().diagonal()[::3].sum() == pytest.approx(125.0)
    assert simulator.positions[simulator.scene.mesh.surface_triangles].shape == (12, 3, 3)
    assert simulator.solver.scene.inputs.values["gravity"][1] == -9.8
    assert material.lame(material.values(mesh))[0] == pytest.approx(1e5 / 2.9)
    scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="ymin")
    ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-4)).step()
    outputs = [ds.Stress(kind="first_piola")]
    assert ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 1, outputs=outputs).forward()["stress"].shape == (
        2,
        6,
        3,
        3,
    )
    with pytest.raises(RuntimeError, match="before Simulator"):
        simulator.solver.set_fixed_vertices("ymax")
    with pytest.raises(ValueError, match="give it fixed="):
        ds.SemiImplicitSolver(scene, dt=1e-4).set_fixed_vertices("ymax")


def test_damping_and_energies_as_taught(taught):
    """The share of velocity kept over one dt; and the energy whose gradient the pages show."""
    mesh = taught["mesh"]
    solver = ds.SemiImplicitSolver(mesh, taught["material"], dt=0.01, gravity=0.0, damping=0.9)
    simulator = ds.Simulator(solver)
    simulator.set_state(velocities=np.tile([1.0, 0.0, 0.0], (8, 1)))
    simulator.step()
    np.testing.assert_allclose(simulator.velocities[:, 0], 0.9, rtol=1e-5)
    material = taught["learnable"]
    stretch = torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64)
    x = (torch.tensor(mesh.vertices.copy()) * stretch).requires_grad_()
    F = mesh.compute_deformation_gradient(x)
    np.testing.assert_allclose(F.detach()[0], np.diag(stretch), atol=1e-12)
    np.testing.assert_allclose(mesh.compute_deformation_gradient(x.detach().numpy()), F.detach(), atol=1e-12)
    energy = torch.sum(material.energy_density(F) * mesh.rest_volume)
    energy.backward()
    mu, lam = material.mu.item(), material.lam.item()
    exact = mu / 2 * (1.1**2 - 1) - mu * np.log(1.1) + lam / 2 * 0.1**2
    assert energy.item() == pytest.approx(0.125 * exact, rel=1e-5)
    by_stretch = 0.125 * (mu * 1.1 - mu / 1.1 + lam * 0.1) / 0.5  # the force on a side of 0.5 m
    assert x.grad[mesh.vertices[:, 0] > 0.4, 0].sum().item() == pytest.approx(by_stretch, rel=1e-5)
    with pytest.raises(ValueError, match="F varies within ten-node tetrahedra"):
        mesh.quadratic().compute_deformation_gradient(x)


def test_supports_of_a_differentiable_simulator(taught):
    simulator = taught["differentiable"]
    simulator.set_fixed_vertices("ymax")
    simulator.reset()
    simulator.step()
    assert simulator.time == pytest.approx(0.01)
    moved = simulator.positions.detach().numpy() - taught["mesh"].vertices
    top = taught["mesh"].vertices[:, 1] > 0.4
    assert np.all(moved[top] == 0) and np.all(moved[~top, 1] < 0)
    with pytest.warns(DeprecationWarning, match=r"contact=None\) is called contact=\"ground\";"):
        old = DifferentiableSimulator(taught["mesh"], taught["learnable"], taught["solver"], contact=None)
    assert "Ground(ground_height=-0.01" in old.describe()


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
