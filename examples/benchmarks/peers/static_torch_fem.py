"""An equilibrium by torch-fem, as it chooses its solver: python static_torch_fem.py JOB.npz ANSWER.npz"""

import sys
import time

import numpy as np
import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

torch.set_default_dtype(torch.float64)


def psi(F, numbers):
    mu, lam = numbers
    C = F.transpose(-1, -2) @ F
    log_J = 0.5 * torch.logdet(C)
    return 0.5 * mu * (torch.trace(C) - 3) - mu * log_J + 0.5 * lam * (torch.exp(log_J) - 1) ** 2


def solved(job):
    body = Solid(
        torch.tensor(job["vertices"]),
        torch.tensor(job["tetrahedra"]),
        Hyperelastic3D(psi, torch.tensor([float(job["mu"]), float(job["lam"])])),
    )
    body.forces = torch.tensor(job["loads"])
    body.constraints[torch.tensor(job["fixed"]), :] = True
    return body.solve(increments=torch.tensor([0.0, 1.0]), max_iter=30, rtol=float(job["tolerance"]))[0]


def main(job) -> dict:
    best = np.inf
    for _ in range(int(job["repeats"])):
        begin = time.perf_counter()
        u = solved(job)
        best = min(best, time.perf_counter() - begin)
    return dict(seconds=best, displacements=u.detach().numpy().reshape(-1, 3))


if __name__ == "__main__":
    np.savez(sys.argv[2], **main(np.load(sys.argv[1])))
