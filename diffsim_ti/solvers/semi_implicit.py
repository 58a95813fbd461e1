"""Symplectic Euler, the seeds' semi-implicit solver."""

from typing import overload

from diffsim_ti.materials.material import Material
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.explicit.solver import ExplicitSolver, Weights
from diffsim_ti.terms import Gravity


class SemiImplicitSolver(ExplicitSolver):
    """Symplectic Euler: v' = (v + h f(x) / m) exp(-c h), x' = x + h v', with h = dt / substeps.

    First order, one force evaluation per substep, keeps linear and angular momentum to round-off; stable for
    h <= 2 / omega_max. Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1.2, doi:10.1007/3-540-30666-8.

    `SemiImplicitSolver(scene, dt=...)` takes dt as it is and refuses an unstable one, as every explicit solver does.

    `SemiImplicitSolver(mesh, material, dt=...)`, or `SemiImplicitSolver(dt=...)` for `Simulator(mesh, material, solver)`,
    makes the scene itself, with density [kg/m^3] and gravity [m/s^2, along y] and nothing else, and takes `substeps` as the
    least number: it raises it to what stability asks for and says so.
    """

    order = 1
    last_frame_is_state = True

    @overload
    def __init__(
        self,
        scene: Scene,
        dt: float = 0.01,
        substeps: int = 1,
        parallel: bool | None = None,
        allow_unstable: bool = False,
        check_start: bool = True,
    ): ...

    @overload
    def __init__(
        self,
        mesh: TetrahedralMesh | None = None,
        material: Material | None = None,
        dt: float = 0.01,
        substeps: int = 1,
        density=1000.0,
        gravity=-9.8,
        parallel: bool | None = None,
        allow_unstable: bool = False,
    ): ...

    def __init__(self, *arguments, **options):
        self.simulator = lambda: None
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
        self, mesh=None, material=None, dt=0.01, substeps=1, density=1000.0, gravity=-9.8, **options
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

    @property
    def positions(self):
        """Positions [m] of the simulator that runs this solver, as a torch tensor made on access."""
        import torch

        simulator = self.simulator()
        if simulator is None:
            raise RuntimeError("no simulator runs this solver yet: make Simulator(solver) first")
        return torch.from_numpy(simulator.positions)

    def lags(self, j, num_passes):
        return True

    def weights(self, j, num_passes, rate):
        h, decay = self.lengths(j, rate)
        return Weights(0, 0, 0.5, 0.5, 0.0, h, h * decay, decay, -h * h * decay, -h * decay)
