"""Linear systems of the implicit solvers: A x = b with A = c M + d2E/du2 on the free vertices, by products alone."""

import numpy as np


class NotConverged(FloatingPointError):
    """An iteration did not reach its tolerance. Carries `residuals`, the relative residual after each round."""

    def __init__(self, message: str, residuals):
        super().__init__(message)
        self.residuals = list(residuals)


class Operator:
    """w -> c m w + d2E/du2 w at the potential's displacement; rows of fixed vertices are zero.

    mass: c m, shape (num_vertices, 1) [N/m]; free: (num_vertices, 1), 1 or 0.
    """

    def __init__(self, potential, mass: np.ndarray, free: np.ndarray):
        self.potential, self.mass, self.free = potential, mass, free
        self.products, self.correction = 0, None

    def __call__(self, w: np.ndarray) -> np.ndarray:
        self.products += 1
        y = self.mass * w + self.potential.product(w, convex=self.correction is not None)
        if self.correction is not None:
            y += self.correction(w)
        return y * self.free


def conjugate_gradients(operator, b, preconditioner, tolerance: float, max_iterations: int, eps: float):
    """(x, relative residual, iterations, p): |b - A x| <= tolerance |b| unless stopped before.

    Stops at a direction p of negative curvature (else None) with the x before it or, if it is the first direction, with
    the preconditioned b: a direction of descent. Nocedal, Wright, Numerical Optimization, alg. 7.1.
    """
    x, r = np.zeros_like(b), b.copy()
    size = np.linalg.norm(b)
    if size == 0:
        return x, 0.0, 0, None
    z = preconditioner(r)
    p, rz = z, float((r * z).sum())
    for k in range(1, max_iterations + 1):
        Ap = operator(p)
        curvature = float((p * Ap).sum())
        if not curvature > 10 * eps * np.linalg.norm(p) * np.linalg.norm(Ap):
            if not np.isfinite(curvature):
                raise FloatingPointError("the stiffness of this state is not finite")
            return (x if k > 1 else z), np.linalg.norm(r) / size, k, p
        alpha = rz / curvature
        x += alpha * p
        r -= alpha * Ap
        if np.linalg.norm(r) <= tolerance * size:
            return x, np.linalg.norm(r) / size, k, None
        z = preconditioner(r)
        rz, old = float((r * z).sum()), rz
        p = z + (rz / old) * p
    return x, np.linalg.norm(r) / size, max_iterations, None


def solve_symmetric(operator, b, preconditioner, tolerance: float, eps: float, max_iterations: int) -> np.ndarray:
    """x with |b - A x| <= tolerance |b| for a symmetric, possibly indefinite A: CG, and MINRES where CG cannot go on.

    Raises NotConverged.
    """
    x, residual, count, negative = conjugate_gradients(operator, b, preconditioner, tolerance, max_iterations, eps)
    if negative is not None:
        from scipy.sparse.linalg import LinearOperator, minres

        n = b.size
        A = LinearOperator((n, n), lambda w: operator(w.reshape(-1, 3)).ravel(), dtype=np.float64)
        M = LinearOperator((n, n), lambda w: preconditioner(w.reshape(-1, 3)).ravel(), dtype=np.float64)
        x = np.zeros_like(b)
        for _ in range(5):  # MINRES measures in the preconditioner's norm: go on until the plain one is small
            r = b - operator(x)
            residual = np.linalg.norm(r) / np.linalg.norm(b)
            if residual <= tolerance:
                break
            step, _ = minres(A, r.ravel(), M=M, rtol=0.1 * tolerance, maxiter=max_iterations)
            x += step.reshape(b.shape)
    if residual > tolerance:
        raise NotConverged(
            f"a linear solve stopped at a relative residual of {residual:.2g} (asked for {tolerance:g}) after {count} "
            "iterations: the state may be at a limit point; loosen the tolerance or take smaller steps",
            [residual],
        )
    return x
