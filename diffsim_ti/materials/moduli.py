"""Conversions between elastic moduli, in float64, with adjoints. Numbers or arrays, which may be complex.

Landau, Lifshitz, Theory of Elasticity, sections 4, 5, 22.
"""

import numpy as np


def lame(E, nu):
    """(mu, lam) [Pa] of Young's modulus E [Pa] and Poisson's ratio nu: E / (2 (1 + nu)), E nu / ((1 + nu)(1 - 2 nu))."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def lame_vjp(E, nu, mu_adj, lam_adj):
    """(E_adj, nu_adj) for adjoints of mu, lam."""
    a, b = 1 + nu, 1 - 2 * nu
    return (
        mu_adj / (2 * a) + nu * lam_adj / (a * b),
        -E * mu_adj / (2 * a**2) + E * (1 + 2 * nu**2) * lam_adj / (a * b) ** 2,
    )


def youngs_poisson(mu, lam):
    """(E, nu) from Lame parameters: mu (3 lam + 2 mu) / (lam + mu), lam / (2 (lam + mu))."""
    return mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))


def bulk_modulus(mu, lam):
    """kappa = lam + 2 mu / 3 [Pa]."""
    return lam + 2 * mu / 3


def pressure_wave_speed(mu, lam, density):
    """c_p = sqrt((lam + 2 mu) / rho) [m/s]."""
    return np.sqrt((lam + 2 * mu) / density)
