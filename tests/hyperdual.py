"""Exact first and second derivatives by hyper-dual numbers x + a e1 + b e2 + c e1 e2, an oracle of its own.

Fike, Alonso 2011, doi:10.2514/6.2011-886. Extended precision (numpy longdouble), element-wise over arrays.
"""

import numpy as np


class HyperDual:
    def __init__(self, x, a=0.0, b=0.0, c=0.0):
        self.parts = x, a, b, c

    def __add__(self, other):
        return HyperDual(*(s + o for s, o in zip(self.parts, lift(other).parts)))

    def __mul__(self, other):
        (x, a, b, c), (y, d, e, f) = self.parts, lift(other).parts
        return HyperDual(x * y, x * d + a * y, x * e + b * y, x * f + a * e + b * d + c * y)

    def apply(self, f, df, ddf):
        """A scalar function with its first two derivatives at x."""
        x, a, b, c = self.parts
        return HyperDual(f(x), df(x) * a, df(x) * b, df(x) * c + ddf(x) * a * b)

    def __neg__(self):
        return self * -1.0

    def __sub__(self, other):
        return self + (-lift(other))

    def __truediv__(self, other):
        return self * lift(other).apply(lambda x: 1 / x, lambda x: -1 / x**2, lambda x: 2 / x**3)

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other):
        return -self + other


def lift(x):
    return x if isinstance(x, HyperDual) else HyperDual(x)


def log(x):
    return x.apply(np.log, lambda x: 1 / x, lambda x: -1 / x**2)


def derivatives(energy, F, dF):
    """(psi, P, dP) of energy(F), a function of nine entries F[i][j]; F, dF of shape (n, 3, 3)."""
    F, dF = np.asarray(F, np.longdouble), np.asarray(dF, np.longdouble)
    unit = np.eye(9, dtype=np.longdouble).reshape(9, 3, 3)

    def entry(i, j):
        return HyperDual(F[:, None, i, j], unit[None, :, i, j], dF[:, None, i, j], 0.0)

    entries = [[entry(i, j) for j in range(3)] for i in range(3)]
    x, a, _, c = (np.broadcast_to(part, (len(F), 9)) for part in energy(entries).parts)
    return x[:, 0], a.reshape(-1, 3, 3), c.reshape(-1, 3, 3)
