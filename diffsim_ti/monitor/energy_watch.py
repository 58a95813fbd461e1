"""Energy that comes from a step's being too long, counted where a method does not surely damp it."""

import weakref

import numpy as np

from diffsim_ti.common.copies import CarriesMore
from diffsim_ti.inputs import kinetic_energy
from diffsim_ti.mechanics.workspace import Workspace


class EnergyGained(CarriesMore, UserWarning):
    """Steps have added energy to the motion. Carries `gained` [J], `share` of the energy that moves, `step`, `time` [s] and
    the `substep` [s] that is advised."""

    def __init__(self, message: str, gained: float, share: float, step: int, time: float, substep: float):
        super().__init__(message)
        self.gained, self.share, self.step, self.time, self.substep = gained, share, step, time, substep


class EnergyWatch:
    """Sums what implicit midpoint and BDF2 steps add to the energy, against the largest energy that moved so far.

    Between u and u' = 2 u* - u the forces f(u*) = -dE/du do the work f(u*) . (u' - u), and kinetic energy changes by just
    that; the energy of strains and contacts changes by E(u') - E(u). The step has added

        E(u') - E(u) + f(u*) . (u' - u)

    which is of third order in u' - u, and none for a quadratic E. Loads, drag and prescribed motion do not enter it. Where
    obstacles go from w by w* to w', E(u) and E(u') are taken with them at w and w', and what they do on the body in the
    middle, dE/dw (w' - w), is none of the step's.
    BDF2 does not keep kinetic energy either, so that of free vertices is added, less the work m (v* - y) / gamma . (u' - u)
    of what accelerates them (solvers/implicit/solver.py). It gives back within a bounce a part of what it has just taken,
    and loses on the whole: only a net gain counts.
    Simo, Tarnow 1992, The discrete energy-momentum method, doi:10.1007/BF00913408.
    """

    def __init__(self, workspace: Workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self.clear()

    def clear(self) -> None:
        """Forget what was seen."""
        self.gained, self.moving = 0.0, 0.0  # [J]
        self.begin()

    def begin(self) -> None:
        """Follow the drift from the present state on."""
        self._begun = self.gained

    def take(self) -> float:
        """What steps have added [J] since the last call, or `begin`; below zero where they took some."""
        added = self.gained - self._begun
        self.begin()
        return added

    def note(
        self,
        u: np.ndarray,
        u_star: np.ndarray,
        u_next: np.ndarray,
        v_next: np.ndarray,
        places: tuple,
        kinetic: float = 0.0,
    ) -> None:
        """A step went from u by u_star to u_next, obstacles from places[0] by places[1] to places[2] (displacements [m],
        shape (num_obstacles, 3)); contacts are as in its pass. kinetic: what it has added to that energy [J]."""
        potential = self.ws.potential  # what viscosity and friction take is no gain, and none of a step's making
        with potential.without_viscosity(), potential.without_friction():
            self._note(u, u_star, u_next, v_next, places, kinetic)

    def _note(self, u, u_star, u_next, v_next, places, kinetic) -> None:
        potential, energies = self.ws.potential, []
        drift = self.ws.arrays.poses.drift(places[0], places[2])
        for displacement, place in ((u, places[0]), (u_next, places[2])):
            self.ws.collisions.put(place)
            potential.place(displacement)
            energies.append(potential.energy()[0])
        self.ws.collisions.put(places[1])
        potential.place(u_star)
        work = float((potential.forces()[0] * (u_next - u)).sum()) - self._work_of_obstacles(u_star, places[1], drift)
        self.gained += energies[1] - energies[0] + work + kinetic
        self.moving = max(self.moving, kinetic_energy(self.ws.mass, v_next) + energies[1])

    def _work_of_obstacles(self, u_star: np.ndarray, places: np.ndarray, drift: np.ndarray) -> float:
        """dE/dw (w' - w) [J], by differences over a hundredth of the smallest gap."""
        if not drift.any():
            return 0.0
        detection = self.ws.collisions.detection
        near = detection.nearest(u_star, places, detection.widest)
        gap = detection.narrowest if near is None else min(near.value, detection.narrowest)
        share, energies = min(0.5, 0.01 * gap / np.abs(drift).max()), []
        for sign in (1, -1):
            self.ws.collisions.put(self.ws.arrays.poses.moved(places, drift, sign * share))
            self.ws.potential.place(u_star)
            energies.append(self.ws.potential.energy()[0])
        self.ws.collisions.put(places)
        return (energies[0] - energies[1]) / (2 * share)

    @property
    def share(self) -> float:
        """Energy gained, over the largest that moved: kinetic, of strains and of contacts."""
        return self.gained / self.moving if self.moving > 0 else 0.0
