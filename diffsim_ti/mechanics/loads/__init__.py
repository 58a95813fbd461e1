"""Prescribed forces on vertices."""
