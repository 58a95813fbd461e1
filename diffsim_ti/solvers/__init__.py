"""Ways to advance a scene: one per file."""

from diffsim_ti.solvers.semi_implicit import SemiImplicitSolver
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.velocity_verlet import VelocityVerletSolver

SOLVERS = (SemiImplicitSolver, VelocityVerletSolver)
__all__ = ["SOLVERS", "SemiImplicitSolver", "Solver", "VelocityVerletSolver"]
