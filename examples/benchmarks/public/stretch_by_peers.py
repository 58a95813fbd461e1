"""The stretch of torch_fem_stretch.py by torch-fem, in its environment: python stretch_by_peers.py VERTICES ...

The same cells, cut into six tetrahedra each, which makes the same unknowns. Seconds of the ten increments and of the
gradient of the force by both moduli, and the force.
"""

import sys
import time

import numpy as np
import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

E, NU, STRETCH, INCREMENTS = 1000.0, 0.3, 10.0, 10
CORNERS = [[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]]  # bits: z, y, x

torch.set_default_dtype(torch.float64)


def psi(F, numbers):
    mu, lam = numbers
    C = F.transpose(-1, -2) @ F
    log_J = 0.5 * torch.logdet(C)
    return 0.5 * mu * (torch.trace(C) - 3) - mu * log_J + 0.5 * lam * log_J**2


def mesh_of(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(vertices, tetrahedra)"""
    length = 4 / (n - 1)
    axes = np.linspace(0, length, 5), np.linspace(0, 1, n), np.linspace(0, 1, n)
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    at = np.arange(5 * n * n).reshape(5, n, n)
    corners = np.stack(
        [at[i : 4 + i, j : n - 1 + j, k : n - 1 + k].ravel() for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    tetrahedra = corners.T[:, CORNERS].reshape(-1, 4)
    edges = vertices[tetrahedra[:, 1:]] - vertices[tetrahedra[:, :1]]
    flipped = np.linalg.det(edges) < 0
    tetrahedra[flipped] = tetrahedra[flipped][:, [0, 1, 3, 2]]
    return vertices, tetrahedra


def measured(n: int) -> None:
    vertices, tetrahedra = mesh_of(n)
    length, X = 4 / (n - 1), torch.tensor(vertices)
    moduli = torch.tensor([E, NU], requires_grad=True)
    mu, lam = moduli[0] / (2 * (1 + moduli[1])), moduli[0] * moduli[1] / ((1 + moduli[1]) * (1 - 2 * moduli[1]))
    body = Solid(X, torch.tensor(tetrahedra), Hyperelastic3D(psi, torch.stack([mu, lam])))
    end = torch.isclose(X[:, 0], torch.tensor(length))
    body.constraints[end | torch.isclose(X[:, 0], torch.tensor(0.0)), 0] = True
    for axis in (1, 2):
        body.constraints[torch.isclose(X[:, axis], torch.tensor(0.5)), axis] = True
    body.displacements[end, 0] = (STRETCH - 1) * length
    shares = torch.tensor([(STRETCH ** (k / INCREMENTS) - 1) / (STRETCH - 1) for k in range(INCREMENTS + 1)])
    begin = time.perf_counter()
    _, forces, *_ = body.solve(increments=shares, differentiable_parameters=moduli, max_iter=50)
    force, middle = forces[end, 0].sum(), time.perf_counter()
    force.backward()
    print(
        f"torch-fem, {3 * len(X)} unknowns: {middle - begin:.2f} s, gradient {time.perf_counter() - middle:.2f} s, ",
        end="",
    )
    print(f"{force.item():.2f} N, by the moduli {moduli.grad.numpy()}", flush=True)


for text in sys.argv[1:]:
    measured(int(text))
