"""Backward Euler."""

import math

from diffsim_ti.solvers.implicit.solver import ImplicitSolver, Stage


class ImplicitEulerSolver(ImplicitSolver):
    """Backward Euler: v' = d v + h a(x'), x' = x + h v', d = exp(-c h), with h = dt / substeps.

    First order, unconditionally stable, and dissipative: a mode of frequency omega loses a factor 1 / sqrt(1 + (omega h)^2)
    of its amplitude per step, a rigid spin of rate omega decays as d omega / dt = -h omega^3 to leading order.
    Hairer, Wanner, Solving Ordinary Differential Equations II, IV.3, doi:10.1007/978-3-642-05221-7.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], precision="f64")
    >>> simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=0.1))  # an explicit step may have 0.054 s
    >>> simulator.step()
    >>> print(f"{simulator.velocities[0, 1]:.3f} m/s, {simulator.displacements[0, 1]:.4f} m")  # -g h and -g h^2
    -0.981 m/s, -0.0981 m
    """

    order, moves_robots = 1, True

    def stage(self, rate, fresh, j):
        h = float(self.schedule.length(j))
        d = math.exp(-rate * h)
        return Stage(h, b0=d, by_rate=(-h * d, 0.0, 0.0, 0.0))
