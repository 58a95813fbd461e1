"""Weight, loads, springs, cables and foundations at the states that frames show, with derivatives, for outputs."""

from dataclasses import replace

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.multipliers import HeldPressure
from diffsim_ti.mechanics.host_force import HostForces, Instant
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.state.schedule import EqualSteps
from diffsim_ti.terms import Chamber, Gravity

STEPS = EqualSteps(1.0, 1)  # a pass for each step


def at_end(step: int, begins: bool = False) -> Instant:
    """That of a frame after so many steps."""
    return Instant(STEPS, max(step - 1, 0), float(step > 0 and not begins))


class AppliedLoads:
    """Forces [N], shape (num_vertices, 3): weight, dead loads and those of interactions, after so many steps: those of the
    last of these as it ends; with `begins`, as it begins.

    moving: with those that read velocities v [m/s], which `forces`, `jvp` and `vjp` then are to be told.
    held: the pressures [Pa] of the scene's chambers in a frame, of which those are taken that hold a volume.
    """

    def __init__(self, scene, weight: bool = True, moving: bool = False):
        self.elements, self.num_chambers = scene.mesh.elements, len(scene.terms_of(Chamber))
        self.hosts = HostForces(force for force in host_forces(scene) if moving or not force.reads_velocities)
        self.filled = self.hosts.only(HeldPressure)
        gravity = scene.term(Gravity) if weight else None
        self.gravity = None if gravity is None else scene.inputs.parameters.of(gravity)
        self.dead = scene.interaction(DeadLoads)

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return bool(self.hosts) or self.gravity is not None or self.dead is not None

    @staticmethod
    def _row(step: int, rows: np.ndarray) -> np.ndarray:
        return rows[min(max(step - 1, 0), len(rows) - 1)]

    def _dead(self, step: int, rows: np.ndarray, begins: bool) -> np.ndarray:
        """Of rows of loads, or of their adjoints, those that a frame shows (inputs/loads.py), as a view."""
        row = self._row(step, rows)
        return row[1 if step and not begins else 0 :: 2] if self.dead.keyed else row

    def _masses(self, derived: Derived) -> np.ndarray:
        """What gravity acts on, shape (num_vertices,), or its change."""
        if derived.element_masses is None:
            return derived.mass
        return np.bincount(self.elements.ravel(), derived.element_masses.sum(2).ravel(), len(derived.mass))

    def _hosts(self, derived: Derived, x, step: int, begins: bool, held, v) -> HostForces:
        """As they are in a frame."""
        instant = at_end(step, begins)
        if v is not None:
            instant = replace(instant, origin=x - derived.rest - v, gamma=1.0)
        hosts = self.hosts.take(derived, instant)
        if self.filled and held is not None:
            for law, k in zip(self.filled.laws, self.filled.places):
                law.multiplier = float(held[k])  # without a penalty, gamma: the pressure whatever the volume
        return hosts

    def held_jvp(self, x: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Change of the forces for that of the pressures of constrained volumes."""
        return sum(change[k] * push for k, push in self._unit_forces(x))

    def held_vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of the pressures of all chambers, zero of gases, for that of the forces."""
        out = np.zeros(self.num_chambers)
        for k, push in self._unit_forces(x):
            out[k] = float((push * w).sum())
        return out

    def _unit_forces(self, x: np.ndarray) -> list:
        """(place of a chamber that holds a volume, forces of 1 Pa in it) of each."""
        places = self.filled.places if self.filled else []
        return [(place, self.filled.unit_forces(x - self.filled.rest, k)) for k, place in enumerate(places)]

    def forces(self, derived: Derived, x: np.ndarray, step: int, begins: bool = False, held=None, v=None) -> np.ndarray:
        """At places x [m] after so many steps."""
        out = np.zeros(x.shape)
        if self.gravity is not None:
            out += self._masses(derived)[:, None] * derived.parameters[self.gravity][:3]
        if self.dead:
            out[self.dead.acts_at] += self._dead(step, derived.forces, begins)
        return out + self._hosts(derived, x, step, begins, held, v).forces(x - derived.rest)

    def jvp(
        self,
        derived: Derived,
        moved: Derived,
        x: np.ndarray,
        dx: np.ndarray,
        step: int,
        begins: bool = False,
        held=None,
        v=None,
        dv=0.0,
    ) -> np.ndarray:
        """Their change, at frozen pressures."""
        out = np.zeros(x.shape)
        if self.gravity is not None:
            g, dg = (of.parameters[self.gravity][:3] for of in (derived, moved))
            out += self._masses(moved)[:, None] * g + self._masses(derived)[:, None] * dg
        if self.dead:
            out[self.dead.acts_at] += self._dead(step, moved.forces, begins)
        hosts = self._hosts(derived, x, step, begins, held, v)
        return out + hosts.jvp(x - derived.rest, dx - moved.rest, dv + np.zeros_like(dx), moved)

    def vjp(
        self,
        derived: Derived,
        x: np.ndarray,
        w: np.ndarray,
        step: int,
        adj: Derived,
        begins: bool = False,
        held=None,
        v=None,
    ) -> tuple:
        """Adjoints of x and v for that of the forces; adds those of all else, but for held pressures, to `adj`."""
        if self.gravity is not None:
            by_mass = w @ derived.parameters[self.gravity][:3]
            if derived.element_masses is None:
                adj.mass += by_mass
            else:
                adj.element_masses += by_mass[self.elements][:, :, None]
            adj.parameters[self.gravity.start : self.gravity.start + 3] += self._masses(derived) @ w
        if self.dead:
            self._dead(step, adj.forces, begins)[:] += w[self.dead.acts_at]
        by_u, by_v = self._hosts(derived, x, step, begins, held, v).vjp(x - derived.rest, w, adj)
        adj.rest -= by_u
        return by_u, by_v
