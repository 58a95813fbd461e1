"""Values at vertices by superconvergent patch recovery: polynomials fitted to the points of the elements around."""

import numpy as np

from diffsim_ti.outputs.deformation import _matrix


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
