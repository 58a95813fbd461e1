"""Taichi's program that runs now; every look at an array comes by, so nothing is imported in the call."""

from taichi.lang import impl

from diffsim_ti.runtime.quadrants import QUADRANTS


def current_program():
    """The program that runs, or None; Quadrants' own property raises where there is none."""
    return impl.get_runtime()._prog if QUADRANTS else impl.pytaichi.prog
