"""The two-step backward differentiation formula."""

import math

from diffsim_ti.solvers.implicit.solver import ImplicitSolver, Stage


class BDF2Solver(ImplicitSolver):
    """BDF2: v' = (4 d v - d^2 v-) / 3 + 2/3 h a(x'), x' = (4 x - x-) / 3 + 2/3 h v', d = exp(-c h); the first step is
    backward Euler.

    Second order, L-stable: what is too fast for the step is damped away, what is slow is hardly touched (relative loss of
    amplitude per step (omega h)^4 / 4). A change of the step, or a state that is set from outside, starts it anew.
    Hairer, Wanner, Solving Ordinary Differential Equations II, V.1, doi:10.1007/978-3-642-05221-7.
    """

    order = 2
    multistep = True
    may_gain_energy = True

    def stage(self, rate, fresh):
        h = self.substep
        d = math.exp(-rate * h)
        if fresh:
            return Stage(h, b0=d, by_rate=(-h * d, 0.0, 0.0, 0.0))
        by_rate = (-4 / 3 * h * d, 2 / 3 * h * d * d, 0.0, 0.0)
        return Stage(2 / 3 * h, 4 / 3, -1 / 3, 4 / 3 * d, -d * d / 3, by_rate=by_rate)
