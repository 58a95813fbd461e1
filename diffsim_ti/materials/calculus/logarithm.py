"""x - log(1 + x): what logarithmic energies are made of, accurate near zero and continued where the logarithm ends.

`fp` is the law's float; constants are cast to it, so that f32 code stays in f32.
"""

import taichi as ti


@ti.func
def x_minus_log1p(x, fp: ti.template()):
    """x - log(1 + x) with all its digits: plain subtraction loses the leading x^2 / 2, and Taichi has no log1p."""
    y = x - ti.log(1 + x)
    if ti.abs(x) * 5 < 1:
        # log(1 + x) = 2 artanh(z) = 2 z (1 + w/3 + w^2/5 + ...); eight terms leave 1e-17 at |x| = 1/5
        z = x / (2 + x)
        w = z * z
        series = 0 * x
        for k in ti.static(range(8)):
            series = ti.cast(1 / (17 - 2 * k), fp) + w * series
        y = z * (x - 2 * w * series)
    return y


# j - log(1 + j) as a function of j = J - 1; below `floor` = J_floor - 1 log J is replaced by its second-order Taylor
# polynomial about J_floor. `max` selects the expansion point; j - c keeps a NaN alive, which `max` alone would swallow.


@ti.func
def value(j, floor, fp: ti.template()):
    """j - log(1 + j), continued below the floor."""
    c = ti.max(j, floor)
    mean_slope = ti.cast(0.5, fp) * (slope(c, floor, fp) + slope(j, floor, fp))
    return x_minus_log1p(c, fp) + (j - c) * mean_slope


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
