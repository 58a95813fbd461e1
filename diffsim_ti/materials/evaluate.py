"""A law evaluated for many deformation gradients together, outside any scene."""

from functools import lru_cache

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.materials.calculus.tensor import tensor


@lru_cache(maxsize=None)
def _kernel(law, what: str):
    K = len(law.coefficient_names) + len(law.state_names)
    matrices = ti.types.ndarray(ti.types.matrix(3, 3, law.fp), 1)
    vectors, scalars = ti.types.ndarray(ti.types.vector(K, law.fp), 1), ti.types.ndarray(law.fp, 1)

    @runtime.untaped
    @runtime.kernel
    def evaluate_law(H: matrices, W: matrices, p: vectors, dp: vectors, psi: scalars, P: matrices, by_p: vectors):
        for i in range(H.shape[0]):
            h, w = tensor(H[i]), tensor(W[i])
            q, dq = [p[i][c] for c in ti.static(range(K))], [dp[i][c] for c in ti.static(range(K))]
            if ti.static(what == "jvp"):
                P[i] = law.stress_jvp(h, w, q, dq).matrix()
            elif ti.static(what == "vjp"):
                by_H, by = law.stress_differential_and_products(h, w, q)
                P[i] = by_H.matrix()
                for c in ti.static(range(K)):
                    by_p[i][c] = by[c]
            elif ti.static(what == "dilatation"):
                psi[i] = law.dilatation(h)
                P[i] = law.dilatation_gradient(h).matrix()
            elif ti.static(what == "dilatation jvp"):
                P[i] = law.dilatation_gradient_differential(h, w).matrix()
            else:
                P[i] = law.stress(h, q).matrix()
            if ti.static(what == "energy"):
                psi[i] = law.energy_density(h, q)
                by = law.energy_by_coefficients(h, q)
                for c in ti.static(range(K)):
                    by_p[i][c] = by[c]

    return evaluate_law


class LawOnArrays:
    """H: shape (m, 3, 3), F = I + H; p: coefficients, (K,) or (m, K) [Pa], and behind them the numbers of a law's state,
    which count as K. Results are in float64. Only for laws of the displacement gradient."""

    def __init__(self, law):
        self.law, self.K = law, len(law.coefficient_names) + len(law.state_names)

    def _run(self, what: str, H, W, p, dp) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        runtime.program()
        number, m = runtime.NUMPY[self.law.precision], len(H)
        matrices = [np.ascontiguousarray(x, number) for x in (H, W)]
        vectors = [np.ascontiguousarray(np.broadcast_to(x, (m, self.K)), number) for x in (p, dp)]
        out = [np.zeros((m, *shape), number) for shape in ((), (3, 3), (self.K,))]
        if m:
            _kernel(self.law, what)(*matrices, *vectors, *out)
        return tuple(x.astype(np.float64) for x in out)

    def energy(self, H: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energy density psi (m,) [J/m^3], P (m, 3, 3) [Pa] and psi's derivatives by the coefficients (m, K)."""
        return self._run("energy", H, H, p, p)

    def stress(self, H: np.ndarray, p: np.ndarray) -> np.ndarray:
        """P [Pa], shape (m, 3, 3)."""
        return self._run("value", H, H, p, p)[1]

    def jvp(self, H, dH, p, dp) -> np.ndarray:
        """Its change for changes dH and dp."""
        return self._run("jvp", H, dH, p, dp)[1]

    def vjp(self, H, W, p) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of H, adjoints of the coefficients, shape (m, K)) for the adjoint W of P."""
        return self._run("vjp", H, W, p, p)[1:]

    def dilatation(self, H) -> tuple[np.ndarray, np.ndarray]:
        """(theta, shape (m,), dtheta/dF) of a law that has one."""
        none = np.zeros(self.K)
        return self._run("dilatation", H, H, none, none)[:2]

    def dilatation_jvp(self, H, dH) -> np.ndarray:
        """Change of dtheta/dF."""
        none = np.zeros(self.K)
        return self._run("dilatation jvp", H, dH, none, none)[1]


def evaluate(law, F: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`LawOnArrays.energy` at deformation gradients F, shape (m, 3, 3)."""
    return LawOnArrays(law).energy(F - np.eye(3), coefficients)
