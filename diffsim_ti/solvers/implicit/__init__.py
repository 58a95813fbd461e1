"""Implicit solvers: minima of incremental potentials, their tangent and their adjoint."""
