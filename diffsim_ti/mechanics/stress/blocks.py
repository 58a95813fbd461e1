"""3x3 blocks of matrices between the nodes of elements, and their sums."""

import numpy as np


def between_nodes(C: np.ndarray, N: np.ndarray, V: np.ndarray | None = None) -> np.ndarray:
    """V N_a . C . N_b of each element for gradients N of its nodes, shape (m, k, 3), as (m, k, k, 3, 3)."""
    k, scaled = N.shape[1], np.swapaxes(N if V is None else N * V[:, None, None], 1, 2)
    right = np.matmul(C.reshape(-1, 27, 3), scaled).reshape(-1, 3, 3, 3 * k)  # i, j, (k, b)
    right = np.ascontiguousarray(np.swapaxes(right, 1, 2)).reshape(-1, 3, 9 * k)
    return np.moveaxis(np.matmul(N, right).reshape(-1, k, 3, 3, k), 4, 2)  # of a, i, k, b


def summed(places: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(places, each once and in order, the sums of the 3x3 blocks there)."""
    from scipy.sparse import csc_matrix

    places, inverse = np.unique(places, return_inverse=True)
    m = len(inverse)
    gather = csc_matrix((np.ones(m), inverse, np.arange(m + 1)), shape=(len(places), m))
    return places, (gather @ blocks.reshape(-1, 9)).reshape(-1, 3, 3)
