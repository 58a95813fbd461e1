"""A learned material: a network maps the rest position of a tetrahedron to its stiffness, trained through the simulator.

The truth is a beam whose stiffness waves along it and falls across it. The network sees one motion (swinging from one end)
and is judged on its field and on another motion (thrown sideways) that it has not seen.

    python examples/identify/learned_material.py
"""

import math
from pathlib import Path

import numpy as np
import torch

import diffsim_ti as ds
from diffsim_ti.optimization import Optimization
from diffsim_ti.picture import save_picture


class NetworkMaterial(torch.nn.Module):
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

    def forward(self) -> torch.Tensor:
        """Young's modulus of each tetrahedron [Pa]."""
        return 1e5 * torch.exp(2 * torch.tanh(self.network(self.at)[:, 0]))


def main(folder="output", iterations: int = 30, seed: int = 0) -> dict:
    torch.manual_seed(seed)
    mesh = ds.TetrahedralMesh.create_box([7, 4, 4], [0.6, 0.3, 0.3])
    x, y, _ = mesh.centroids.T
    truth = torch.from_numpy(np.log(1e5) + 0.7 * np.cos(2 * np.pi * x / 0.6) - 1.5 * (y - 0.15))
    material = NetworkMaterial(mesh)
    terms, law = [ds.Gravity(-9.8), ds.Drag(3.0)], ds.StableNeoHookean(truth.exp().numpy(), 0.3)
    scene = ds.Scene(mesh, law, terms=terms, fixed="xmin", precision="f64")
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=0.01, substeps=12), 25, save_every=5)
    swing, thrown = torch.zeros(mesh.num_vertices, 3).double(), torch.zeros(mesh.num_vertices, 3).double()
    thrown[:, 2] = 2 * torch.from_numpy(mesh.vertices[:, 0].copy())

    def motion(E, velocities):
        return ds.rollout_frames(rollout, youngs_modulus=E, initial_velocities=velocities).displacements

    with torch.no_grad():
        measured, unseen = motion(truth.exp(), swing), motion(truth.exp(), thrown)

    def relative(found, exact):
        return (found - exact).square().mean() / exact.square().mean()

    def loss():
        return 1e3 * relative(motion(material(), swing), measured)

    before = math.sqrt(relative(motion(material(), thrown), unseen).item())
    optimizer = torch.optim.LBFGS(material.parameters(), max_iter=5, history_size=20, line_search_fn="strong_wolfe")
    optimization = Optimization(material, optimizer, mesh, folder and Path(folder) / "learned_material.state")
    optimization.run(loss, iterations)
    optimization.restore_best()
    with torch.no_grad():
        error = (material().log() - truth).abs()
        after = math.sqrt(relative(motion(material(), thrown), unseen).item())
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
        bent, E = mesh.vertices + unseen[-1].numpy(), material().detach().numpy()
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
