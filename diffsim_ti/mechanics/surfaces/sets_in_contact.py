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
from types import SimpleNamespace

import numpy as np

from diffsim_ti.common.rotations import skew
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
        weighed = self.own * m[:, None, None]
        K = np.tensordot(weighed, self.own, 2 * [(0, 1)]) + np.diag(1.0 * ~self.basis.any(0))
        N, inverse = self.own[here].reshape(-1, len(K)), np.linalg.inv(K)
        return Factors(np.concatenate([N, np.eye(len(K))]), inverse, self._sizes(N, inverse, len(here))[0])

    def _sizes(self, N: np.ndarray, inverse: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """(roots of the sums of the squares of W between two vertices, W by components)"""
        W = (N @ inverse @ N.T).reshape(count, -1, count, len(N) // count)
        square = (W * W).sum((1, 3))
        return np.sqrt(np.where(square.real > TINY**2, square, TINY**2)), W

    def factors_vjp(self, here: np.ndarray, x0, x1, m: np.ndarray, own: Factors, by: Factors) -> tuple:
        """Adjoints of places, of which both have the same, and of masses, for those of the factors."""
        N, count = own.N[: -len(own.inverse)], len(here)
        sizes, W = self._sizes(N, own.inverse, count)
        by_W = ((by.sizes / sizes)[:, None, :, None] * W).reshape(len(N), len(N))
        by_K = -own.inverse @ (by.inverse + N.T @ by_W @ N) @ own.inverse
        return 0.0, ((self.own @ by_K) * self.own).sum((1, 2))

    def settle(self, x0, x1, v, e: np.ndarray, b: np.ndarray, decay, m):
        """(how places change, velocities) where contact has done e, and b to velocities before they decay."""
        moved, pushed = (
            np.einsum("via,ab->vib", self.own, y.reshape(self.basis.shape[1], -1)).reshape(x1.shape) for y in (e, b)
        )
        return moved, v + decay * pushed

    def settle_vjp(self, x0, x1, v, e, b, decay, m, by_x, by_v) -> SimpleNamespace:
        """Adjoints for those of the places x' and of velocities."""
        by_e, by_b = (
            np.einsum("via,vib->ab", self.own, y.reshape(*self.own.shape[:2], -1)).reshape(e.shape)
            for y in (by_x, by_v)
        )
        return SimpleNamespace(x0=0.0, x1=by_x, v=by_v, e=by_e, b=decay * by_b, decay=(by_b * b).sum(), m=0.0)


class RigidInContact(SetInContact):
    """A set that does not deform: its numbers are (t, theta, twist)."""

    follows_places = twist = True
    count = 3

    def __init__(self, body: Together, at: np.ndarray):
        self.vertices, self.at = body.vertices, at

    def factors(self, here, x0, x1, m) -> Factors:
        r, J = self._arms(x0, x1, m)
        N = np.zeros((len(here), 3, 9), r.dtype)
        N[:, :, :3] = np.eye(3)
        N[:, :, 3:6] = -np.swapaxes(np.cross(r[here][:, None], np.eye(3)), 1, 2)
        inverse = np.eye(9, dtype=J.dtype)
        inverse[:3, :3] /= m.sum()
        inverse[3:6, 3:6] = A = np.linalg.inv(J)
        rho = self._turns(r[here], A)
        return Factors(
            np.concatenate([N.reshape(-1, 9), np.eye(9)]), inverse, 1 / m.sum() + np.multiply.outer(rho, rho)
        )

    @staticmethod
    def _arms(x0, x1, m):
        """(r, J)"""
        middle = 0.5 * (x0 + x1)
        r = middle - m @ middle / m.sum()
        return r, spread(r, m)

    @staticmethod
    def _turns(r, A):
        """Roots of the traces of what turns have of W at each vertex."""
        square = np.trace(A) * (r * r).sum(1) - np.einsum("vi,ij,vj->v", r, A, r)
        return np.sqrt(np.where(square.real > TINY**2, square, TINY**2))

    def factors_vjp(self, here, x0, x1, m, own, by):
        r, J = self._arms(x0, x1, m)
        A, M, near = own.inverse[3:6, 3:6], m.sum(), r[here]
        turning = by.N[:-9].reshape(-1, 3, 9)[:, :, 3:6]
        rho, both = self._turns(near, A), by.sizes + by.sizes.T
        share = 0.5 * (both @ rho) / rho
        by_A = by.inverse[3:6, 3:6] + 0.5 * spread(near, 2 * share)
        by_r, by_m = spread_vjp(r, m, -A @ by_A @ A)
        by_r[here] += -np.stack([axial(x) for x in turning]) + 2 * share[:, None] * (np.trace(A) * near - near @ A)
        by_c = -by_r.sum(0)
        by_M = -(np.trace(by.inverse[:3, :3]) + by.sizes.sum()) / M**2
        return 0.5 * (by_r + np.outer(m, by_c) / M), by_m + r @ by_c / M + by_M

    def settle(self, x0, x1, v, e, b, decay, m):
        at = self._settled(x0, x1, v, e, b, decay, m)
        return at.c1 + e[0] + at.z - x1, at.p1 / at.M + decay * b[0] + np.cross(at.omega, at.z)

    def _settled(self, x0, x1, v, e, b, decay, m):
        at, (t, theta, twist), (s, sigma) = SimpleNamespace(M=m.sum()), e, b[:2]
        at.r, at.J = self._arms(x0, x1, m)
        at.c1, at.p1 = m @ x1 / at.M, m @ v
        at.y, at.P = x1 - at.c1, at.M * s
        at.phi = 0.5 * theta
        at.S = skew(at.phi)
        at.k = 2 / (1 + at.phi @ at.phi)
        at.Q = np.eye(3) + at.k * (at.S + at.S @ at.S)
        at.z = at.y @ at.Q.T
        at.I = spread(at.z, m)
        at.d = 0.5 * (m @ (x0 - x1)) / at.M - t  # from where it is to where P acts
        at.given = at.J @ sigma + twist + np.cross(at.d, at.P)
        spin = (m[:, None] * np.cross(at.y, v)).sum(0) + decay * at.given - np.cross(t, at.p1)
        at.omega = np.linalg.solve(at.I, spin)
        return at

    def settle_vjp(self, x0, x1, v, e, b, decay, m, by_x, by_v):
        at, t, (s, sigma) = self._settled(x0, x1, v, e, b, decay, m), e[0], b[:2]
        whole = by_v.sum(0)
        mu = np.linalg.solve(at.I, np.cross(at.z, by_v).sum(0))
        by_z, by_m = spread_vjp(at.z, m, -np.outer(mu, at.omega))
        by_z = by_z + by_x + np.cross(by_v, at.omega)
        # the angular momentum
        by_P, by_d, p = decay * np.cross(mu, at.d), decay * np.cross(at.P, mu), whole / at.M - np.cross(mu, t)
        by_t = by_x.sum(0) - np.cross(at.p1, mu) - by_d
        by_M = -whole @ at.p1 / at.M**2 + s @ by_P
        by_r, of_J = spread_vjp(at.r, m, decay * np.outer(mu, sigma))
        by_decay = whole @ s + mu @ at.given
        # the turn
        by_Q = by_z.T @ at.y
        by_S = at.k * (by_Q + by_Q @ at.S.T + at.S.T @ by_Q)
        by_phi = axial(by_S) - at.k**2 * (by_Q * (at.S + at.S @ at.S)).sum() * at.phi
        # what is summed over vertices
        by_y = by_z @ at.Q + m[:, None] * np.cross(v, mu)
        by_c1 = by_x.sum(0) - by_y.sum(0)
        by_middle = by_r - np.outer(m, by_r.sum(0)) / at.M
        push = 0.5 * np.outer(m, by_d) / at.M
        by_m = by_m + of_J + np.cross(at.y, v) @ mu + v @ p + at.y @ by_c1 / at.M - at.r @ by_r.sum(0) / at.M
        by_m = by_m + (0.5 * (x0 - x1) - (at.d + t)) @ by_d / at.M + by_M
        return SimpleNamespace(
            x0=0.5 * by_middle + push,
            x1=0.5 * by_middle - push + by_y + np.outer(m, by_c1) / at.M,
            v=m[:, None] * (np.cross(mu, at.y) + p),
            e=np.stack([by_t, 0.5 * by_phi, decay * mu]),
            b=np.stack([decay * whole + at.M * by_P, decay * at.J @ mu, 0 * mu]),
            decay=by_decay,
            m=by_m,
        )


def spread(x: np.ndarray, m: np.ndarray) -> np.ndarray:
    """sum m (|x|^2 - x x^T)"""
    return (m * (x * x).sum(1)).sum() * np.eye(3) - x.T @ (m[:, None] * x)


def spread_vjp(x: np.ndarray, m: np.ndarray, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Adjoints of x and m."""
    trace = np.trace(by)
    by_m = trace * (x * x).sum(1) - np.einsum("ni,ij,nj->n", x, by, x)
    return m[:, None] * (2 * trace * x - x @ (by + by.T)), by_m
