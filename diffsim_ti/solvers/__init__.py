"""Ways to advance a scene: one per file."""

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.solvers.bdf2 import BDF2Solver
from diffsim_ti.solvers.implicit_euler import ImplicitEulerSolver
from diffsim_ti.solvers.implicit_midpoint import ImplicitMidpointSolver
from diffsim_ti.solvers.semi_implicit import SemiImplicitSolver
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.stable_step import stable_dt
from diffsim_ti.solvers.static import StaticSolver
from diffsim_ti.solvers.velocity_verlet import VelocityVerletSolver

SOLVERS = (SemiImplicitSolver, VelocityVerletSolver, ImplicitEulerSolver, ImplicitMidpointSolver, BDF2Solver)
__all__ = ["SOLVERS", "BDF2Solver", "ImplicitEulerSolver", "ImplicitMidpointSolver", "NotConverged"]
__all__ += ["SemiImplicitSolver", "Solver", "StaticSolver", "VelocityVerletSolver", "stable_dt"]
