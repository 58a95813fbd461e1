"""Growth over time: a link from what terms give to what each tetrahedron has as each step begins and ends."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.inputs.loads import _Together


class GrowthRows(_Together):
    """Sum of all growths in time, shape (rows, 2, m): as each step begins and ends, of each tetrahedron, or m = 1 where all
    grow alike. Each part has shape (2, rows) or (2, rows, groups); chosen: its tetrahedra, None for all; group: which
    number each of these has."""

    def __init__(self, reads: Sequence[str], chosen: Sequence, group: Sequence, num_tetrahedra: int):
        super().__init__(reads, "growths")
        self.chosen, self.group = chosen, group
        self.count = 1 if all(own is None for own in chosen) else num_tetrahedra

    def value(self, *x):
        rows = self.rows(x)
        out = np.zeros((rows, 2, self.count))
        for part, chosen, group in zip(x, self.chosen, self.group):
            by_time = np.moveaxis(part[:, :rows], 0, 1)
            spread = by_time[..., None] if part.ndim == 2 else by_time[..., group]
            out[..., slice(None) if chosen is None else chosen] += spread
        return (out,)

    def vjp(self, x, y_adj):
        out = []
        for part, chosen, group in zip(x, self.chosen, self.group):
            own = np.moveaxis(y_adj[0][..., slice(None) if chosen is None else chosen], 1, 0)
            if part.ndim == 2:
                out.append(self._pulled(part, own.sum(-1)))
                continue
            by_group = np.zeros((part.shape[2], *own.shape[:2]))
            np.add.at(by_group, group, np.moveaxis(own, -1, 0))
            out.append(self._pulled(part, np.moveaxis(by_group, 0, -1)))
        return out
