"""Drag and lift of fluids on the surface, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti.mechanics.fluid.dragged_triangle import DraggedTriangle
from diffsim_ti.mechanics.fluid.on_host import Fluid
from diffsim_ti.mechanics.interaction import Interaction, add_at
from diffsim_ti.terms import SurfaceDrag


class FluidDrag(Interaction):
    """Each triangle in a fluid is an item. Its six numbers stand in the scene's parameters, from `first_number` on."""

    name, kinds, works, is_load = "dragged", (SurfaceDrag,), "drag", False
    no_equilibrium = "SurfaceDrag is of velocities, and an equilibrium has none"

    @cached_property
    def triangles(self) -> np.ndarray:
        return np.concatenate([term.triangles(self.mesh) for term in self.terms])

    @cached_property
    def first_number(self) -> np.ndarray:
        parameters = self.scene.inputs.parameters
        return np.concatenate([np.full(len(t.triangles(self.mesh)), parameters.first(t)) for t in self.terms])

    @property
    def vertices(self) -> np.ndarray:
        return self.triangles.ravel()

    @property
    def count(self) -> int:
        return len(self.triangles)

    @property
    def topology(self):
        return dict(dragged=self.vertices, dragged_numbers=self.first_number)

    def kernel(self, values, precision, shape):
        return DraggedTriangle(precision, shape)

    def host(self):
        return Fluid(self.triangles, self.first_number, self.mesh.num_vertices)

    def adjoints(self, values, shape):
        return dict(fluid_adjoint=(2 * self.count,), dragged_rest=(3 * self.count * shape,))

    def collect(self, found, out, shape):
        numbers = self.first_number[:, None] + np.arange(6)
        by_numbers = found["fluid_adjoint"]
        np.add.at(out.parameters, (..., numbers.ravel()), by_numbers.reshape(*by_numbers.shape[:-2], -1))
        if shape:
            add_at(out.rest, self.vertices, found["dragged_rest"])
