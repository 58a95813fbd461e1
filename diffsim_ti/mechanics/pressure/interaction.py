"""Pressures that follow the surface, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.inputs.loads import PressureRows
from diffsim_ti.mechanics.interaction import Interaction, add_at
from diffsim_ti.mechanics.pressure.follower_pressure import FollowerPressure
from diffsim_ti.mechanics.pressure.pressed_face import pressed_element
from diffsim_ti.terms import Chamber, Pressure


class Pressing(Interaction):
    """What presses on the surface as it is: pressures and what fills chambers, whose numbers share rows."""

    # pressures, then numbers of chambers, as each step begins and ends, and 0: (1 or steps, loads and numbers, 3)
    derived = dict(follower="vectors2")

    def links(self, own):
        every = self.scene.terms_of(Pressure, Chamber)
        if self.terms[0] is not every[0]:  # another kind joins them all
            return []
        return [PressureRows([row for t in every for row in t.rows_in_time(own[t])], "follower")]


class Pressures(Pressing):
    """Each face that a pressure acts on is an item."""

    name, kinds, works = "pressed", (Pressure,), "loads"

    @cached_property
    def faces(self) -> np.ndarray:
        """Shape (k, 3) or (k, 6)."""
        return np.concatenate([term.faces(self.mesh) for term in self.terms])

    @cached_property
    def load_of(self) -> np.ndarray:
        """The term of each."""
        return np.repeat(np.arange(len(self.terms)), [len(term.faces(self.mesh)) for term in self.terms])

    @property
    def vertices(self) -> np.ndarray:
        return self.faces.ravel()

    @property
    def count(self) -> int:
        return len(self.faces)

    @property
    def topology(self):
        return dict(pressed=self.faces.ravel(), pressed_load=self.load_of)

    def kernel(self, values: Derived, precision: str, shape: bool):
        return pressed_element(self.mesh.order, precision, len(values.follower) > 1, shape)

    def host(self):
        return FollowerPressure(self.faces, self.load_of, self.mesh.num_vertices)

    def adjoints(self, values, shape):
        return dict(pressure_adjoint=(len(values.follower), self.count), pressed_rest=(self.faces.size * shape,))

    def collect(self, found, out, shape):
        add_at(out.follower, self.load_of, found["pressure_adjoint"])
        if shape:
            add_at(out.rest, self.vertices, found["pressed_rest"])
