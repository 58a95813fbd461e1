"""The implicit midpoint rule."""

import math

from diffsim_ti.solvers.implicit.solver import ImplicitSolver, Stage


class ImplicitMidpointSolver(ImplicitSolver):
    """Implicit midpoint: v' = v + h a((x + x') / 2), x' = x + h (v + v') / 2, with h = dt / substeps; drag half before
    and half after.

    Second order, no dissipation, keeps linear and angular momentum to the solver's tolerance. It is stable for linear
    motions only: what is stiff and nonlinear (omega h beyond about 10) rings on and can blow up, which raises NotConverged,
    or gains energy, which warns once it is a tenth of what moves (energy_balance.py); use BDF2 or backward Euler there.
    Contact in the middle of a step is not contact at its end.
    Hairer, Lubich, Wanner, Geometric Numerical Integration, II.1.2, doi:10.1007/3-540-30666-8.
    """

    order = 2
    may_gain_energy = True

    def stage(self, rate, fresh, j):
        h = float(self.schedule.length(j))
        d = math.exp(-0.5 * rate * h)
        slope = -0.5 * h * d
        return Stage(0.5 * h, b0=d, c0=2.0, e0=2 * d, e1=-d, by_rate=(slope, 0.0, 2 * slope, -slope))
