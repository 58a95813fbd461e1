"""The barrier of a distance, made dimensionless: b(d) = stiffness width^2 beta(d / width).

    beta(s) = -(s - 1)^2 log s    for s < 1, zero beyond; C2 at s = 1
    below s0 = 1/1000: the second-order Taylor polynomial of beta at s0, so that the force stays finite and outwards.

Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425. `fp` is the scene's float: constants are cast to
it, so that f32 code stays in f32.
"""

import math

import numpy as np
import taichi as ti

CROSSOVER = 1e-3
_VALUE = -((CROSSOVER - 1) ** 2) * math.log(CROSSOVER)
_SLOPE = -2 * (CROSSOVER - 1) * math.log(CROSSOVER) - (CROSSOVER - 1) ** 2 / CROSSOVER
_CURVATURE = -2 * math.log(CROSSOVER) - 4 * (CROSSOVER - 1) / CROSSOVER + ((CROSSOVER - 1) / CROSSOVER) ** 2


@ti.func
def value(s, fp: ti.template()):
    """beta(s)"""
    b = 0 * s
    if s < ti.cast(CROSSOVER, fp):
        t = s - ti.cast(CROSSOVER, fp)
        b = ti.cast(_VALUE, fp) + t * (ti.cast(_SLOPE, fp) + t * ti.cast(_CURVATURE / 2, fp))
    elif s < 1:
        b = -(s - 1) * (s - 1) * ti.log(s)
    return b


@ti.func
def slope(s, fp: ti.template()):
    """beta'(s)"""
    b = 0 * s
    if s < ti.cast(CROSSOVER, fp):
        b = ti.cast(_SLOPE, fp) + (s - ti.cast(CROSSOVER, fp)) * ti.cast(_CURVATURE, fp)
    elif s < 1:
        b = -(s - 1) * (2 * ti.log(s) + (s - 1) / s)
    return b


@ti.func
def curvature(s, fp: ti.template()):
    """beta''(s)"""
    b = 0 * s
    if s < ti.cast(CROSSOVER, fp):
        b = ti.cast(_CURVATURE, fp)
    elif s < 1:
        b = -2 * ti.log(s) - 4 * (s - 1) / s + (s - 1) * (s - 1) / (s * s)
    return b


@ti.func
def slope_and_curvature(s, fp: ti.template()):
    """(beta'(s), beta''(s)) with one logarithm, the dearest part of either"""
    b, c = 0 * s, 0 * s
    if s < ti.cast(CROSSOVER, fp):
        b, c = slope(s, fp), curvature(s, fp)
    elif s < 1:
        log, share = ti.log(s), (s - 1) / s
        b, c = -(s - 1) * (2 * log + share), -2 * log - 4 * (s - 1) / s + (s - 1) * (s - 1) / (s * s)
    return b, c


@ti.func
def third(s, fp: ti.template()):
    """beta'''(s)"""
    b = 0 * s
    if s >= ti.cast(CROSSOVER, fp) and s < 1:
        b = (-2 * s * s - 4 * s + 2 * (s - 1)) / (s * s * s)
    return b


def beta(s) -> np.ndarray:
    """beta(s) on the host, for numbers or arrays, in float64."""
    s = np.asarray(s, np.float64)
    t, inside = s - CROSSOVER, np.clip(s, CROSSOVER, 1)
    return np.where(s < CROSSOVER, _VALUE + t * (_SLOPE + t * _CURVATURE / 2), -((inside - 1) ** 2) * np.log(inside))


def slope_at(s: float) -> float:
    """beta'(s) on the host, for s < 1."""
    if s < CROSSOVER:
        return _SLOPE + (s - CROSSOVER) * _CURVATURE
    return -(s - 1) * (2 * math.log(s) + (s - 1) / s)


def reference_curvature() -> float:
    """beta'' at a tenth of the width: the stiffness to expect of a firm contact, in units of the barrier's stiffness."""
    s = 0.1
    return -2 * math.log(s) - 4 * (s - 1) / s + ((s - 1) / s) ** 2
