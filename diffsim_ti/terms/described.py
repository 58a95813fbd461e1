"""Descriptions of numbers that many terms have."""

from numpy.typing import ArrayLike

from diffsim_ti.common.checked import present
from diffsim_ti.inputs import POSITIVE, Input
from diffsim_ti.inputs.description import length
from diffsim_ti.mesh import TetrahedralMesh


def positive(argument: str, value: ArrayLike, unit: str, plain: str = "") -> Input:
    """One number > 0, which errors call by its argument."""
    present(argument, value)
    return Input(argument, value, ((),), unit, POSITIVE, plain=plain, label=f"{argument} [{unit}]")


def place(argument: str, value: ArrayLike, plain: str) -> Input:
    """A point of an obstacle's shape: 3 numbers [m]."""
    present(argument, value)
    return Input(argument, value, ((3,),), "m", change=length, plain=plain, axes="xyz")


def extent(argument: str, value: ArrayLike, plain: str) -> Input:
    """A size of an obstacle's shape: one number > 0 [m]."""
    present(argument, value)
    return Input(argument, value, ((),), "m", POSITIVE, plain=plain)


def chosen_width(mesh: TetrahedralMesh) -> float:
    """The width of a barrier whose width is left to the scene [m]: 1 % of the smallest body, with three digits."""
    return float(f"{0.01 * mesh.body_size:.3g}")
