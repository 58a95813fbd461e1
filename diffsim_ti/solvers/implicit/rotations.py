"""How far each vertex of a body has turned."""

import numpy as np


def vertex_rotations(potential, u: np.ndarray) -> np.ndarray | None:
    """Mean rotation at each vertex, shape (num_vertices, 3, 3), weighted by volume; None where all are small."""
    points, n = potential.stress_points, potential.arrays.num_vertices
    at, count = points.nodes.ravel(), points.nodes.shape[1]
    H = points.displacement_gradients(u)
    if np.abs(H).max(initial=0.0) < 0.02:
        return None
    H *= points.volumes[:, None, None]
    F = np.stack([np.bincount(at, np.repeat(H.reshape(-1, 9)[:, k], count), n) for k in range(9)], 1)
    F /= np.bincount(at, np.repeat(points.volumes, count), n)[:, None] + 1e-300
    return rotations_of(F.reshape(-1, 3, 3) + np.eye(3))


def rotations_of(F: np.ndarray) -> np.ndarray:
    """The rotation next to each F, shape (k, 3, 3): by Newton's iteration R <- (R + R^-T) / 2, which takes a fourth of the
    time of singular values; by those where F is nearly singular or mirrored.

    Higham 1986, Computing the Polar Decomposition, doi:10.1137/0907079.
    """
    x = np.ascontiguousarray(F.reshape(-1, 9).T)
    _, det = _cofactors(x)
    hard = ~(det > 0.05 * ((x**2).sum(0) / 3) ** 1.5)
    x[:, hard] = np.eye(3).reshape(9, 1)
    for _ in range(8):
        cofactors, det = _cofactors(x)
        x = 0.5 * (x + cofactors / det)
    R = x.T.reshape(-1, 3, 3).copy()
    if hard.any():
        U, _, V = np.linalg.svd(F[hard])
        U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
        R[hard] = U @ V
    return R


def _cofactors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cofactors and determinants of matrices whose numbers are rows of x, shape (9, k)."""
    a, b, c, d, e, f, g, h, i = x
    out = [e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g, b * g - a * h]
    out += [b * f - c * e, c * d - a * f, a * e - b * d]
    return np.stack(out), a * out[0] + b * out[1] + c * out[2]
