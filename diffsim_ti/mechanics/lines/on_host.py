"""Springs and cables in float64 on the host: energy, forces, products.

The numbers are those of inputs/lines.py: T = a + k e, e = L - L0 + s, and where a line element pulls only, e is zero
where it would be less. d = D + C u: segments, D at rest, C from displacements of vertices.
"""

import numpy as np

from diffsim_ti.differentiation.arrays import Node, ratio, summed_at, times, value_of
from diffsim_ti.inputs.lines import directions
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mechanics.lines.pull import across, tension


class LinesOnHost(HostForce):
    """Springs and, after them, cables, of `SpringsAndCables`; `at` says what they are at a time."""

    has_energy = symmetric = True

    def __init__(self, lines):
        self.paths = paths = lines.paths
        self.one_sided, self.cables, num_vertices = lines.one_sided, lines.cables, lines.mesh.num_vertices
        self._may_be_slack = self.one_sided & ~lines.keyed  # as the run begins, and then for good
        self._by_length = ~lines.by_tension
        places, starts = paths.matrix(num_vertices), paths.starts
        self.parted = (places[starts + 1] - places[starts]).tocsr()  # C
        self.together = self.parted.T.tocsr()  # its transpose, built once
        self._squared = self.together.multiply(self.together).tocsr()
        entries = self.parted.tocoo()
        self._entries = entries.row, entries.data
        pairs, self._pair = np.unique(paths.path_of[entries.row] * num_vertices + entries.col, return_inverse=True)
        self._pair_path, self._pair_vertex = np.divmod(pairs, num_vertices)
        self.num_vertices = num_vertices

    def at(self, segments: np.ndarray, tension: np.ndarray, slack: np.ndarray, stiffness: np.ndarray) -> "LinesOnHost":
        """With segments at rest (points, 3) [m], and a, s, k of each line element."""
        self.D, self.a, self.s, self.k = segments[self.paths.starts], tension, slack, stiffness
        self._seen = None
        return self

    def take(self, values, instant):
        super().take(values, instant)
        return self.at(values.line_segments, *self._numbers(values.lines))

    def _numbers(self, rows: np.ndarray) -> tuple:
        """(a, s, k) of the instant, of rows or of their change; the pull of springs is there from the start of statics."""
        a, s, k = self.instant.schedule.lines(rows, self.instant.j, self.instant.share)
        return a * np.where(self.cables, self.instant.load, 1.0), s, k

    def stiffest(self, values, schedule):
        """The largest tension and stiffness of each in all rows, and its least length."""
        ends = values.lines.reshape(len(values.lines), -1, 2, 3)
        a, s = ends[:, :, 0, :2].max((0, 2)), ends[:, :, 1, :2].max((0, 2))
        return self.at(values.line_segments, a, s, ends[:, :, 0, 2].max(0))

    def _sums(self, of_segments):
        """Of each path."""
        return summed_at(self.paths.path_of, of_segments, len(self.paths))

    def _state(self, u):
        """(directions, d, T/|d|, of a spring without length k, lengths, L - L0, k as far as it pulls, T)"""
        records = isinstance(u, Node)
        if not records and self._seen is not None and np.array_equal(self._seen[0], u):
            return self._seen[1]
        moved = times(self.parted, u)
        d = self.D + moved
        length = np.linalg.norm(d, axis=1)
        both = length + np.linalg.norm(self.D, axis=1)
        stretch = self._sums(ratio((moved * (self.D + d)).sum(1), both))
        e = stretch + self.s
        pulls = ~(self.one_sided & (e <= 0))
        T = tension(self.a, self.k, e * pulls)
        q = np.where(value_of(length) > 0, ratio(T[self.paths.path_of], length), self.k[self.paths.path_of])
        out = ratio(d, length[:, None]), d, q, length, stretch, self.k * pulls, T
        self._seen = None if records else (np.array(u), out)
        return out

    @staticmethod
    def _across(t, q, x):
        """q = T/|d| of what of x lies across segments."""
        return across(q[:, None], t, (t * x).sum(1)[:, None], x)

    def lengths(self, u: np.ndarray) -> np.ndarray:
        """Length of each path [m]."""
        return self._sums(self._state(u)[3])

    def tensions(self, u: np.ndarray) -> np.ndarray:
        """T of each [N]."""
        return self._state(u)[-1]

    def energies(self, u: np.ndarray) -> np.ndarray:
        """a (L - L0) + k e^2 / 2 of each [J]."""
        *_, stretch, k, _ = self._state(u)
        return self.a * stretch + 0.5 * k * (stretch + self.s) ** 2

    def stored(self, u: np.ndarray) -> dict[str, float]:
        """Of springs: cables are loads."""
        return {} if self.cables.all() else dict(springs=float(self.energies(u)[~self.cables].sum()))

    def load_energy(self, u):
        """Of cables."""
        return float(self.energies(u)[self.cables].sum())

    def forces(self, u):
        _, d, q, *_ = self._state(u)
        return -times(self.together, q[:, None] * d)

    def loads(self, u):
        """Of cables."""
        t, *_, T = self._state(u)
        return -(self.together @ ((T * self.cables)[self.paths.path_of, None] * t))

    def sizes(self, u: np.ndarray) -> np.ndarray:
        T = np.abs(self._state(u)[-1])[self.paths.path_of]
        return abs(self.together) @ T

    def product(self, u: np.ndarray, w: np.ndarray, convex: bool = False) -> np.ndarray:
        """d2E/du2 w [N]; convex: without what pushes, which has negative curvature."""
        t, _, q, *_, k, _ = self._state(u)
        dd = self.parted @ w
        along = (k * self._sums((t * dd).sum(1)))[self.paths.path_of]
        across = self._across(t, np.maximum(q, 0) if convex else q, dd)
        return self.together @ (along[:, None] * t + across)

    def blocks(self, u: np.ndarray) -> np.ndarray:
        """3x3 diagonal blocks of d2E/du2 [N/m], shape (num_vertices, 3, 3)."""
        t, _, q, *_, k, _ = self._state(u)
        g, out = self._along_paths(t), np.zeros((self.num_vertices, 3, 3))
        np.add.at(out, self._pair_vertex, k[self._pair_path, None, None] * g[:, :, None] * g[:, None, :])
        across = self._stiffness_across(t, q)
        return out + (self._squared @ across.reshape(-1, 9)).reshape(-1, 3, 3)

    def _along_paths(self, t) -> np.ndarray:
        """dL/du of each pair of a path and a vertex, shape (pairs, 3)."""
        row, data = self._entries
        return np.stack([np.bincount(self._pair, data * t[row, d], len(self._pair_path)) for d in range(3)], 1)

    def _stiffness_across(self, t, q) -> np.ndarray:
        """`_across` as a matrix of each segment, shape (segments, 3, 3)."""
        return np.stack([self._across(t, q, np.tile(axis, (len(t), 1))) for axis in np.eye(3)], 2)

    def turning(self, u: np.ndarray, w: np.ndarray) -> float:
        """The largest |C w| / |d| of segments that have a length."""
        length, moved = self._state(u)[3], np.linalg.norm(self.parted @ w, axis=1)
        return float(np.divide(moved, length, out=np.zeros_like(moved), where=length > 0).max(initial=0.0))

    def matrix(self, u: np.ndarray):
        """d2E/du2 [N/m] as a SciPy sparse matrix, rows 3 i + d: C^T (k t t^T along each path + what lies across) C."""
        from scipy.sparse import block_diag, csr_matrix, diags, identity, kron

        t, _, q, *_, k, _ = self._state(u)
        across = self._stiffness_across(t, q)
        C = kron(self.parted, identity(3), "csr")
        places = np.repeat(self.paths.path_of, 3), np.arange(t.size)
        g = csr_matrix((t.ravel(), places), shape=(len(self.paths), t.size)) @ C  # dL/du of each path
        return C.T @ block_diag(list(across), "csr") @ C + g.T @ diags(k) @ g

    def row_sums(self, u: np.ndarray) -> np.ndarray:
        """A bound of the sums of |d2E/du2| over the block row of each vertex [N/m]."""
        t, _, q, *_, k, _ = self._state(u)
        size = np.linalg.norm(self._along_paths(t), axis=1)
        whole = np.bincount(self._pair_path, size, len(self.paths))
        out = np.bincount(self._pair_vertex, (k * whole)[self._pair_path] * size, self.num_vertices)
        C = abs(self.parted)
        return out + C.T @ (np.abs(q) * np.asarray(C.sum(1)).ravel())

    def resisted(self):
        """Along paths that are elastic and not slack as the run begins, or whose length is given over time."""
        size = np.abs(self.values.rest - self.values.rest.mean(0)).max()
        slack = self.values.lines[0].reshape(-1, 2, 3)[:, 1, :2].max(1) < -1e-9 * size
        holds = (self.k > 0) & self._by_length & ~(self._may_be_slack & slack)
        C, t, path = self.parted.tocoo(), directions(self.D), self.paths.path_of
        rows, vertices, vectors = [], [], []
        for number, axis in enumerate((None, *np.eye(3))):  # a spring without length holds in all directions
            own = holds[path[C.row]] & (t.any(1)[C.row] == (axis is None))
            row = C.row[own]
            rows.append(path[row] + number * len(self.paths))
            vertices.append(C.col[own])
            vectors.append(C.data[own, None] * (t[row] if axis is None else axis))
        return np.concatenate(rows), np.concatenate(vertices), np.concatenate(vectors)
