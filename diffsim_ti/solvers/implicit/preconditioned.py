"""Which preconditioner a pass takes, and which of them are kept."""

import numpy as np

from diffsim_ti.inputs import Mass, diagonal_of
from diffsim_ti.solvers.implicit.multigrid import Multigrid
from diffsim_ti.solvers.implicit.preconditioners import BlockJacobi, BodyBlocks


class Preconditioned:
    """A part of ImplicitWorkspace."""

    def preconditioner(self, mass: Mass) -> tuple:
        """(preconditioner for c M + K with mass = c m, size of the diagonal of that at rest [N/m])."""
        mass = diagonal_of(mass)
        size_of, mass = mass, self._rounded(mass)
        key = float(mass.sum())
        if key not in self._preconditioners:
            with self.potential.at_rest():
                blocks, contact = self.potential.blocks(), self.potential.contact_blocks()
            size = np.abs(blocks if contact is None else blocks - contact).sum((1, 2))[:, None]
            kind = Multigrid if self._wants_multigrid(size, mass) else BodyBlocks if self.scene.reduced else BlockJacobi
            if len(self._preconditioners) > 5:
                self._preconditioners.pop(next(iter(self._preconditioners)))
            self._preconditioners[key] = kind(self.potential, mass, self.free, size, self.parallel), size
        kept, size = self._preconditioners[key]
        kept.begin()
        return kept, size + size_of

    def _rounded(self, inertia: np.ndarray) -> np.ndarray:
        """c m, of unequal steps for the nearest power of four of c, so that some preconditioners serve all steps."""
        if not (self.solver.schedule.varies and inertia.any()):
            return inertia
        c = float(inertia.sum() / diagonal_of(self.mass).sum())
        return inertia * (4.0 ** np.round(0.5 * np.log2(c)) / c)

    def _wants_multigrid(self, size: np.ndarray, mass: np.ndarray) -> bool:
        if self.scene.reduced:
            return False
        if self.solver.preconditioner != "auto":
            return self.solver.preconditioner == "multigrid"
        ratio = np.max(size[mass > 0] / mass[mass > 0], initial=0.0) if mass.any() else np.inf
        most = 1000 if self.scene.mesh.order == 1 else 200  # vertices up to which blocks alone take less time
        return len(size) > most and ratio > 1000
