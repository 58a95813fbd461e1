"""What contact of surfaces does to sets that move by few numbers, in an explicit pass (contact_stage.py).

The vertices of a set change by N q for numbers q, so that impulses on them change their velocities by

    W = N K^-1 N^T,    K = N^T M N

in place of 1 / M. N is the basis of a set, of each component or of all three. A rigid set turns about where it is in the
middle of the pass: of places c + r there, with the centre of mass c, N = [1, -[r]x], and K has the mass and the inertia.
Where contact has moved it by (t, theta), and given it the impulse P and the angular impulse c x P + H, it has the places and
velocities

    x' = c1 + t + Q (x1 - c1),    v' = (p1 + P) / M + omega x (x' - c1 - t)

of x1, c1, p1, places, centre of mass and momentum without contact: rigid ones. Q is the rotation by 2 atan(|theta| / 2), and
omega that by which the set has the angular momentum that it had, and that impulse. So both momenta are kept to round-off.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.rotations import skew
from diffsim_ti.differentiation.arrays import Recorded, linear, reverse_of_all, value_of
from diffsim_ti.inputs.rigid_start import axial
from diffsim_ti.terms.reduced import Together

TINY = 1e-150


@dataclass
class Factors:
    """N and K^-1 of some vertices of a set, and behind them of its numbers, whose rows of N are those of 1; sizes: bounds of
    what W has between two of these vertices, (vertices, vertices). Or adjoints of all that."""

    N: np.ndarray
    inverse: np.ndarray
    sizes: np.ndarray

    @property
    def real(self) -> "Factors":
        return Factors(self.N.real, self.inverse.real, self.sizes.real)

    def zeros(self) -> "Factors":
        return Factors(*(np.zeros(x.shape) for x in (self.N, self.inverse, self.sizes)))

    def numbers(self, x: np.ndarray) -> np.ndarray:
        """N^T x"""
        return self.N.T @ x.reshape(len(self.N), -1)

    def lightened(self, x: np.ndarray) -> np.ndarray:
        """W x"""
        return (self.N @ (self.inverse @ self.numbers(x))).reshape(x.shape)

    def lightened_vjp(self, out: "Factors", a: np.ndarray, x: np.ndarray) -> None:
        """Add adjoints of a . W x."""
        by_a, by_x = self.numbers(a), self.numbers(x)
        out.inverse += by_a @ by_x.T
        a, x = a.reshape(len(self.N), -1), x.reshape(len(self.N), -1)
        out.N += a @ (self.inverse @ by_x).T + x @ (self.inverse @ by_a).T

    def of_components(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """N and K^-1 of all components of `count` nodes."""
        three = np.eye(3 if len(self.N) == count else 1)
        return np.kron(self.N, three), np.kron(self.inverse, three)

    def whitened(self) -> tuple[np.ndarray, np.ndarray]:
        """(R, N R) with W = N R R^T N^T."""
        root = np.linalg.cholesky(self.inverse)
        return root, self.N @ root


class SetInContact:
    """A set that moves by a basis; `at`: where its vertices stand among those of the stage.

    x0, x1: their places where a pass begins and where it would end; m: their masses. It has `count` vectors of numbers.
    """

    follows_places = False  # whether N is of where it is
    # whether its last vector is the sum of dx x f, dx from the places that N is of to where impulses f act
    twist = False

    def __init__(self, body: Together, at: np.ndarray):
        self.vertices, self.at, self.basis = body.vertices, at, body.basis
        if not body.per_component:
            self.basis = np.pad(body.basis, [(0, 0), (0, -body.basis.shape[1] % 3)])
        self.count = self.basis.shape[1] // (1 if body.per_component else 3)
        self.own = self.basis.reshape(len(at), -1, self.basis.shape[1])  # rows of each vertex

    def factors(self, here: np.ndarray, x0, x1, m: np.ndarray) -> Factors:
        """Of some of its vertices."""
        rows = self.own.reshape(-1, self.own.shape[2])
        K = (self.own * m[:, None, None]).reshape(rows.shape).T @ rows + np.diag(1.0 * ~self.basis.any(0))
        N, inverse = self.own[here].reshape(-1, len(K)), np.linalg.inv(K)
        W = (N @ inverse @ N.T).reshape(len(here), -1, len(here), len(N) // len(here))
        return Factors(np.concatenate([N, np.eye(len(K))]), inverse, root((W * W).sum((1, 3))))

    def factors_vjp(self, here: np.ndarray, x0, x1, m: np.ndarray, by: Factors) -> list:
        """Adjoints of both places and of masses for those of the factors."""
        own, leaves = recorded(lambda *at: self.factors(here, *at), x0, x1, m)
        return adjoints([(own.N, by.N), (own.inverse, by.inverse), (own.sizes, by.sizes)], leaves)

    def settle(self, x0, x1, v, e: np.ndarray, b: np.ndarray, decay, m):
        """(how places change, velocities) where contact has done e, and b to velocities before they decay."""
        moved, pushed = (
            np.einsum("via,ab->vib", self.own, y.reshape(self.basis.shape[1], -1)).reshape(x1.shape) for y in (e, b)
        )
        return moved, v + decay * pushed

    def settle_vjp(self, *given, by_x: np.ndarray, by_v: np.ndarray) -> list:
        """Adjoints of what `settle` is given for those of the places x' and of velocities."""
        ends, leaves = recorded(self.settle, *given)
        x0, x1, *others = adjoints(zip(ends, (by_x, by_v)), leaves)
        return [x0, x1 + by_x, *others]


def root(square):
    """The root, of what is zero a tiny number."""
    return np.sqrt(np.where(value_of(square).real > TINY**2, square, TINY**2))


def recorded(f: Callable, *x) -> tuple:
    """(f of x that record, these)"""
    leaves = [Recorded(np.asarray(own, np.float64)) for own in x]
    return f(*leaves), leaves


def adjoints(seeds, leaves: list[Recorded]) -> list:
    return [0.0 if by is None else by for by in reverse_of_all(seeds, leaves)]


class RigidInContact(SetInContact):
    """A set that does not deform: its numbers are (t, theta, twist)."""

    follows_places = twist = True
    count = 3

    def __init__(self, body: Together, at: np.ndarray):
        self.vertices, self.at = body.vertices, at

    def factors(self, here, x0, x1, m) -> Factors:
        r, J = self._arms(x0, x1, m)
        near, A, one, none = r[here], np.linalg.inv(J), np.eye(3), np.zeros((3, 3))
        turns = -np.swapaxes(np.cross(near[:, None], one), 1, 2)
        N = np.concatenate([np.broadcast_to(one, turns.shape), turns, np.zeros(turns.shape)], 2).reshape(-1, 9)
        rows = [one / m.sum(), none, none], [none, A, none], [none, none, one]
        inverse = np.concatenate([np.concatenate(row, 1) for row in rows])
        trace = (A * one).sum()
        rho = root(
            trace * (near * near).sum(1) - np.einsum("vi,ij,vj->v", near, A, near)
        )  # traces of what turns have of W
        return Factors(np.concatenate([N, np.eye(9)]), inverse, 1 / m.sum() + rho[:, None] * rho)

    @staticmethod
    def _arms(x0, x1, m):
        """(r, J)"""
        middle = 0.5 * (x0 + x1)
        r = middle - m @ middle / m.sum()
        return r, spread(r, m)

    def settle(self, x0, x1, v, e, b, decay, m):
        (t, _, twist), (s, sigma), M, phi = e, b[:2], m.sum(), 0.5 * e[1]
        _, J = self._arms(x0, x1, m)
        c1, p1 = m @ x1 / M, m @ v
        y, P, S = x1 - c1, M * s, linear(phi, skew, axial)
        Q = np.eye(3) + 2 / (1 + phi @ phi) * (S + S @ S)
        z = y @ Q.T
        d = 0.5 * (m @ (x0 - x1)) / M - t  # from where it is to where P acts
        given = J @ sigma + twist + np.cross(d, P)
        spin = (m[:, None] * np.cross(y, v)).sum(0) + decay * given - np.cross(t, p1)
        omega = np.linalg.solve(spread(z, m), spin)
        return c1 + t + z - x1, p1 / M + decay * s + np.cross(omega, z)


def spread(x: np.ndarray, m: np.ndarray) -> np.ndarray:
    """sum m (|x|^2 - x x^T)"""
    return (m * (x * x).sum(1)).sum() * np.eye(3) - x.T @ (m[:, None] * x)
