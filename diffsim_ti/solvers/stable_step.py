"""The largest stable step of a scene, before a solver is chosen."""

from diffsim_ti.monitor.stability import StepLimit, element_limit, lanczos_limit
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.semi_implicit import SemiImplicitSolver
from diffsim_ti.state.workspace import Workspace


def stable_dt(scene: Scene, tight: bool = True) -> StepLimit:
    """Largest stable explicit step [s] of a scene at its start.

    tight: 2 / omega_max of the assembled system, self-contact included (`lanczos_limit`); else the element bound at rest,
    without contact (`element_limit`), which needs no kernels and is smaller. Obstacles limit no step unless a solver is told
    contact="force"; that solver's own `stable_dt(tight=True)` knows them.
    """
    return lanczos_limit(start_workspace(scene)) if tight else element_limit(scene)


def start_workspace(scene: Scene) -> Workspace:
    """A workspace of the scene at its start; every explicit solver with its default contact has the same stiffness."""
    solver = SemiImplicitSolver(scene, dt=1e-9, check_start=False)  # motions are asked for their values at 0 and dt
    return solver.workspace(solver.start_values())
