"""Poses of obstacles and supports over time: from rows of numbers to what kernels read, with derivatives both ways.

A row is a translation [m] and a rotation: 3 numbers (none), 6 (rotation vector [rad]), 7 (quaternion w, x, y, z of any
length). Within a step a pose goes from its row to the next at constant velocity and constant angular velocity,

    t + s (t' - t),    R(s phi) R,    0 <= s <= 1,    phi the rotation vector from R to R'.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.common.checked import shown
from diffsim_ti.differentiation.arrays import summed_at, value_of
from diffsim_ti.inputs.chain import Link, Recording

COLUMNS = 3  # of a pose: translation, R as modified Rodrigues parameters, phi
ONE_AXIS = 1e-2  # sine of the angle within which two rotation vectors have one axis
FULL_TURN = 2 * np.pi


def columns_of(width: int) -> int:
    """How many columns a path of 3, 6 or 7 numbers has."""
    return 1 if width == 3 else COLUMNS


def quaternions(rows: np.ndarray) -> np.ndarray:
    """Unit quaternions of rows of 6 or 7 numbers; ValueError for one of length zero."""
    if rows.shape[-1] == 6:
        return rotations.quaternion(rows[..., 3:])
    if not np.all(np.linalg.norm(rows[..., 3:], axis=-1) > 0):
        raise ValueError("a quaternion (w, x, y, z) must not be zero; the rotation by nothing is (1, 0, 0, 0)")
    return rotations.unit(rows[..., 3:])


def between(name: str, rows: np.ndarray) -> np.ndarray:
    """Rotation vectors from each row to the next, shape (rows - 1, 3).

    Quaternions take the short way. Rotation vectors on one axis keep their turns, and others take the short way of half a
    turn at most. Raises ValueError for rows that are farther apart.
    """
    q = quaternions(rows)
    out = rotations.vector(rotations.product(q[1:], rotations.conjugate(q[:-1])))
    if rows.shape[-1] == 7:
        return out
    a, b = rows[:-1, 3:], rows[1:, 3:]
    far, size = np.linalg.norm(b - a, axis=-1), np.linalg.norm(out, axis=-1)
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    alone = across <= ONE_AXIS * np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    wrong = np.flatnonzero((far > np.pi) & ~alone)
    if len(wrong):
        k = wrong[0]
        raise ValueError(
            f"{name}: rotation vectors {shown(a[k].tolist())} and {shown(b[k].tolist())}, rows {k} and {k + 1}, are more "
            "than half a turn apart and not on one axis; insert keyframes between them"
        )
    # out + 2 pi k n, n its direction, nearest to the difference
    n = np.where((size > 1e-9)[:, None], out, b - a)
    n = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-300)
    turns = np.where(far > np.pi, np.round((((b - a) * n).sum(-1) - size) / FULL_TURN), 0.0)
    return out + FULL_TURN * turns[:, None] * n


def theta_of(rows: np.ndarray) -> np.ndarray:
    """Zero, whose change is theta of the rotations for a change of the rows, which record."""
    given = value_of(rows)[:, 3:]
    change = rows[:, 3:] - given
    if rows.shape[1] == 6:
        return np.einsum("kij,kj->ki", rotations.left_jacobian(given), change)
    return 2 * rotations.product(change, rotations.conjugate(given))[:, 1:] / (given**2).sum(1, keepdims=True)


class PoseColumns(Recording, Link):
    """Paths of obstacles side by side, shape (steps + 1, columns, 3): a displacement is a column, a pose three.

    The change of R is theta with dR = [theta]x R, in place of that of its parameters. With R' = R(phi) R,

        J(phi) dphi = theta' - R(phi) theta;

    theta = J(r) dr of a rotation vector r, 2 vec(dq q^*) / |q|^2 of a quaternion.

    away: of each path, what its translations have less (origin.py) [m]; nothing by default.
    Raises ValueError for rows that are a full turn or more apart.
    """

    def __init__(self, reads: Iterable[str], writes: str, away: Iterable[np.ndarray] = ()):
        self.reads, self.writes, self.away = tuple(reads), (writes,), tuple(away)

    def value(self, *x):
        out = [self._columns(name, rows) for name, rows in zip(self.reads, x)]
        for k, away in enumerate(self.away):
            out[k] = np.concatenate([out[k][:, :1] - away, out[k][:, 1:]], 1)
        return (np.concatenate(out, 1),)

    @staticmethod
    def _columns(name: str, rows: np.ndarray) -> np.ndarray:
        if rows.shape[1] == 3:
            return rows[:, None]
        given, phi = value_of(rows), np.zeros((len(rows), 3))
        phi[:-1] = between(name, given)
        most = np.linalg.norm(phi, axis=1).max(initial=0.0)
        if most > FULL_TURN - 1e-3:
            raise ValueError(
                f"{name}: turns by {most:.4g} rad in one step, which must be less than a full turn; take shorter steps"
            )
        theta = theta_of(rows)
        change = theta[1:] - rotations.turned(rotations.quaternion(phi[:-1]), theta[:-1])
        dphi = np.einsum("kij,kj->ki", rotations.inverse_jacobian(phi[:-1]), change)
        phi = phi + np.concatenate([dphi, np.zeros((1, 3))])
        return np.stack([rows[:, :3], rotations.rodrigues(quaternions(given)) + theta, phi], 1)


@dataclass(frozen=True)
class PosedSupport:
    """Names of its inputs; its vertices, places of these among all that are held, shape (k,), and what their displacements
    are multiplied by, shape (k, 3, 3)."""

    pose: str
    about: str
    vertices: np.ndarray
    places: np.ndarray
    projectors: np.ndarray


class PosedMotion(Recording, Link):
    """Displacements of fixed vertices from their start x, shape (rows, k, 3): P (c + t + R (x - c) - x), and those that
    `prescribed_motion` adds."""

    writes = ("motion",)

    def __init__(self, posed_supports: Sequence[PosedSupport], num_held: int, more: bool):
        self.posed_supports, self.num_held = posed_supports, num_held
        names = [name for support in posed_supports for name in (support.pose, support.about)]
        self.reads = ("initial_positions", *names, *(["prescribed_motion"] if more else []))
        self.more = more

    def value(self, *x):
        out = x[-1] if self.more else np.zeros((len(x[1]), self.num_held, 3))
        for support, rows, about in zip(self.posed_supports, x[1::2], x[2::2]):
            arm = (x[0][support.vertices] - about)[None]
            moved = rows[:, None, :3] + _turned(rows, arm) - arm
            own = np.einsum("kij,rkj->kri", support.projectors, moved)
            out = out + np.moveaxis(summed_at(support.places, own, self.num_held), 0, 1)
        return (out,)


def _turned(rows: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """R arm by the rotation of each row, shape (rows, k, 3)."""
    out = rotations.turned(quaternions(value_of(rows))[:, None], arm)
    return out + np.cross(theta_of(rows)[:, None], value_of(out))
