"""Losses and gradients of equilibria by torch-fem: python gradient_torch_fem.py JOB.job.npz ...

theta: log E of three thirds, nu, factors of three fields of load. Each answer has the loss at theta plus each offset of each
step, shape (7, offsets), and the gradient by torch's reverse mode at theta.
"""

import sys

import numpy as np
import torch
from static_torch_fem import psi
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

torch.set_default_dtype(torch.float64)


def loss(job, theta):
    E, nu = torch.exp(theta[torch.tensor(job["third"])]), theta[3]
    lame = torch.stack([E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))], 1)
    body = Solid(torch.tensor(job["vertices"]), torch.tensor(job["tetrahedra"]), Hyperelastic3D(psi, lame))
    body.constraints[torch.tensor(job["fixed"]), :] = True
    body.displacements = torch.tensor(job["moved"])
    body.forces = torch.tensordot(theta[4:], torch.tensor(job["loads"]), 1)
    shares = torch.linspace(0, 1, 6)
    u = body.solve(increments=shares, max_iter=50, rtol=1e-10, atol=1e-12, differentiable_parameters=theta)[0]
    return (u.reshape(-1, 3) * torch.tensor(job["weights"])).sum()


for path in sys.argv[1:]:
    with np.load(path) as file:
        job = {name: value[()] for name, value in file.items()}
    theta = torch.tensor(job["theta"], requires_grad=True)
    loss(job, theta).backward()
    with torch.no_grad():
        values = [
            [float(loss(job, torch.tensor(job["theta"] + k * row))) for k in job["offsets"]]
            for row in np.diag(job["steps"])
        ]
    np.savez(path.replace(".job.", ".answer."), gradient=theta.grad.numpy(), values=values)
