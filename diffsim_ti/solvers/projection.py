"""What makes the Hessian of each tetrahedron positive definite, as a correction to the exact product."""

import numpy as np


class Projection:
    """w -> sum over tetrahedra of V B^T (C+ - C) B w, with C = d2psi/dF2 and C+ the same with |eigenvalues|.

    Chen et al. 2024, Stabler Neo-Hookean Simulation: Absolute Eigenvalue Filtering, doi:10.1145/3641519.3657433.
    """

    def __init__(self, potential, absolute: bool = True):
        a = potential.arrays
        potential.blocks()
        C = potential.tangents()
        values, vectors = np.linalg.eigh(0.5 * (C + np.swapaxes(C, 1, 2)))
        some = np.nonzero(values[:, 0] < 0)[0]
        values, vectors = values[some], vectors[some]
        change = np.abs(values) - values if absolute else np.maximum(values, 0) - values
        volumes, B = a.values.volumes[some], a.values.gradients[some]
        self.C = np.einsum("eij,ej,ekj,e->eik", vectors, change, vectors, volumes, optimize=True)
        self.N = np.concatenate([-B.sum(1, keepdims=True), B], 1)
        self.tets, self.num_vertices = potential.tetrahedra[some], a.num_vertices

    def __call__(self, w: np.ndarray) -> np.ndarray:
        dH = np.einsum("eac,eaj->ecj", w[self.tets], self.N)
        dP = np.matmul(self.C, dH.reshape(-1, 9, 1)).reshape(-1, 3, 3)
        forces = np.einsum("ecj,eaj->eac", dP, self.N).reshape(-1, 3)
        at = self.tets.ravel()
        return np.stack([np.bincount(at, forces[:, d], self.num_vertices) for d in range(3)], 1)
