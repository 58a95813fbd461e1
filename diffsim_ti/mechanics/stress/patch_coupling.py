"""How patches couple their vertices, as matrices on the host: what preconditioners need of them."""

import numpy as np


class PatchCoupling:
    """sum_p c_p g_p (x) g_p, what patches add to d2E/du2 beyond their tetrahedra at fixed pressure.

    g_p: the change of W_p theta_p for displacements of the patch's vertices [m^2], c_p = lam_p / W_p [Pa/m^3]
    (patched_tetrahedron.py). A row for each pair of a patch and one of its vertices.
    """

    def __init__(self, arrays):
        self._place, self._n = arrays.place, arrays.num_vertices
        values, factors, elements = arrays.values, arrays.law.base.last_without_lam, arrays.mesh.elements
        self._nodes = elements.shape[1]
        pairs, row_of = np.unique(arrays.patches[:, None] * self._n + elements, return_inverse=True)
        self._row_of, self.patches, self.vertices = row_of.ravel(), pairs // self._n, pairs % self._n
        p = np.broadcast_to(values.coefficients, (len(elements), values.coefficients.shape[-1]))
        lam = p[:, -1] - sum(f * p[:, k] for k, f in enumerate(factors))
        own = values.volumes if arrays.points == 1 else values.volumes.sum(1)
        volumes = np.bincount(arrays.patches, own)
        self.c = np.bincount(arrays.patches, lam * own) / volumes**2

    def rows(self, corner: np.ndarray) -> np.ndarray:
        """g by rows, shape (num_rows, 3), from the corner forces of unit pressures."""
        at_corners = corner.reshape(-1, self._nodes, 3)[self._place].reshape(-1, 3)
        return np.stack([np.bincount(self._row_of, at_corners[:, d], len(self.vertices)) for d in range(3)], 1)

    def diagonal(self, g: np.ndarray) -> np.ndarray:
        """Its 3x3 diagonal blocks [N/m], shape (num_vertices, 3, 3)."""
        blocks = (self.c[self.patches, None, None] * g[:, :, None] * g[:, None, :]).reshape(-1, 9)
        return np.stack([np.bincount(self.vertices, blocks[:, k], self._n) for k in range(9)], 1).reshape(-1, 3, 3)

    def entries(self, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(row vertex, column vertex, block [N/m] of shape (count, 3, 3)) of all its blocks; some meet."""
        sizes = np.bincount(self.patches)
        first = np.cumsum(sizes) - sizes
        count = sizes[self.patches]  # of the partners of each row
        i = np.repeat(np.arange(len(self.patches)), count)
        j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + first[self.patches[i]]
        blocks = self.c[self.patches[i], None, None] * g[i][:, :, None] * g[j][:, None, :]
        return self.vertices[i], self.vertices[j], blocks
