"""Weight, loads, springs, cables and foundations at the states that frames show, with derivatives, for outputs."""

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.pressures import following
from diffsim_ti.mechanics.ties.attached import Attached
from diffsim_ti.state.schedule import EqualSteps, Schedule
from diffsim_ti.terms import Gravity

STEPS = EqualSteps(1.0, 1)  # a pass for each step


def at_end(step: int, begins: bool = False) -> tuple[Schedule, int, float]:
    """(schedule, pass, share of its step) of a frame after so many steps."""
    return STEPS, max(step - 1, 0), float(step > 0 and not begins)


class GivenLoads:
    """Forces [N], shape (num_vertices, 3): weight, dead loads, pressures, chambers, springs, cables and foundations after so
    many steps: those of the last of these as it ends; with `begins`, as it begins.

    held: the pressures [Pa] of the scene's chambers in a frame, of which those are taken that hold a volume.
    """

    def __init__(self, scene, weight: bool = True):
        self.scene, self.follower, self.elements = scene, following(scene), scene.mesh.elements
        gravity = scene.term(Gravity) if weight else None
        self.gravity = None if gravity is None else scene.inputs.parameters.of(gravity)
        self.loaded, self.keyed = scene.loaded_vertices if scene.dead_loads else None, scene.inputs.keyed_forces
        self.attached = Attached.of(scene)

    @staticmethod
    def _row(step: int, rows: np.ndarray) -> np.ndarray:
        return rows[min(max(step - 1, 0), len(rows) - 1)]

    def _dead(self, step: int, rows: np.ndarray, begins: bool) -> np.ndarray:
        """Of rows of loads, or of their adjoints, those that a frame shows (inputs/loads.py), as a view."""
        row = self._row(step, rows)
        return row[1 if step and not begins else 0 :: 2] if self.keyed else row

    def _pressures(self, step: int, rows: np.ndarray, begins: bool) -> np.ndarray:
        return self._row(step, rows)[:, 1 if step and not begins else 0]

    def _attached(self, derived: Derived, step: int, begins: bool) -> Attached:
        return self.attached.at(derived, derived.ties, *at_end(step, begins))

    def _masses(self, derived: Derived) -> np.ndarray:
        """What gravity acts on, shape (num_vertices,), or its change."""
        if derived.element_masses is None:
            return derived.mass
        return np.bincount(self.elements.ravel(), derived.element_masses.sum(2).ravel(), len(derived.mass))

    def _following(self, derived: Derived, step: int, begins: bool, held):
        """Pressures and chambers of a frame."""
        follower = self.follower.at(self._pressures(step, derived.follower, begins))
        for k in follower.held if held is not None else ():
            follower.laws[k].multiplier = float(held[k])  # without a penalty, gamma: the pressure whatever the volume
        return follower

    def held_jvp(self, x: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Change of the forces for that of the pressures of held volumes."""
        return sum((change[k] * self.follower.unit_forces(x, k) for k in self.follower.held), np.zeros(x.shape))

    def held_vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of the pressures of all chambers, zero of gases, for that of the forces."""
        out = np.zeros(len(self.scene.chambers))
        for k in self.follower.held:
            out[k] = float((self.follower.unit_forces(x, k) * w).sum())
        return out

    def forces(self, derived: Derived, x: np.ndarray, step: int, begins: bool = False, held=None) -> np.ndarray:
        """At places x [m] after so many steps."""
        out = np.zeros(x.shape)
        if self.gravity is not None:
            out += self._masses(derived)[:, None] * derived.parameters[self.gravity][:3]
        if self.loaded is not None:
            out[self.loaded] += self._dead(step, derived.forces, begins)
        if self.follower is not None:
            out += self._following(derived, step, begins, held).forces(x)
        if self.attached:
            out += self._attached(derived, step, begins).forces(x - derived.rest)
        return out

    def jvp(
        self,
        derived: Derived,
        moved: Derived,
        x: np.ndarray,
        dx: np.ndarray,
        step: int,
        begins: bool = False,
        held=None,
    ) -> np.ndarray:
        """Their change, at held pressures."""
        out = np.zeros(x.shape)
        if self.gravity is not None:
            g, dg = (of.parameters[self.gravity][:3] for of in (derived, moved))
            out += self._masses(moved)[:, None] * g + self._masses(derived)[:, None] * dg
        if self.loaded is not None:
            out[self.loaded] += self._dead(step, moved.forces, begins)
        if self.follower is not None:
            follower = self._following(derived, step, begins, held)
            out += follower.jvp(x, dx, self._pressures(step, moved.follower, begins))
        if self.attached:
            attached, du = self._attached(derived, step, begins), dx - moved.rest
            out += attached.jvp(x - derived.rest, du, moved, *at_end(step, begins))
        return out

    def vjp(
        self, derived: Derived, x: np.ndarray, w: np.ndarray, step: int, adj: Derived, begins: bool = False, held=None
    ) -> np.ndarray:
        """Adjoint of x for that of the forces; adds those of all else, but for held pressures, to `adj`."""
        if self.gravity is not None:
            by_mass = w @ derived.parameters[self.gravity][:3]
            if derived.element_masses is None:
                adj.mass += by_mass
            else:
                adj.element_masses += by_mass[self.elements][:, :, None]
            adj.parameters[self.gravity.start : self.gravity.start + 3] += self._masses(derived) @ w
        if self.loaded is not None:
            self._dead(step, adj.forces, begins)[:] += w[self.loaded]
        out = np.zeros(x.shape)
        if self.attached:
            out += self._attached(derived, step, begins).vjp(x - derived.rest, w, adj, *at_end(step, begins))
            adj.rest -= out
        if self.follower is None:
            return out
        follower = self._following(derived, step, begins, held)
        self._pressures(step, adj.follower, begins)[:] += follower.pressures_vjp(x, w)
        return out + follower.vjp(x, w)
