"""Descent by gradients alone, a run and a reverse sweep for each evaluation: SciPy's L-BFGS-B, or an optimiser of torch."""

from collections.abc import Callable

import numpy as np

from diffsim_ti.identification.search import FAILURES, Search

SMALL_STEPS = 3  # iterations that hardly lower the cost, one after the other, end L-BFGS-B
PATIENCE = 50  # iterations without a lower cost end torch's


def evaluate(search: Search, t: np.ndarray) -> tuple[float, np.ndarray]:
    """(cost, its gradient) at t; the search keeps the point if it is the best. Raises what the run raises."""
    point = search.point if np.array_equal(t, search.point.t) else search.problem.run(t)
    cost = search.cost_of(point)
    gradient = 2 * search.half_gradient(point)
    if cost < search.cost:
        search.keep(point, cost)
    return cost, gradient


def l_bfgs_b(search: Search, record: Callable, tolerance: float) -> tuple[str, bool]:
    """(why it stopped, whether it converged: iterations that lower the cost by less than tolerance^2 per unknown)

    Byrd, Lu, Nocedal, Zhu 1995, doi:10.1137/0916069.
    """
    from scipy.optimize import minimize

    least, costs = tolerance**2 * search.problem.size, [search.cost]

    def cost_and_gradient(t):
        try:
            return evaluate(search, t)
        except FAILURES:  # numbers that end a run: the line search comes back
            return 2 * search.cost + 10, np.zeros_like(t)

    def note_iteration(t):
        costs.append(search.cost)
        record()
        if len(costs) > SMALL_STEPS and costs[-1 - SMALL_STEPS] - costs[-1] < SMALL_STEPS * least:
            raise StopIteration

    bounds = search.problem.reach.T
    options = dict(maxiter=10**6, maxfun=10**6, maxcor=20, ftol=0.0, gtol=0.0)
    found = minimize(
        cost_and_gradient,
        search.point.t,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        callback=note_iteration,
        options=options,
    )
    if len(costs) > SMALL_STEPS and costs[-1 - SMALL_STEPS] - costs[-1] < SMALL_STEPS * least:
        return "converged", True
    return f"L-BFGS-B finds no lower cost ({found.message})", False


def torch_descent(make: Callable, search: Search, record: Callable, tolerance: float) -> tuple[str, bool]:
    """(why it stopped, whether it converged: the last iterations lowered the cost by less than tolerance^2 per unknown)"""
    import torch

    t = torch.tensor(search.point.t, dtype=torch.float64, requires_grad=True)
    optimizer, costs = make([t]), [search.cost]
    if not isinstance(optimizer, torch.optim.Optimizer):
        raise ValueError(f"identify: method must return a torch optimiser for a list of tensors, got {optimizer!r}")

    def closure():
        cost, gradient = evaluate(search, t.detach().numpy().copy())
        t.grad = torch.from_numpy(gradient)
        return torch.tensor(cost)

    while True:
        try:
            optimizer.step(closure)
        except FAILURES as error:
            return f"numbers went too far; take smaller steps ({type(error).__name__}: {error})", False
        costs.append(search.cost)
        record()
        if len(costs) > PATIENCE and costs[-1 - PATIENCE] - costs[-1] < tolerance**2 * search.problem.size:
            return "converged", True
