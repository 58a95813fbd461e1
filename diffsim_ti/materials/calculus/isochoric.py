"""What a deformation is besides its change of volume."""

from diffsim_ti.differentiation import Number, expm1_minus_x, log1p, x_minus_log1p
from diffsim_ti.materials.calculus.tensor import Tensor, invariants


def isochoric(H: Tensor) -> tuple[Number, Number, Number]:
    """(J^(-2/3) I_C - 3, J - 1, log J) of F = I + H, with all digits near rest; J > 0."""
    _, j, s = invariants(H)  # s = I_C - 3 - 2 j
    log = log1p(j)
    more = expm1_minus_x(log * (-2 / 3))  # J^(-2/3) = 1 - 2/3 log J + more
    # all parts are of second order in H: nothing cancels
    return s + 2 * x_minus_log1p(j) + 3 * more + (more - log * (2 / 3)) * (s + 2 * j), j, log
