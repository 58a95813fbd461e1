"""Eigenvectors of a symmetric 3x3 matrix by rotations, in lanes as one by one."""

import taichi as ti

from diffsim_ti.runtime import Bundle, assign, let, traced, variable


@traced
def eigenbasis(A: list, fp) -> list:
    """N, nine numbers by rows, whose columns are eigenvectors of the symmetric A, nine numbers too: N^T A N is diagonal.

    Cyclic Jacobi, with as many sweeps as rounding asks for: N is orthogonal, and N^T A N diagonal to round-off of A's
    size, whatever eigenvalues coincide. Golub, Van Loan, Matrix Computations, 4th ed., 8.5.
    """
    size = let(A[0] * 0 + ti.cast(1e-30, fp))
    for x in A:
        size = let(ti.max(size, ti.max(x, 0 - x)))
    scaled = [variable(x / size) for x in A]
    zero, one = let(size * 0), let(size * 0 + 1)
    n = [variable(one if k % 4 == 0 else zero) for k in range(9)]
    # off[k] is the entry in the two rows other than k
    turning = Bundle(diagonal=scaled[::4], off=[scaled[5], scaled[2], scaled[1]], n=n)
    _turn(turning, fp)
    return n


@ti.func
def _turn(m: ti.template(), fp: ti.template()):
    for _ in range(6 if fp == ti.f64 else 4):
        _sweep(m, fp)


@traced
def _sweep(m, fp) -> None:
    for r in range(3):
        _rotate(m, (r + 1) % 3, (r + 2) % 3, r, fp)


@traced
def _rotate(m, p: int, q: int, r: int, fp) -> None:
    """Make the entry (p, q) zero by a rotation in their plane."""
    d, o = let(m.diagonal[q] - m.diagonal[p]), let(m.off[r] * 2)
    root = let(ti.sqrt(d * d + o * o))
    bottom = let(ti.select(d < 0, d - root, d + root))
    t = let(o / ti.select(root > 0, bottom, root + 1))
    c = let(ti.cast(1, fp) / ti.sqrt(t * t + 1))
    s = let(t * c)
    moved = let(t * m.off[r])
    changes = [(m.diagonal[p], m.diagonal[p] - moved), (m.diagonal[q], m.diagonal[q] + moved), (m.off[r], 0 * moved)]
    for x, y in [(m.off[q], m.off[p]), *((m.n[3 * k + p], m.n[3 * k + q]) for k in range(3))]:
        changes += [(x, c * x - s * y), (y, s * x + c * y)]
    values = [let(value) for _, value in changes]
    for (number, _), value in zip(changes, values):
        assign(number, value)
