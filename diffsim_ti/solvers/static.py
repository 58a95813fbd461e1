"""Equilibria."""

from typing import TYPE_CHECKING, Literal

from diffsim_ti.mechanics.supports.mobility import free_motions
from diffsim_ti.solvers.implicit.solver import ImplicitSolver, Stage
from diffsim_ti.terms import SelfContact

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


class StaticSolver(ImplicitSolver):
    """Equilibrium: forces, weight and contact balance; velocities are zero. One step finds it, so that
    `Rollout(StaticSolver(scene), steps=1)` is the map from inputs to the equilibrium; a minimum of the energy, not a
    saddle. Several steps follow prescribed motion and forces per step quasi-statically.

    tolerance, max_iterations, preconditioner: as of implicit steps: "block_jacobi", "multigrid" or "auto" for the last.
    load_steps: in the first step loads and prescribed motion are applied in so many parts, each starting from the last.
    Raises ValueError, which names the motions, if supports, springs, cables and foundations leave a piece of the body free
    to move rigidly, or parts that meet at a vertex or an edge alone free to turn, as about a hinge. Where the scene has
    obstacles or SelfContact such a piece goes, as the loads pull it, by up to the body's size to where contact holds it,
    with a warning; NotConverged if nothing does. Bodies whose surfaces overlap at the start by less than an edge of these,
    such as parts of a press fit, are pressed apart first, with a warning: the equilibrium is that of bodies as they are at
    rest, and so are its gradients; in that step they have no friction on each other. NotConverged, too, where the body does
    not bear the load of a step, which names the share of it that it bears. Warns Buckled where it leaves a branch of stable
    equilibria.
    Nocedal, Wright, Numerical Optimization, 2nd ed., 2006, ch. 3 and 7, doi:10.1007/978-0-387-40065-5.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1).forward()
    >>> print(f"{frames.displacements[-1, :, 1].min():.3f} m")  # it settles under its own weight
    -0.050 m
    """

    order, moves_robots = 0, True
    arguments = ("load_steps", "tolerance", "max_iterations", "dt", "parallel", "preconditioner")

    def __init__(
        self,
        scene: "Scene",
        load_steps: int = 1,
        tolerance: float = 1e-8,
        max_iterations: int = 100,
        dt: float = 1.0,
        parallel: bool | None = None,
        preconditioner: Literal["auto", "block_jacobi", "multigrid"] = "auto",
    ):
        self.check_scene(scene)
        for x in scene.interactions:
            if x.no_equilibrium:
                raise ValueError(f"{x.no_equilibrium}; take a solver with inertia")
        if scene.law.state_names and not scene.law.plastic:
            raise ValueError(
                f"{scene.law.title} has a state that moves on with time, and an equilibrium has none: take a solver with "
                "inertia, or the law of what lasts when all has settled, which of Prony(material, shares, times) is the "
                "material inside with the same numbers"
            )
        super().__init__(scene, dt, load_steps, tolerance, max_iterations, parallel, preconditioner)
        self._refuse_rigid_modes()

    @property
    def load_steps(self) -> int:
        """Parts in which loads, motions and paths are applied."""
        return self.substeps

    def check_schedule(self, schedule):
        raise ValueError(
            "equilibria do not depend on time, and lengths of steps mean nothing to them: pass the number of steps"
        )

    def stage(self, rate, fresh, j):
        return Stage(self.substep, b0=0.0, e0=0.0, static=True)

    def _refuse_rigid_modes(self) -> None:
        """Raise ValueError, which names them, if rigid motions of a part of the body are left that no contact can hold."""
        said = free_motions(self.scene)
        if said and (self.scene.obstacles or self.scene.term(SelfContact)):  # which may: known when it is closed
            self.loose = said.split(": hold")[0]
        elif said:
            raise ValueError(f"static solve: {said}, or use a solver with inertia")
