"""What the implicit solvers share. A pass solves one equation for the place u* where forces are taken:

    x = a0 u + a1 u-,  y = b0 v + b1 v-         where inertia starts from: the present state and the one before
    u* = x + gamma v*,  v* = y + gamma a(u*)    the equation, in one unknown
    u' = c0 u* + (1 - c0) u,  v' = e0 v* + e1 y

Backward Euler: x = u, y = v, gamma = h, u' = u*, v' = v*. Implicit midpoint: the same with gamma = h / 2, then the end is as
far beyond the middle as the start was before it. BDF2: x and y extrapolate from two states. Damping by a rate multiplies the
velocities by exp(-c h) in a stage of its own. Statics: no inertia, u* is where forces vanish.
"""

from abc import abstractmethod
from typing import TYPE_CHECKING, Literal

from diffsim_ti.common.checked import between, whole
from diffsim_ti.solvers.implicit.adjoint import ImplicitAdjoint
from diffsim_ti.solvers.implicit.tangent import ImplicitTangent
from diffsim_ti.solvers.implicit.workspace import ImplicitWorkspace
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.substeps import Substeps
from diffsim_ti.state.stage import Stage

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


class ImplicitSolver(Solver):
    """Implicit steps: each is the minimum of an incremental potential that descends from where the step begins, found by
    Newton's method (newton.py) in one solve or, where that fails, by load stepping.

    tolerance: residual of the equation of motion against the forces that meet at vertices, loads and inertia where the solve
        ends; gradients are as exact as the solve.
    max_iterations: Newton rounds per substep, after which NotConverged is raised and the state stays as it was. Rounds whose
        direction an obstacle, or the surface itself, cuts short do not count, up to five times as many, nor do those that
        come after while ten of them halve the residual.
    preconditioner: of the linear solves: "block_jacobi", "multigrid" (smoothed aggregation; of up to 200 vertices the
        inverse at rest), or "auto": the first for up to 30 vertices and where inertia outweighs stiffness.
        Where they take more products than the time of a sparse factorisation allows (slender bodies), that takes its place,
        from 30 000 unknowns on with a warning.

    On the way from one state to the next no vertex or face meets an obstacle; what comes to the body, obstacles on their
    paths and fixed vertices, makes room for itself. Where there is none, Blocked (a NotConverged) says what stands there.
    """

    arguments = ("dt", "substeps", "tolerance", "max_iterations", "parallel", "preconditioner")
    last_frame_is_state = True
    multistep = False
    loose = ""  # what is free to move rigidly but for contact, in words: of equilibria (closing.py)
    may_gain_energy = False  # whether long steps can add energy, so that it must be watched

    def __init__(
        self,
        scene: "Scene",
        dt: float = 0.01,
        substeps: Substeps = 1,
        tolerance: float = 1e-6,
        max_iterations: int = 50,
        parallel: bool | None = None,
        preconditioner: Literal["auto", "block_jacobi", "multigrid"] = "auto",
    ):
        if preconditioner not in ("auto", "block_jacobi", "multigrid"):
            raise ValueError(f"preconditioner must be auto, block_jacobi or multigrid, got {preconditioner!r}")
        bodies = getattr(getattr(scene, "reduced", None), "bodies", ())
        if preconditioner == "multigrid" and any(body.kind != "tie" for body in bodies):
            raise ValueError(
                'preconditioner: a scene with reduced= takes "block_jacobi", with blocks of the bodies; or "auto"'
            )
        self.preconditioner = preconditioner
        self.tolerance = between("tolerance", tolerance, 0, 1, ends=False)
        self.max_iterations = whole("max_iterations", max_iterations, 1)
        super().__init__(scene, dt, substeps, parallel)

    @abstractmethod
    def stage(self, rate: float, fresh: bool, j: int) -> Stage:
        """The numbers of pass j; `fresh`: there is no state before the present one."""

    def workspace(self, derived, bend=0.0):
        """Arrays and launches for runs of this solver; bend: see state/bending.py."""
        return ImplicitWorkspace(self, derived, bend)

    def adjoint(self, workspace, density: bool, shape: bool):
        """The reverse sweep of a run."""
        return ImplicitAdjoint(workspace, density, shape)

    def tangent(self, workspace, tangent):
        """The tangent of a run."""
        return ImplicitTangent(workspace, tangent)

    def describe(self) -> str:
        return (
            f"{type(self).__name__}: dt {self.dt:g} s, {self.substeps} substeps, relative tolerance {self.tolerance:g}"
        )
