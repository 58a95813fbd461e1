"""Links of the start of sets that do not deform: the rigid motion that is nearest to what is given.

Of places x and rest positions X, y and D being these without their means: x' = mean x + R D with the rotation R that is
nearest to A = sum y D^T = R S (polar decomposition), which is that of the least squares (Kabsch 1976,
doi:10.1107/S0567739476001873). Of velocities v: v' = mean v + omega x R D, I omega = sum R D x v, likewise.
"""

import numpy as np

from diffsim_ti.common.rotations import skew
from diffsim_ti.differentiation.arrays import linear, made, replaced, value_of
from diffsim_ti.inputs.chain import Link, Recording


def axial(M: np.ndarray) -> np.ndarray:
    """a of [a]x = M - M^T."""
    return np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])


def inertia(y: np.ndarray) -> np.ndarray:
    """sum |y|^2 - y y^T."""
    return (y * y).sum() * np.eye(3) - y.T @ y


def nearest_rotation(A: np.ndarray) -> np.ndarray:
    """The rotation R nearest to A = sum y D^T; of arrays that record, too."""
    given = value_of(A)
    U, s, Vt = np.linalg.svd(given)
    s[-1] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0
    R = U @ np.diag([1, 1, np.sign(s[-1]) or 1.0]) @ Vt
    S = R.T @ given
    lever = np.trace(S) * np.eye(3) - 0.5 * (S + S.T)

    def turn(change):
        """R changes by R [delta]x, where lever delta is the axial vector of R^T dA; its own transpose."""
        return R @ skew(np.linalg.solve(lever, axial(R.T @ change)))

    return made(R, (A, turn, turn))


class Displacement(Recording, Link):
    """u = of(x - X), `of` being a symmetric projection onto what the scene can do; of `bodies`, as `Reduced.rigid` has them,
    that of the nearest rigid motion."""

    reads, writes = ("initial_positions", "rest"), ("displacement",)

    def __init__(self, of, bodies: tuple):
        self.of, self.bodies = of, bodies

    def value(self, x, X):
        out = linear(x - X, self.of, self.of)
        for body in self.bodies:
            at, y, D = body.vertices, body.apart(x), body.apart(X)
            moved = x[at].mean(0) - X[at].mean(0) + D @ (nearest_rotation(y.T @ D).T - np.eye(3))
            out = replaced(out, at, moved)
        return (out,)

    def vjp(self, x, y_adj):
        if self.bodies:
            return super().vjp(x, y_adj)
        by_place = np.array(self.of(y_adj[0]))
        return by_place, -by_place


class RigidVelocity(Recording, Link):
    """v = free(v), free being a projection, and of sets that do not deform that of the nearest rigid motion."""

    reads, writes = ("initial_velocities", "displacement", "rest"), ("velocity",)

    def __init__(self, free, bodies: tuple):
        self.free, self.bodies = free, bodies

    def value(self, v, u, X):
        out = linear(v, self.free, self.free)
        for body in self.bodies:
            y, own = body.apart(X + u), v[body.vertices]
            omega = np.linalg.solve(inertia(y), np.cross(y, own).sum(0))
            out = replaced(out, body.vertices, own.mean(0) + np.cross(omega, y))
        return (out,)
