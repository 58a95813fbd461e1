"""Symplectic Euler, the seeds' semi-implicit solver."""

from typing import Literal, TypedDict, overload

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.answers import answered
from diffsim_ti.common.checked import between, whole
from diffsim_ti.materials.material import Material
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.explicit.solver import CONTACT_DAMPING, ExplicitSolver, Weights
from diffsim_ti.solvers.substeps import Substeps
from diffsim_ti.state.schedule import Schedule, StagedSteps
from diffsim_ti.state.viscous_stages import MOST, ViscousStages
from diffsim_ti.terms import Drag, FilledChamber, Gravity, MultiPointConstraint


class SemiImplicitOptions(TypedDict, total=False):
    """What SemiImplicitSolver takes by name, of a scene or of a mesh and a material."""

    scene: Scene
    mesh: TetrahedralMesh | None
    material: Material | None
    dt: float
    substeps: Substeps
    density: ArrayLike
    gravity: ArrayLike
    damping: float
    damping: float
    parallel: bool | None
    allow_unstable: bool
    check_start: bool
    contact: Literal["stage", "force"]
    contact_damping: float


@answered
class SemiImplicitSolver(ExplicitSolver):
    """Symplectic Euler: v' = (v + h f(x) / m) exp(-c h), x' = x + h v', with h = dt / substeps.

    First order, one force evaluation per substep, keeps linear and angular momentum to round-off; stable for
    h <= 2 / omega_max. Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1.2, doi:10.1007/3-540-30666-8.

    viscous_stages: kicks of each substep, 1 to 32, which cost a force evaluation each. Viscosity then limits the substep by
    the square of their number: strongly damped bodies (KelvinVoigt, damping ratio xi of the fastest motion) take steps that
    cost, with the best number, 1 / 2.1 as much at xi = 5, 1 / 4 at 20, 1 / 9 at 100, and no less at 1 (ViscousStages).

    `SemiImplicitSolver(mesh, material, dt=...)`, or `SemiImplicitSolver(dt=...)` for `Simulator(mesh, material, solver)`, is
    for code that follows torch-diffsim's documents. It makes the scene itself, with density [kg/m^3], gravity [m/s^2, along
    y], `damping`, the share of velocity kept over one dt (a Drag), and nothing else; `set_fixed_vertices` fixes some. It
    takes a number of `substeps` as the least: it raises it to what stability asks for and says so.
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
        *,
        contact: Literal["stage", "force"] = "stage",
        contact_damping: float = CONTACT_DAMPING,
        viscous_stages: int = 1,
    ): ...

    @overload
    def __init__(
        self,
        mesh: TetrahedralMesh | None = None,
        material: Material | None = None,
        dt: float = 0.01,
        substeps: Substeps = "auto",
        density: ArrayLike = 1000.0,
        gravity: ArrayLike = -9.8,
        damping: float = 1.0,
        *,
        parallel: bool | None = None,
        allow_unstable: bool = False,
        contact: Literal["stage", "force"] = "stage",
        contact_damping: float = CONTACT_DAMPING,
        viscous_stages: int = 1,
    ): ...

    def __init__(self, *arguments, viscous_stages: int = 1, **options: Unpack[SemiImplicitOptions]):
        self.simulator = lambda: None
        self.viscous_stages = whole("viscous_stages", viscous_stages, 1)
        if self.viscous_stages > MOST:
            raise ValueError(f"viscous_stages must be at most {MOST}, got {viscous_stages}; take more substeps")
        self.kicks = ViscousStages(self.viscous_stages)
        if isinstance(arguments[0] if arguments else options.get("scene"), Scene):
            if known := [name for name in ("mesh", "material", "density", "gravity", "damping") if name in options]:
                raise TypeError(f"{type(self).__name__}: a scene has its own {' and '.join(known)}; give them to Scene")
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
        self, mesh=None, material=None, dt=0.01, substeps="auto", density=1000.0, gravity=-9.8, damping=1.0, **options
    ) -> tuple:
        """What `bind` needs besides the mesh and the material, which are returned."""
        self.dt, self.substeps, self._fixed = dt, substeps, None
        kept = between("damping", damping, 0, 1, ends=True)
        if kept == 0:
            raise ValueError("damping is the share of velocity kept over one dt and must lie in (0, 1], got 0")
        self._terms = [Gravity(gravity), *([Drag(-np.log(kept) / dt)] if kept < 1 else [])]
        self._density, self._options = density, options
        return mesh, material

    def bind(self, mesh: TetrahedralMesh, material: Material) -> None:
        """Make the scene of a mesh and a material, and choose the substeps."""
        if self.scene is not None:
            raise ValueError("this solver already has a scene: use Simulator(solver)")
        scene = Scene(mesh, material, self._density, self._terms, self._fixed)
        super().__init__(scene, self.dt, self.substeps, **self._options, check_start=False)
        self.choose_substeps()
        self.check_start = True

    def set_fixed_vertices(self, vertices: str | ArrayLike) -> None:
        """Fix a vertex set's name, indices or a mask, of a solver that makes its scene itself, before a Simulator is made.

        Raises ValueError for a solver made from a Scene, whose `fixed` says it, and RuntimeError where one runs already.
        """
        if not hasattr(self, "_terms"):
            raise ValueError("set_fixed_vertices: this solver has a Scene of its own: give it fixed=vertices")
        if self.simulator() is not None:
            raise RuntimeError(
                "set_fixed_vertices: a simulator runs this solver already: call it before Simulator(...)"
            )
        self._fixed = vertices
        if self.scene is not None:
            made, self.scene = self.scene, None
            self.bind(made.mesh, made.material)

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
        held = scene.term(FilledChamber) or scene.term(MultiPointConstraint)
        if self.viscous_stages > 1 and (held or scene.reduced):
            what = f"a {type(held).__name__} takes" if held else "reduced sets take"
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
