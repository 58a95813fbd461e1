"""Gradients of an ensemble of rollouts, shared among processes: how the work outgrows one machine.

Each process simulates its share of an ensemble of throws and all average their gradients; every process then takes the same
optimiser step. Rank 0 also computes the whole ensemble alone and compares; it keeps the state file, from which all ranks go
on, and draws the picture.

    torchrun --nproc_per_node=2 examples/identify/train_distributed.py
"""

import argparse
import json
import os
import time
from pathlib import Path

import torch
import torch.distributed as dist

from diffsim_ti import TetrahedralMesh
from diffsim_ti.diff_physics import DifferentiableMaterial, TorchMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
from diffsim_ti.optimization import load_state, save_state
from diffsim_ti.picture import save_picture

MEMBERS, TRUE_E, TRUE_NU = 4, 8e4, 0.35


class LogMaterial(TorchMaterial):
    def __init__(self, E: float, nu: float):
        super().__init__()
        self.log_E = torch.nn.Parameter(torch.tensor(E, dtype=torch.float64).log())
        self.nu = torch.nn.Parameter(torch.tensor(nu, dtype=torch.float64))

    @property
    def E(self):
        return self.log_E.exp()


class Ensemble:
    """Throws of one body held at its left, each member with its own velocity."""

    def __init__(self, material):
        self.mesh = TetrahedralMesh.create_cube(3, 0.4)
        solver = DifferentiableSolver(dt=0.01, gravity=-9.8, damping=0.97, substeps=8)
        true = DifferentiableMaterial(torch.tensor(TRUE_E, dtype=torch.float64), TRUE_NU)
        options = dict(fixed_vertices="xmin", contact=False)
        self.real, self.ours = (DifferentiableSimulator(self.mesh, m, solver, **options) for m in (true, material))
        with torch.no_grad():
            self.targets = [self.motion(self.real, k) for k in range(MEMBERS)]

    def motion(self, simulator, member: int) -> torch.Tensor:
        random = torch.Generator().manual_seed(member)
        velocity = torch.randn(3, generator=random, dtype=torch.float64) * torch.tensor(self.mesh.vertices[:, :1])
        simulator.reset(velocities=velocity)
        return simulator.rollout(15, save_every=5).displacements

    def loss(self, member: int) -> torch.Tensor:
        target = self.targets[member]
        return (self.motion(self.ours, member) - target).square().mean() / target.square().mean()


def main(folder="output", iterations: int = 80) -> dict:
    dist.init_process_group("gloo")
    rank, world = dist.get_rank(), dist.get_world_size()
    material = LogMaterial(1.5e5, 0.25)
    ensemble, parameters = Ensemble(material), list(material.parameters())
    optimizer = torch.optim.Adam(parameters, lr=0.05)

    def gradients(members) -> list[torch.Tensor]:
        optimizer.zero_grad()
        sum(ensemble.loss(k) for k in members).backward()
        return [p.grad.clone() / MEMBERS for p in parameters]

    path = folder and Path(folder) / "train_distributed.state"
    state = load_state(path, ensemble.mesh) if path else None  # every rank reads the same file
    first, seconds, difference = 0, 0.0, 0.0
    if state is not None:
        first, seconds, difference = state["iteration"], state["seconds"], state["difference"]
        material.load_state_dict(state["module"])
        optimizer.load_state_dict(state["optimizer"])
    dist.barrier()  # nobody writes before all have read

    start = time.perf_counter()
    for iteration in range(first, iterations):
        shares = gradients(range(rank, MEMBERS, world))
        for share in shares:
            dist.all_reduce(share)
        if rank == 0 and iteration % 10 == 0:
            whole = gradients(range(MEMBERS))
            difference = max(difference, *(abs(a / b - 1).item() for a, b in zip(shares, whole)))
        for parameter, share in zip(parameters, shares):
            parameter.grad = share
        optimizer.step()
        if path and rank == 0 and ((iteration + 1) % 10 == 0 or iteration + 1 == iterations):
            save_state(
                path,
                ensemble.mesh,
                dict(
                    iteration=iteration + 1,
                    seconds=seconds + time.perf_counter() - start,
                    difference=difference,
                    module=material.state_dict(),
                    optimizer=optimizer.state_dict(),
                ),
            )
    every = [torch.zeros(2, dtype=torch.float64) for _ in range(world)]
    dist.all_gather(every, torch.stack([p.detach() for p in parameters]))
    result = dict(
        processes=world,
        difference_from_serial=difference,
        ranks_agree=all(torch.equal(every[0], x) for x in every),
        E=material.E.item(),
        nu=material.nu.item(),
        E_error=abs(material.E.item() / TRUE_E - 1),
        nu_error=abs(material.nu.item() / TRUE_NU - 1),
        iterations=iterations,
        seconds=seconds + time.perf_counter() - start,
    )
    dist.destroy_process_group()
    if rank == 0:
        print(json.dumps(result))
        if folder:
            with torch.no_grad():
                u = ensemble.motion(ensemble.ours, 0)[-1]
            save_picture(
                Path(folder) / "train_distributed.png",
                ensemble.mesh,
                ensemble.mesh.vertices + u.numpy(),
                u.norm(dim=1).numpy(),
                "displacement [m]",
                title=f"E = {result['E']:.4g} Pa, nu = {result['nu']:.3f}",
            )
    return result


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", default="output", help="where state and picture go")
    parser.add_argument("--iterations", type=int, default=80)
    main(**vars(parser.parse_args()))
