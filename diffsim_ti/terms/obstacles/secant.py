"""The push of a barrier over a step in which the distance goes from d to y: a stage of explicit passes of its own.

    P = k w p(d / w, y / w),    p(s, t) = -c beta'(t) - (1 - c) sigma(s, t),    sigma = (beta(t) - beta(s)) / (t - s)

c = 1 is backward Euler of the barrier alone, c = 0 its discrete gradient, which keeps the energy. beta is that of
barrier.py, and sigma its secant's slope: symmetric, falling in size as either argument grows, without cancellation where
s and t are near. Gonzalez 1996, Time integration and discrete Hamiltonian systems, doi:10.1007/BF02440162.
"""

import taichi as ti

from diffsim_ti.terms.obstacles import barrier
from diffsim_ti.terms.obstacles.barrier import CROSSOVER


@ti.func
def log1p_ratio(x, fp: ti.template()):
    """log(1 + x) / x for x > -1, and its derivative"""
    value, derivative = 1 + 0 * x, 0 * x
    if ti.abs(x) * 8 < 1:
        # 1 - x/2 + x^2/3 - ..., by Horner's rule with its derivative; at |x| = 1/8 a double needs 18 terms, a single 9
        value, derivative = 0 * x, 0 * x
        for k in ti.static(range(18 if fp == ti.f64 else 9, 0, -1)):
            derivative = value + x * derivative
            value = ti.cast((-1) ** (k - 1) / k, fp) + x * value
    else:
        value = ti.log(1 + x) / x
        derivative = (ti.cast(1, fp) / (1 + x) - value) / x
    return value, derivative


@ti.func
def _inside(s, t, fp: ti.template()):
    """sigma and its derivative by t for s and t between the crossover and 1."""
    ratio, derivative = log1p_ratio((t - s) / s, fp)
    value = -(s + t - 2) * ti.log(t) - (s - 1) * (s - 1) / s * ratio
    by_t = -ti.log(t) - (s + t - 2) / t - (s - 1) * (s - 1) / (s * s) * derivative
    return value, by_t


@ti.func
def secant_by_end(s, t, fp: ti.template()):
    """(sigma, its derivative by t)"""
    corner, half = ti.cast(CROSSOVER, fp), ti.cast(0.5, fp)  # dividing by 2 would compute in f64
    low, high = ti.min(s, t), ti.max(s, t)
    value, by_t = 0 * s, 0 * s
    if high <= corner:  # a straight slope
        value = half * (barrier.slope(s, fp) + barrier.slope(t, fp))
        by_t = half * barrier.curvature(t, fp)
    elif low >= corner and high <= 1:
        value, by_t = _inside(s, t, fp)
    elif low < 1:
        a, b = ti.max(low, corner), ti.min(high, 1 + 0 * s)
        part, _ = _inside(a, b, fp)
        rise = part * (b - a)
        if low < corner:
            rise += half * (barrier.slope(low, fp) + barrier.slope(corner, fp)) * (corner - low)
        value = rise / (high - low)
        by_t = (barrier.slope(t, fp) - value) / (t - s)
    return value, by_t


@ti.func
def secant(s, t, fp: ti.template()):
    """(sigma, its derivative by s, its derivative by t)"""
    value, by_t = secant_by_end(s, t, fp)
    _, by_s = secant_by_end(t, s, fp)  # it is symmetric
    return value, by_s, by_t


@ti.func
def push_by_end(s, t, c, fp: ti.template()):
    """(p, -dp/dt): all that looking for the end of a pass needs"""
    slope, curvature = barrier.slope_and_curvature(t, fp)
    value, by_t = -slope, curvature
    if c < 1:
        sigma, sigma_t = secant_by_end(s, t, fp)
        value = c * value - (1 - c) * sigma
        by_t = c * by_t + (1 - c) * sigma_t
    return value, by_t


@ti.func
def push(s, t, c, fp: ti.template()):
    """(p, -dp/ds, -dp/dt): none is negative."""
    value, by_t = push_by_end(s, t, c, fp)
    _, sigma_s = secant_by_end(t, s, fp)
    return value, (1 - c) * sigma_s, by_t
