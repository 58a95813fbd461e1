"""Moments of forces on vertices about a point, M = sum_i (x_i - p) x f_i, in each frame, with their derivatives."""

import numpy as np


def moments(x: np.ndarray, point: np.ndarray, f: np.ndarray) -> np.ndarray:
    """x, f: shape (frames, vertices, 3); the value has shape (frames, 3)."""
    return np.cross(x.astype(np.float64) - point, f).sum(1)


def moments_jvp(x, point, f, dx, df) -> np.ndarray:
    """Change of M for changes of x (None: zero) and f."""
    out = np.cross(x.astype(np.float64) - point, df).sum(1)
    return out if dx is None else out + np.cross(dx, f).sum(1)


def moments_vjp(x, point, f, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Adjoints of x and f: w . (x x f) = x . (f x w) = f . (w x x)."""
    w = seed[:, None]
    return np.cross(f, w), np.cross(w, x.astype(np.float64) - point)
