"""Equilibria."""

from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.solvers.implicit.solver import ImplicitSolver, Stage

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


class StaticSolver(ImplicitSolver):
    """Equilibrium: forces, weight and contact balance; velocities are zero. One step finds it, so that
    `Rollout(StaticSolver(scene), steps=1)` is the map from inputs to the equilibrium; a minimum of the energy, not a
    saddle. Several steps follow prescribed motion and forces per step quasi-statically.

    load_steps: in the first step loads and prescribed motion are laid on in so many parts, each starting from the last.
    Raises ValueError if the fixed vertices leave a piece of the body free to move rigidly, NotConverged otherwise.
    """

    order = 0
    arguments = ("load_steps", "tolerance", "max_iterations", "dt", "parallel", "preconditioner")

    def __init__(
        self,
        scene: "Scene",
        load_steps: int = 1,
        tolerance: float = 1e-8,
        max_iterations: int = 100,
        dt: float = 1.0,
        parallel: bool | None = None,
        preconditioner: str = "auto",
    ):
        law = scene.law
        if law.state_names:
            raise ValueError(
                f"{type(law).__name__} has a state ({', '.join(law.state_names)}) that moves on with time, and an "
                "equilibrium has none; take a solver with inertia, or a law of what is left when it has settled"
            )
        super().__init__(scene, dt, load_steps, tolerance, max_iterations, parallel, preconditioner)
        self._refuse_rigid_modes()

    @property
    def load_steps(self) -> int:
        """Parts in which loads, motions and paths are applied."""
        return self.substeps

    def stage(self, rate, fresh):
        return Stage(self.substep, b0=0.0, e0=0.0, static=True)

    def _refuse_rigid_modes(self) -> None:
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        mesh, fixed = self.scene.mesh, np.zeros(self.scene.mesh.num_vertices, bool)
        fixed[self.scene.fixed] = True
        tets = mesh.tetrahedra
        edges = tets[:, [0, 0, 0]].ravel(), tets[:, 1:].ravel()
        graph = coo_matrix((np.ones(len(edges[0])), edges), shape=(len(fixed), len(fixed)))
        count, piece = connected_components(graph, directed=False)
        for k in range(count):
            held = mesh.vertices[fixed & (piece == k)]
            spread = np.linalg.matrix_rank(held - held[0], tol=1e-9 * np.ptp(mesh.vertices)) if len(held) else -1
            if spread < 2:
                free = {-1: "6 rigid modes: 3 translations, 3 rotations", 0: "3 rotations", 1: "1 rotation"}[
                    int(spread)
                ]
                which = f"piece {k} of {count} of the body" if count > 1 else "the body"
                raise ValueError(
                    f"statics: {which} is free to move rigidly ({free}): fix at least three of its vertices that do not "
                    "lie on a line, or use a solver with inertia"
                )
