"""Displacement gradients of tetrahedra in the frames of a run, with derivatives; means and recovered values of what
they make."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.mesh.geometry import edge_matrices
from diffsim_ti.mesh.jacobian import barycentric_in, solved
from diffsim_ti.mesh.reference_element import QUADRATIC, barycentric


@dataclass
class Deformation:
    """H = D B at the points of some tetrahedra, D = du/dxi, rows of B grad xi; arrays (frames, points, 3, 3)."""

    D: np.ndarray
    B: np.ndarray
    elements: np.ndarray
    order: int

    @classmethod
    def of(cls, frames, derived, mesh, chosen) -> "Deformation":
        """chosen: which of all tetrahedra."""
        u, elements = frames.displacements.astype(np.float64), mesh.elements[chosen]
        B = derived.gradients[chosen].reshape(-1, 3, 3)
        return cls(_edges(u, elements, mesh.order), B, elements, mesh.order)

    @property
    def H(self) -> np.ndarray:
        return self.D @ self.B

    @property
    def F(self) -> np.ndarray:
        return np.eye(3) + self.H

    def jvp(self, du: np.ndarray, dB: np.ndarray) -> np.ndarray:
        """dH for changes of the displacements, shape (frames, num_vertices, 3), and of B."""
        return _edges(du, self.elements, self.order) @ self.B + self.D @ dB.reshape(self.B.shape)

    def vjp(self, H_adj: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of the displacements, of B, by tetrahedra) for that of H."""
        D_adj = H_adj @ np.swapaxes(self.B, -1, -2)
        out = np.zeros((len(H_adj), num_vertices, 3))
        for u_adj, by_D in zip(out, D_adj):
            if self.order == 2:
                by_D = by_D.reshape(len(self.elements), -1, 3, 3)
                np.add.at(u_adj, self.elements, np.einsum("eqik,qak->eai", by_D, _BY_XI, optimize=True))
                continue
            rows = np.swapaxes(by_D, -1, -2)  # a row for each edge
            np.add.at(u_adj, self.elements[:, 1:].ravel(), rows.reshape(-1, 3))
            np.add.at(u_adj, self.elements[:, 0], -rows.sum(1))
        by_B = (np.swapaxes(self.D, -1, -2) @ H_adj).sum(0)
        return out, by_B.reshape(len(self.elements), -1, 3, 3) if self.order == 2 else by_B


_BY_XI = QUADRATIC.derivatives(QUADRATIC.points)
_LINEAR = np.linalg.inv(barycentric(QUADRATIC.points))  # corners' values of what is 1 at one of the points, 0 at others


def _edges(u: np.ndarray, elements: np.ndarray, order: int) -> np.ndarray:
    """du/dxi at the points, shape (frames, points, 3, 3)."""
    if order == 1:
        return np.stack([edge_matrices(x, elements) for x in u])
    return np.einsum("feai,qak->feqik", u[:, elements], _BY_XI, optimize=True).reshape(len(u), -1, 3, 3)


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
        rows = (T * _like(V, T)).reshape(*T.shape[:2], -1)
        out = np.stack([self._around @ frame for frame in rows])
        return out.reshape(len(T), -1, *T.shape[2:]) / _like(self._around @ V, T)

    def jvp(self, T, dT, V, dV) -> np.ndarray:
        """Its change."""
        mean, total = self.value(T, V), self._around @ V
        share = _like(self._around @ dV / total, T)
        return self.value(dT, V) + self.value(T * _like(dV / V, T), V) - mean * share

    def vjp(self, T, V, seed) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of T, of V)."""
        mean, total = self.value(T, V), self._around @ V
        scaled = seed / _like(total, T)
        back = self._around.T @ scaled.reshape(*seed.shape[:2], -1).swapaxes(0, 1).reshape(len(total), -1)
        back = back.reshape(len(V), len(T), -1).swapaxes(0, 1).reshape(T.shape)
        kept = self._around.T @ (scaled * mean).reshape(len(T), len(total), -1).sum((0, 2))
        return back * _like(V, T), (back * T).reshape(len(T), len(V), -1).sum((0, 2)) - kept


def followed(X: np.ndarray, located, start: np.ndarray) -> np.ndarray:
    """xi of places in ten-node tetrahedra at rest positions X, from those in the mesh. Raises ValueError where X carries a
    tetrahedron too far away."""
    xi, found = solved(X[located.vertices], located.points, start)
    if not found.all():
        k = int(np.argmin(found))
        raise ValueError(
            f"rest_positions carry tetrahedron {located.tetrahedra[k]} so far from point {k} at "
            f"{located.points[k].tolist()} that it cannot be followed; take a smaller step in the rest shape"
        )
    return xi


class PointInterpolation:
    """Values at places in ten-node tetrahedra, of the linear functions that those at their four points make."""

    moves = True

    def __init__(self, mesh, located):
        self.located, self._start = located, barycentric_in(mesh.vertices[located.vertices], located.points)[:, 1:]

    def _inner(self, X: np.ndarray) -> np.ndarray:
        """xi of the places in rest positions X."""
        return followed(X, self.located, self._start)

    def shares(self, X: np.ndarray) -> np.ndarray:
        """Of the points in the value, shape (4 k,)."""
        return (barycentric(self._inner(X)) @ _LINEAR).ravel()

    def _slopes(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N of the nodes at the places, change of the shares for that of a place in space, shape (k, 4, 3))."""
        xi = self._inner(X)
        D = np.einsum("pai,pak->pik", X[self.located.vertices], QUADRATIC.derivatives(xi))
        return QUADRATIC.functions(xi), np.einsum("kq,pki->pqi", _LINEAR[1:] - _LINEAR[:1], np.linalg.inv(D))

    def shares_jvp(self, X: np.ndarray, dX: np.ndarray) -> np.ndarray:
        """Their change: places stay where they are in space."""
        N, by = self._slopes(X)
        return -np.einsum("pqi,pa,pai->pq", by, N, dX[self.located.vertices]).ravel()

    def shares_vjp(self, X: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """Adjoint of X."""
        (N, by), out = self._slopes(X), np.zeros_like(X)
        np.add.at(out, self.located.vertices, -np.einsum("pqi,pa,pq->pai", by, N, seed.reshape(-1, 4)))
        return out

    @staticmethod
    def value(T: np.ndarray, c: np.ndarray) -> np.ndarray:
        """T: (frames, points, ...) -> (frames, places, ...)."""
        return (T * _like(c, T)).reshape(len(T), -1, 4, *T.shape[2:]).sum(2)

    def jvp(self, T, dT, c, dc) -> np.ndarray:
        """Its change."""
        return self.value(dT, c) + self.value(T, dc)

    def vjp(self, T, c, seed) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of T, of the shares)."""
        every = np.repeat(seed, 4, 1)
        return every * _like(c, T), (every * T).reshape(len(T), len(c), -1).sum((0, 2))


def _matrix(weights: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]):
    from scipy.sparse import csr_matrix

    return csr_matrix((weights, (rows, columns)), shape)


def _like(per_item: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Numbers of items, to multiply arrays (frames, items, ...)."""
    return per_item.reshape(1, -1, *[1] * (T.ndim - 2))


def von_mises(T: np.ndarray) -> np.ndarray:
    """sqrt(3/2 s : s), s = T - tr T / 3, of symmetric tensors; its gradient is 0 where it is 0."""
    s = _deviator(T)
    return np.sqrt(1.5 * (s**2).sum((-1, -2)))


def von_mises_jvp(T: np.ndarray, dT: np.ndarray) -> np.ndarray:
    """Its change, 3/2 s : dT / value."""
    return (von_mises_vjp(T, np.ones(T.shape[:-2])) * dT).sum((-1, -2))


def von_mises_vjp(T: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Adjoint of T."""
    value = von_mises(T)
    by = np.divide(1.5 * seed, value, out=np.zeros_like(value), where=value > 0)
    return by[..., None, None] * _deviator(T)


def _deviator(T: np.ndarray) -> np.ndarray:
    return T - np.trace(T, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)


def stretches(E: np.ndarray) -> np.ndarray:
    """sqrt(1 + 2 E_i), ascending, E_i: eigenvalues of Green's strain."""
    squares = 1 + 2 * principal(E)
    if np.any(squares <= 0):  # of the linear function through the points of a ten-node tetrahedron
        raise ValueError(
            f"Strain: stretches of a strain whose 1 + 2 E is {squares.min():.3g} at a vertex or point: it changes too "
            'much within one tetrahedron; take at="tetrahedra", or refine the mesh there'
        )
    return np.sqrt(squares)


def stretches_jvp(E: np.ndarray, dE: np.ndarray) -> np.ndarray:
    """Their change."""
    return principal_jvp(E, dE) / stretches(E)


def stretches_vjp(E: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Adjoint of E."""
    return principal_vjp(E, seed / stretches(E))


def principal(T: np.ndarray) -> np.ndarray:
    """Eigenvalues of symmetric tensors, ascending."""
    return np.linalg.eigvalsh(T)


def principal_jvp(T: np.ndarray, dT: np.ndarray) -> np.ndarray:
    """Their change, n . dT n for each; where some coincide, in the directions that the eigenvectors happen to have."""
    n = np.linalg.eigh(T)[1]
    return np.einsum("...ia,...ij,...ja->...a", n, dT, n)


def principal_vjp(T: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Adjoint of T."""
    n = np.linalg.eigh(T)[1]
    return np.einsum("...ia,...a,...ja->...ij", n, seed, n)


# what tensors are shown by: (number of components, value, jvp, vjp)
NUMBERS = {
    "principal": ((3,), principal, principal_jvp, principal_vjp),
    "von_mises": ((), von_mises, von_mises_jvp, von_mises_vjp),
    "stretches": ((3,), stretches, stretches_jvp, stretches_vjp),
}


def _monomials(z: np.ndarray, order: int, slopes: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """(1, z_1, z_2, z_3 and, of order 2, their six products, along the last axis; their derivatives by z behind it)"""
    i, j = np.triu_indices(3) if order == 2 else (np.zeros(0, int),) * 2
    values = np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., j]], -1)
    if not slopes:
        return values, None
    by = np.zeros((*values.shape, 3))
    by[..., np.arange(1, 4), np.arange(3)] = 1
    for k, (a, b) in enumerate(zip(i, j), 4):
        by[..., k, a] += z[..., b]
        by[..., k, b] += z[..., a]
    return values, by


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

    def _patches(self, X: np.ndarray, slopes: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(p, its derivatives by places, A) in rest positions X."""
        x = np.einsum("qa,eai->eqi", self.N, X[self.elements]).reshape(-1, 3)
        z = x[self.points] - X[:, None]
        if self.size is None:  # fixed by the mesh
            far = np.linalg.norm(z, axis=2)
            self.size = (far * self.there).max(1, initial=1e-300)
            self.weights = self.there * (self.size[:, None] / np.maximum(far, 1e-9 * self.size[:, None])) ** self.fall
            self.weights /= np.maximum(self.weights.max(1, keepdims=True), 1e-300)
        p, by = _monomials(z / self.size[:, None, None], self.order, slopes)
        A = np.swapaxes(p, 1, 2) @ (p * self.weights[..., None])
        A[~self.used] = np.eye(p.shape[-1])
        return p, by / self.size[:, None, None, None] if slopes else by, A

    def _too_few(self, X: np.ndarray, which: np.ndarray) -> np.ndarray:
        self.size = None
        values = np.linalg.eigvalsh(self._patches(X, False)[2][which])
        return values[:, 0] < self.worst * values[:, -1]

    def shares(self, X: np.ndarray) -> np.ndarray:
        """c, (vertices points,)"""
        p, _, A = self._patches(X, False)
        return ((p @ np.linalg.inv(A)[:, :, :1])[..., 0] * self.weights).ravel()

    def shares_jvp(self, X: np.ndarray, dX: np.ndarray) -> np.ndarray:
        """Their change."""
        p, slopes, A = self._patches(X)
        x = np.einsum("qa,eai->eqi", self.N, dX[self.elements]).reshape(-1, 3)
        dp, w = np.einsum("vkti,vki->vkt", slopes, x[self.points] - dX[:, None]), self.weights
        a = np.linalg.inv(A)[:, :, 0]
        pa, dpa = np.einsum("vkt,vt->vk", p, a), np.einsum("vkt,vt->vk", dp, a)
        turned = np.einsum("vkt,vk->vt", dp, w * pa) + np.einsum("vkt,vk->vt", p, w * dpa)
        da = -np.linalg.solve(A, turned[..., None])[..., 0]
        return (w * (dpa + np.einsum("vkt,vt->vk", p, da))).ravel()

    def shares_vjp(self, X: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """Adjoint of X."""
        p, slopes, A = self._patches(X)
        w, seed = self.weights, seed.reshape(p.shape[:2]) * self.weights
        a = np.linalg.inv(A)[:, :, 0]
        g = np.linalg.solve(A, np.einsum("vkt,vk->vt", p, seed)[..., None])[..., 0]
        pa, pg = w * np.einsum("vkt,vt->vk", p, a), w * np.einsum("vkt,vt->vk", p, g)
        by_p = (seed - pg)[..., None] * a[:, None] - pa[..., None] * g[:, None]
        by_z = np.einsum("vkti,vkt->vki", slopes, by_p)
        by_x, out = np.zeros((len(self.elements) * self.num_points, 3)), -by_z.sum(1)
        np.add.at(by_x, self.points, by_z)
        by_x = np.einsum("qa,eqi->eai", self.N, by_x.reshape(len(self.elements), -1, 3))
        np.add.at(out, self.elements, by_x)
        return out

    def _of(self, c: np.ndarray):
        rows = np.repeat(np.arange(len(self.points)), self.points.shape[1])
        return _matrix(c, rows, self.points.ravel(), (len(self.points), len(self.elements) * self.num_points))

    def value(self, T: np.ndarray, c: np.ndarray) -> np.ndarray:
        """T: (frames, points, ...) -> (frames, vertices, ...)."""
        C = self._of(c)
        out = np.stack([C @ frame.reshape(len(frame), -1) for frame in T])
        return out.reshape(len(T), -1, *T.shape[2:])

    def jvp(self, T, dT, c, dc) -> np.ndarray:
        """Its change."""
        return self.value(dT, c) + self.value(T, dc)

    def vjp(self, T, c, seed) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of T, of the shares)."""
        C = self._of(c).T.tocsr()
        by_T = np.stack([C @ frame.reshape(len(frame), -1) for frame in seed]).reshape(T.shape)
        rows, every = T.reshape(*T.shape[:2], -1), seed.reshape(*seed.shape[:2], -1)
        by_c = sum(np.einsum("vkj,vj->vk", t[self.points], s) for t, s in zip(rows, every))
        return by_T, (by_c * self.there).ravel()
