"""Preconditioners for c M + d2E/du2: block Jacobi here, multigrid in multigrid.py.

Both are functions of the present state alone, so that a run that is started again from a checkpoint takes the same steps.
"""

import numpy as np

from diffsim_ti.potential.free import Free, FreeDirections, mask_of


class BlockJacobi:
    """The inverse 3x3 diagonal blocks; blocks that are not positive definite take |eigenvalues|.

    size: of the diagonal at rest [N/m], to which what is all but zero is raised.
    """

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray, parallel: bool = True):
        self.potential, self.mass, self.free, self.least = potential, mass, free, 1e-6 * (size + mass)

    def update(self, u: np.ndarray) -> None:
        """Adapt to the displacement at which the potential is placed."""
        D = self.potential.blocks() + self.mass[:, :, None] * np.eye(3)
        if isinstance(self.free, FreeDirections):
            D = self.free.around(D)
            D[self.free.guided] += self.free.guides * (size_of(D[self.free.guided]) / 3)[:, None, None]
        values, vectors = np.linalg.eigh(0.5 * (D + np.swapaxes(D, 1, 2)))
        values = np.maximum(np.abs(values), self.least)
        inverse = np.divide(mask_of(self.free), values, out=np.zeros_like(values), where=values > 0)
        self._inverse = np.matmul(vectors * inverse[:, None, :], np.swapaxes(vectors, 1, 2))
        if isinstance(self.free, FreeDirections):
            self._inverse = self.free.around(self._inverse)

    def __call__(self, r: np.ndarray) -> np.ndarray:
        return np.matmul(self._inverse, r[:, :, None])[:, :, 0]


class BodyBlocks(BlockJacobi):
    """The same, and of each set that moves by few numbers q the inverse of its own d2E/dq2, from as many products."""

    def update(self, u: np.ndarray) -> None:
        super().update(u)
        self._bodies = []
        for body in self.free.reduced.bodies:
            k, m = body.basis.shape
            G = np.zeros((m, 3, m, 3))
            for j in range(m):
                for d in range(3):
                    w = np.zeros((len(self.mass), 3))
                    w[body.vertices, d] = body.basis[:, j]
                    G[:, :, j, d] = body.basis.T @ (self.mass * w + self.potential.product(w))[body.vertices]
            G = G.reshape(3 * m, 3 * m)
            values, vectors = np.linalg.eigh(0.5 * (G + G.T))
            least = 1e-12 * np.abs(values).max() + self.least[body.vertices].min()
            values = np.maximum(np.abs(values), least)
            self._bodies.append((body, (vectors / values) @ vectors.T))

    def __call__(self, r: np.ndarray) -> np.ndarray:
        out = super().__call__(r)
        for body, inverse in self._bodies:
            q = inverse @ (body.basis.T @ r[body.vertices]).ravel()
            out[body.vertices] = body.basis @ q.reshape(-1, 3)
        return out


def size_of(blocks: np.ndarray) -> np.ndarray:
    """Sum of the sizes of the diagonal of each block."""
    return np.abs(np.diagonal(blocks, axis1=1, axis2=2)).sum(1)
