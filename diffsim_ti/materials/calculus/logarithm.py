"""x - log(1 + x): what logarithmic energies are made of, accurate near zero and continued where the logarithm ends.

`fp` is the law's float; constants are cast to it, so that f32 code stays in f32.
"""

import taichi as ti

from diffsim_ti.differentiation.functions import x_minus_log1p_value

# j - log(1 + j) as a function of j = J - 1; below `floor` = J_floor - 1 log J is replaced by its second-order Taylor
# polynomial about J_floor. `max` selects the expansion point; j - c keeps a NaN alive, which `max` alone would swallow.


@ti.func
def value(j, floor, fp: ti.template()):
    """j - log(1 + j), continued below the floor."""
    c = ti.max(j, floor)
    mean_slope = ti.cast(0.5, fp) * (slope(c, floor, fp) + slope(j, floor, fp))
    return x_minus_log1p_value(c, fp) + (j - c) * mean_slope


@ti.func
def slope(j, floor, fp: ti.template()):
    """j / (1 + j), continued below the floor."""
    c = ti.max(j, floor)
    inverse = ti.cast(1, fp) / (1 + c)
    return (c + (j - c) * inverse) * inverse


@ti.func
def curvature(j, floor, fp: ti.template()):
    """1 / (1 + j)^2, continued below the floor."""
    inverse = ti.cast(1, fp) / (1 + ti.max(j, floor))
    return inverse * inverse
