"""Weight and loads on the vertices of a body at the states that frames show, with derivatives, for outputs."""

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.potential.chamber_pressure import following
from diffsim_ti.terms import Gravity


class GivenLoads:
    """Forces [N], shape (num_vertices, 3): weight, dead loads and pressures after so many steps: those of the last of these
    as it ends; with `begins`, as it begins."""

    def __init__(self, scene, weight: bool = True):
        if scene.holds_volumes:
            raise ValueError(
                "the pressure of a FilledChamber is no function of a frame's state, so that reactions in its scene are not "
                "known: give it as a GasChamber or a Pressure of what ChamberPressure found"
            )
        self.scene, self.follower = scene, following(scene)
        gravity = scene.term(Gravity) if weight else None
        self.gravity = None if gravity is None else scene.inputs.parameters.of(gravity)
        self.loaded, self.keyed = scene.loaded_vertices if scene.dead_loads else None, scene.inputs.keyed_forces

    @staticmethod
    def _row(step: int, rows: np.ndarray) -> np.ndarray:
        return rows[min(max(step - 1, 0), len(rows) - 1)]

    def _dead(self, step: int, rows: np.ndarray, begins: bool) -> np.ndarray:
        """Of rows of loads, or of their adjoints, those that a frame shows (inputs/loads.py), as a view."""
        row = self._row(step, rows)
        return row[1 if step and not begins else 0 :: 2] if self.keyed else row

    def _pressures(self, step: int, rows: np.ndarray, begins: bool) -> np.ndarray:
        return self._row(step, rows)[:, 1 if step and not begins else 0]

    def forces(self, derived: Derived, x: np.ndarray, step: int, begins: bool = False) -> np.ndarray:
        """At places x [m] after so many steps."""
        out = np.zeros(x.shape)
        if self.gravity is not None:
            out += derived.mass[:, None] * derived.parameters[self.gravity][:3]
        if self.loaded is not None:
            out[self.loaded] += self._dead(step, derived.forces, begins)
        if self.follower is not None:
            out += self.follower.at(self._pressures(step, derived.follower, begins)).forces(x)
        return out

    def jvp(
        self, derived: Derived, moved: Derived, x: np.ndarray, dx: np.ndarray, step: int, begins: bool = False
    ) -> np.ndarray:
        """Their change."""
        out = np.zeros(x.shape)
        if self.gravity is not None:
            g, dg = (of.parameters[self.gravity][:3] for of in (derived, moved))
            out += moved.mass[:, None] * g + derived.mass[:, None] * dg
        if self.loaded is not None:
            out[self.loaded] += self._dead(step, moved.forces, begins)
        if self.follower is not None:
            pressures = self._pressures(step, derived.follower, begins)
            out += self.follower.at(pressures).jvp(x, dx, self._pressures(step, moved.follower, begins))
        return out

    def vjp(
        self, derived: Derived, x: np.ndarray, w: np.ndarray, step: int, adj: Derived, begins: bool = False
    ) -> np.ndarray:
        """Adjoint of x for that of the forces; adds those of all else to `adj`."""
        if self.gravity is not None:
            adj.mass += w @ derived.parameters[self.gravity][:3]
            adj.parameters[self.gravity.start : self.gravity.start + 3] += derived.mass @ w
        if self.loaded is not None:
            self._dead(step, adj.forces, begins)[:] += w[self.loaded]
        if self.follower is None:
            return np.zeros(x.shape)
        follower = self.follower.at(self._pressures(step, derived.follower, begins))
        self._pressures(step, adj.follower, begins)[:] += follower.pressures_vjp(x, w)
        return follower.vjp(x, w)
