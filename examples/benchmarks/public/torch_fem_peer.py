"""The problems of torch_fem_suite.py by torch-fem, in its environment: python torch_fem_peer.py CASE N CELLS

CASE: cube, topology or stretch; N as there; CELLS: hexahedra, as published, or tetrahedra (of the stretch alone: six in a
cell, which makes the same unknowns). Prints seconds of setting up, of the equilibria and of the gradient, peak memory [MB],
the value and the number of unknowns as JSON.
"""

import json
import math
import resource
import sys
import time
from importlib import metadata

import numpy as np
import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D, IsotropicElasticity3D
from torchfem.mesh import cube_hexa

CORNERS = [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]  # of a hexahedron

torch.set_default_dtype(torch.float64)


def cube(n: int, mesh):
    """A cube of n vertices along each edge is drawn out by a tenth; by the forces of all vertices, of the sum of all
    displacements; the value is the force that draws."""
    nodes, elements = mesh(n, n, n)
    body = Solid(nodes, elements, IsotropicElasticity3D(E=1000.0, nu=0.3))
    body.forces = torch.zeros_like(nodes, requires_grad=True)
    low, high = torch.isclose(nodes[:, 0], torch.tensor(0.0)), torch.isclose(nodes[:, 0], torch.tensor(1.0))
    body.constraints[low] = True
    body.constraints[high, 0] = True
    body.displacements[high, 0] = 0.1

    def solve():
        u, f, *_ = body.solve(differentiable_parameters=body.forces)
        return u.sum(), f[high, 0].sum().item()

    return body, solve


def topology(n: int, mesh):
    """A cantilever of 2n x n x n cells, each of its own stiffness by a random density: compliance by the densities."""
    nodes, elements = mesh(2 * n + 1, n + 1, n + 1, 2.0, 1.0, 1.0)
    rng = np.random.default_rng(0)
    rho = torch.tensor(np.clip(0.5 + 0.3 * rng.standard_normal(len(elements)), 0.05, 0.95), requires_grad=True)
    material = IsotropicElasticity3D(E=70000.0, nu=0.3).vectorize(len(elements))
    material.C = (1e-3 + (1 - 1e-3) * rho**3)[:, None, None, None, None] * material.C
    body = Solid(nodes, elements, material)
    body.constraints[torch.isclose(nodes[:, 0], torch.tensor(0.0))] = True
    end = torch.isclose(nodes[:, 0], torch.tensor(2.0))
    inner = ((nodes[end, 1:] > 1e-9) & (nodes[end, 1:] < 1 - 1e-9)).sum(1)
    body.forces[end, 2] = -(2.0**inner) / (4 * n**2)

    def solve():
        u, *_ = body.solve(differentiable_parameters=rho)
        compliance = (body.forces * u).sum()
        return compliance, compliance.item()

    return body, solve


def stretch(n: int, mesh):
    """torch_fem_stretch.py; the force by both moduli."""
    length = 4 / (n - 1)
    nodes, elements = mesh(5, n, n, length, 1.0, 1.0)
    moduli = torch.tensor([1000.0, 0.3], requires_grad=True)
    mu, lam = moduli[0] / (2 * (1 + moduli[1])), moduli[0] * moduli[1] / ((1 + moduli[1]) * (1 - 2 * moduli[1]))

    def psi(F, numbers):
        C = F.transpose(-1, -2) @ F
        log_J = 0.5 * torch.logdet(C)
        return 0.5 * numbers[0] * (torch.trace(C) - 3) - numbers[0] * log_J + 0.5 * numbers[1] * log_J**2

    body = Solid(nodes, elements, Hyperelastic3D(psi, torch.stack([mu, lam])))
    end = torch.isclose(nodes[:, 0], torch.tensor(length))
    body.constraints[end | torch.isclose(nodes[:, 0], torch.tensor(0.0)), 0] = True
    for axis in (1, 2):
        body.constraints[torch.isclose(nodes[:, axis], torch.tensor(0.5)), axis] = True
    body.displacements[end, 0] = 9 * length
    increments = (torch.logspace(0, math.log10(10.0), 11) - 1) / 9

    def solve():
        _, f, *_ = body.solve(increments=increments, differentiable_parameters=moduli, max_iter=50)
        force = f[end, 0].sum()
        return force, force.item()

    return body, solve


def tetrahedra(*arguments):
    nodes, elements = cube_hexa(*arguments)
    return nodes, elements[:, CORNERS].reshape(-1, 4)


if __name__ == "__main__":
    case, n, cells = sys.argv[1:]
    make, mesh = globals()[case], tetrahedra if cells == "tetrahedra" else cube_hexa
    make(3, mesh)[1]()[0].backward()  # what a process does but once
    begin = time.perf_counter()
    body, solve = make(int(n), mesh)
    made = time.perf_counter()
    target, value = solve()
    solved = time.perf_counter()
    target.backward()
    answer = dict(
        unknowns=3 * body.n_nod,
        setup=made - begin,
        forward=solved - made,
        gradient=time.perf_counter() - solved,
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        value=value,
        version=metadata.version("torch-fem"),
    )
    print(json.dumps(answer))
