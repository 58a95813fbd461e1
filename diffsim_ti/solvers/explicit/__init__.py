"""Explicit solvers: a chain of kicks and drifts, its tangent and its adjoint."""
