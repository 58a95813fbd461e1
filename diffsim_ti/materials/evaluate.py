"""A law evaluated for many deformation gradients together, outside any scene."""

from functools import lru_cache

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.materials.calculus.tensor import tensor


@lru_cache(maxsize=None)
def _kernel(law):
    K = len(law.coefficient_names) + len(law.state_names)
    matrices = ti.types.ndarray(ti.types.matrix(3, 3, law.fp), 1)
    vectors, scalars = ti.types.ndarray(ti.types.vector(K, law.fp), 1), ti.types.ndarray(law.fp, 1)

    @runtime.untaped
    @runtime.kernel
    def evaluate_law(H: matrices, p: vectors, psi: scalars, P: matrices, by_coefficient: vectors):
        for i in range(H.shape[0]):
            h, coefficients = tensor(H[i]), [p[i][c] for c in ti.static(range(K))]
            psi[i] = law.energy_density(h, coefficients)
            P[i] = law.stress(h, coefficients).matrix()
            by = law.energy_by_coefficients(h, coefficients)
            for c in ti.static(range(K)):
                by_coefficient[i][c] = by[c]

    return evaluate_law


def evaluate(law, F: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Energy density (m,) [J/m^3], stress P (m, 3, 3) [Pa] and the energy's derivative by each coefficient (m, K).

    F: shape (m, 3, 3). coefficients: (K,) or (m, K) [Pa]; the numbers of a law's state follow, and count as K.
    """
    runtime.program()
    dtype, K = runtime.NUMPY[law.precision], len(law.coefficient_names) + len(law.state_names)
    H = np.ascontiguousarray(F - np.eye(3), dtype)
    p = np.ascontiguousarray(np.broadcast_to(coefficients, (len(H), K)), dtype)
    psi, P, by = np.zeros(len(H), dtype), np.zeros_like(H), np.zeros((len(H), K), dtype)
    if len(H):
        _kernel(law)(H, p, psi, P, by)
    return psi, P, by
