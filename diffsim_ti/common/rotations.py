"""Rotations on the host: rotation vectors [rad] and unit quaternions (w, x, y, z), rows of arrays of any leading shape.

A change of a rotation R is the vector theta with dR = [theta]x R. Diebel 2006, Representing Attitude; Sola, Deray, Atchuthan
2018, A micro Lie theory for state estimation in robotics, arXiv:1812.01537.
"""

import numpy as np


def _times(scalars: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return scalars[..., None] * vectors


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b of vectors of three numbers, with the bits of np.cross in half of its time."""
    return np.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], -1)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(cos(a / 2), sin(a / 2) n) of a rotation vector a n."""
    half = 0.5 * np.linalg.norm(rotation, axis=-1)
    return np.concatenate([np.cos(half)[..., None], _times(0.5 * np.sinc(half / np.pi), rotation)], -1)


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Of quaternions: the rotation q, then p."""
    a, b, x, y = p[..., 0], q[..., 0], p[..., 1:], q[..., 1:]
    return np.concatenate([(a * b - (x * y).sum(-1))[..., None], _times(a, y) + _times(b, x) + cross(x, y)], -1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """The rotation back."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def unit(q: np.ndarray) -> np.ndarray:
    """A quaternion of length one."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def vector(q: np.ndarray) -> np.ndarray:
    """The rotation vector of a unit quaternion, at most half a turn."""
    q = np.where(q[..., :1] < 0, -q, q)
    size = np.linalg.norm(q[..., 1:], axis=-1)
    half = np.arctan2(size, q[..., 0])
    return _times(np.where(size > 0, 2 * half / np.where(size > 0, size, 1.0), 2.0), q[..., 1:])


def rodrigues(q: np.ndarray) -> np.ndarray:
    """Modified Rodrigues parameters tan(a / 4) n of a unit quaternion, of length one at most."""
    q = np.where(q[..., :1] < 0, -q, q)
    return q[..., 1:] / (1 + q[..., :1])


def from_rodrigues(s: np.ndarray) -> np.ndarray:
    """The unit quaternion of modified Rodrigues parameters."""
    n = (s**2).sum(-1, keepdims=True)
    return np.concatenate([1 - n, 2 * s], -1) / (1 + n)


def turned(q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """R x"""
    across = 2 * cross(q[..., 1:], x)
    return x + q[..., :1] * across + cross(q[..., 1:], across)


def skew(a: np.ndarray) -> np.ndarray:
    """[a]x, shape (..., 3, 3)"""
    out = np.zeros((*a.shape, 3), a.dtype)
    out[..., [2, 0, 1], [1, 2, 0]], out[..., [1, 2, 0], [2, 0, 1]] = a, -a
    return out


def left_jacobian(a: np.ndarray) -> np.ndarray:
    """J(a): the change of the rotation of the vector a is J(a) da."""
    size, K = np.linalg.norm(a, axis=-1)[..., None, None], skew(a)
    small = size < 0.1
    safe = np.where(small, 1.0, size)
    s2 = size**2
    third = np.where(
        small, 1 / 6 - s2 / 120 + s2**2 / 5040 - s2**3 / 362880 + s2**4 / 39916800, (1 - np.sin(safe) / safe) / safe**2
    )
    return np.eye(3) + 0.5 * np.sinc(size / (2 * np.pi)) ** 2 * K + third * (K @ K)


def inverse_jacobian(a: np.ndarray) -> np.ndarray:
    """J(a)^-1, of less than a full turn."""
    size, K = np.linalg.norm(a, axis=-1)[..., None, None], skew(a)
    small, s2 = size < 0.1, size**2
    safe = np.where(small, 1.0, size)
    series = 1 / 12 + s2 / 720 + s2**2 / 30240 + s2**3 / 1209600
    return np.eye(3) - 0.5 * K + np.where(small, series, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2) * (K @ K)
