"""Preconditioners for c M + d2E/du2: block Jacobi, and algebraic multigrid of the body at rest, turned with it.

Both are functions of the present state alone, so that a run that is started again from a checkpoint takes the same steps.
"""

import numpy as np


class BlockJacobi:
    """The inverse 3x3 diagonal blocks; blocks that are not positive definite take |eigenvalues|.

    size: of the diagonal at rest [N/m], to which what is all but zero is raised.
    """

    def __init__(self, potential, mass: np.ndarray, free: np.ndarray, size: np.ndarray):
        self.potential, self.mass, self.free, self.least = potential, mass, free, 1e-6 * (size + mass)

    def update(self, u: np.ndarray) -> None:
        """Adapt to the displacement at which the potential is placed."""
        D = self.potential.blocks() + self.mass[:, :, None] * np.eye(3)
        values, vectors = np.linalg.eigh(0.5 * (D + np.swapaxes(D, 1, 2)))
        values = np.maximum(np.abs(values), self.least)
        inverse = np.divide(self.free, values, out=np.zeros_like(values), where=values > 0)
        self._inverse = np.matmul(vectors * inverse[:, None, :], np.swapaxes(vectors, 1, 2))

    def __call__(self, r: np.ndarray) -> np.ndarray:
        return np.matmul(self._inverse, r[:, :, None])[:, :, 0]


class Multigrid:
    """Smoothed aggregation on the assembled matrix of the rest state, with rigid motions as near kernel.

    Isotropic laws: turning a body turns its stiffness, K(R u) = R K(u) R^T. So residuals are turned back by each vertex's
    mean rotation, and corrections forth. Contact stiffness joins the finest level.
    Vanek, Mandel, Brezina 1996, doi:10.1007/BF02238511; Bell, Olson, Schroder, PyAMG, doi:10.21105/joss.04142.
    """

    def __init__(self, potential, mass: np.ndarray, free: np.ndarray, size: np.ndarray):
        import pyamg

        self.potential, self.free = potential, free
        with potential.at_rest():
            potential.blocks()
            self._matrix, self._diagonal = _assemble(potential, mass, free)
        sweep = ("block_gauss_seidel", {"sweep": "symmetric", "iterations": 1})
        state = np.random.get_state()
        np.random.seed(0)  # pyamg estimates a spectral radius from a random vector
        try:
            self._levels = pyamg.smoothed_aggregation_solver(
                self._matrix,
                B=_rigid_motions(potential.arrays.values.rest) * np.repeat(free, 3, 0),
                strength=("symmetric", {"theta": 0.08}),
                presmoother=sweep,
                postsmoother=sweep,
                max_coarse=300,
                coarse_solver="splu",
            )
        finally:
            np.random.set_state(state)
        self._rotations, self._contact = None, None

    def update(self, u: np.ndarray) -> None:
        """Adapt to the displacement at which the potential is placed."""
        self._rotations = vertex_rotations(self.potential, u)
        contact = self.potential.contact_blocks()
        if contact is None:
            return
        if self._rotations is not None:
            contact = np.swapaxes(self._rotations, 1, 2) @ contact @ self._rotations
        if self._contact is not None and np.array_equal(contact, self._contact):
            return
        from pyamg.relaxation.smoothing import change_smoothers

        finest = self._levels.levels[0].A
        finest.data[self._diagonal] += contact - (0 if self._contact is None else self._contact)
        self._contact = contact
        for kept in ("block_D", "block_D_inv"):  # pyamg keeps the diagonal that it found first
            if hasattr(finest, kept):
                delattr(finest, kept)
        sweep = ("block_gauss_seidel", {"sweep": "symmetric", "iterations": 1})
        change_smoothers(self._levels, sweep, sweep)

    def __call__(self, r: np.ndarray) -> np.ndarray:
        R = self._rotations
        if R is not None:
            r = np.matmul(np.swapaxes(R, 1, 2), r[:, :, None])[:, :, 0]
        z = self._levels.solve(r.ravel(), x0=np.zeros(r.size), maxiter=1, tol=1e-300, cycle="V").reshape(-1, 3)
        if R is not None:
            z = np.matmul(R, z[:, :, None])[:, :, 0]
        return z * self.free


def vertex_rotations(potential, u: np.ndarray) -> np.ndarray | None:
    """Mean rotation at each vertex, shape (num_vertices, 3, 3); None where everything is nearly unturned."""
    a, tets = potential.arrays, potential.tetrahedra
    D = u[tets[:, 1:]] - u[tets[:, :1]]
    H = np.matmul(np.swapaxes(D, 1, 2), a.values.gradients)
    if np.abs(H).max(initial=0.0) < 0.02:
        return None
    H *= a.values.volumes[:, None, None]
    F = np.stack([np.bincount(tets.ravel(), np.repeat(H.reshape(-1, 9)[:, k], 4), a.num_vertices) for k in range(9)], 1)
    F /= np.bincount(tets.ravel(), np.repeat(a.values.volumes, 4), a.num_vertices)[:, None] + 1e-300
    U, _, V = np.linalg.svd(F.reshape(-1, 3, 3) + np.eye(3))
    U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
    return U @ V


def _rigid_motions(X: np.ndarray) -> np.ndarray:
    x, y, z = (X - X.mean(0)).T
    out = np.zeros((len(X), 3, 6))
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1
    out[:, 0, 3], out[:, 1, 3] = -y, x
    out[:, 1, 4], out[:, 2, 4] = -z, y
    out[:, 0, 5], out[:, 2, 5] = z, -x
    return out.reshape(-1, 6)


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


def _assemble(potential, mass, free):
    """(c M + K as a block matrix, places of its diagonal blocks); fixed vertices keep a diagonal."""
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
    is_free = free[:, 0] > 0
    data[~(is_free[rows] & is_free[columns])] = 0
    diagonal = np.searchsorted(places, np.arange(n, dtype=np.int64) * (n + 1))
    data[diagonal] += mass[:, :, None] * np.eye(3)
    data[diagonal[~is_free]] = np.eye(3) * (np.abs(data).max() or 1.0)
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    return bsr_matrix((data, columns, start), shape=(3 * n, 3 * n)), diagonal
