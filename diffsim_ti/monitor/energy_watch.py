"""Energy that comes from a step's being too long, counted where a method does not damp it."""

import weakref

import numpy as np

from diffsim_ti.state.workspace import Workspace


class EnergyWatch:
    """Sums what implicit midpoint steps add to the energy, against the largest energy that moved so far.

    Between u and u' = 2 u* - u the forces f(u*) = -dE/du do the work f(u*) . (u' - u), and kinetic energy changes by just
    that; the energy of strains and contacts changes by E(u') - E(u). The step has added

        E(u') - E(u) + f(u*) . (u' - u)

    which is of third order in u' - u, and none for a quadratic E. Loads, drag and prescribed motion do not enter it.
    Simo, Tarnow 1992, The discrete energy-momentum method, doi:10.1007/BF00913408.
    """

    def __init__(self, workspace: Workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self.clear()

    def clear(self) -> None:
        """Forget what was seen."""
        self.gained, self.moving = 0.0, 0.0  # [J]

    def note(self, u: np.ndarray, u_star: np.ndarray, u_next: np.ndarray, v_next: np.ndarray) -> None:
        """A step went from u by u_star to u_next; contacts are as in its pass."""
        potential, energies = self.ws.potential, []
        for place in (u, u_next):
            potential.place(place)
            energies.append(potential.energy()[0])
        potential.place(u_star)
        work = float((potential.forces()[0] * (u_next - u)).sum())
        self.gained += energies[1] - energies[0] + work
        kinetic = 0.5 * float((self.ws.mass * v_next**2).sum())
        self.moving = max(self.moving, kinetic + energies[1])

    @property
    def share(self) -> float:
        """Energy gained, over the largest that moved: kinetic, of strains and of contacts."""
        return self.gained / self.moving if self.moving > 0 else 0.0
