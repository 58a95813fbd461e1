"""The largest stable step of a scene, before a solver is chosen."""

from collections.abc import Callable

from diffsim_ti.common.checked import instance
from diffsim_ti.common.public import public
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.monitor.stability import StepLimit, element_limit, lanczos_limit, stiffest
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.semi_implicit import SemiImplicitSolver


@public
def stable_dt(scene: Scene, tight: bool = True) -> StepLimit:
    """Largest stable explicit step [s] of a scene at its start.

    Pressures of gases, tensions and lengths of cables are the stiffest of all keyframes and steps; functions of time are
    checked by runs, which sample them.
    tight: 2 / omega_max of the assembled system, self-contact included (`lanczos_limit`); else the element bound at rest,
    without contact (`element_limit`), which needs no kernels and is smaller. Obstacles limit no step unless a solver is told
    contact="force"; that solver's own `stable_dt(tight=True)` knows them. Scenes with sets that are `reduced`, for which
    explicit solvers take contact="force" alone, have those obstacles counted that press at the start; sets that move by a
    basis, and what ties glue, count as if their vertices were free, which errs on the safe side.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> soft = ds.Scene(mesh, material, precision="f64")
    >>> stiff = ds.Scene(mesh, ds.StableNeoHookean(E=4e5, nu=0.3), precision="f64")
    >>> print(f"{ds.stable_dt(soft) / ds.stable_dt(stiff):.6f}")  # four times the stiffness, half of the step
    2.000000
    """
    instance("stable_dt", "scene", scene, Scene, "a Scene")
    return lanczos_limit(start_workspace(scene, stiffest)) if tight else element_limit(scene)


class _AtStart(SemiImplicitSolver):
    """Tells the stiffness of scenes and takes no step, so that it need not support all that they have."""

    check_bodies = staticmethod(lambda scene, contact: None)


def start_workspace(scene: Scene, of: Callable[[Scene, dict], dict] = lambda scene, values: values) -> Workspace:
    """A workspace of the scene at its start, with what `of` makes of its values; every explicit solver with its default
    contact has the same stiffness."""
    contact = "force" if scene.reduced else "stage"
    # motions are asked for their values at 0 and dt
    solver = _AtStart(scene, dt=1e-9, check_start=False, contact=contact)
    return solver.workspace(scene.inputs.derive(of(scene, scene.inputs.at_times([0.0, solver.dt]))))
