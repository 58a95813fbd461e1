"""Velocity Verlet: second order at the cost of symplectic Euler."""

import numpy as np

from diffsim_ti.solvers.explicit.solver import ExplicitSolver, Weights


class VelocityVerletSolver(ExplicitSolver):
    """Velocity Verlet: v+ = v + h/2 a(x), x' = x + h v+, v' = v+ + h/2 a(x'), with h = dt / substeps.

    Second order; the two half kicks that meet at a time share one force evaluation. Drag acts in the middle of the
    drift (exact, symmetric). Stable for h <= 2 / omega_max. Forces given per step enter a kick that two steps share
    with half of each, or with their parts of it where steps are unequal. A `Simulator` ends each step with a force of its
    own: the same, but of viscous laws, and of contact beside what is held exactly, which a run takes at the speed between
    two kicks there. Hairer, Lubich, Wanner, Geometric Numerical
    Integration, I.1.4, doi:10.1007/3-540-30666-8.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], precision="f64")
    >>> simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3))
    >>> simulator.run(10)
    >>> print(f"{simulator.displacements[0, 1]:.7f} m")  # g t^2 / 2, without error
    -0.0004905 m
    """

    order = 2
    last_frame_is_state = False

    def num_passes(self, steps: int) -> int:
        return super().num_passes(steps) + 1

    def lags(self, j, num_passes):
        return 0 < j < num_passes

    def weights(self, j, num_passes, rate):
        (h, decay), (before, _) = self.lengths(j, rate), self.lengths(np.maximum(j - 1, 0), rate)
        kicked, kicks = j > 0, j < num_passes - 1  # the half kicks that end a step, and that begin one
        drifts = lambda x, none=0.0: np.where(kicks, x, none)  # noqa: E731
        part = np.where(kicked & kicks, before / (before + h), 0.5)  # of the kick that ends a step
        shares = part, 1 - part
        return Weights(
            kicked * 1,
            (~kicks & kicked) * 1,
            *shares,
            kicked * before / 2,
            kicks * h / 2,
            drifts(h * (1 + decay) / 2),
            drifts(decay, 1.0),
            drifts(-h * h * decay / 2),
            drifts(-h * decay),
        )
