"""Links of muscles: from activations, stress and the rest shape to the tension of the fibre of each point."""

import numpy as np

from diffsim_ti.inputs.chain import Link


class MuscleTension(Link):
    """T = alpha s V / L0 [N] in time, shape (2, rows, points): alpha: activations in time as `InTime` has them, of all
    together or of each group; s: stress [Pa], a number or one for each group; V: volume of each of the points `chosen` among
    those of all tetrahedra; L0: length at rest of the segment there; group: that of each point."""

    def __init__(self, activation: str, stress: str, segments: str, chosen, group, writes: str):
        self.reads, self.writes = (activation, stress, segments, "volumes"), (writes,)
        self.chosen, self.group = chosen, group

    def _spread(self, of_groups):
        """To points, along the last axis."""
        return of_groups[..., self.group] if of_groups.shape[-1] > 1 else of_groups

    def _parts(self, activation, stress, segments, volumes):
        """(alpha, s, V, D, L0)"""
        alpha = self._spread(activation.reshape(*activation.shape[:2], -1))
        D = segments[0::2]
        return alpha, self._spread(stress.reshape(-1)), volumes.ravel()[self.chosen], D, np.linalg.norm(D, axis=1)

    def value(self, *x):
        alpha, s, V, _, length = self._parts(*x)
        return (alpha * (s * V / length),)

    def jvp(self, x, dx):
        alpha, s, V, D, length = self._parts(*x)
        dalpha, ds, dV, dD, _ = self._parts(*dx)
        dlength = (D * dD).sum(1) / length
        return (dalpha * (s * V / length) + alpha * (ds * V + s * dV - s * V * dlength / length) / length,)

    def vjp(self, x, y_adj):
        alpha, s, V, D, length = self._parts(*x)
        by = (y_adj[0] * alpha).sum((0, 1))
        segments, volumes = np.zeros_like(x[2]), np.zeros(x[3].size)
        segments[0::2] = (-by * s * V / length**3)[:, None] * D
        np.add.at(volumes, self.chosen, by * s / length)
        activation = self._gathered(y_adj[0] * (s * V / length), x[0])
        return activation, self._gathered(by * V / length, x[1]), segments, volumes.reshape(x[3].shape)

    def _gathered(self, by_points, given):
        """Adjoint of what was spread, from that of points."""
        lead = by_points.shape[:-1]
        groups = given.size // int(np.prod(lead, dtype=int))
        if groups == 1:
            return by_points.sum(-1).reshape(given.shape)
        out = np.zeros((groups, *lead))
        np.add.at(out, self.group, np.moveaxis(by_points, -1, 0))
        return np.moveaxis(out, 0, -1).reshape(given.shape)
