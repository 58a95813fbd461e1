"""E and nu from an ensemble of throws that processes share: how the work outgrows one machine.

Each process simulates its share; losses and gradients are summed in the order of throws, so the result has the same bits
on any number of processes. A process that dies is started again with the others, from the state of the last iteration.

    torchrun --nproc_per_node=2 --max-restarts=3 examples/identify/train_distributed.py
"""

import argparse
import json
import os
from pathlib import Path

import torch

import diffsim_ti as ds
from diffsim_ti.optimization import Optimization
from diffsim_ti.picture import save_picture

TRUE_E, TRUE_NU = 8e4, 0.35
THROWS = [(3, 0), (3, 1), (4, 2), (2, 3)]  # vertices along an edge of the body, seed of its velocity


class LogModuli(torch.nn.Module):
    def __init__(self, E: float, nu: float):
        super().__init__()
        self.log_E = torch.nn.Parameter(torch.tensor(E, dtype=torch.float64).log())
        self.nu = torch.nn.Parameter(torch.tensor(nu, dtype=torch.float64))

    @property
    def E(self):
        return self.log_E.exp()

    def forward(self) -> dict:
        """What a rollout takes."""
        return dict(youngs_modulus=self.E, poissons_ratio=self.nu)


class Throw:
    """A body held at its left, with a velocity of its own, and how it moved."""

    def __init__(self, material, resolution: int, seed: int):
        self.mesh = ds.TetrahedralMesh.create_cube(resolution, 0.4)
        random = torch.Generator().manual_seed(seed)
        self.velocity = torch.randn(3, generator=random, dtype=torch.float64) * torch.tensor(self.mesh.vertices[:, :1])
        law, terms = ds.StableNeoHookean(TRUE_E, TRUE_NU), [ds.Gravity(-9.8), ds.Drag(3.0)]
        scene = ds.Scene(self.mesh, law, terms=terms, fixed="xmin", precision="f64")
        self.rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=0.01, substeps=8), 15, save_every=5)
        self.material = material
        with torch.no_grad():
            self.target = self.motion({})

    def motion(self, moduli: dict) -> torch.Tensor:
        return ds.rollout_frames(self.rollout, initial_velocities=self.velocity, **moduli).displacements

    def loss(self) -> torch.Tensor:
        return (self.motion(self.material()) - self.target).square().mean() / self.target.square().mean() / len(THROWS)


def main(folder="output", iterations: int = 80) -> dict:
    material = LogModuli(1.5e5, 0.25)
    ensemble = ds.Ensemble(THROWS, lambda throw: Throw(material, *throw), costs=[n**3 for n, _ in THROWS])
    path = folder and Path(folder) / "train_distributed.state"
    mesh = ds.TetrahedralMesh.create_cube(THROWS[0][0], 0.4)
    optimization = Optimization(material, torch.optim.Adam(material.parameters(), lr=0.05), mesh, path)
    if ensemble.is_first and optimization.iteration:
        print(f"goes on after iteration {optimization.iteration}", flush=True)
    optimization.run(lambda: ensemble.loss(Throw.loss, material), iterations, title="train")
    result = dict(
        processes=ensemble.num_ranks,
        restarts=int(os.environ.get("TORCHELASTIC_RESTART_COUNT", 0)),
        E=material.E.item(),
        nu=material.nu.item(),
        E_error=abs(material.E.item() / TRUE_E - 1),
        nu_error=abs(material.nu.item() / TRUE_NU - 1),
        loss=optimization.losses[-1],
        iterations=iterations,
        seconds=optimization.seconds,
    )
    if ensemble.is_first:
        print(json.dumps(result))
    if ensemble.is_first and folder:
        throw = ensemble.member(0)
        with torch.no_grad():
            u = throw.motion(material())[-1]
        save_picture(
            Path(folder) / "train_distributed.png",
            throw.mesh,
            throw.mesh.vertices + u.numpy(),
            u.norm(dim=1).numpy(),
            "displacement [m]",
            title=f"E = {result['E']:.4g} Pa, nu = {result['nu']:.3f}",
        )
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", default="output", help="where state and picture go")
    parser.add_argument("--iterations", type=int, default=80)
    main(**vars(parser.parse_args()))
