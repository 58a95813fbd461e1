"""Faces of six nodes: their shape functions, and a rule that is exact for what is integrated over them.

Coordinates (s, t) of the reference triangle (0,0), (1,0), (0,1); L = (1 - s - t, s, t). Corners come first, then the middles
of 01, 12, 20. N_a = L_a (2 L_a - 1) at corners, 4 L_a L_b between. The rule is that of Cowper 1973, Gaussian quadrature
formulas for triangles, doi:10.1002/nme.1620070316.
"""

import numpy as np

from diffsim_ti.mesh.geometry import SIDES
from diffsim_ti.mesh.reference_element import barycentric, quadratic, quadratic_slopes

BY_L = np.array([[-1.0, -1], [1, 0], [0, 1]])  # dL / d(s, t)
BY_NEXT = np.roll(BY_L, -1, 0)


def functions(st: np.ndarray) -> np.ndarray:
    """N_a at points, shape (k, 6)."""
    return quadratic(barycentric(st), SIDES)


def derivatives(st: np.ndarray) -> np.ndarray:
    """dN_a / d(s, t) at points, shape (k, 6, 2)."""
    return quadratic_slopes(barycentric(st), BY_L, SIDES)


# d2N_a / d(s, t)^2, which are constants, shape (6, 2, 2)
SECOND = 4 * np.concatenate(
    [BY_L[:, :, None] * BY_L[:, None], BY_L[:, :, None] * BY_NEXT[:, None] + BY_NEXT[:, :, None] * BY_L[:, None]]
)


def _six_points() -> tuple[np.ndarray, np.ndarray]:
    """((s, t), shares of the area) of the rule of six points that is exact to degree four."""
    st, weights = [], []
    for sign in (1, -1):
        a = (8 - np.sqrt(10) + sign * np.sqrt(38 - 44 * np.sqrt(0.4))) / 18
        w = (620 + sign * np.sqrt(213125 - 53320 * np.sqrt(10))) / 3720
        st += [(a, a), (1 - 2 * a, a), (a, 1 - 2 * a)]
        weights += 3 * [w]
    return np.array(st), np.array(weights)


POINTS, WEIGHTS = _six_points()
