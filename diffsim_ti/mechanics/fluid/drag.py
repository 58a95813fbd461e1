"""Drag and lift of a triangle, written once for kernels and for the host.

With v the mean velocity of the corners against the stream, N = (x_1 - x_0) x (x_2 - x_0), L = |N|, s = v . N, a corner has

    G = -rho / 12 |v| B,    B = c L v + k (s / L) N,    c = c_t, k = c_n - c_t.

per_L: 1 / L, or 0 where L is.
"""


def pull(c, k, v, N, L, s, per_L):
    """B"""
    return c * L * v + k * s * per_L * N


def pull_jvp(c, k, v, N, L, s, per_L, dc, dk, dv, dN, dL, ds):
    """Its change."""
    dB = c * (dL * v + L * dv) + dc * L * v + dk * s * per_L * N
    return dB + k * per_L * ((ds - s * dL * per_L) * N + s * dN)


def pull_vjp(c, k, v, N, L, s, per_L, b, across, straight):
    """Adjoints (of v, of N) for the adjoint b of B; across: b . N, straight: b . v."""
    by_s = k * per_L * across
    by_L = c * straight - by_s * s * per_L
    return c * L * b + by_s * N, k * s * per_L * b + by_s * v + by_L * per_L * N
