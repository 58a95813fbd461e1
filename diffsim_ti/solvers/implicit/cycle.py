"""A V-cycle over matrices of blocks on the device, in float32, which memory's speed limits."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import put
from diffsim_ti.runtime import ROWS, kernels_of
from diffsim_ti.solvers.implicit.cycle_kernels import THETA, CycleKernels, LevelKernels

SWEEPS, MARGIN = 20, 1.05  # power iterations for a largest eigenvalue, and what they are trusted to


def rows_of(blocks: np.ndarray) -> np.ndarray:
    """Columns of blocks, shape (k, numbers, columns), as k x columns vectors."""
    numbers = blocks.shape[1]
    out = np.zeros((len(blocks), blocks.shape[2], {3: 4, 6: 8}[numbers]), np.float32)
    out[:, :, :numbers] = np.swapaxes(blocks, 1, 2)
    return out.reshape(-1, out.shape[2])


def upload_rows(blocks: np.ndarray):
    """The same on the device."""
    return runtime.upload(rows_of(blocks), ROWS[blocks.shape[1]])


def block_matrix(M) -> SimpleNamespace:
    """A SciPy matrix of blocks on the device."""
    return SimpleNamespace(
        start=runtime.upload(M.indptr, ti.i32), column=runtime.upload(M.indices, ti.i32), values=upload_rows(M.data)
    )


def threads_of(M) -> int:
    """How many threads share a row of blocks: several on a card, where one waits for each entry in turn, if rows are long
    and too few to occupy it."""
    long, few = len(M.data) > 16 * nodes_of(M), nodes_of(M) <= 2**14
    return 8 if long and few and not runtime.runs_on_cpu() else 1


def nodes_of(M) -> int:
    """Rows of blocks."""
    return M.shape[0] // M.blocksize[0]


def diagonal_blocks(M) -> np.ndarray:
    """Of a matrix of square blocks."""
    rows = np.repeat(np.arange(nodes_of(M)), np.diff(M.indptr))
    out, on = np.zeros((nodes_of(M), *M.blocksize)), rows == M.indices
    out[rows[on]] = M.data[on]
    return out


class Level:
    """A level: a matrix of square blocks whose largest eigenvalue against its diagonal blocks is found here."""

    def __init__(self, M, parallel: bool, coupled: bool = False):
        self.numbers, self.nodes = M.blocksize[0], nodes_of(M)
        rows = np.repeat(np.arange(self.nodes), np.diff(M.indptr))
        self._off = rows != M.indices
        start = np.concatenate([[0], np.cumsum(np.bincount(rows[self._off], minlength=self.nodes))])
        self.start, self.column = runtime.upload(start, ti.i32), runtime.upload(M.indices[self._off], ti.i32)
        self.values = upload_rows(M.data[self._off])
        self.b, self.x, self.d, self.y = (runtime.array(ROWS[self.numbers], self.nodes) for _ in range(4))
        self.diagonal, self.inverse = (runtime.array(ROWS[self.numbers], self.numbers * self.nodes) for _ in range(2))
        self.threads, self.parallel, self.coupled = threads_of(M), parallel, coupled
        self._measure(M)
        if coupled:
            self.contact_start = runtime.upload(np.zeros(self.nodes + 1), ti.i32)
            self._make_room(1)

    def _measure(self, M) -> None:
        blocks = diagonal_blocks(M)
        self.largest = getattr(M, "largest", None) or largest_eigenvalue(M, blocks)  # or known since it was made
        runtime.fill(self.diagonal, rows_of(blocks))
        self._inverses = inverses(blocks)
        self.widen(self.largest)

    def widen(self, largest: float) -> None:
        """Take another largest eigenvalue: inverses are those of the matrix alone, which contact of vertices then joins."""
        self.theta = THETA * MARGIN * largest
        runtime.fill(self.inverse, rows_of(self._inverses / self.theta))

    def _make_room(self, blocks: int) -> None:
        """Of a matrix of contact."""
        self._room = blocks
        self.contact_column = runtime.array(ti.i32, blocks)
        self.contact_values = runtime.array(ROWS[self.numbers], self.numbers * blocks)

    def couple(self, M) -> bool:
        """Let a matrix of contact join this one: whether arrays are others."""
        grows = len(M.data) > self._room
        if grows:
            self._make_room(len(M.data) + len(M.data) // 2)
        runtime.fill(self.contact_start, M.indptr)
        put(self.contact_column, M.indices)
        put(self.contact_values, rows_of(M.data))
        return grows

    def put_contact(self, M, more) -> bool:
        """The same of all of a matrix with its diagonal blocks, beside M, whose numbers are there."""
        self._measure((M + more).tobsr(M.blocksize))
        return self.couple(without(more, diagonal_blocks(more)))

    def put_numbers(self, M) -> None:
        """Set those of another matrix with the same places, without contact of surfaces."""
        runtime.fill(self.values, rows_of(M.data[self._off]))
        if self.coupled:
            runtime.fill(self.contact_start, 0)
        self._measure(M)

    def invert(self, nodes: np.ndarray) -> None:
        """Anew the inverses of the diagonal blocks of some nodes of three numbers."""
        blocks, inverse = (runtime.fetch(x).reshape(-1, 3, 3) for x in (self.diagonal, self.inverse))
        inverse[nodes] = inverses(np.swapaxes(blocks[nodes].astype(np.float64), 1, 2)) / self.theta  # symmetric
        runtime.fill(self.inverse, inverse.reshape(-1, 3))


def without(M, diagonal: np.ndarray):
    """M less diagonal blocks, without blocks of zeros."""
    from scipy.sparse import bsr_matrix

    k = len(diagonal)
    out = (M - bsr_matrix((diagonal, np.arange(k), np.arange(k + 1)), shape=M.shape)).tobsr(M.blocksize)
    out.sort_indices()
    some = out.data.any((1, 2))
    start = np.concatenate([[0], np.cumsum(some)])[out.indptr]
    return bsr_matrix((out.data[some], out.indices[some], start), shape=M.shape)


def largest_eigenvalue(M, diagonal: np.ndarray) -> float:
    """Of D^-1 M, D the diagonal blocks, by power iteration; at least 1."""
    inverse, size = inverses(diagonal), 1.0
    x = np.random.default_rng(0).standard_normal(diagonal.shape[:2])
    for _ in range(SWEEPS):
        x = x / (np.linalg.norm(x) or 1.0)
        x = np.einsum("ijk,ik->ij", inverse, (M @ x.ravel()).reshape(x.shape))
        size = float(np.linalg.norm(x))
    return max(size, 1.0)


def inverses(blocks: np.ndarray) -> np.ndarray:
    """Of symmetric positive semidefinite blocks; zero in directions in which they are."""
    size = np.abs(blocks).max((1, 2), initial=0.0)
    plain = np.linalg.det(blocks / np.maximum(size, 1e-300)[:, None, None]) > 1e-9
    out = np.zeros_like(blocks)
    out[plain] = np.linalg.inv(blocks[plain])
    if not plain.all():
        out[~plain] = np.linalg.pinv(0.5 * (blocks[~plain] + np.swapaxes(blocks[~plain], 1, 2)), 1e-7, hermitian=True)
    return 0.5 * (out + np.swapaxes(out, 1, 2))


def positive_inverse(A: np.ndarray) -> np.ndarray:
    """The inverse of a symmetric matrix; where that is not definite, as of a body that nothing holds yet, eigenvalues are
    raised to a millionth of the largest, which float32 resolves."""
    from scipy.linalg.lapack import dpotrf, dpotri

    factor, fails = dpotrf(A.T, lower=1)
    if not fails:
        half = dpotri(factor, lower=1, overwrite_c=1)[0]
        half[np.diag_indices_from(half)] *= 0.5
        inverse = half.T + half
        if np.abs(A).sum(0).max() * np.abs(inverse).sum(0).max() < 1e10:  # which is at least its condition
            return inverse
    values, vectors = np.linalg.eigh(A)
    return (vectors / np.maximum(np.abs(values), 1e-6 * np.abs(values).max())) @ vectors.T


class Inverse:
    """The inverse of a matrix of blocks, body by body, as one on the device; motions that a block has not stay zero.
    whole: as if it were one body."""

    def __init__(self, M, whole: bool = False):
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        k, rows = nodes_of(M), np.repeat(np.arange(nodes_of(M)), np.diff(M.indptr))
        graph = csr_matrix((np.ones(len(rows)), M.indices, M.indptr), shape=(k, k))
        label, place, self._bodies = connected_components(graph, directed=False)[1], np.zeros(k, int), []
        label = 0 * label if whole else label
        start = np.concatenate([[0], np.cumsum(np.bincount(label)[label])])
        nodes, entries = (
            np.split(np.argsort(x, kind="stable"), np.cumsum(np.bincount(x))[:-1]) for x in (label, label[rows])
        )
        for own, mine in zip(nodes, entries):
            place[own] = np.arange(len(own))
            there = start[own][:, None] + np.arange(len(own))
            self._bodies.append((own, mine, place[rows[mine]], place[M.indices[mine]], there))
        column = np.concatenate([nodes[body] for body in label])
        self._rows = np.zeros((start[-1], M.blocksize[0], ROWS[M.blocksize[0]].n), np.float32)
        self.start, self.column = runtime.upload(start, ti.i32), runtime.upload(column, ti.i32)
        self.values = runtime.array(ROWS[M.blocksize[0]], self._rows[..., 0].size)
        self.data, self.shape, self.blocksize = self._rows, M.shape, M.blocksize  # as of a matrix
        self.put(M)

    def put(self, M, anew=(True,)) -> None:
        """anew: a mask of the scenes whose numbers have changed."""
        b = M.blocksize[0]
        for own, mine, row, column, there in self._bodies:
            if not anew[own[0] * len(anew) // nodes_of(M)]:
                continue
            dense = np.zeros((len(own), b, len(own), b))
            dense[row, :, column] = M.data[mine]
            self._put(dense.reshape(b * len(own), -1), there)
        self._upload()

    def put_dense(self, dense: np.ndarray) -> None:
        """The same for a matrix of one body, as a dense array."""
        self._put(dense, self._bodies[0][-1])
        self._upload()

    def _upload(self) -> None:
        runtime.fill(self.values, self._rows.reshape(-1, self._rows.shape[2]))

    def _put(self, dense: np.ndarray, there: np.ndarray) -> None:
        still, k, b = np.flatnonzero(np.diagonal(dense) == 0), len(there), self.blocksize[0]
        dense[still, still] = dense.max() or 1.0
        inverse = positive_inverse(dense)
        inverse[still, still] = 0.0
        self._rows[there, :, :b] = inverse.reshape(k, b, k, b).transpose(2, 0, 1, 3)  # symmetric

    @property
    def is_of_one_body(self) -> bool:
        return len(self._bodies) == 1


class Cycle:
    """z = P Q V Q^T r for r = P r, V a V-cycle with three terms of Chebyshev's polynomial in D^-1 A on each way, D the
    diagonal blocks: symmetric and positive definite on what P leaves.

    matrices: of each level, the coarsest last; ways: from each to the one before. frames: `turned` Q and `allowed` P, a
    block for each node of the finest level, by columns. coupled: whether contact of surfaces joins the levels, of which the
    last one does without where it has too many nodes for one dense inverse (`most`).
    Adams, Brezina, Hu, Tuminaro 2003, doi:10.1016/S0021-9991(03)00194-3.
    """

    wide, most = 1000, 150  # nodes of a level from which on all threads work on it; of the last one
    renewals = 0  # of arrays

    def __init__(self, matrices: list, ways: list, frames, parallel: bool, coupled: bool = False):
        self.frames = frames
        self.levels = [Level(M, self._wide(M, parallel), coupled) for M in matrices]
        self._entries = [len(M.data) for M in (*matrices, *ways)]
        self._down, self._up = [], []  # (kernel, records, numbers)
        downs = [P.T.tobsr(P.blocksize[::-1]) for P in ways]
        last, self.couples_below = self.levels[-1], coupled and nodes_of(matrices[-1]) <= self.most
        self.inverse = Inverse(matrices[-1], self.couples_below)
        within = [level.threads for level in self.levels[:-1]] + [threads_of(self.inverse)]
        for level, threads, above in zip(self.levels, within, [1, *map(threads_of, downs)]):
            if max(threads, above) > 1:
                level.part = runtime.array(ROWS[level.numbers], level.nodes * max(threads, above))
        for level, below, P, down in zip(self.levels, self.levels[1:], ways, downs):
            threads = level.threads, threads_of(down)
            kernels = kernels_of(CycleKernels, level.numbers, below.numbers, self._wide(P, parallel), *threads, coupled)
            between = dict(level=level, down=block_matrix(down), up=block_matrix(P), below=below)
            own = dict(nodes=level.nodes, shares=threads[0] * level.nodes)
            more = dict(below=below.nodes, shares_below=threads[1] * below.nodes)
            self._down.append((kernels.down, between, own | more))
            self._up.insert(0, (kernels.up, between, own))
        kernels = kernels_of(LevelKernels, last.numbers, "f32", last.parallel, within[-1])
        numbers = dict(nodes=last.nodes, shares=within[-1] * last.nodes)
        self._solve = kernels.solve, dict(level=last, inverse=self.inverse), numbers
        vectors = "f32" if runtime.arch_name() == "vulkan" else "f64"
        self._ends = kernels_of(LevelKernels, 3, vectors, self._wide(matrices[0], parallel))
        self._bound = {}

    def _wide(self, M, parallel: bool) -> bool:
        return parallel and nodes_of(M) > self.wide or not runtime.runs_on_cpu()

    def put(self, matrices: list, ways: list) -> bool:
        """Set the numbers of other matrices and ways; False where their entries are not in the same places."""
        if [len(M.data) for M in (*matrices, *ways)] != self._entries:
            return False
        self.levels[0].put_numbers(matrices[0])
        for (_, between, _), P in zip(self._down, ways):
            runtime.fill(between["down"].values, rows_of(P.T.tobsr(P.blocksize[::-1]).data))
            runtime.fill(between["up"].values, rows_of(P.data))
        self.put_below(matrices[1:] or matrices)
        return True

    def put_below(self, matrices: list, anew=(True,)) -> None:
        """Set the numbers of the levels below the finest one, if there are any, and of the inverse of scenes that are
        `anew`."""
        for level, M in zip(self.levels[1:-1], matrices):
            level.put_numbers(M)
        if matrices:
            self.inverse.put(matrices[-1], anew)

    def couple(self, M, overlap: float) -> None:
        """Let a matrix of contact join the finest level, at most so many times its diagonal blocks."""
        finest = self.levels[0]
        self._renew([finest.couple(M)])
        finest.widen(max(finest.largest, overlap))

    def put_contact_below(self, matrices: list, more: list) -> None:
        """Let matrices of contact join those of the levels below the finest one."""
        self._renew([level.put_contact(M, own) for level, M, own in zip(self.levels[1:-1], matrices, more)])
        self.inverse.put_dense((matrices[-1] + more[-1]).toarray())

    def _renew(self, others: list) -> None:
        """Kernels are bound anew where arrays are others."""
        if any(others):
            self.renewals, self._bound = self.renewals + 1, {}

    def parts(self, at, scale: float = 1.0) -> list:
        """(kernel, records, numbers) one after the other: at.z = Q V Q^T at.r; scale: what brings r to about one."""
        finest = self.levels[0]
        own, nodes = dict(at=at, level=finest, frames=self.frames), finest.nodes
        enter = self._ends.enter, own, dict(nodes=nodes, scale=scale)
        leave = self._ends.leave, own, dict(nodes=nodes, scale=1 / scale)
        return [enter, *self._down, self._solve, *self._up, leave]

    def __call__(self, at, scale: float) -> None:
        parts = self.parts(at, scale)
        if id(at) not in self._bound:
            lanes = runtime.runs_on_cpu()  # vectors stay vectors, which takes half the time
            self._bound[id(at)] = [kernel.bind(lanes, **records) for kernel, records, _ in parts], at
        for launch, (_, _, numbers) in zip(self._bound[id(at)][0], parts):
            launch(**numbers)
