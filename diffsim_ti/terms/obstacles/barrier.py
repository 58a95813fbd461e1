"""The barrier of a distance, made dimensionless: b(d) = stiffness width^2 beta(d / width).

    beta(s) = -(s - 1)^2 log s    for s < 1, zero beyond; C2 at s = 1
    below s0 = 1/1000: the second-order Taylor polynomial of beta at s0, so that the force stays finite and outwards.

Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425. `fp` is the scene's float: constants are cast to
it, so that f32 code stays in f32.
"""

import math

import numpy as np
import taichi as ti

from diffsim_ti.runtime import traced

CROSSOVER = 1e-3

# beta and its derivatives between the crossover and 1, for numbers of kernels, of the host and arrays; log: log s


@traced
def value_within(s, log):
    return -(s - 1) * (s - 1) * log


@traced
def slope_within(s, log):
    return -(s - 1) * (2 * log + (s - 1) / s)


@traced
def curvature_within(s, log):
    return -2 * log - 4 * (s - 1) / s + (s - 1) * (s - 1) / (s * s)


VALUE, SLOPE, CURVATURE = (f(CROSSOVER, math.log(CROSSOVER)) for f in (value_within, slope_within, curvature_within))


@ti.func
def value(s, fp: ti.template()):
    """beta(s)"""
    b = 0 * s
    if s < ti.cast(CROSSOVER, fp):
        t = s - ti.cast(CROSSOVER, fp)
        b = ti.cast(VALUE, fp) + t * (ti.cast(SLOPE, fp) + t * ti.cast(CURVATURE / 2, fp))
    elif s < 1:
        b = value_within(s, ti.log(s))
    return b


@ti.func
def slope(s, fp: ti.template()):
    """beta'(s)"""
    b = 0 * s
    if s < ti.cast(CROSSOVER, fp):
        b = ti.cast(SLOPE, fp) + (s - ti.cast(CROSSOVER, fp)) * ti.cast(CURVATURE, fp)
    elif s < 1:
        b = slope_within(s, ti.log(s))
    return b


@ti.func
def curvature(s, fp: ti.template()):
    """beta''(s)"""
    b = 0 * s
    if s < ti.cast(CROSSOVER, fp):
        b = ti.cast(CURVATURE, fp)
    elif s < 1:
        b = curvature_within(s, ti.log(s))
    return b


@ti.func
def slope_and_curvature(s, fp: ti.template()):
    """(beta'(s), beta''(s)) with one logarithm, the dearest part of either"""
    b, c = 0 * s, 0 * s
    if s < ti.cast(CROSSOVER, fp):
        b, c = slope(s, fp), curvature(s, fp)
    elif s < 1:
        log = ti.log(s)
        b, c = slope_within(s, log), curvature_within(s, log)
    return b, c


@ti.func
def third(s, fp: ti.template()):
    """beta'''(s)"""
    b = 0 * s
    if s >= ti.cast(CROSSOVER, fp) and s < 1:
        b = (-2 * s * s - 4 * s + 2 * (s - 1)) / (s * s * s)
    return b


# on the host, for numbers or arrays, in float64


def _joined(s, below, inside):
    """`below` of s less the crossover where that is negative, else `inside`, which is zero from s = 1 on."""
    s = np.asarray(s, np.float64)
    clipped = np.clip(s, CROSSOVER, 1)
    return np.where(s < CROSSOVER, below(s - CROSSOVER), inside(clipped, np.log(clipped)))


def beta(s) -> np.ndarray:
    """beta(s)"""
    return _joined(s, lambda t: VALUE + t * (SLOPE + t * CURVATURE / 2), value_within)


def slope_at(s) -> np.ndarray:
    """beta'(s)"""
    return _joined(s, lambda t: SLOPE + t * CURVATURE, slope_within)


def curvature_at(s) -> np.ndarray:
    """beta''(s)"""
    return _joined(s, lambda t: CURVATURE + 0 * t, curvature_within)


REFERENCE_CURVATURE = float(curvature_at(0.1))  # the stiffness to expect of a firm contact, per that of the barrier
