"""Displacement gradients of tetrahedra in the frames of a run; means and recovered values of what they make."""

import numpy as np

from diffsim_ti.differentiation.arrays import made, times, value_of
from diffsim_ti.mesh.jacobian import barycentric_in, solved
from diffsim_ti.mesh.reference_element import QUADRATIC, barycentric


def displacement_gradients(frames, derived, mesh, chosen) -> np.ndarray:
    """H = sum_a u_a (x) grad N_a at the points of chosen tetrahedra, shape (frames, points, 3, 3)."""
    u, elements = frames.displacements.astype(np.float64), mesh.elements[chosen]
    B = derived.gradients[chosen].reshape(-1, 3, 3)
    if mesh.order == 1:  # du/dxi, by edges
        return np.moveaxis(u[:, elements[:, 1:]] - u[:, elements[:, :1]], 2, 3) @ B
    return np.einsum("feai,qak->feqik", u[:, elements], _BY_XI, optimize=True).reshape(len(u), -1, 3, 3) @ B


_BY_XI = QUADRATIC.derivatives(QUADRATIC.points)
_LINEAR = np.linalg.inv(barycentric(QUADRATIC.points))  # corners' values of what is 1 at one of the points, 0 at others


class PointMeans:
    """Means over points by volumes V, T_i = sum c_ip V_p T_p / sum c_ip V_p; of item i over the points in row i of
    `around`, which holds the c_ip."""

    moves = False  # whether its shares move with the rest shape

    def __init__(self, around):
        self._around = around

    @classmethod
    def of_vertices(cls, mesh, of: np.ndarray) -> "PointMeans":
        """Of each vertex over the tetrahedra around, with the value that each has there: with one point that of the point,
        with four that of the linear function through them.

        of: tetrahedra that count alone at their vertices, none: all.
        """
        element, mask = mesh.reference, np.zeros(mesh.num_tetrahedra, bool)
        shares = np.ones((4, 1)) if element.order == 1 else barycentric(element.nodes) @ _LINEAR
        mask[of] = True
        own = np.zeros(mesh.num_vertices, bool)
        own[mesh.elements[mask]] = True
        counts = np.repeat((mask[:, None] | ~own[mesh.elements]).ravel(), element.num_points)
        rows = np.repeat(mesh.elements.ravel(), element.num_points)[counts]
        points = np.arange(mesh.num_tetrahedra * element.num_points).reshape(-1, element.num_points)
        columns = np.repeat(points, element.num_nodes, 0).ravel()[counts]
        weights = np.tile(shares.ravel(), mesh.num_tetrahedra)[counts]
        return cls(_matrix(weights, rows, columns, (mesh.num_vertices, points.size)))

    @classmethod
    def of_tetrahedra(cls, count: int, points: int) -> "PointMeans":
        """Of each tetrahedron over its points."""
        every = np.arange(count * points)
        return cls(_matrix(np.ones(len(every)), every // points, every, (count, len(every))))

    def value(self, T: np.ndarray, V: np.ndarray) -> np.ndarray:
        """T: (frames, points, ...) -> (frames, items, ...)."""
        sums = np.stack([times(self._around, frame) for frame in T * _like(V, T)])
        return sums / _like(times(self._around, V), T)


def followed(X: np.ndarray, located, start: np.ndarray) -> np.ndarray:
    """xi of places in ten-node tetrahedra at rest positions X, from those in the mesh: they stay where they are in space.
    Raises ValueError where X carries a tetrahedron too far away."""
    nodes = value_of(X)[located.vertices]
    xi, found = solved(nodes, located.points, start)
    if not found.all():
        k = int(np.argmin(found))
        raise ValueError(
            f"rest_positions carry tetrahedron {located.tetrahedra[k]} so far from point {k} at "
            f"{located.points[k].tolist()} that it cannot be followed; take a smaller step in the rest shape"
        )
    inverse = np.linalg.inv(np.einsum("pai,pak->pik", nodes, QUADRATIC.derivatives(xi)))
    by_nodes = -np.einsum("pki,pa->pkai", inverse, QUADRATIC.functions(xi))
    push = lambda dx: np.einsum("pkai,pai->pk", by_nodes, dx)  # noqa: E731
    return made(xi, (X[located.vertices], push, lambda seed: np.einsum("pkai,pk->pai", by_nodes, seed)))


class PointInterpolation:
    """Values at places in ten-node tetrahedra, of the linear functions that those at their four points make."""

    moves = True

    def __init__(self, mesh, located):
        self.located, self._start = located, barycentric_in(mesh.vertices[located.vertices], located.points)[:, 1:]

    def shares(self, X: np.ndarray) -> np.ndarray:
        """Of the points in the value, shape (4 k,)."""
        return (barycentric(followed(X, self.located, self._start)) @ _LINEAR).ravel()

    @staticmethod
    def value(T: np.ndarray, c: np.ndarray) -> np.ndarray:
        """T: (frames, points, ...) -> (frames, places, ...)."""
        return (T * _like(c, T)).reshape(len(T), -1, 4, *T.shape[2:]).sum(2)


def _matrix(weights: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]):
    from scipy.sparse import csr_matrix

    return csr_matrix((weights, (rows, columns)), shape)


def _like(per_item: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Numbers of items, to multiply arrays (frames, items, ...)."""
    return per_item.reshape(1, -1, *[1] * (T.ndim - 2))


def von_mises(T: np.ndarray) -> np.ndarray:
    """sqrt(3/2 s : s), s = T - tr T / 3, of symmetric tensors; its gradient is 0 where it is 0."""
    s = T - (T * np.eye(3)).sum((-1, -2))[..., None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * (s**2).sum((-1, -2)))


def stretches(E: np.ndarray) -> np.ndarray:
    """sqrt(1 + 2 E_i), ascending, E_i: eigenvalues of Green's strain."""
    squares = 1 + 2 * np.linalg.eigvalsh(E)
    least = value_of(squares).min()
    if not least > 0:  # of the linear function through the points of a ten-node tetrahedron
        raise ValueError(
            f"Strain: stretches of a strain whose 1 + 2 E is {least:.3g} at a vertex or point: it changes too "
            'much within one tetrahedron; take at="tetrahedra", or refine the mesh there'
        )
    return np.sqrt(squares)


# what tensors are shown by: (shape of the components, function); where eigenvalues coincide, slopes are those in the
# directions that the eigenvectors happen to have
NUMBERS = {"principal": ((3,), np.linalg.eigvalsh), "von_mises": ((), von_mises), "stretches": ((3,), stretches)}


def _monomials(z: np.ndarray, order: int) -> np.ndarray:
    """1, z_1, z_2, z_3 and, of order 2, their six products, along the last axis."""
    i, j = np.triu_indices(3) if order == 2 else (np.zeros(0, int),) * 2
    return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., j]], -1)


class PatchRecovery:
    """T at each vertex x_v: the value there of the polynomial, of the order of the elements' displacements, that is nearest
    in the weighted mean square to T at the points x_k of the elements around, and around these where they are too few:

        T(x_v) = sum_k c_k T_k,    c_k = w_k e_0 . A^-1 p(x_k - x_v),    A = sum_k w_k p p^T

    w_k: the distance |x_k - x_v| in the mesh as it was made to the power -4, the greatest of a vertex being 1.
    of: tetrahedra that count alone at their vertices, none: all.
    Zienkiewicz, Zhu 1992, The superconvergent patch recovery, doi:10.1002/nme.1620330702.
    """

    moves = True  # shares move with the rest shape
    size, fall = None, 4  # of patches [m]; weights fall with this power of the distance
    most = 24  # elements, the nearest, of a patch; more where these are too few
    worst = 1e-6  # least eigenvalue of A of monomials over its greatest

    def __init__(self, mesh, of: np.ndarray):
        element, n, m = mesh.reference, mesh.num_vertices, mesh.num_tetrahedra
        self.elements, self.order, self.num_points = mesh.elements, element.order, element.num_points
        self.N = element.functions(element.points)  # (points, nodes)
        own, mask = np.zeros(n, bool), np.zeros(m, bool)
        mask[of] = True
        own[mesh.elements[mask]] = True
        every = _matrix(
            np.ones(mesh.elements.size), mesh.elements.ravel(), np.repeat(np.arange(m), element.num_nodes), (n, m)
        )
        inner = every.multiply(mask[None]).tocsr()
        rows, middles, left = [np.zeros(0, np.int64)] * n, mesh.centroids, np.flatnonzero(np.diff(every.indptr))
        around, inner_around = every, inner
        for ring in range(1, 6):
            for v in left:
                source = inner_around if own[v] else around
                row = source.indices[source.indptr[v] : source.indptr[v + 1]]
                near = np.argsort(((middles[row] - mesh.vertices[v]) ** 2).sum(1), kind="stable")
                rows[v] = np.sort(row[near[: self.most * ring]])
            self._pad(rows)
            left = left[self._too_few(mesh.vertices, left)]
            if not len(left):
                return
            around, inner_around = around @ (every.T @ every), inner_around @ (inner.T @ inner)
        raise ValueError(
            f"recovered values: the elements around vertex {left[0]} do not tell a polynomial of order {self.order}: the "
            'body is too thin there, or has too few elements; take at="vertices"'
        )

    def _pad(self, rows) -> None:
        """Points of each vertex, shape (n, most), and which of them there are."""
        elements = np.zeros((len(rows), max(map(len, rows))), np.int64)
        there = np.arange(elements.shape[1]) < np.array([[len(row)] for row in rows])
        elements[there] = np.concatenate(rows)
        q = np.arange(self.num_points)
        self.points = (self.num_points * elements[..., None] + q).reshape(len(rows), -1)
        self.there = np.repeat(there, self.num_points, 1).astype(float)
        self.used = there.any(1)

    def _patches(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(p, A) in rest positions X."""
        x = np.einsum("qa,eai->eqi", self.N, X[self.elements]).reshape(-1, 3)
        z = x[self.points] - X[:, None]
        if self.size is None:  # fixed by the mesh
            far = np.linalg.norm(z, axis=2)
            self.size = (far * self.there).max(1, initial=1e-300)
            self.weights = self.there * (self.size[:, None] / np.maximum(far, 1e-9 * self.size[:, None])) ** self.fall
            self.weights /= np.maximum(self.weights.max(1, keepdims=True), 1e-300)
        p = _monomials(z / self.size[:, None, None], self.order)
        A = np.swapaxes(p, 1, 2) @ (p * self.weights[..., None])
        return p, np.where(self.used[:, None, None], A, np.eye(p.shape[-1]))

    def _too_few(self, X: np.ndarray, which: np.ndarray) -> np.ndarray:
        self.size = None
        values = np.linalg.eigvalsh(self._patches(X)[1][which])
        return values[:, 0] < self.worst * values[:, -1]

    def shares(self, X: np.ndarray) -> np.ndarray:
        """c, (vertices points,)"""
        p, A = self._patches(X)
        return ((p @ np.linalg.inv(A)[:, :, :1])[..., 0] * self.weights).ravel()

    def value(self, T: np.ndarray, c: np.ndarray) -> np.ndarray:
        """T: (frames, points, ...) -> (frames, vertices, ...)."""
        c = c.reshape(self.points.shape)
        return np.stack([np.einsum("vk,vk...->v...", c, t[self.points]) for t in T])
