"""What springs and cables pull with, written once for kernels, one by one and in lanes, and for the host.

T = a + k e, e = L - L0 + s (inputs/lines.py). If a segment d, of direction t, changes by x, its force changes by that of T
along t, and by T/|d| times what of x lies across t.
"""


def tension(a, k, e):
    """T [N]"""
    return a + k * e


def tension_jvp(k, e, da, dk, de):
    """Its change; e and k are those by which T depends on e: zero where what pulls only is slack."""
    return da + dk * e + k * de


def across(q, t, along, x):
    """q times what of x lies across t; along: t . x."""
    return q * (x - along * t)
