"""Fixed vertices that a pose moves: a clamp that rotates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.inputs.chain import Link
from diffsim_ti.inputs.poses import quaternions, theta_of, theta_vjp


@dataclass(frozen=True)
class PosedSupport:
    """Names of its inputs; its vertices, places of these among all that are held, shape (k,), and what their displacements
    are multiplied by, shape (k, 3, 3)."""

    pose: str
    about: str
    vertices: np.ndarray
    places: np.ndarray
    projectors: np.ndarray


class PosedMotion(Link):
    """Displacements of fixed vertices from their start x, shape (rows, k, 3): P (c + t + R (x - c) - x), and those that
    `prescribed_motion` adds."""

    writes = ("motion",)

    def __init__(self, posed_supports: Sequence[PosedSupport], num_held: int, more: bool):
        self.posed_supports, self.num_held = posed_supports, num_held
        names = [name for support in posed_supports for name in (support.pose, support.about)]
        self.reads = ("initial_positions", *names, *(["prescribed_motion"] if more else []))
        self.more = more

    def _each(self, x):
        for k, support in enumerate(self.posed_supports):
            rows, about = x[1 + 2 * k], x[2 + 2 * k]
            yield support, rows, quaternions(rows)[:, None], (x[0][support.vertices] - about)[None]

    def value(self, *x):
        out = np.array(x[-1]) if self.more else np.zeros((len(x[1]), self.num_held, 3))
        for support, rows, q, arm in self._each(x):
            moved = rows[:, None, :3] + rotations.turned(q, arm) - arm
            np.add.at(out, (slice(None), support.places), np.einsum("kij,rkj->rki", support.projectors, moved))
        return (out,)

    def jvp(self, x, dx):
        out = np.array(dx[-1]) if self.more else np.zeros((len(x[1]), self.num_held, 3))
        changes = zip(self._each(x), dx[1::2], dx[2::2])
        for (support, rows, q, arm), drows, dabout in changes:
            darm, theta = (dx[0][support.vertices] - dabout)[None], theta_of(rows, drows)[:, None]
            moved = drows[:, None, :3] + np.cross(theta, rotations.turned(q, arm)) + rotations.turned(q, darm) - darm
            np.add.at(out, (slice(None), support.places), np.einsum("kij,rkj->rki", support.projectors, moved))
        return (out,)

    def vjp(self, x, y_adj):
        out = [np.zeros_like(part) for part in x]
        for k, (support, rows, q, arm) in enumerate(self._each(x)):
            by = np.einsum("kij,rki->rkj", support.projectors, y_adj[0][:, support.places])
            by_theta = np.cross(rotations.turned(q, arm), by).sum(1)
            by_arm = (rotations.turned(rotations.conjugate(q), by) - by).sum(0)
            out[0][support.vertices] += by_arm
            out[1 + 2 * k] = np.concatenate([by.sum(1), theta_vjp(rows, by_theta)], 1)
            out[2 + 2 * k] = -by_arm.sum(0)
        if self.more:
            out[-1] = y_adj[0]
        return out
