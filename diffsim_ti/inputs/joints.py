"""What drives of robots are told over time."""

import numpy as np

from diffsim_ti.inputs.loads import _Together


class JointRows(_Together):
    """Of targets and torques of each robot in turn, shape (2, rows, joints): target as each step begins, as it ends, torque;
    shape (rows, joints of all, 3)."""

    def value(self, *x):
        rows, out = self.rows(x), []
        for targets, torques in zip(x[::2], x[1::2]):
            columns = (np.broadcast_to(part[:rows], (rows, part.shape[-1])) for part in (*targets, torques[0]))
            out.append(np.stack(list(columns), -1))
        return (np.concatenate(out, 1),)

    def vjp(self, x, y_adj):
        out, at = [], 0
        for targets, torques in zip(x[::2], x[1::2]):
            own = y_adj[0][:, at : at + targets.shape[2]]
            out.append(self._pulled(targets, np.moveaxis(own[..., :2], 2, 0)))
            out.append(self._pulled(torques, np.stack([own[..., 2], np.zeros(own.shape[:2])])))
            at += targets.shape[2]
        return out
