"""Displacement gradients of tetrahedra in the frames of a run, with derivatives, and averages of what they make."""

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


class PointInterpolation:
    """Values at places in ten-node tetrahedra, of the linear functions that those at their four points make."""

    moves = True

    def __init__(self, mesh, located):
        self.located, self._start = located, barycentric_in(mesh.vertices[located.vertices], located.points)[:, 1:]

    def _inner(self, X: np.ndarray) -> np.ndarray:
        """xi of the places in rest positions X."""
        xi, found = solved(X[self.located.vertices], self.located.points, self._start)
        if not found.all():
            k = int(np.argmin(found))
            raise ValueError(
                f"rest_positions carry tetrahedron {self.located.tetrahedra[k]} so far from point {k} at "
                f"{self.located.points[k].tolist()} that it cannot be followed; take a smaller step in the rest shape"
            )
        return xi

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
