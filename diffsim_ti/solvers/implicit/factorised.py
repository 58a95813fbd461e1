"""Sparse factorisation of the Hessian, for solves in which conjugate gradients or GMRES take too many products."""

import os
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mechanics.supports.free import FreeBodies

MOST_NEGATIVE = 100  # pivots, each of which costs a solve


@dataclass(frozen=True)
class Effort:
    """What a factorisation of the matrix of a mesh takes at most, by the envelope of reverse Cuthill-McKee.

    unknowns; entries of the factors; operations; entries of the matrix.
    George, Liu 1981, Computer Solution of Large Sparse Positive Definite Systems, ch. 4.
    """

    unknowns: int
    entries: float
    operations: float
    coupled: int

    large = 30_000  # unknowns from which on a factorisation is said

    @classmethod
    def of(cls, mesh) -> "Effort":
        """Of the vertices that the elements of a mesh couple; found once."""
        known = KNOWN.get(mesh)
        if known is None:
            known = KNOWN[mesh] = cls._found(mesh.elements, mesh.num_vertices)
        return known

    @classmethod
    def _found(cls, elements: np.ndarray, n: int) -> "Effort":
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        k = elements.shape[1]
        pairs = np.repeat(elements, k, 1).ravel(), np.tile(elements, k).ravel()
        graph = coo_matrix((np.ones(len(pairs[0]), np.int32), pairs), shape=(n, n)).tocsr()
        place = np.empty(n, np.int64)
        place[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(n)
        first = place.copy()  # of each vertex the first in its row
        np.minimum.at(first, np.repeat(np.arange(n), np.diff(graph.indptr)), place[graph.indices])
        width = 3.0 * (place - first) + 3
        return cls(3 * n, 6.0 * width.sum(), 3.0 * (width**2).sum(), 9 * graph.nnz)

    @property
    def patience(self) -> int:
        """Products of the Hessian, with multigrid, that take about as long as assembly and factorisation."""
        return int(100 + self.operations / (50 * self.coupled))

    @property
    def fits(self) -> bool:
        """Whether the factors take less than a quarter of the memory, and less than some minutes."""
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 8e9
        return 16 * self.entries < 0.25 * memory and self.operations < 1e12


KNOWN: WeakKeyDictionary = WeakKeyDictionary()  # of meshes


class Factorised:
    """r -> M^-1 r for the Hessian that an Operator multiplies by, with stress, patches, mass, matrices of host forces and
    what a Projection adds. Of contact between surfaces it has the convex part, of host forces without a matrix the diagonal
    blocks, of chambers nothing that couples all of their surface: products and conjugate gradients make up for these.

    A symmetric matrix is L D L^T, without pivoting, and M = L |D| L^T: positive definite, and the matrix itself where that
    is. Then M^-1 = A^-1 + 2 sum of w w^T / |d| over the negative pivots d, with L^T w = e, so that w . A w = d. `negative`
    is their number, which is that of the negative eigenvalues. Others are A = L U.
    Gill, Murray, Ponceleon, Saunders 1992, doi:10.1137/0613022.
    """

    def __init__(self, operator):
        from scipy.sparse.linalg import splu

        free, symmetric = operator.free, operator.symmetric
        matrix = hessian(operator).tocsc()
        self._eliminate = getattr(free, "elimination", None)
        if self._eliminate is not None:
            matrix = eliminated(matrix, self._eliminate)
        matrix.eliminate_zeros()
        self._solve, self._free, self._along, self.negative = None, free, None, 0
        pivoting = 0.0 if symmetric else 0.1
        try:
            factors = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=pivoting, options=dict(SymmetricMode=True))
        except (RuntimeError, MemoryError):  # singular, or no room
            return
        if symmetric:
            pivots = factors.U.diagonal()
            below = np.flatnonzero(pivots < 0)
            self.negative = len(below)
            if self.negative > MOST_NEGATIVE or not np.array_equal(factors.perm_r, factors.perm_c):
                return
            if self.negative:
                columns = factors.L[:, below].toarray()[factors.perm_r]
                self._along = factors.solve(columns) * np.sqrt(2 * -pivots[below])  # w sqrt(2 / |d|), w = d A^-1 L e
        self._solve = lambda r: factors.solve(r, "T" if operator.transposed and not symmetric else "N")

    @classmethod
    def of(cls, operator) -> "Factorised | None":
        """None where there is no such factorisation: of sets that move by few numbers but ties, of singular matrices."""
        if isinstance(operator.free, FreeBodies) and operator.free.elimination is None:
            return None
        out = cls(operator)
        return out if out._solve else None

    def __call__(self, r: np.ndarray) -> np.ndarray:
        r, T = (r * self._free).ravel(), self._eliminate
        r = r if T is None else T.T @ r
        out = self._solve(r)
        if self._along is not None:
            out = out + self._along @ (self._along.T @ r)
        return (out if T is None else T @ out).reshape(-1, 3) * self._free


def eliminated(matrix, T):
    """T^T A T, with a diagonal in the place of what T leaves out."""
    from scipy.sparse import diags

    left_out = np.diff(T.tocsc().indptr) == 0
    return (T.T @ matrix @ T + diags(left_out * np.abs(matrix.diagonal()).max())).tocsc()


def hessian(operator):
    """The matrix of an operator, as `Factorised` has it, in blocks."""
    from scipy.sparse import bsr_matrix

    potential = operator.potential
    n, u, contact, more = potential.arrays.num_vertices, potential.held_at, potential.contact_blocks(), []
    for matrix, blocks in potential.hosts.matrices(u):
        contact = contact - blocks
        more.append(matrix)
    if potential.pairs:
        matrix, blocks = potential.pairs.stiffness(potential.u)
        contact = contact - blocks
        more.append(matrix)
    if contact is not None:
        more.append(bsr_matrix((contact, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n)))
    for matrix, _ in operator.others.matrices(u):
        more.append(0.5 * (matrix + matrix.T) if operator.symmetric else matrix)
    if operator.correction is not None:
        more.append(operator.correction.matrix())
    potential.blocks()
    return assemble(potential, operator.mass, operator.free, more)[0]
