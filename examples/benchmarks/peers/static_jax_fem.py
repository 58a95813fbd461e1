"""An equilibrium by JAX-FEM with PETSc as it chooses: python static_jax_fem.py JOB.npz ANSWER.npz"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
from jax_fem.generate_mesh import Mesh  # noqa: E402
from jax_fem.problem import Problem  # noqa: E402
from jax_fem.solver import solver  # noqa: E402

job = np.load(sys.argv[1])
mu, lam, weight = float(job["mu"]), float(job["lam"]), np.asarray(job["weight"])


def psi(F):
    J = jnp.linalg.det(F)
    return 0.5 * mu * (jnp.sum(F * F) - 3) - mu * jnp.log(J) + 0.5 * lam * (J - 1) ** 2


class Body(Problem):
    def get_tensor_map(self):
        return lambda gradient: jax.grad(psi)(gradient + jnp.eye(3))

    def get_mass_map(self):
        return lambda u, x: -jnp.array(weight)


def solved():
    X = job["vertices"]
    held = float(X[job["fixed"], 0].max()) + 1e-9
    at = [lambda x: x[0] < held] * 3
    mesh = Mesh(X, job["tetrahedra"], ele_type="TET4")
    body = Body(mesh, vec=3, dim=3, ele_type="TET4", dirichlet_bc_info=[at, [0, 1, 2], [lambda x: 0.0] * 3])
    options = {"petsc_solver": {}, "rel_tol": float(job["tolerance"]), "tol": 1e-8}
    return solver(body, options)[0]


best = np.inf
for _ in range(int(job["repeats"])):
    begin = time.perf_counter()
    u = np.asarray(solved())
    best = min(best, time.perf_counter() - begin)
np.savez(sys.argv[2], seconds=best, displacements=u)
