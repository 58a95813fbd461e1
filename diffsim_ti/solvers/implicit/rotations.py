"""How far each vertex of a body has turned."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime import ROWS, kernels_of
from diffsim_ti.solvers.implicit.frame_kernels import FrameKernels


class Frames:
    """Mean rotations of the vertices of a potential's body, weighted by volume, on the device: `turned`, by columns."""

    def __init__(self, potential, parallel: bool):
        points, n, self.potential = potential.stress_points, potential.arrays.num_vertices, potential
        self.count = len(points.volumes), points.nodes.shape[1], n
        at = points.nodes.ravel()
        order = np.argsort(at, kind="stable")
        around = np.bincount(at, minlength=n)
        share = 1 / (np.bincount(at, np.repeat(points.volumes, self.count[1]), n) + 1e-300)
        gradients = points.gradients * points.volumes[:, None, None]
        self.turned = runtime.array(ROWS[3], 3 * n)
        self.body = SimpleNamespace(
            nodes=runtime.upload(at, ti.i32),
            gradients=runtime.upload(gradients.reshape(-1, 3), ROWS[3]),
            strains=runtime.array(ROWS[3], 3 * len(points.volumes)),
            start=runtime.upload(np.concatenate([[0], np.cumsum(around)]), ti.i32),
            point=runtime.upload(order // self.count[1], ti.i32),
            share=runtime.upload(np.where(around > 0, share, 0), ti.f32),
            hard=runtime.array(ti.i32, n),
        )
        kernel = kernels_of(FrameKernels, potential.arrays.precision, parallel).frames
        self.part = (
            kernel,
            dict(at=potential, body=self.body, frames=self),
            dict(zip(("points", "nodes", "vertices"), self.count)),
        )
        self._launch = kernel.bind(**self.part[1])

    def update(self) -> None:
        """To the displacement at which the potential is placed."""
        self._launch(**self.part[2])
        hard = np.nonzero(runtime.fetch(self.body.hard))[0]
        if len(hard):
            R = self.matrices()
            R[hard] = rotations_of(self._means()[hard])
            self.put(R)

    def matrices(self) -> np.ndarray:
        """Shape (num_vertices, 3, 3)."""
        return np.swapaxes(runtime.fetch(self.turned).reshape(-1, 3, 3), 1, 2).astype(np.float64)

    def put(self, R: np.ndarray) -> None:
        """Set them."""
        runtime.fill(self.turned, np.swapaxes(R, 1, 2).reshape(-1, 3))

    def _means(self) -> np.ndarray:
        """Mean deformation gradients."""
        b = {name: runtime.fetch(getattr(self.body, name)) for name in ("strains", "point", "start", "share")}
        columns = b["strains"].reshape(-1, 9)[b["point"]]
        at = np.repeat(np.arange(self.count[2]), np.diff(b["start"]))
        sums = np.stack([np.bincount(at, columns[:, k], self.count[2]) for k in range(9)], 1) * b["share"][:, None]
        return np.swapaxes(sums.reshape(-1, 3, 3), 1, 2) + np.eye(3)


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
