"""Links of the start of sets that do not deform: the rigid motion that is nearest to what is given.

Of places x and rest positions X, y and D being these without their means: x' = mean x + R D with the rotation R that is
nearest to A = sum y D^T = R S (polar decomposition), which is that of the least squares (Kabsch 1976,
doi:10.1107/S0567739476001873). Of velocities v: v' = mean v + omega x R D, I omega = sum R D x v, likewise.
"""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.inputs.chain import Analytic, Link


def cross_matrix(a: np.ndarray) -> np.ndarray:
    """[a]x"""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def axial(M: np.ndarray) -> np.ndarray:
    """a of [a]x = M - M^T."""
    return np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])


def inertia(y: np.ndarray) -> np.ndarray:
    """sum |y|^2 - y y^T."""
    return (y * y).sum() * np.eye(3) - y.T @ y


@dataclass
class Nearest:
    """The rotation R nearest to sum y D^T, and its derivatives."""

    y: np.ndarray
    D: np.ndarray

    def __post_init__(self):
        U, s, Vt = np.linalg.svd(self.y.T @ self.D)
        s[-1] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0
        self.R = U @ np.diag([1, 1, np.sign(s[-1]) or 1.0]) @ Vt
        S = self.R.T @ (self.y.T @ self.D)
        # R changes by R [delta]x, where (tr S - S) delta is the axial vector of R^T dA
        self._lever = np.trace(S) * np.eye(3) - 0.5 * (S + S.T)

    def jvp(self, dy: np.ndarray, dD: np.ndarray) -> np.ndarray:
        dA = dy.T @ self.D + self.y.T @ dD
        return self.R @ cross_matrix(np.linalg.solve(self._lever, axial(self.R.T @ dA)))

    def vjp(self, R_adj: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints of y and D."""
        A_adj = self.R @ cross_matrix(np.linalg.solve(self._lever, axial(self.R.T @ R_adj)))
        return self.D @ A_adj.T, self.y @ A_adj


class Displacement(Link):
    """u = of(x - X), `of` being a symmetric projection onto what the scene can do; of `bodies`, as `Reduced.rigid` has them,
    that of the nearest rigid motion."""

    reads, writes = ("initial_positions", "rest"), ("displacement",)

    def __init__(self, of, bodies: tuple):
        self.of, self.bodies = of, bodies

    def value(self, x, X):
        out = np.array(self.of(x - X))
        for body in self.bodies:
            at = body.vertices
            D = body.apart(X)
            out[at] = x[at].mean(0) - X[at].mean(0) + D @ (Nearest(body.apart(x), D).R.T - np.eye(3))
        return (out,)

    def jvp(self, x, dx):
        out = np.array(self.of(dx[0] - dx[1]))
        for body in self.bodies:
            at, D, dD = body.vertices, body.apart(x[1]), body.apart(dx[1])
            near = Nearest(body.apart(x[0]), D)
            turned = dD @ (near.R.T - np.eye(3)) + D @ near.jvp(body.apart(dx[0]), dD).T
            out[at] = dx[0][at].mean(0) - dx[1][at].mean(0) + turned
        return (out,)

    def vjp(self, x, y_adj):
        (u_adj,) = y_adj
        x_adj = np.array(self.of(u_adj))
        X_adj = -x_adj
        for body in self.bodies:
            at, D, own, mean = body.vertices, body.apart(x[1]), u_adj[body.vertices], u_adj[body.vertices].mean(0)
            near = Nearest(body.apart(x[0]), D)
            by_y, by_D = near.vjp(own.T @ D)
            by_D = by_D + own @ (near.R - np.eye(3))
            x_adj[at], X_adj[at] = mean + by_y - by_y.mean(0), by_D - by_D.mean(0) - mean
        return x_adj, X_adj


class RigidVelocity(Analytic, Link):
    """v = free(v), and of sets that do not deform that of the nearest rigid motion."""

    reads, writes = ("initial_velocities", "displacement", "rest"), ("velocity",)

    def __init__(self, free, bodies: tuple):
        self.free, self.bodies = free, bodies

    def value(self, v, u, X):
        out = np.array(self.free(v))
        for body in self.bodies:
            y, _, omega = self._spin(body, v, u, X)
            out[body.vertices] = v[body.vertices].mean(0) + np.cross(omega, y)
        return (out,)

    @staticmethod
    def _spin(body, v, u, X):
        """(y, I, omega)"""
        y = body.apart(X + u)
        inertia_of = inertia(y)
        return y, inertia_of, np.linalg.solve(inertia_of, np.cross(y, v[body.vertices]).sum(0))

    def vjp(self, x, y_adj):
        (out_adj,) = y_adj
        v_adj, place_adj = np.array(self.free(out_adj)), np.zeros_like(out_adj)
        for body in self.bodies:
            at, own = body.vertices, out_adj[body.vertices]
            y, inertia_of, omega = self._spin(body, *x)
            mu = np.linalg.solve(inertia_of, np.cross(y, own).sum(0))
            v_adj[at] = own.mean(0) + np.cross(mu, y)
            by_y = np.cross(own, omega) + np.cross(x[0][at], mu)
            by_y += -2 * (mu @ omega) * y + np.outer(y @ omega, mu) + np.outer(y @ mu, omega)
            place_adj[at] = by_y - by_y.mean(0)
        return v_adj, place_adj, place_adj
