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

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation.arrays import Recorded, reverse_of_all, value_of
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
        weighed, count = self.own * m[:, None, None], len(here)
        K = np.einsum("via,vib->ab", weighed, self.own) + np.diag(1.0 * ~self.basis.any(0))
        N, inverse = self.own[here].reshape(-1, len(K)), np.linalg.inv(K)
        W = (N @ inverse @ N.T).reshape(count, -1, count, len(N) // count)
        return Factors(np.concatenate([N, np.eye(len(K))]), inverse, _root((W * W).sum((1, 3))))

    def factors_vjp(self, here: np.ndarray, places: tuple, by: Factors) -> list:
        """Adjoints of (x0, x1, m) for those of the factors."""
        leaves = [Recorded(x) for x in places]
        own = self.factors(here, *leaves)
        return _adjoints(leaves, (own.N, by.N), (own.inverse, by.inverse), (own.sizes, by.sizes))

    def settle(self, x0, x1, v, e: np.ndarray, b: np.ndarray, decay, m):
        """(how places change, velocities) where contact has done e, and b to velocities before they decay."""
        moved, pushed = (
            np.einsum("via,ab->vib", self.own, y.reshape(self.basis.shape[1], -1)).reshape(x1.shape) for y in (e, b)
        )
        return moved, v + decay * pushed

    def settle_vjp(self, numbers: tuple, by_x: np.ndarray, by_v: np.ndarray) -> list:
        """Adjoints of the arguments of `settle` for those of the places x' and of velocities."""
        leaves = [Recorded(x) for x in numbers]
        moved, v = self.settle(*leaves)
        return _adjoints(leaves, (leaves[1] + moved, by_x), (v, by_v))


class RigidInContact(SetInContact):
    """A set that does not deform: its numbers are (t, theta, twist)."""

    follows_places = twist = True
    count = 3

    def __init__(self, body: Together, at: np.ndarray):
        self.vertices, self.at = body.vertices, at

    def factors(self, here, x0, x1, m) -> Factors:
        r, J = self._arms(x0, x1, m)
        one, none, A = *(np.tile(x, (len(here), 1, 1)) for x in (np.eye(3), np.zeros((3, 3)))), np.linalg.inv(J)
        N = np.concatenate([one, -np.swapaxes(np.cross(r[here][:, None], np.eye(3)), 1, 2), none], 2)
        first, second, third = np.eye(9).reshape(3, 3, 9)
        inverse = first.T @ first / m.sum() + second.T @ A @ second + third.T @ third
        rho = self._turns(r[here], A)
        return Factors(np.concatenate([N.reshape(-1, 9), np.eye(9)]), inverse, 1 / m.sum() + rho[:, None] * rho)

    @staticmethod
    def _arms(x0, x1, m):
        """(r, J)"""
        middle = 0.5 * (x0 + x1)
        r = middle - m @ middle / m.sum()
        return r, spread(r, m)

    @staticmethod
    def _turns(r, A):
        """Roots of the traces of what turns have of W at each vertex."""
        return _root((A[0, 0] + A[1, 1] + A[2, 2]) * (r * r).sum(1) - np.einsum("vi,ij,vj->v", r, A, r))

    def settle(self, x0, x1, v, e, b, decay, m):
        (t, theta, twist), s, sigma = e, b[0], b[1]
        M, (_, J) = m.sum(), self._arms(x0, x1, m)
        c1, p1 = m @ x1 / M, m @ v
        y, P, phi = x1 - c1, M * s, 0.5 * theta
        turned = np.cross(phi, y)
        z = y + 2 / (1 + phi @ phi) * (turned + np.cross(phi, turned))
        d = 0.5 * (m @ (x0 - x1)) / M - t  # from where it is to where P acts
        given = J @ sigma + twist + np.cross(d, P)
        spin = (m[:, None] * np.cross(y, v)).sum(0) + decay * given - np.cross(t, p1)
        omega = np.linalg.solve(spread(z, m), spin)
        return c1 + t + z - x1, p1 / M + decay * s + np.cross(omega, z)


def spread(x: np.ndarray, m: np.ndarray) -> np.ndarray:
    """sum m (|x|^2 - x x^T)"""
    return (m * (x * x).sum(1)).sum() * np.eye(3) - x.T @ (m[:, None] * x)


def _root(square):
    """Roots, of what may be zero, too."""
    return np.sqrt(np.where(value_of(square).real > TINY**2, square, TINY**2))


def _adjoints(leaves: list[Recorded], *adjoints: tuple) -> list:
    """Of leaves for those of several arrays, (array, its adjoint) each."""
    return [np.zeros(x.shape) if by is None else by for x, by in zip(leaves, reverse_of_all(adjoints, leaves))]
