"""Algebraic multigrid of the body at rest, turned with it, as a preconditioner for c M + d2E/du2."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mechanics.stress.projection import without_negative
from diffsim_ti.mechanics.supports.free import Free, FreeDirections, projectors_of
from diffsim_ti.solvers.implicit.cycle import Cycle, upload_rows
from diffsim_ti.solvers.implicit.device_cg import DeviceCG
from diffsim_ti.solvers.implicit.factorised import eliminated
from diffsim_ti.solvers.implicit.preconditioners import Preconditioner
from diffsim_ti.solvers.implicit.rotations import Frames


class Multigrid(Preconditioner):
    """Smoothed aggregation on the assembled matrix of the rest state, host forces included, with rigid motions as near
    kernel.

    Isotropic laws: turning a body turns its stiffness, K(R u) = R K(u) R^T. So residuals are turned back by each vertex's
    mean rotation, and corrections forth. Contact stiffness, and that of host forces as it changes, join the finest level.
    The V-cycle over it is cycle.py's.
    Below ten-node tetrahedra lie the linear ones of their corners, and aggregates of these (p-multigrid): aggregates of all
    ten nodes take half as many iterations again.
    Of ties (terms/glued.py) the matrix is T^T K T, with the large weights of T alone; residuals and corrections take all.
    Vanek, Mandel, Brezina 1996, doi:10.1007/BF02238511; Bell, Olson, Schroder, PyAMG, doi:10.21105/joss.04142; Heys,
    Manteuffel, McCormick, Olson 2005, Algebraic multigrid for higher-order finite elements, doi:10.1016/j.jcp.2004.09.021.
    """

    direct = 200  # nodes of which the inverse itself takes less time than levels below them

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray, parallel: bool = False):
        self.potential, self.free = potential, free
        mesh, rest = potential.arrays.mesh, potential.arrays.values.rest
        with potential.at_rest():
            at, hosts = potential.held_at, potential.hosts.matrices(potential.held_at)
            potential.blocks()
            matrix, diagonal = assemble(potential, mass, free, [own for own, _ in hosts])
            self._ties = getattr(free, "elimination", None)
            if self._ties is not None:
                matrix, diagonal = glued(matrix, _short(self._ties))
            self._known = np.zeros((len(at), 3, 3))  # of what `update` adds
            for _, own in hosts:
                self._known = self._known + (free.around(own) if isinstance(free, FreeDirections) else own)
        aggregated, allowed = matrix, free
        if mesh.order == 2:
            aggregated, allowed, rest, up = of_corners(matrix, free, mesh, rest, self._ties)
        matrices, ways = [aggregated], []
        changes = potential.arrays.contacts or potential.pairs or potential.hosts  # on the finest level
        scenes = potential.arrays.num_scenes
        if changes or len(rest) > scenes * self.direct:
            matrices, ways = _aggregated(aggregated, _allowed(_rigid_motions(rest), allowed), scenes)
        if mesh.order == 2:
            matrices, ways = [matrix, *matrices], [up, *ways]
        self._at_rest = matrix.data[diagonal]
        self.frames = Frames(potential, parallel)
        self.frames.allowed = upload_rows(projectors_of(free), 3)
        matrices, ways = [as_blocks(M) for M in matrices], [as_blocks(P) for P in ways]
        self.cycle = Cycle(matrices, ways, self.frames, parallel)
        self.solver = DeviceCG(potential, self.cycle, free, parallel)
        self._contact = None

    def updating(self) -> tuple[list, object]:
        changes = self.potential.arrays.contacts or self.potential.pairs or self.potential.hosts
        return ([], None) if changes else ([self.frames.part], self.frames.body)

    def update(self, u: np.ndarray) -> None:
        """Adapt to the displacement at which the potential is placed."""
        self.frames.update()
        contact = self.potential.contact_blocks()
        if contact is None:
            return
        contact = without_negative(contact)  # edges and points yield sideways, for which a cycle has no place
        if isinstance(self.free, FreeDirections):
            contact = self.free.around(contact)
        R = self.frames.matrices()
        contact = np.swapaxes(R, 1, 2) @ contact @ R - self._known
        before = np.zeros_like(contact) if self._contact is None else self._contact
        changed = np.flatnonzero((contact != before).any((1, 2)))
        if len(changed):
            self.cycle.put_diagonal(self._at_rest[changed] + contact[changed], changed)
        self._contact = contact

    def __call__(self, r: np.ndarray) -> np.ndarray:
        solver, T = self.solver, self._ties
        r = r if T is None else (T.T @ r.ravel()).reshape(r.shape)
        runtime.fill(solver.r, r[None])
        self.cycle(solver, 1.0 / (np.linalg.norm(r) or 1.0))
        z = runtime.fetch_row(solver.z, 0)
        return (z if T is None else (T @ z.ravel()).reshape(z.shape)) * self.free


def _aggregated(matrix, motions: np.ndarray, scenes: int = 1) -> tuple[list, list]:
    """(matrices of all levels, ways from each to the one before) by smoothed aggregation, which leaves rigid motions to the
    coarse ones. Of several scenes those of the first say the ways of all."""
    import pyamg

    if scenes > 1:
        n = matrix.shape[0] // scenes
        one = matrix.tocsr()[:n, :n].tobsr(matrix.blocksize)
        ways, matrices = [_repeated(P, scenes) for P in _aggregated(one, motions[:n])[1]], [matrix]
        for P in ways:
            matrices.append((P.T @ matrices[-1] @ P).tobsr((P.blocksize[1],) * 2))
        return matrices, ways

    state = np.random.get_state()
    np.random.seed(0)  # pyamg estimates a spectral radius from a random vector
    try:
        levels = pyamg.smoothed_aggregation_solver(
            matrix,
            B=motions,
            strength=("symmetric", {"theta": 0.08}),
            improve_candidates=(("block_gauss_seidel", {"sweep": "symmetric", "iterations": 2}), None),
            max_coarse=min(100, matrix.shape[0] // (4 * matrix.blocksize[0])),
        ).levels
    finally:
        np.random.set_state(state)
    return [matrix, *(level.A for level in levels[1:])], [level.P for level in levels[:-1]]


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
