"""Damped Gauss-Newton steps: Marquardt 1963, doi:10.1137/0111030; solved as far as they are worth it: Eisenstat, Walker
1996, doi:10.1137/0917003."""

from collections.abc import Callable

import numpy as np

from diffsim_ti.identification.search import FAILURES, Search

DENSE = 20  # unknowns up to which the Jacobian is made column by column
LONGEST = 2.0  # change of a logarithm in one iteration
LEAST = 1e-3  # damping that keeps directions without information where they are
FORCING = 0.02, 0.1  # least and largest share of the gradient that conjugate gradients leave


class LevenbergMarquardt:
    """Steps (J^T J + damping) dt = -J^T r; J by tangent runs, above DENSE unknowns by products J d and J^T w in CG."""

    def __init__(self, search: Search):
        self.search, self.dense, self.size = search, search.problem.size <= DENSE, None

    def linearize(self) -> None:
        """Gradient (half of the cost's) and the products that stand for half its Hessian, at the point."""
        search, priors = self.search, self.search.priors
        at, self.prior_hessian = search.point, priors.hessian(search.point.t)
        if self.dense:
            J = search.J = search.problem.jacobian(at)
            self.gradient = J.T @ at.residual + priors.gradient(at.t)
            self.hessian = J.T @ J + self.prior_hessian
        else:
            self.gradient = search.half_gradient(at)
        low, high = search.problem.reach  # numbers at an end that the cost pushes outwards stay there
        ended = (at.t <= low) & (self.gradient > 0) | (at.t >= high) & (self.gradient < 0)
        self.gradient[ended] = 0.0
        if self.dense:
            self.hessian[ended], self.hessian[:, ended] = 0.0, 0.0

    def step(self) -> np.ndarray:
        """The damped Gauss-Newton step."""
        problem, damping = self.search.problem, self.search.damping
        if self.dense:
            damped = self.hessian + np.diag(damping * np.diag(self.hessian) + LEAST)
            return -np.linalg.solve(damped, self.gradient)

        def product(d):
            both = problem.transposed(self.search.point, problem.product(self.search.point, d))
            return both + self.prior_hessian @ d + (damping + LEAST) * d

        solve = np.linalg.inv(self.prior_hessian + np.eye(problem.size))
        before, self.size = self.size, float(self.gradient @ solve @ self.gradient)
        share = FORCING[1] if before is None else float(np.clip(self.size / before, *FORCING))
        return _conjugate_gradients(product, -self.gradient, solve, share)

    def limited(self, step: np.ndarray) -> np.ndarray:
        """A step that changes no logarithm and no bounded number by more than LONGEST, and ends within their reach."""
        free = np.concatenate([np.full(f.size, f.kind != "linear") for f in self.search.problem.unknowns])
        step, t = np.where(free, np.clip(step, -LONGEST, LONGEST), step), self.search.point.t
        return np.clip(t + step, *self.search.problem.reach) - t

    def try_step(self, step: np.ndarray) -> str | None:
        """Take the step if the cost falls; else damp more, and say why."""
        search = self.search
        try:
            new = search.problem.run(search.point.t + step)
            cost, why = search.cost_of(new), "the cost rose"
        except FAILURES as error:
            new, cost, why = None, np.inf, f"{type(error).__name__}: {error}"
        if not cost < search.cost:
            search.damping *= 10
            return why
        search.keep(new, cost)
        search.damping = max(search.damping / 10, 1e-9)
        return None


def levenberg_marquardt(search: Search, record: Callable, tolerance: float) -> tuple[str, bool]:
    """(why it stopped, whether it converged: a step promises less than this share of a standard error per unknown)"""
    method, rejected = LevenbergMarquardt(search), 0
    while True:
        if rejected == 0:
            method.linearize()
        if method.dense or rejected == 0:
            step = method.step()
        else:
            step = step * 0.3  # products are dear: along the same way
        promised = float(-method.gradient @ step)
        if promised <= tolerance**2 * search.problem.size:
            return "converged", True
        step = method.limited(step)
        why = method.try_step(step)
        rejected = rejected + 1 if why else 0
        record(promised, why)
        if rejected > 12:
            return f"no step lowers the cost ({why})", False


def _conjugate_gradients(product: Callable, b: np.ndarray, solve: np.ndarray, share: float, iterations: int = 100):
    """Approximate solution of A x = b, A symmetric and positive, preconditioned by the matrix `solve`, until that share of
    the residual's norm is left: Steihaug 1983, doi:10.1137/0720042."""
    x, r = np.zeros_like(b), b.copy()
    z = solve @ r
    p, size = z.copy(), float(r @ z)
    stop = share**2 * size
    for _ in range(iterations):
        if size <= stop or size == 0:
            break
        Ap = product(p)
        alpha = size / float(p @ Ap)
        x, r = x + alpha * p, r - alpha * Ap
        z = solve @ r
        size, before = float(r @ z), size
        p = z + size / before * p
    return x
