"""Preconditioners for c M + d2E/du2: block Jacobi here, multigrid in multigrid.py; and its assembled matrix.

Both are functions of the present state alone, so that a run that is started again from a checkpoint takes the same steps.
"""

import numpy as np

from diffsim_ti.solvers.implicit.free import Free, FreeDirections, mask_of, projectors_of


class BlockJacobi:
    """The inverse 3x3 diagonal blocks; blocks that are not positive definite take |eigenvalues|.

    size: of the diagonal at rest [N/m], to which what is all but zero is raised.
    """

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray):
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


def size_of(blocks: np.ndarray) -> np.ndarray:
    """Sum of the sizes of the diagonal of each block."""
    return np.abs(np.diagonal(blocks, axis1=1, axis2=2)).sum(1)


def element_matrices(potential) -> np.ndarray:
    """12x12 stiffness of each tetrahedron where `potential.blocks` was last called, as (m, 4, 4, 3, 3) blocks [N/m]; a
    patch's pressure is held.
    """
    a = potential.arrays
    m, B = a.num_tetrahedra, a.values.gradients
    N = np.concatenate([-B.sum(1, keepdims=True), B], 1)
    C = potential.tangents().reshape(m, 3, 3, 3, 3) * a.values.volumes[:, None, None, None, None]
    right = np.matmul(C.reshape(m, 27, 3), np.swapaxes(N, 1, 2)).reshape(m, 3, 3, 3, 4)
    return np.einsum("eaj,eijkb->eabik", N, right, optimize=True)


def assemble(potential, mass, free):
    """(c M + K as a block matrix, places of its diagonal blocks); what is held keeps a diagonal."""
    from scipy.sparse import bsr_matrix

    n, tets = potential.arrays.num_vertices, potential.tetrahedra.astype(np.int64)
    places = (tets[:, :, None] * n + tets[:, None, :]).ravel()
    entries = element_matrices(potential).reshape(-1, 9)
    if potential.arrays.patches is not None:
        rows, columns, blocks = potential.coupling.entries(potential.patch_gradients())
        places, entries = np.concatenate([places, rows * n + columns]), np.concatenate([entries, blocks.reshape(-1, 9)])
    places, inverse = np.unique(places, return_inverse=True)
    data = np.stack([np.bincount(inverse, entries[:, k], len(places)) for k in range(9)], 1).reshape(-1, 3, 3)
    rows, columns = places // n, places % n
    is_free, P = mask_of(free)[:, 0] > 0, projectors_of(free)
    data[~(is_free[rows] & is_free[columns])] = 0
    if isinstance(free, FreeDirections):
        data = P[rows] @ data @ P[columns]
    diagonal = np.searchsorted(places, np.arange(n, dtype=np.int64) * (n + 1))
    data[diagonal] += mass[:, :, None] * np.eye(3)
    data[diagonal[~is_free]] = np.eye(3) * (np.abs(data).max() or 1.0)
    if isinstance(free, FreeDirections):
        at = diagonal[free.guided]
        data[at] = P[free.guided] @ data[at] @ P[free.guided] + free.guides * np.abs(data).max()
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    return bsr_matrix((data, columns, start), shape=(3 * n, 3 * n)), diagonal
