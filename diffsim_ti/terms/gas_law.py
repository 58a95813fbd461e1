"""The law of a gas in a chamber."""

import taichi as ti


def gas_law(p0, outside, V0, n, V):
    """p = p_0 (V_0 / V)^n - p_out and its derivatives by p_0, p_out, V_0, n and V, of plain numbers or in a kernel."""
    log = ti.log(V0 / V)
    grown = ti.exp(n * log)
    absolute = p0 * grown
    return absolute - outside, grown, -1, n * absolute / V0, absolute * log, -n * absolute / V
