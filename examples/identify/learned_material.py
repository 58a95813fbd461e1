"""A learned material: a network maps the rest position of a tetrahedron to its stiffness, trained through the simulator.

The truth is a beam whose stiffness waves along it and falls across it. The network sees one motion (swinging from one end)
and is judged on its field and on another motion (thrown sideways) that it has not seen.

    python examples/identify/learned_material.py
"""

import math
from pathlib import Path

import numpy as np
import torch

from diffsim_ti import TetrahedralMesh
from diffsim_ti.diff_physics import SpatiallyVaryingMaterial, TorchMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
from diffsim_ti.optimization import Optimization
from diffsim_ti.picture import save_picture


class NetworkMaterial(TorchMaterial):
    """E = 1e5 exp(2 tanh(network(centroid))): always within a factor of 7.4 of 1e5 Pa."""

    def __init__(self, mesh, width: int = 24):
        super().__init__()
        low, high = mesh.bounding_box
        self.register_buffer("at", torch.from_numpy(2 * (mesh.centroids - low) / (high - low) - 1))
        self.network = torch.nn.Sequential(
            torch.nn.Linear(3, width),
            torch.nn.Tanh(),
            torch.nn.Linear(width, width),
            torch.nn.Tanh(),
            torch.nn.Linear(width, 1),
        ).double()
        self.nu = torch.tensor(0.3, dtype=torch.float64)

    @property
    def E(self):
        return 1e5 * torch.exp(2 * torch.tanh(self.network(self.at)[:, 0]))


def main(folder="output", iterations: int = 30, seed: int = 0) -> dict:
    torch.manual_seed(seed)
    mesh = TetrahedralMesh.create_box([7, 4, 4], [0.6, 0.3, 0.3])
    x, y, _ = mesh.centroids.T
    truth = torch.from_numpy(np.log(1e5) + 0.7 * np.cos(2 * np.pi * x / 0.6) - 1.5 * (y - 0.15))
    real = SpatiallyVaryingMaterial(mesh.num_tetrahedra, 1e5, 0.3).double()
    with torch.no_grad():
        real.log_E.copy_(truth)
    material = NetworkMaterial(mesh)

    def simulator(law):
        solver = DifferentiableSolver(dt=0.01, gravity=[0.0, -9.8, 0.0], damping=0.97, substeps=12)
        return DifferentiableSimulator(mesh, law, solver, fixed_vertices="xmin", contact=False)

    swing, thrown = torch.zeros(mesh.num_vertices, 3).double(), torch.zeros(mesh.num_vertices, 3).double()
    thrown[:, 2] = 2 * torch.from_numpy(mesh.vertices[:, 0].copy())

    def motion(simulator, velocities):
        simulator.reset(velocities=velocities)
        return simulator.rollout(25, save_every=5).displacements

    ours, theirs = simulator(material), simulator(real)
    with torch.no_grad():
        measured, unseen = motion(theirs, swing), motion(theirs, thrown)

    def relative(found, exact):
        return (found - exact).square().mean() / exact.square().mean()

    def loss():
        return 1e3 * relative(motion(ours, swing), measured)

    before = math.sqrt(relative(motion(ours, thrown), unseen).item())
    optimizer = torch.optim.LBFGS(material.parameters(), max_iter=5, history_size=20, line_search_fn="strong_wolfe")
    optimization = Optimization(material, optimizer, mesh, folder and Path(folder) / "learned_material.state")
    optimization.run(loss, iterations)
    optimization.restore_best()
    with torch.no_grad():
        error = (material.E.log() - truth).abs()
        after = math.sqrt(relative(motion(ours, thrown), unseen).item())
    result = dict(
        median_error=error.median().item(),
        unseen_motion_error=after,
        unseen_motion_error_before=before,
        loss=optimization.best_loss,
        iterations=iterations,
        seconds=optimization.seconds,
    )
    print(
        f"learned material on {mesh.num_tetrahedra} tetrahedra: " + ", ".join(f"{k} {v:.4g}" for k, v in result.items())
    )
    if folder:
        Path(folder).mkdir(exist_ok=True)
        bent, E = mesh.vertices + unseen[-1].numpy(), material.E.detach().numpy()
        save_picture(
            Path(folder) / "learned_material.png",
            mesh,
            bent,
            E,
            "Young's modulus [Pa]",
            title="stiffness from a network, in a motion it has not seen",
        )
    return result


if __name__ == "__main__":
    main()
