"""Preconditioners for c M + d2E/du2: block Jacobi here, multigrid in multigrid.py.

Both are functions of the present state alone, so that a run that is started again from a checkpoint takes the same steps.
"""

import numpy as np

from diffsim_ti.potential.free import Free, FreeDirections, mask_of


class BlockJacobi:
    """The inverse 3x3 diagonal blocks; blocks that are not positive definite take |eigenvalues|.

    size: of the diagonal at rest [N/m], to which what is all but zero is raised.
    """

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray, parallel: bool = True):
        self.potential, self.mass, self.free, self.least = potential, mass, free, 1e-6 * (size + mass)

    def update(self, u: np.ndarray) -> None:
        """Adapt to the displacement at which the potential is placed."""
        D = self.potential.blocks() + self.mass[:, :, None] * np.eye(3)
        if isinstance(self.free, FreeDirections):
            D = self.free.around(D)
            D[self.free.guided] += self.free.guides * (size_of(D[self.free.guided]) / 3)[:, None, None]
        values, vectors = np.linalg.eigh(0.5 * (D + np.swapaxes(D, 1, 2)))
        values = np.maximum(np.abs(values), self.least)
        inverse = np.divide(mask_of(self.free), values, out=np.zeros_like(values), where=values > 0)
        self._inverse = np.matmul(vectors * inverse[:, None, :], np.swapaxes(vectors, 1, 2))
        if isinstance(self.free, FreeDirections):
            self._inverse = self.free.around(self._inverse)

    def __call__(self, r: np.ndarray) -> np.ndarray:
        return np.matmul(self._inverse, r[:, :, None])[:, :, 0]


class BodyBlocks(BlockJacobi):
    """The same, and the inverse of d2E/dq2 of each set that moves by few numbers q: of the body at rest, with inertia and
    contact as they are; where its basis is of each component turned with it, as in multigrid.py."""

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray, parallel: bool = True):
        super().__init__(potential, mass, free, size, parallel)
        with potential.at_rest():
            self._at_rest = [self._of_products(body) for body in free.reduced.bodies]

    def _of_products(self, body) -> np.ndarray:
        """B^T d2E/du2 B where the potential stands, shape (count, count)."""
        out, fields = np.zeros((body.count, body.count)), body.fields()
        for j in range(body.count):
            w = np.zeros((len(self.mass), 3))
            w[body.vertices] = fields[:, :, j]
            out[:, j] = body.numbers(self.potential.product(w)).ravel()
        return 0.5 * (out + out.T)

    def update(self, u: np.ndarray) -> None:
        super().update(u)
        contact, rest, self._bodies = self.potential.contact_blocks(), self.potential.arrays.values.rest, []
        for body, G in zip(self.free.reduced.bodies, self._at_rest):
            own, n = body.vertices, body.count
            if body.per_component:
                R, m = turn_of(rest[own], rest[own] + u[own]), n // 3
                G = np.einsum("ia,jakb,lb->jikl", R, G.reshape(m, 3, m, 3), R, optimize=True).reshape(n, n)
            blocks = self.mass[own, :, None] * np.eye(3) + (0.0 if contact is None else contact[own])
            fields = body.fields()
            G = G + fields.reshape(-1, n).T @ np.matmul(blocks, fields).reshape(-1, n)
            values, vectors = np.linalg.eigh(0.5 * (G + G.T))
            values = np.maximum(np.abs(values), 1e-12 * np.abs(values).max() + self.least[own].min())
            self._bodies.append((body, (vectors / values) @ vectors.T))

    def __call__(self, r: np.ndarray) -> np.ndarray:
        out = super().__call__(r)
        for body, inverse in self._bodies:
            q = body.numbers(r)
            out[body.vertices] = body.motion((inverse @ q.ravel()).reshape(q.shape))
        return out


def turn_of(X: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The rotation that takes points X nearest to x, about their centres."""
    U, _, Vt = np.linalg.svd((x - x.mean(0)).T @ (X - X.mean(0)))
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt)) or 1.0
    return U @ Vt


def size_of(blocks: np.ndarray) -> np.ndarray:
    """Sum of the sizes of the diagonal of each block."""
    return np.abs(np.diagonal(blocks, axis1=1, axis2=2)).sum(1)
