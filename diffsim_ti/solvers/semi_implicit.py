"""Symplectic Euler, the seeds' semi-implicit solver."""

import math

from diffsim_ti.solvers.explicit import ExplicitSolver, Weights


class SemiImplicitSolver(ExplicitSolver):
    """Symplectic Euler: v' = (v + h f(x) / m) exp(-c h), x' = x + h v', with h = dt / substeps.

    First order, one force evaluation per substep, keeps linear and angular momentum to round-off; stable for
    h <= 2 / omega_max. Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1.2, doi:10.1007/3-540-30666-8.
    """

    order = 1
    last_frame_is_state = True

    def num_passes(self, steps: int) -> int:
        return steps * self.substeps

    def groups(self, first, last, num_passes, rate):
        h = self.dt / self.substeps
        decay = math.exp(-rate * h)
        weights = Weights(0, 0, 0.0, h, h * decay, decay, -h * h * decay, -h * decay)
        return [(first, last - first, weights)] if last > first else []
