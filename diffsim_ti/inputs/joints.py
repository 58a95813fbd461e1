"""What drives of robots are told over time."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.inputs.loads import rows_of


class JointRows(Recording, Link):
    """Of targets and torques of each robot in turn, shape (2, rows, joints): target as each step begins, as it ends, torque;
    shape (rows, joints of all, 3)."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    def value(self, *x):
        rows, out = rows_of(x), []
        for targets, torques in zip(x[::2], x[1::2]):
            columns = (np.broadcast_to(part[:rows], (rows, part.shape[-1])) for part in (*targets, torques[0]))
            out.append(np.stack(list(columns), -1))
        return (np.concatenate(out, 1),)
