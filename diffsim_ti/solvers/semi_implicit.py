"""Symplectic Euler, the seeds' semi-implicit solver."""

import math

from diffsim_ti.scene import Scene
from diffsim_ti.solvers.explicit.solver import ExplicitSolver, Weights
from diffsim_ti.terms import Gravity


class SemiImplicitSolver(ExplicitSolver):
    """Symplectic Euler: v' = (v + h f(x) / m) exp(-c h), x' = x + h v', with h = dt / substeps.

    First order, one force evaluation per substep, keeps linear and angular momentum to round-off; stable for
    h <= 2 / omega_max. Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1.2, doi:10.1007/3-540-30666-8.
    """

    order = 1
    last_frame_is_state = True

    def __init__(
        self, scene=None, material=None, dt: float = 0.01, substeps: int = 1, density=1000.0, gravity=-9.8, **options
    ):
        """`SemiImplicitSolver(scene, dt=...)` takes dt as it is and refuses an unstable one.

        `SemiImplicitSolver(mesh, material, dt=...)`, or `SemiImplicitSolver(dt=...)` for
        `Simulator(mesh, material, solver)`, makes the scene itself, with density [kg/m^3] and gravity [m/s^2, along y]
        and nothing else, and takes `substeps` as the least number: it raises it to what stability asks for and says so.
        """
        self.simulator = lambda: None
        self._own = dict(density=density, terms=[Gravity(gravity)])
        if isinstance(material, (int, float)):
            substeps = substeps if dt == 0.01 else dt  # SemiImplicitSolver(scene, 1e-3, 4)
            material, dt = None, float(material)
        if scene is None:
            self._waiting = dict(dt=dt, substeps=substeps) | options
            self.scene, self.dt, self.substeps = None, dt, substeps
        elif material is None:
            super().__init__(scene, dt, substeps, **options)
        else:
            self._waiting = dict(dt=dt, substeps=substeps) | options
            self.bind(scene, material)

    def bind(self, mesh, material) -> None:
        """Make the scene of a mesh and a material, and choose the substeps."""
        if getattr(self, "scene", None) is not None:
            raise ValueError("this solver already has a scene: use Simulator(solver)")
        super().__init__(Scene(mesh, material, **self._own), **self._waiting, check_start=False)
        self.choose_substeps()

    @property
    def positions(self):
        """Positions [m] of the simulator that runs this solver, as a torch tensor made on access."""
        import torch

        simulator = self.simulator()
        if simulator is None:
            raise RuntimeError("no simulator runs this solver yet: make Simulator(solver) first")
        return torch.from_numpy(simulator.positions)

    def num_passes(self, steps: int) -> int:
        return steps * self.substeps

    def weights(self, j, num_passes, rate):
        h = self.dt / self.substeps
        decay = math.exp(-rate * h)
        return Weights(0, 0, 0.0, h, h * decay, decay, -h * h * decay, -h * decay)
