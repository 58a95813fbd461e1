"""Which preconditioner a pass takes, and which of them are kept."""

import weakref

import numpy as np

from diffsim_ti.inputs import Mass, diagonal_of
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.solvers.implicit.multigrid import Following, Multigrid
from diffsim_ti.solvers.implicit.preconditioners import BlockJacobi, BodyBlocks


class Preconditioners:
    """Those of a workspace."""

    small, stiff = 30, 30  # vertices, and stiffness over inertia c m, up to which blocks alone take less time

    def __init__(self, workspace):
        self.ws, self._kept = weakref.proxy(workspace), {}  # which holds this: no circle
        self.following = Following()

    def __call__(self, mass: Mass) -> tuple:
        """(preconditioner for c M + K with mass = c m, size of the diagonal of that at rest [N/m])."""
        ws, size_of = self.ws, diagonal_of(mass)
        mass = self._rounded(size_of)
        key = float(mass.sum())
        if key not in self._kept:
            p = ws.potential
            with p.at_rest():
                blocks = p.blocks()
                if p.hosts or p.pairs or ws.arrays.contacts:  # of this pass, which others are not to depend on
                    K, diagonal = assemble(p, 0 * size_of, np.ones_like(size_of))
                    blocks = K.data[diagonal]
            size = np.abs(blocks).sum((1, 2))[:, None]
            kind, how = BodyBlocks if ws.scene.reduced else BlockJacobi, size
            if self._wants_multigrid(size, mass):
                kind, how = Multigrid, weakref.proxy(self)
            if len(self._kept) > 5:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = self.make(kind, how, mass), size
        kept, size = self._kept[key]
        kept.begin()
        return kept, size + size_of

    def make(self, kind: type, how, mass: np.ndarray):
        """A preconditioner of a kind; how: the sizes that one of blocks takes, or the run that a hierarchy follows."""
        return kind(self.ws.potential, mass, self.ws.free, how, self.ws.parallel)

    def _rounded(self, inertia: np.ndarray) -> np.ndarray:
        """c m, of unequal steps for the nearest power of four of c, so that some preconditioners serve all steps."""
        if not (self.ws.solver.schedule.varies and inertia.any()):
            return inertia
        c = float(inertia.sum() / diagonal_of(self.ws.mass).sum())
        return inertia * (4.0 ** np.round(0.5 * np.log2(c)) / c)

    def _wants_multigrid(self, size: np.ndarray, mass: np.ndarray) -> bool:
        if self.ws.scene.reduced and self.ws.free.elimination is None:
            return False
        if self.ws.solver.preconditioner != "auto":
            return self.ws.solver.preconditioner == "multigrid"
        ratio = np.max(size[mass > 0] / mass[mass > 0], initial=0.0) if mass.any() else np.inf
        return self.ws.arrays.vertices_of_one > self.small and ratio > self.stiff
