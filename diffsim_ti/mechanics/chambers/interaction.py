"""Gases and filled chambers, among a scene's interactions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim_ti.mechanics.chambers.multipliers import HeldPressure
from diffsim_ti.mechanics.chambers.pressures import ChamberPressure, rows_of
from diffsim_ti.mechanics.interaction import ItemForce, add_at
from diffsim_ti.mechanics.pressure.interaction import Pressing
from diffsim_ti.terms import FilledChamber, GasChamber
from diffsim_ti.terms.chambers import gas_law


@dataclass(frozen=True)
class GasForce(ItemForce):
    """Corners of chambers, whose forces are written by launches of their own before each pass (gases.py)."""

    per_step: bool
    name, apart, reads_rest, asks_for_steps = "gases", True, True, True


WORKS = "gases and filled chambers"


class Gases(Pressing):
    """Three corners for each triangle of a chamber's wall and lids."""

    name, kinds, works, apart = "gases", (GasChamber,), WORKS, True

    @cached_property
    def triangles(self) -> np.ndarray:
        return np.concatenate([chamber.enclosure.triangles for chamber in self.terms])

    @cached_property
    def rows(self) -> list[slice]:
        """Of the numbers of each in `Derived.follower`."""
        return rows_of(self.scene, self.terms)

    @property
    def vertices(self) -> np.ndarray:
        return self.triangles.ravel()

    def kernel(self, values, precision, shape):
        return GasForce(precision, len(values.follower) > 1)

    def host(self):
        return ChamberPressure(self.scene, self.terms)

    def adjoints(self, values, shape):
        return dict(
            chamber_adjoint=(len(values.follower), 4 * len(self.terms)), chamber_rest=(self.triangles.size * shape,)
        )

    def collect(self, found, out, shape):
        rows = np.concatenate([np.arange(r.start, r.stop) for r in self.rows])
        out.follower[..., rows, :] += found["chamber_adjoint"]
        if shape:
            add_at(out.rest, self.vertices, found["chamber_rest"])

    def added_omega2(self, values, derived):
        """At rest: -dp/dV sum |dV/dx|^2 / m of the free vertices, of each chamber."""
        free, out = np.delete(np.arange(self.mesh.num_vertices), self.scene.fixed), 0.0
        for chamber in self.terms:
            names = self.scene.input_names(chamber)
            p = np.max(values[names[chamber.plain]])
            V, g = chamber.enclosure.volume(derived.rest), chamber.enclosure.gradient(derived.rest)
            slope = gas_law(p, 0.0, V, values[names["gas_exponent"]], V)[-1]
            out -= float(slope * ((g[free] ** 2).sum(1) / derived.mass[free]).sum())
        return out


class FilledChambers(Pressing):
    """Implicit steps find their pressures as multipliers (multipliers.py); explicit steps have a stage
    (volume_constraints.py)."""

    name, kinds, works, apart, in_kernels = "filled", (FilledChamber,), WORKS, True, False

    def host(self):
        return HeldPressure(self.scene, self.terms)
