"""The two-step backward differentiation formula."""

import math

import numpy as np

from diffsim_ti.solvers.implicit.solver import ImplicitSolver, Stage

LARGEST_RATIO = 2.4  # of a step to the one before; 1 + sqrt(2) is the limit


class BDF2Solver(ImplicitSolver):
    """BDF2: v' = (4 d v - d^2 v-) / 3 + 2/3 h a(x'), x' = (4 x - x-) / 3 + 2/3 h v', d = exp(-c h); the first step is
    backward Euler.

    Second order, L-stable: what is too fast for the step is damped away, what is slow is hardly touched (relative loss of
    amplitude per step (omega h)^4 / 4). In a schedule of `UnequalSteps` a step that is w times as long as the one before
    takes v' = ((1 + w)^2 d v - w^2 d d- v-) / (1 + 2 w) + (1 + w) / (1 + 2 w) h a(x'), and x' alike, which is of second
    order too. Another step of a `Simulator`, or a state that is set from outside, starts it anew.
    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, III.5, doi:10.1007/978-3-540-78862-1;
    Hairer, Wanner, Solving Ordinary Differential Equations II, V.1, doi:10.1007/978-3-642-05221-7.
    """

    order = 2
    multistep = moves_robots = True
    may_gain_energy = True

    def stage(self, rate, fresh, j):
        h = float(self.schedule.length(j))
        d = math.exp(-rate * h)
        if fresh:
            return Stage(h, b0=d, by_rate=(-h * d, 0.0, 0.0, 0.0))
        before = float(self.schedule.length(max(j - 1, 0)))
        if abs(before - h) > 1e-12 * h:
            return self._after_another(h, before, rate)
        by_rate = (-4 / 3 * h * d, 2 / 3 * h * d * d, 0.0, 0.0)
        return Stage(2 / 3 * h, 4 / 3, -1 / 3, 4 / 3 * d, -d * d / 3, by_rate=by_rate)

    @staticmethod
    def _after_another(h: float, before: float, rate: float) -> Stage:
        """Of a step h after one of another length; w = h / before."""
        w = h / before
        a0, a1 = (1 + w) ** 2 / (1 + 2 * w), -w * w / (1 + 2 * w)
        d, both = math.exp(-rate * h), math.exp(-rate * (h + before))
        by_rate = (-a0 * h * d, -a1 * (h + before) * both, 0.0, 0.0)
        return Stage((1 + w) / (1 + 2 * w) * h, a0, a1, a0 * d, a1 * both, by_rate=by_rate)

    def check_schedule(self, schedule):
        super().check_schedule(schedule)
        h = schedule.length(np.arange(schedule.first(len(schedule))))
        ratio = float((h[1:] / h[:-1]).max(initial=1.0))
        if ratio > LARGEST_RATIO:
            raise ValueError(
                f"BDF2 is stable where no step is more than {LARGEST_RATIO} times as long as the one before; here one is "
                f"{ratio:.3g} times: let steps grow more slowly"
            )
