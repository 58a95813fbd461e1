"""Velocity Verlet: second order at the cost of symplectic Euler."""

import math

from diffsim_ti.solvers.explicit.solver import ExplicitSolver, Weights


class VelocityVerletSolver(ExplicitSolver):
    """Velocity Verlet: v+ = v + h/2 a(x), x' = x + h v+, v' = v+ + h/2 a(x'), with h = dt / substeps.

    Second order; the two half kicks that meet at a time share one force evaluation. Drag acts in the middle of the
    drift (exact, symmetric). Stable for h <= 2 / omega_max. Forces given per step enter a kick that two steps share
    with half of each. Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1.4, doi:10.1007/3-540-30666-8.
    """

    order = 2
    last_frame_is_state = False

    def num_passes(self, steps: int) -> int:
        return steps * self.substeps + 1

    def groups(self, first, last, num_passes, rate):
        h = self.dt / self.substeps
        decay = math.exp(-rate * h)
        drift = (h * (1 + decay) / 2, decay, -h * h * decay / 2, -h * decay)
        runs = [
            (0, 1, Weights(0, 0, 0.0, h / 2, *drift)),
            (1, num_passes - 1, Weights(1, 0, h / 2, h / 2, *drift)),
            (num_passes - 1, num_passes, Weights(1, 1, h / 2, 0.0, 0.0, 1.0)),
        ]
        if num_passes == 1:  # no step: the pass only shows the start
            runs = [(0, 1, Weights(0, 0, 0.0, 0.0, 0.0, 1.0))]
        cut = ((max(first, a), min(last, b), w) for a, b, w in runs)
        return [(a, b - a, w) for a, b, w in cut if b > a]
