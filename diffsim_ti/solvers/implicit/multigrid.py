"""Algebraic multigrid of the body at rest, turned with it, as a preconditioner for c M + d2E/du2."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mechanics.stress.projection import Projection
from diffsim_ti.mechanics.supports.free import Free, FreeDirections, projectors_of
from diffsim_ti.runtime import kernels_of
from diffsim_ti.solvers.implicit.contact_kernels import ContactKernels
from diffsim_ti.solvers.implicit.cycle import (
    Cycle,
    diagonal_blocks,
    inverses,
    largest_eigenvalue,
    nodes_of,
    upload_rows,
    without,
)
from diffsim_ti.solvers.implicit.device_cg import DeviceCG
from diffsim_ti.solvers.implicit.factorised import eliminated
from diffsim_ti.solvers.implicit.preconditioners import Preconditioner
from diffsim_ti.solvers.implicit.rotations import Frames

STRONG = 0.07  # share of the mean of two diagonals from which on aggregates join; measured


@dataclass(frozen=True)
class Following:
    """The state that the matrices of a run are of: its displacements, None at rest; iterations of conjugate gradients per
    decade of residual there; iterations spent beyond that since. It goes with the states of a run, so that one that starts
    again from any of them takes the same steps."""

    place: np.ndarray | None = None
    usual: float | None = None
    excess: float = 0.0

    def numbers(self) -> np.ndarray:
        """For a file."""
        place = () if self.place is None else self.place.ravel()
        return np.array([self.excess, self.usual or 0.0, *place])

    @classmethod
    def of(cls, numbers: np.ndarray, shape: tuple) -> "Following":
        """Of `numbers`, for displacements of a shape. Raises ValueError."""
        if numbers.shape not in ((2,), (2 + np.prod(shape),)) or not np.all(np.isfinite(numbers)):
            raise ValueError(
                f"resume: preconditioner: expected 2 finite numbers, or {2 + np.prod(shape)}, as `state` has them, got an "
                f"array of shape {numbers.shape}"
            )
        return cls(numbers[2:].reshape(shape) if len(numbers) > 2 else None, float(numbers[1]), float(numbers[0]))


class Multigrid(Preconditioner):
    """Smoothed aggregation on the assembled matrix, host forces included, with rigid motions as near kernel: of the rest
    state, or of the one that `following` names.

    Isotropic laws: turning a body turns its stiffness, K(R u) = R K(u) R^T. So residuals are turned back by each vertex's
    mean rotation, and corrections forth. Contact stiffness, and that of host forces as it changes, join the finest level;
    of large bodies that of obstacles joins the others, too. Of contact between surfaces all that is convex joins all levels.
    Where strains have grown so much that iterations in excess cost more than numbers of the matrices do, these are made anew
    at the present state, its tetrahedra made positive semidefinite, on the same aggregates.
    The V-cycle over it is cycle.py's.
    Below ten-node tetrahedra lie the linear ones of their corners, and aggregates of these (p-multigrid): aggregates of all
    ten nodes take half as many iterations again.
    Of ties (terms/glued.py) the matrix is T^T K T, with the large weights of T alone; residuals and corrections take all.
    Vanek, Mandel, Brezina 1996, doi:10.1007/BF02238511; Bell, Olson, Schroder, PyAMG, doi:10.21105/joss.04142; Heys,
    Manteuffel, McCormick, Olson 2005, Algebraic multigrid for higher-order finite elements, doi:10.1016/j.jcp.2004.09.021.
    """

    direct = 200  # nodes of which the inverse itself takes less time than levels below them
    # measured: iterations that new numbers cost, of a large body, and more, times the vertices, of a small one
    price = 40, 50_000
    # what iterations per decade at rest may be taken for; change of C = F^T F from which on numbers may be poor
    usual, strained = (1.5, 3.0), 0.1
    # vertices of all scenes from which on coarse levels take contact; how many times as stiff as a vertex it is at least,
    # over the vertices along a cube's edge, for smoothing sees to less; the change of its share there that they take.
    # Of equilibria of what is loose at rest they take all.
    large, stiff, changed = 1000, 50, 0.5
    few = 100  # vertices up to which contact between surfaces is taken for its diagonal blocks, in one kernel of all

    def __init__(self, potential, mass: np.ndarray, free: Free, run=None, parallel: bool = False):
        """run: what has the `following` of a run; on one thread a cycle is where threads take scenes."""
        self.potential, self.mass, self.free = potential, mass, free
        self.run = run or SimpleNamespace(following=Following())
        self._ties = getattr(free, "elimination", None)
        a = potential.arrays
        self._follows = (
            potential.z is None and potential.held is None and not potential.hosts and a.values.growths is None
        ) and (a.num_scenes == 1 and not a.law.linear)
        self.frames, within = Frames(potential, parallel), parallel and not a.by_scene
        self.frames.allowed = upload_rows(projectors_of(free))
        self._aggregates = None
        with potential.at_rest():
            self.frames.update()
            matrices, ways = self._levels()
        if a.contacts and a.num_scenes == 1 and ways and not mass.any() and is_loose(matrices[-1]):
            self.large = self.stiff = 0
        self.place = None
        self.couples = bool(potential.pairs and ways) and self._ties is None and len(mass) > self.few
        self._forget_contact(matrices, ways)
        self.cycle = Cycle(matrices, ways, self.frames, within, self.couples)
        if self.cycle.couples_below:
            self.large = self.stiff = 0
        self.solver = DeviceCG(potential, self.cycle, free, parallel)
        if self._changes:
            self._make_join(parallel)

    def _make_join(self, parallel: bool) -> None:
        a, n, precision = self.potential.arrays, len(self.mass), self.solver.precision
        own = runtime.array(runtime.array_types(precision)["vectors"].dtype, 3, n)
        self._joined = SimpleNamespace(own=own, touched=runtime.array(ti.i32, n), hard=runtime.array(ti.i32, n))
        records = dict(at=self.potential.barriers, frames=self.frames, turning=self.frames.body, body=self._joined)
        records["level"] = self.cycle.levels[0]
        within, alone = parallel and not a.by_scene, parallel  # in one kernel with others, and in its own
        within, alone = (kernels_of(ContactKernels, a.precision, precision, p).join for p in (within, alone))
        self._join, self._launch = (within, records, dict(vertices=n)), alone.bind(**records)
        self._begin_join()

    def _begin_join(self) -> None:
        """The finest level has other numbers."""
        runtime.fill(self._joined.own, np.moveaxis(self._diagonal - self._known, 2, 0))
        runtime.fill(self._joined.touched, self._known.any((1, 2)))
        self._join[2]["theta"] = self.cycle.levels[0].theta

    def begin(self) -> None:
        super().begin()
        self._is_new = np.ones(self.potential.arrays.num_scenes, bool)
        place = self.run.following.place if self._follows else None
        if self.place is not place:
            self._go_to(place)

    def _go_to(self, place: np.ndarray | None) -> None:
        """Make the numbers of the matrices those of another state."""
        self.place, u = place, self.potential.held_at
        if place is None:
            with self.potential.at_rest():
                self.frames.update()
                self._put(*self._levels())
            if self._changes:
                self._begin_join()
            return
        self.potential.place(place)
        self.frames.update()
        for slight in (0.01, 0.0):
            correction = Projection(self.potential, slight)
            matrices, ways = self._levels([correction.matrix(obstacles=False)] if len(correction.C) else [])
            if is_definite(matrices[-1]):
                break
        self._follows = self._put(matrices, ways)
        if not self._follows:  # entries lie in other places: from here on as at rest
            self._go_to(None)
        elif self._changes:
            self._begin_join()
        self.potential.place(u)

    def _put(self, matrices: list, ways: list) -> bool:
        self._forget_contact(matrices, ways)
        return self.cycle.put(matrices, ways)

    def _forget_contact(self, matrices: list, ways: list) -> None:
        """Levels below the finest one have none."""
        scenes, n = self.potential.arrays.num_scenes, self.potential.arrays.vertices_of_one
        self._made, self._below, self._contact = (matrices[1:], ways), matrices[1:], np.zeros((scenes, n))
        self._full = None  # of one body with one level below the finest one, as dense arrays
        self._acts = False  # whether contact between surfaces is on the finest one

    def _bring_contact_down(self, met: bool) -> None:
        """Contact between surfaces joins the finest level; the levels below it take all contact, where it has changed by
        much or a solve begins."""
        potential, a = self.potential, self.potential.arrays
        of_pairs = self._couple() if self.couples else None
        if not (of_pairs or a.contacts) or a.num_vertices <= self.large or self._ties is not None:
            return
        blocks = potential.obstacle_blocks(met) if a.contacts else np.zeros_like(self._diagonal)
        size = np.abs(np.einsum("kii->k", blocks))
        if a.contacts and potential.pairs:
            potential.put_contact_blocks()
        if of_pairs:
            size += np.abs(np.einsum("kii->k", of_pairs[1]))
        anew, size = self._changed(size.reshape(a.num_scenes, -1))
        if not anew.any():
            return
        from scipy.sparse import bsr_matrix

        self.frames.update()
        (matrices, ways), levels = self._made, []
        at = np.flatnonzero(size.ravel() * blocks.any((1, 2)) * np.repeat(anew, a.vertices_of_one))
        turns = projectors_of(self.free)[at] @ self.frames.matrices()[at]
        values, vectors = np.linalg.eigh(0.5 * (blocks[at] + np.swapaxes(blocks[at], 1, 2)))
        roots = np.swapaxes(turns, 1, 2) @ vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        more, start = roots @ np.swapaxes(roots, 1, 2), np.searchsorted(at, np.arange(size.size + 1))
        if not of_pairs and len(matrices) == 1 and self.cycle.inverse.is_of_one_body:
            if self._full is None:
                self._full = matrices[0].toarray(), ways[0].toarray().reshape(size.size, 3, -1)
            M, P = self._full[0], self._full[1][at]
            self.cycle.inverse.put_dense(M + np.tensordot(P, more @ P, ((0, 1), (0, 1))))
            return
        more = bsr_matrix((more, at, start), shape=2 * (3 * size.size,))
        if of_pairs:
            more = more + of_pairs[0]
            for M, P in zip(matrices, ways):
                more = (P.T @ (more @ P)).tobsr(M.blocksize)
                levels.append(more)
            self.cycle.put_contact_below(matrices, levels)
            return
        for M, P, before in zip(matrices, ways, self._below):
            more = (P.T @ (more @ P)).tobsr(M.blocksize)
            levels.append(with_blocks(M, more))
            stay = ~np.repeat(anew, len(M.data) // a.num_scenes)
            levels[-1].data[stay] = before.data[stay]
        self._below = levels
        self.cycle.put_below(levels, anew)

    def _changed(self, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(mask of the scenes of which coarse levels take contact anew, size of what they take at vertices) for such a size
        of contact, shape (scenes, vertices): none where it is too soft for them."""
        known, stiffness = self._contact.any(1), np.abs(np.einsum("kii->k", self._diagonal)).reshape(size.shape)
        soft = ~(size * size.shape[1] ** (1 / 3) > self.stiff * stiffness).any(1)
        size = size * ~(soft & (self._is_new | ~known))[:, None]
        share = size / (size + stiffness + 1e-300)
        change, most = np.abs(share - self._contact), np.maximum(share, self._contact)
        anew = change.sum(1) > self.changed * most.sum(1)
        anew |= self._is_new & (size.any(1) | known)
        self._is_new, self._contact[anew] = self._is_new & ~anew, share[anew]
        return anew, size

    def _couple(self) -> tuple | None:
        """Let contact between surfaces join the finest level, which has diagonal blocks of it by itself: its matrix and
        these, turned back, for the levels below; None where these take none."""
        pairs, finest = self.potential.pairs, self.cycle.levels[0]
        M, diagonal = pairs.stiffness(self.potential.u)
        acts = bool(len(M.data))
        if acts or self._acts:
            self.frames.update()
            turns = projectors_of(self.free) @ self.frames.matrices()
            M, diagonal = turned(M, turns, turns), np.swapaxes(turns, 1, 2) @ diagonal @ turns
            self.cycle.couple(without(M, diagonal), acts * pairs.overlap)
            self._join[2]["theta"], self._acts = finest.theta, acts
        return (M, diagonal) if self.cycle.couples_below else None

    def _levels(self, more=()) -> tuple[list, list]:
        """(matrices of all levels, ways from each to the one before) where the potential stands, turned back by frames."""
        potential, free = self.potential, self.free
        a, mesh = potential.arrays, potential.arrays.mesh
        hosts, R = potential.hosts.matrices(potential.held_at), self.frames.matrices()
        x = a.values.rest + potential.held_at
        potential.blocks()
        matrix, diagonal = assemble(potential, self.mass, free, [*more, *(own for own, _ in hosts)])
        if self._ties is not None:
            matrix, diagonal = glued(matrix, _short(self._ties))
        self._known = np.zeros((len(x), 3, 3))  # of what `update` adds
        for _, own in hosts:
            self._known = self._known + (free.around(own) if isinstance(free, FreeDirections) else own)
        aggregated, allowed, above, ways = matrix, free, [], []
        if mesh.order == 2:
            aggregated, allowed, x, up = of_corners(matrix, free, mesh, x, self._ties)
            ways, above = [turned(as_blocks(up), R, R[mesh.corners])], [turned(matrix, R, R)]
            R = R[mesh.corners]
        matrices = [turned(aggregated, R, R)]
        self._diagonal = (above or matrices)[0].data[diagonal]
        if self._changes or len(x) > a.num_scenes * self.direct:  # changes are on the finest level
            motions = np.swapaxes(R, 1, 2) @ (projectors_of(allowed) @ _rigid_motions(x))
            motions = motions.reshape(-1, 6)
            matrices, found, self._aggregates = smoothed(matrices[0], motions, self._aggregates, a.num_scenes)
            ways = [*ways, *found]
        return [as_blocks(M) for M in (*above, *matrices)], [as_blocks(P) for P in ways]

    def learn(self, residual: float, iterations: int) -> None:
        """What a solve took."""
        if not (0 < residual < 0.5 and iterations > 1):
            return
        now, known = self.run.following, iterations / -np.log10(residual)
        usual = now.usual or max(known, self.usual[0])
        if now.place is None:  # a solve that was the first one, but not at rest, says too much
            usual = min(usual, self.usual[1])
        excess = max(iterations * (1 - usual / known), 0.0)
        self.run.following = Following(now.place, usual, now.excess + excess)

    def _is_poor(self, u: np.ndarray) -> bool:
        """Whether other numbers would pay."""
        fixed, small = self.price
        now = self.run.following
        if not self._follows or now.excess <= fixed + small / len(u):
            return False
        nodes, N, V = self.potential.stress_points
        here, there = (
            np.einsum("eai,eaj->eij", (np.zeros_like(u) if w is None else w)[nodes], N) + np.eye(3)
            for w in (u, self.place)
        )
        here, there = (np.swapaxes(F, 1, 2) @ F for F in (here, there))
        change = ((here - there) ** 2).sum((1, 2)) / (there**2).sum((1, 2))
        self.run.following = Following(now.place, now.usual)
        return bool((V * change).sum() > self.strained**2 * V.sum())

    @property
    def _changes(self) -> bool:
        """Whether the finest level changes beside its turning."""
        return bool(self.potential.arrays.contacts or self.potential.pairs or self.potential.hosts)

    def updating(self) -> tuple[list, object]:
        return (
            ([self.frames.part, self._join], self._joined) if self._changes else ([self.frames.part], self.frames.body)
        )

    def follow(self, u: np.ndarray, met: bool = False) -> None:
        if self._is_poor(u):
            self.run.following = Following(u.copy())
            self._go_to(self.run.following.place)
            if self._changes:
                self.potential.put_contact_blocks()
        self._bring_contact_down(met)

    def update(self, u: np.ndarray, met: bool = False) -> None:
        self.follow(u, met)
        self.frames.update()
        if not self._changes:
            return
        if not met or self.potential.hosts:
            self.potential.put_contact_blocks()
        self._launch(**self._join[2])
        hard = np.flatnonzero(runtime.fetch(self._joined.hard))
        if len(hard):
            self.cycle.levels[0].invert(hard)

    def __call__(self, r: np.ndarray) -> np.ndarray:
        solver, T = self.solver, self._ties
        r = r if T is None else (T.T @ r.ravel()).reshape(r.shape)
        runtime.fill(solver.r, r[None])
        self.cycle(solver, 1.0 / (np.linalg.norm(r) or 1.0))
        z = runtime.fetch_row(solver.z, 0)
        return (z if T is None else (T @ z.ravel()).reshape(z.shape)) * self.free


def smoothed(
    matrix, motions: np.ndarray, aggregates: list | None = None, scenes: int = 1
) -> tuple[list, list, list | None]:
    """(matrices of all levels, ways from each to the one before, aggregates of each level but the last) by smoothed
    aggregation, which leaves motions, shape (3 nodes, 6), to the coarse ones; aggregates: of the same matrix with other
    numbers. Of several scenes those of the first say the ways of all."""
    from pyamg.aggregation import standard_aggregation
    from pyamg.aggregation.tentative import fit_candidates
    from pyamg.strength import symmetric_strength_of_connection
    from scipy.sparse import bsr_matrix

    if scenes > 1:
        n = matrix.shape[0] // scenes
        one = smoothed(matrix.tocsr()[:n, :n].tobsr(matrix.blocksize), motions[:n])[1]
        ways, matrices = [_repeated(P, scenes) for P in one], [matrix]
        for P in ways:
            matrices.append((P.T @ (matrices[-1] @ P)).tobsr((6, 6)))
        return matrices, ways, None

    matrices, ways, found = [matrix], [], []
    most = min(100, matrix.shape[0] // (4 * matrix.blocksize[0]))
    while len(found) < len(aggregates) if aggregates is not None else nodes_of(matrices[-1]) > most:
        A = matrices[-1]
        if aggregates is not None:
            own = aggregates[len(found)]
        else:
            own, _ = standard_aggregation(symmetric_strength_of_connection(A, STRONG))
            if not 0 < own.shape[1] < own.shape[0]:
                break
        tentative, motions = fit_candidates(own, motions)
        blocks = diagonal_blocks(A)
        rows = np.repeat(np.arange(nodes_of(A)), np.diff(A.indptr))
        A.largest = largest_eigenvalue(A, blocks)  # which its level needs, too
        data = inverses(blocks)[rows] @ A.data * (-4 / (3 * A.largest))
        data[rows == A.indices] += np.eye(A.blocksize[0])
        P = bsr_matrix((data, A.indices, A.indptr), shape=A.shape) @ tentative  # by a product, which keeps zeros
        ways.append(P)
        matrices.append((P.T @ (A @ P)).tobsr((6, 6)))
        found.append(own)
    return matrices, ways, found


def turned(M, rows: np.ndarray, columns: np.ndarray):
    """R^T M Q for rotations R of the rows of blocks, and Q of the columns."""
    from scipy.sparse import bsr_matrix

    at = np.repeat(np.arange(nodes_of(M)), np.diff(M.indptr))
    data = np.swapaxes(rows, 1, 2)[at] @ M.data @ columns[M.indices]
    return bsr_matrix((data, M.indices, M.indptr), shape=M.shape)


def is_loose(M) -> bool:
    """Whether a matrix lets something move freely: `positive_inverse` raises such eigenvalues."""
    A = M.toarray()
    values = np.linalg.eigvalsh(A[np.ix_(*2 * (np.diagonal(A) > 0,))])
    return len(values) > 0 and bool(values[0] < 1e-6 * values[-1])


def is_definite(M) -> bool:
    """Whether the least eigenvalue of a matrix is not negative, but for rounding."""
    values = np.linalg.eigvalsh(M.toarray())
    return bool(values[0] > -1e-9 * values[-1])


def with_blocks(M, more):
    """M and another matrix, whose blocks are among those of M."""
    out, places = M.copy(), []
    more.sort_indices()
    for A in (M, more):
        places.append(np.repeat(np.arange(nodes_of(A)), np.diff(A.indptr)) * nodes_of(A) + A.indices)
    out.data[np.searchsorted(*places)] += more.data
    return out


def _repeated(M, count: int):
    """The block-diagonal matrix of so many M."""
    from scipy.sparse import bsr_matrix

    k, columns = len(M.indices), M.shape[1] // M.blocksize[1]
    each = np.arange(count)[:, None]
    start = np.append((M.indptr[:-1] + k * each).ravel(), k * count)
    shape = M.shape[0] * count, M.shape[1] * count
    return bsr_matrix((np.tile(M.data, (count, 1, 1)), (M.indices + columns * each).ravel(), start), shape=shape)


def as_blocks(M):
    """A matrix of pyamg or SciPy in blocks of 3 or 6 numbers a node."""
    if M.format != "bsr":
        M = M.tobsr((3, 3))
    M.sort_indices()
    return M


def _short(T):
    """T without weights below a thousandth, of which what is left keeps the sums of rows."""
    from scipy.sparse import diags

    near = T.multiply(abs(T) > 1e-3).tocsr()
    sums, kept = (np.asarray(M.sum(1)).ravel() for M in (T, near))
    return diags(np.divide(sums, kept, out=np.ones_like(sums), where=kept != 0)) @ near


def glued(matrix, T) -> tuple:
    """(T^T A T in blocks, places of its diagonal blocks), with a diagonal in the place of what T leaves out."""
    out = eliminated(matrix, T).tobsr((3, 3))
    out.sort_indices()
    rows = np.repeat(np.arange(out.shape[0] // 3), np.diff(out.indptr))
    return out, np.flatnonzero(rows == out.indices)


def of_corners(matrix, free: Free, mesh, rest: np.ndarray, T=None) -> tuple:
    """(matrix of the linear elements on the corners of ten-node ones, what these may do, their places, the interpolation
    from them: the middle of an edge moves by the mean of its ends)."""
    from scipy.sparse import diags, eye, kron

    corners = mesh.corners
    allowed = free[corners] if isinstance(free, np.ndarray) else free.of(corners)
    may, may_here = (_block_diagonal(projectors_of(x)) for x in (free, allowed))
    up = may @ kron(mesh.from_corners, eye(3)) @ may_here
    held = eye(3 * len(corners)) - may_here
    if T is not None:  # what follows others is made of these in both meshes
        stays = diags((np.diff(T.tocsc().indptr) > 0).astype(float))
        up = stays @ up @ (T @ up).tocsr()[(3 * corners[:, None] + np.arange(3)).ravel()]
        held = held + diags((np.diff(up.tocsc().indptr) == 0) * (1 - held.diagonal()))
    coarse = (up.T @ matrix @ up).tocsr()
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


def _rigid_motions(X: np.ndarray) -> np.ndarray:
    x, y, z = (X - X.mean(0)).T
    out = np.zeros((len(X), 3, 6))
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1
    out[:, 0, 3], out[:, 1, 3] = -y, x
    out[:, 1, 4], out[:, 2, 4] = -z, y
    out[:, 0, 5], out[:, 2, 5] = z, -x
    return out
