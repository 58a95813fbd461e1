"""Poses over time, as paths of obstacles and motions of clamps have them: rows of 3, 6 or 7 numbers at some times."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common import rotations
from diffsim_ti.common.checked import numbers
from diffsim_ti.common.public import Public
from diffsim_ti.inputs.poses import between, quaternions
from diffsim_ti.terms.over_time import Motion, sampled


@dataclass(frozen=True, eq=False)
class Pose(metaclass=Public):
    """A motion of fixed vertices as of a rigid body, c + t + R (x - c): a clamp that rotates.

    path: a function of time [s], or keyframes (times, poses), of 6 numbers, a displacement t [m] and a rotation vector
    [rad], or of 7, t and a quaternion (w, x, y, z) of any length, as a path of an `Obstacle`. It is sampled at the steps,
    within which fixed vertices go straight: by turns of phi in a step at the radius r, r phi^2 / 8 within the arc.
    about [m]: the point c.
    Raises ValueError for a path of other numbers.
    """

    path: Motion
    about: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self):
        if path_width(self.path) not in ROWS:
            raise ValueError(
                "Pose: path must give 6 or 7 numbers at each time, a displacement [m] and a rotation vector [rad] or a "
                "quaternion; a displacement alone is a motion as it is"
            )

    @property
    def width(self) -> int:
        """Numbers of a pose: 6 with a rotation vector, 7 with a quaternion."""
        return path_width(self.path)

    def rows(self, name: str, times: ArrayLike) -> np.ndarray:
        """The path at each time [s], shape (len(times), width); name: how errors call it."""
        return sampled_path(name, self.path, times)


ROWS = 6, 7  # numbers of a pose: translation and rotation vector, or quaternion


def path_width(path: Motion) -> int:
    """How many numbers a path gives at a time: 3 of a displacement, 6 or 7 of a pose."""
    if callable(path):
        shape = np.shape(path(0.0))
    else:
        shape = np.shape(path[1]) if isinstance(path, tuple | list) and len(path) == 2 else ()
    return shape[-1] if len(shape) == (1 if callable(path) else 2) and shape[-1] in ROWS else 3


def sampled_path(name: str, path: Motion, times: ArrayLike) -> np.ndarray:
    """A path at each time [s], shape (len(times), 3, 6 or 7).

    Between keyframes translations are linear and angular velocities constant: quaternions take the short way, rotation
    vectors on one axis keep their turns. Raises ValueError for keyframes that do not fit.
    """
    width = path_width(path)
    if width == 3:
        return sampled(name, path, times, 1)[:, 0]
    if callable(path):
        rows = [np.asarray(path(float(t)), np.float64) for t in times]
        if any(row.shape != (width,) for row in rows):
            raise ValueError(f"{name}: must give {width} numbers at each time, as at the first")
        out = np.reshape(rows, (len(rows), width))
    else:
        at, keys = (numbers(name, part) for part in path)
        if at.shape != (len(keys),) or len(at) == 0 or np.any(np.diff(at) <= 0):
            raise ValueError(
                f"{name}: keyframes need one time for each row, and times that increase, got {at.tolist()}"
            )
        if not np.all(np.isfinite(keys)):
            raise ValueError(f"{name}: poses must be finite")
        out = _between_keys(name, at, keys, np.asarray(times, np.float64))
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{name}: poses must be finite")
    quaternions(out)
    return out


def _between_keys(name: str, at: np.ndarray, keys: np.ndarray, times: np.ndarray) -> np.ndarray:
    phi = np.concatenate([between(name, keys), np.zeros((1, 3))])
    k = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 1)
    after = np.minimum(k + 1, len(at) - 1)
    share = np.clip((times - at[k]) / np.where(after > k, at[after] - at[k], 1.0), 0, 1)[:, None]
    moved = keys[k, :3] + share * (keys[after, :3] - keys[k, :3])
    q = rotations.product(rotations.quaternion(share * phi[k]), quaternions(keys)[k])
    if keys.shape[1] == 7:
        return np.concatenate([moved, q], 1)
    # the rotation vector of q that is nearest to the mean of the keyframes'
    straight, own = keys[k, 3:] + share * (keys[after, 3:] - keys[k, 3:]), rotations.vector(q)
    size = np.linalg.norm(own, axis=1, keepdims=True)
    n = np.where(size > 1e-9, own, straight)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
    turns = np.round(((straight * n).sum(1, keepdims=True) - size) / (2 * np.pi))
    return np.concatenate([moved, own + 2 * np.pi * turns * n], 1)


def as_pose(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(translation [m], unit quaternion) of 3, 6 or 7 numbers."""
    row = np.asarray(row, np.float64)
    return row[:3], np.array([1.0, 0, 0, 0]) if len(row) == 3 else quaternions(row[None])[0]


def carried(points: np.ndarray, row: np.ndarray, about: ArrayLike) -> np.ndarray:
    """Where a pose takes points of an obstacle [m]: c + t + R (x - c)."""
    t, q = as_pose(row)
    return points + t if len(row) == 3 else about + t + rotations.turned(q, points - about)


def brought_back(points: np.ndarray, row: np.ndarray, about: ArrayLike) -> np.ndarray:
    """Where points [m] lie in an obstacle as it was made: the inverse of `carried`."""
    t, q = as_pose(row)
    return points - t if len(row) == 3 else about + rotations.turned(rotations.conjugate(q), points - t - about)
