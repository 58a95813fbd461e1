"""A stiffness field from displacements: which tetrahedra of a beam are the stiff ones?

A beam with a stiff middle hangs from one end and swings; the displacements of all vertices are measured with noise in some
frames. log E of every tetrahedron is free, so that neighbours must be told to agree: the penalty is the jump of log E across
each inner face, weighted by its area (total variation, which leaves sharp edges sharp).

    python examples/identify/stiffness_field.py
"""

from pathlib import Path

import numpy as np
import torch

from diffsim_ti import TetrahedralMesh
from diffsim_ti.diff_physics import SpatiallyVaryingMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
from diffsim_ti.optimization import Optimization
from diffsim_ti.picture import save_picture

SOFT, STIFF, NOISE = 5e4, 2e5, 2e-5


def inner_faces(mesh) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs of tetrahedra that share a face, shape (k, 2), and the areas of those faces over their mean."""
    corners = mesh.tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    order = np.lexsort(np.sort(corners, 1).T)
    same = np.all(np.diff(np.sort(corners, 1)[order], axis=0) == 0, 1)
    first, second = order[:-1][same], order[1:][same]
    a, b, c = np.moveaxis(mesh.vertices[corners[first]], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return torch.from_numpy(np.stack([first // 4, second // 4], 1)), torch.from_numpy(areas / areas.mean())


def main(folder="output", iterations: int = 25, cells=(8, 3, 3), weight: float = 3e-6) -> dict:
    mesh = TetrahedralMesh.create_box([c + 1 for c in cells], [0.8, 0.3, 0.3])
    solver = DifferentiableSolver(dt=0.01, gravity=[0.0, -9.8, 3.0], damping=0.97, substeps=8)
    stiff = np.abs(mesh.centroids[:, 0] - 0.35) < 0.15
    truth = torch.from_numpy(np.where(stiff, np.log(STIFF), np.log(SOFT)))
    material = SpatiallyVaryingMaterial(mesh.num_tetrahedra, 1e5, 0.3).double()
    material.nu.requires_grad_(False)
    simulator = DifferentiableSimulator(mesh, material, solver, fixed_vertices="xmin", contact=False)

    def motion():
        simulator.reset()
        return simulator.rollout(30, save_every=5).displacements

    with torch.no_grad():
        start = material.log_E.clone()
        material.log_E.copy_(truth)
        exact = motion()
        noise = NOISE * torch.from_numpy(np.random.default_rng(0).standard_normal(exact.shape))
        measured = exact + noise
        material.log_E.copy_(start)
    pairs, areas = inner_faces(mesh)

    def loss():
        fit = (motion() - measured).square().mean() / exact.square().mean()
        jumps = material.log_E[pairs[:, 0]] - material.log_E[pairs[:, 1]]
        return 1e3 * (fit + weight * (areas * (jumps**2 + 1e-3).sqrt()).mean())

    optimizer = torch.optim.LBFGS([material.log_E], max_iter=10, history_size=30, line_search_fn="strong_wolfe")
    optimization = Optimization(material, optimizer, mesh, folder and Path(folder) / "stiffness_field.state")
    optimization.run(loss, iterations)
    optimization.restore_best()
    error = (material.log_E.detach() - truth).abs()
    found = (material.log_E.detach() > 0.5 * np.log(SOFT * STIFF)).numpy()
    result = dict(
        median_error=error.median().item(),
        worst_tenth=error.quantile(0.9).item(),
        classified=float((found == stiff).mean()),
        start_error=(start - truth).abs().median().item(),
        loss=optimization.best_loss,
        iterations=iterations,
        seconds=optimization.seconds,
    )
    print(
        f"stiffness field of {mesh.num_tetrahedra} tetrahedra: " + ", ".join(f"{k} {v:.4g}" for k, v in result.items())
    )
    if folder:
        Path(folder).mkdir(exist_ok=True)
        save_picture(
            Path(folder) / "stiffness_field.png",
            mesh,
            mesh.vertices,
            material.E.detach().numpy(),
            "Young's modulus [Pa]",
            title="recovered from noisy displacements",
        )
    return result


if __name__ == "__main__":
    main()
