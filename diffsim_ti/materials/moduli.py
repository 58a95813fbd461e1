"""Conversions between elastic moduli, of numbers, arrays or tensors.

Landau, Lifshitz, Theory of Elasticity, sections 4, 5, 22.
"""

import numpy as np


def lame(E, nu):
    """(mu, lam) [Pa] of Young's modulus E [Pa] and Poisson's ratio nu: E / (2 (1 + nu)), E nu / ((1 + nu)(1 - 2 nu))."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def youngs_poisson(mu, lam):
    """(E, nu) from Lame parameters: mu (3 lam + 2 mu) / (lam + mu), lam / (2 (lam + mu))."""
    return mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))


def bulk_modulus(mu, lam):
    """kappa = lam + 2 mu / 3 [Pa]."""
    return lam + 2 * mu / 3


def pressure_wave_speed(mu, lam, density):
    """c_p = sqrt((lam + 2 mu) / rho) [m/s]."""
    return np.sqrt((lam + 2 * mu) / density)
