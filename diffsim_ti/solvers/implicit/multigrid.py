"""Algebraic multigrid of the body at rest, turned with it, as a preconditioner for c M + d2E/du2."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.potential.assembled import assemble
from diffsim_ti.potential.free import Free, FreeDirections, projectors_of


class Multigrid:
    """Smoothed aggregation on the assembled matrix of the rest state, with rigid motions as near kernel.

    Isotropic laws: turning a body turns its stiffness, K(R u) = R K(u) R^T. So residuals are turned back by each vertex's
    mean rotation, and corrections forth. Contact stiffness joins the finest level. A V-cycle has one sweep of Gauss-Seidel
    on each way, forward down and backward up, which keeps it symmetric.
    Below ten-node tetrahedra lie the linear ones of their corners, and aggregates of these (p-multigrid): aggregates of all
    ten nodes take half as many iterations again.
    Vanek, Mandel, Brezina 1996, doi:10.1007/BF02238511; Bell, Olson, Schroder, PyAMG, doi:10.21105/joss.04142; Heys,
    Manteuffel, McCormick, Olson 2005, Algebraic multigrid for higher-order finite elements, doi:10.1016/j.jcp.2004.09.021.
    """

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray):
        import pyamg

        self.potential, self.free = potential, free
        mesh, rest = potential.arrays.mesh, potential.arrays.values.rest
        with potential.at_rest():
            potential.blocks()
            matrix, diagonal = assemble(potential, mass, free)
        aggregated, allowed = matrix, free
        if mesh.order == 2:
            aggregated, allowed, rest, up = of_corners(matrix, free, mesh, rest)
        state = np.random.get_state()
        np.random.seed(0)  # pyamg estimates a spectral radius from a random vector
        try:
            levels = pyamg.smoothed_aggregation_solver(
                aggregated,
                B=_allowed(_rigid_motions(rest), allowed),
                strength=("symmetric", {"theta": 0.08}),
                max_coarse=300,
            ).levels
        finally:
            np.random.set_state(state)
        tags = matrix.copy()
        tags.data = np.arange(matrix.data.size, dtype=float).reshape(matrix.data.shape)
        order = tags.tocsr().data.astype(np.int64)  # where numbers of the finest level lie in blocks
        self._diagonal = np.argsort(order).reshape(-1, 3, 3)[diagonal]
        self._fp = runtime.NUMPY[potential.arrays.precision]  # of the cycle, which memory's speed limits
        self._at_rest = matrix.tocsr().data[self._diagonal]
        matrices = [aggregated, *(level.A for level in levels[1:])]
        ways = [(A, level.P, level.R) for A, level in zip(matrices, levels[:-1])]
        if mesh.order == 2:
            ways.insert(0, (matrix, up, up.T))
        self._levels = [Level(*(M.tocsr().astype(self._fp) for M in way)) for way in ways]
        self._coarsest = _factorised(levels[-1].A)
        self._rotations, self._contact = None, None

    def update(self, u: np.ndarray) -> None:
        """Adapt to the displacement at which the potential is placed."""
        self._rotations = vertex_rotations(self.potential, u)
        contact = self.potential.contact_blocks()
        if contact is None:
            return
        if isinstance(self.free, FreeDirections):
            contact = self.free.around(contact)
        if self._rotations is not None:
            contact = np.swapaxes(self._rotations, 1, 2) @ contact @ self._rotations
        if self._contact is not None and np.array_equal(contact, self._contact):
            return
        if self._levels:
            self._levels[0].put(self._diagonal, self._at_rest + contact)
        self._contact = contact

    def __call__(self, r: np.ndarray) -> np.ndarray:
        R = self._rotations
        if R is not None:
            r = np.einsum("nji,nj->ni", R, r)
        size = np.abs(r).max(initial=0.0) + 1e-300  # no number may be too small for the cycle
        z = size * self._cycle(0, (r / size).ravel().astype(self._fp)).astype(np.float64).reshape(-1, 3)
        if R is not None:
            z = np.einsum("nij,nj->ni", R, z)
        return z * self.free

    def _cycle(self, k: int, b: np.ndarray) -> np.ndarray:
        """A V-cycle for level k."""
        if k == len(self._levels):
            return self._coarsest(b.astype(np.float64)).astype(self._fp)
        level = self._levels[k]
        x, left = level.smooth(b)
        x += level.P @ self._cycle(k + 1, level.R @ left)
        level.smooth_again(x, b)
        return x


def of_corners(matrix, free: Free, mesh, rest: np.ndarray) -> tuple:
    """(matrix of the linear elements on the corners of ten-node ones, what these may do, their places, the interpolation
    from them: the middle of an edge moves by the mean of its ends)."""
    from scipy.sparse import eye, kron

    corners = mesh.corners
    allowed = free[corners] if isinstance(free, np.ndarray) else free.of(corners)
    may, may_here = (_block_diagonal(projectors_of(x)) for x in (free, allowed))
    up = may @ kron(mesh.from_corners, eye(3)) @ may_here
    coarse = (up.T @ matrix @ up).tocsr()
    held = eye(3 * len(corners)) - may_here
    return (
        (coarse + held * (np.abs(coarse.data).max(initial=0.0) or 1.0)).tobsr((3, 3)),
        allowed,
        rest[corners],
        up.tocsr(),
    )


def _block_diagonal(blocks: np.ndarray):
    from scipy.sparse import bsr_matrix

    k = len(blocks)
    return bsr_matrix((blocks, np.arange(k), np.arange(k + 1)), shape=(3 * k, 3 * k)).tocsr()


class Level:
    """A level's matrix A = L + U, L with the diagonal, the way up P from the next coarser one, and the way down R."""

    def __init__(self, A, P, R):
        from scipy.sparse import tril, triu

        self.A, self.P, self.R = A, P, R
        tags = A.copy()
        tags.data = np.arange(1, A.nnz + 1, dtype=float)
        self.L, self.U = tril(tags, format="csr"), triu(tags, 1, format="csr")
        self._of_L, self._of_U = (part.data.astype(np.int64) - 1 for part in (self.L, self.U))
        self._split()

    def _split(self) -> None:
        self.L.data, self.U.data = self.A.data[self._of_L], self.A.data[self._of_U]

    def put(self, places: np.ndarray, numbers: np.ndarray) -> None:
        """Change numbers of A, which lie at `places`."""
        self.A.data[places] = numbers
        self._split()

    def smooth(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(x, b - A x) after a forward sweep from zero, x = L^-1 b, which leaves -U x."""
        x = np.zeros_like(b)
        _sweep(self.L, x, b, "forward")
        return x, -(self.U @ x)

    def smooth_again(self, x: np.ndarray, b: np.ndarray) -> None:
        """A backward sweep."""
        _sweep(self.A, x, b, "backward")


def _sweep(A, x: np.ndarray, b: np.ndarray, way: str) -> None:
    from pyamg.relaxation.relaxation import gauss_seidel

    gauss_seidel(A, x, b, sweep=way)


def _factorised(A):
    """Solutions with a coarsest matrix, in which motions that an aggregate has not have empty rows: they get a diagonal."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    size = np.abs(A.diagonal())
    return splu((A + diags(np.where(size > 0, 0.0, size.max(initial=0.0) or 1.0))).tocsc()).solve


def vertex_rotations(potential, u: np.ndarray) -> np.ndarray | None:
    """Mean rotation at each vertex, shape (num_vertices, 3, 3), weighted by volume; None where all are small."""
    points, n = potential.stress_points, potential.arrays.num_vertices
    at, count = points.nodes.ravel(), points.nodes.shape[1]
    H = points.displacement_gradients(u)
    if np.abs(H).max(initial=0.0) < 0.02:
        return None
    H *= points.volumes[:, None, None]
    F = np.stack([np.bincount(at, np.repeat(H.reshape(-1, 9)[:, k], count), n) for k in range(9)], 1)
    F /= np.bincount(at, np.repeat(points.volumes, count), n)[:, None] + 1e-300
    return rotations_of(F.reshape(-1, 3, 3) + np.eye(3))


def rotations_of(F: np.ndarray) -> np.ndarray:
    """The rotation next to each F, shape (k, 3, 3): by Newton's iteration R <- (R + R^-T) / 2, which takes a fourth of the
    time of singular values; by those where F is nearly singular or mirrored.

    Higham 1986, Computing the Polar Decomposition, doi:10.1137/0907079.
    """
    x = np.ascontiguousarray(F.reshape(-1, 9).T)
    _, det = _cofactors(x)
    hard = ~(det > 0.05 * ((x**2).sum(0) / 3) ** 1.5)
    x[:, hard] = np.eye(3).reshape(9, 1)
    for _ in range(8):
        cofactors, det = _cofactors(x)
        x = 0.5 * (x + cofactors / det)
    R = x.T.reshape(-1, 3, 3).copy()
    if hard.any():
        U, _, V = np.linalg.svd(F[hard])
        U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
        R[hard] = U @ V
    return R


def _cofactors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cofactors and determinants of matrices whose numbers are rows of x, shape (9, k)."""
    a, b, c, d, e, f, g, h, i = x
    out = [e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g, b * g - a * h]
    out += [b * f - c * e, c * d - a * f, a * e - b * d]
    return np.stack(out), a * out[0] + b * out[1] + c * out[2]


def _allowed(motions: np.ndarray, free: Free) -> np.ndarray:
    """What may be done of motions, shape (3 num_vertices, k)."""
    return (projectors_of(free) @ motions.reshape(-1, 3, motions.shape[1])).reshape(motions.shape)


def _rigid_motions(X: np.ndarray) -> np.ndarray:
    x, y, z = (X - X.mean(0)).T
    out = np.zeros((len(X), 3, 6))
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1
    out[:, 0, 3], out[:, 1, 3] = -y, x
    out[:, 1, 4], out[:, 2, 4] = -z, y
    out[:, 0, 5], out[:, 2, 5] = z, -x
    return out.reshape(-1, 6)
