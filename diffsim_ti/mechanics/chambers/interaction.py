"""Gases in chambers, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti.mechanics.chambers.gas_force import GasForce
from diffsim_ti.mechanics.chambers.laws import law_of
from diffsim_ti.mechanics.interaction import Interaction, add_at
from diffsim_ti.terms import GasChamber


class Gases(Interaction):
    """Three corners for each triangle of a chamber's wall and lids."""

    name, kinds = "gases", (GasChamber,)

    @cached_property
    def triangles(self) -> np.ndarray:
        return np.concatenate([chamber.enclosure.triangles for chamber in self.terms])

    @cached_property
    def rows(self) -> list[slice]:
        """Of the numbers of each in `Derived.follower`."""
        ends = len(self.scene.pressures) + np.cumsum([0, *(law_of(t).count for t in self.scene.chambers)])
        return [slice(*map(int, ends[k : k + 2])) for k in map(self.scene.chambers.index, self.terms)]

    @property
    def vertices(self) -> np.ndarray:
        return self.triangles.ravel()

    def kernel(self, values, precision, shape):
        return GasForce(precision, len(values.follower) > 1)

    def adjoints(self, values, shape):
        return dict(
            chamber_felt=(len(values.follower), 4 * len(self.terms)), chamber_rest=(self.triangles.size * shape,)
        )

    def collect(self, found, out, shape):
        rows = np.concatenate([np.arange(r.start, r.stop) for r in self.rows])
        out.follower[..., rows, :] += found["chamber_felt"]
        if shape:
            add_at(out.rest, self.vertices, found["chamber_rest"])
