"""Symplectic Euler, the seeds' semi-implicit solver."""

from typing import overload

import numpy as np

from diffsim_ti.common.checked import whole
from diffsim_ti.materials.material import Material
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.explicit.solver import ExplicitSolver, Weights
from diffsim_ti.solvers.substeps import Substeps
from diffsim_ti.state.schedule import Schedule
from diffsim_ti.state.staged_steps import StagedSteps
from diffsim_ti.state.viscous_stages import MOST, ViscousStages
from diffsim_ti.terms import Gravity


class SemiImplicitSolver(ExplicitSolver):
    """Symplectic Euler: v' = (v + h f(x) / m) exp(-c h), x' = x + h v', with h = dt / substeps.

    First order, one force evaluation per substep, keeps linear and angular momentum to round-off; stable for
    h <= 2 / omega_max. Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1.2, doi:10.1007/3-540-30666-8.

    viscous_stages: kicks of each substep, 1 to 32, which cost a force evaluation each. Viscosity then limits the substep by
    the square of their number: strongly damped bodies (KelvinVoigt, damping ratio xi of the fastest motion) take steps that
    cost, with the best number, 1 / 2.1 as much at xi = 5, 1 / 4 at 20, 1 / 9 at 100, and no less at 1 (ViscousStages).

    `SemiImplicitSolver(mesh, material, dt=...)`, or `SemiImplicitSolver(dt=...)` for `Simulator(mesh, material, solver)`,
    makes the scene itself, with density [kg/m^3] and gravity [m/s^2, along y] and nothing else, and takes a number of
    `substeps` as the least: it raises it to what stability asks for and says so.
    Raises ValueError for `viscous_stages` beyond 32, without viscosity, and with a FilledChamber or reduced sets.
    """

    order = 1
    last_frame_is_state = True
    viscous_stages = 1
    arguments = (*ExplicitSolver.arguments, "viscous_stages")

    @overload
    def __init__(
        self,
        scene: Scene,
        dt: float = 0.01,
        substeps: Substeps = "auto",
        parallel: bool | None = None,
        allow_unstable: bool = False,
        check_start: bool = True,
        viscous_stages: int = 1,
    ): ...

    @overload
    def __init__(
        self,
        mesh: TetrahedralMesh | None = None,
        material: Material | None = None,
        dt: float = 0.01,
        substeps: Substeps = "auto",
        density=1000.0,
        gravity=-9.8,
        parallel: bool | None = None,
        allow_unstable: bool = False,
    ): ...

    def __init__(self, *arguments, viscous_stages: int = 1, **options):
        self.simulator = lambda: None
        self.viscous_stages = whole("viscous_stages", viscous_stages, 1)
        if self.viscous_stages > MOST:
            raise ValueError(f"viscous_stages must be at most {MOST}, got {viscous_stages}; take more substeps")
        self.kicks = ViscousStages(self.viscous_stages)
        if isinstance(arguments[0] if arguments else options.get("scene"), Scene):
            super().__init__(*arguments, **options)
            return
        self.scene = None
        mesh, material = self._keep_for_later(*arguments, **options)
        if (mesh is None) != (material is None):
            raise TypeError(
                f"{type(self).__name__} takes a Scene, or a mesh and a material, or neither (see Simulator)"
            )
        if mesh is not None:
            self.bind(mesh, material)

    def _keep_for_later(
        self, mesh=None, material=None, dt=0.01, substeps="auto", density=1000.0, gravity=-9.8, **options
    ) -> tuple:
        """What `bind` needs besides the mesh and the material, which are returned."""
        self.dt, self.substeps = dt, substeps
        self._density, self._gravity, self._options = density, gravity, options
        return mesh, material

    def bind(self, mesh: TetrahedralMesh, material: Material) -> None:
        """Make the scene of a mesh and a material, and choose the substeps."""
        if self.scene is not None:
            raise ValueError("this solver already has a scene: use Simulator(solver)")
        scene = Scene(mesh, material, self._density, Gravity(self._gravity))
        super().__init__(scene, self.dt, self.substeps, **self._options, check_start=False)
        self.choose_substeps()
        self.check_start = True

    @property
    def positions(self):
        """Positions [m] of the simulator that runs this solver, as a torch tensor made on access."""
        import torch

        simulator = self.simulator()
        if simulator is None:
            raise RuntimeError("no simulator runs this solver yet: make Simulator(solver) first")
        return torch.from_numpy(simulator.positions)

    def check_scene(self, scene):
        super().check_scene(scene)
        if self.viscous_stages > 1 and not scene.law.viscous:
            raise ValueError(
                f"viscous_stages={self.viscous_stages}: {scene.material.name} has no viscosity, so that additional kicks "
                "in a substep have no effect; put KelvinVoigt around it, or leave viscous_stages out"
            )
        if self.viscous_stages > 1 and (scene.holds_volumes or scene.reduced):
            what = "a FilledChamber takes" if scene.holds_volumes else "reduced sets take"
            raise ValueError(f"viscous_stages: {what} one kick for each substep; take substeps, or an implicit solver")

    def describe(self):
        kicks = f"; {self.viscous_stages} kicks in each substep" if self.viscous_stages > 1 else ""
        return super().describe() + kicks

    def passes_of(self, steps: Schedule) -> Schedule:
        return StagedSteps(steps, self.viscous_stages) if self.viscous_stages > 1 else steps

    def lags(self, j, num_passes):
        return True

    def weights(self, j, num_passes, rate):
        h, decay = self.lengths(j, rate)
        if self.viscous_stages == 1:
            return Weights(0, 0, 0.5, 0.5, 0.0, h, h * decay, decay, -h * h * decay, -h * decay)
        k = np.asarray(j) % self.viscous_stages
        drifts = lambda x, none=0.0: np.where(k == self.viscous_stages - 1, x, none)  # noqa: E731
        of_drift = drifts(h * decay), drifts(decay, 1.0), drifts(-h * h * decay), drifts(-h * decay)
        return Weights(0, 0, 0.5, 0.5, 0.0, h * self.kicks.kicks[k], *of_drift)
