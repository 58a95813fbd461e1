"""A law's stress P, and its derivatives, of many displacement gradients at once: NumPy arrays in and out."""

from functools import lru_cache

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.materials.calculus.tensor import tensor


@lru_cache(maxsize=None)
def _kernel(law, what: str):
    K = len(law.coefficient_names) + len(law.state_names)
    matrices = ti.types.ndarray(ti.types.matrix(3, 3, law.fp), 1)
    vectors = ti.types.ndarray(ti.types.vector(K, law.fp), 1)

    @runtime.untaped
    @runtime.kernel
    def law_on_arrays(H: matrices, W: matrices, p: vectors, dp: vectors, P: matrices, by_p: vectors):
        for i in range(H.shape[0]):
            h, w, q, dq = (
                tensor(H[i]),
                tensor(W[i]),
                [p[i][c] for c in ti.static(range(K))],
                [dp[i][c] for c in ti.static(range(K))],
            )
            if ti.static(what == "value"):
                P[i] = law.stress(h, q).matrix()
            elif ti.static(what == "jvp"):
                P[i] = law.stress_jvp(h, w, q, dq).matrix()
            else:
                by_H, by = law.stress_differential_and_products(h, w, q)
                P[i] = by_H.matrix()
                for c in ti.static(range(K)):
                    by_p[i][c] = by[c]

    return law_on_arrays


class LawOnArrays:
    """H: shape (m, 3, 3); p: coefficients, (K,) or (m, K) [Pa], and behind them the numbers of a law's state. Only for laws
    of the displacement gradient."""

    def __init__(self, law):
        self.law, self.K = law, len(law.coefficient_names) + len(law.state_names)

    def _run(self, what: str, H, W, p, dp) -> tuple[np.ndarray, np.ndarray]:
        runtime.program()
        number, m = runtime.NUMPY[self.law.precision], len(H)
        matrices = [np.ascontiguousarray(x, number) for x in (H, W)]
        vectors = [np.ascontiguousarray(np.broadcast_to(x, (m, self.K)), number) for x in (p, dp)]
        P, by_p = np.zeros((m, 3, 3), number), np.zeros((m, self.K), number)
        if m:
            _kernel(self.law, what)(*matrices, *vectors, P, by_p)
        return P.astype(np.float64), by_p.astype(np.float64)

    def stress(self, H: np.ndarray, p: np.ndarray) -> np.ndarray:
        """P [Pa], shape (m, 3, 3)."""
        return self._run("value", H, H, p, p)[0]

    def jvp(self, H, dH, p, dp) -> np.ndarray:
        """Its change for changes dH and dp."""
        return self._run("jvp", H, dH, p, dp)[0]

    def vjp(self, H, W, p) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of H, adjoints of the coefficients, shape (m, K)) for the adjoint W of P."""
        return self._run("vjp", H, W, p, p)
