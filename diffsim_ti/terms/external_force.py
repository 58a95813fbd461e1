"""Given forces on vertices, constant or one set per step."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import present
from diffsim_ti.inputs import Input
from diffsim_ti.inputs.links import PerStep
from diffsim_ti.inputs.loads import InTime
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.marks import arrows
from diffsim_ti.terms.term import Term


class ExternalForce(Term):
    """Forces [N] on vertices: constant, shape (k, 3), or per step (controls), shape (steps, k, 3).

    vertices: which k vertices, as indices or the name of a vertex set; None means all. A single vector of 3 is laid
    on each of them. Per-step forces hold during one step dt; a run longer than the list is an error.
    Input with gradient: "external_forces", of the shape given, or "<name>.forces". Several in a scene add up.
    Raises ValueError for other shapes, unknown sets, and a run longer than the list.
    Belytschko, Liu, Moran, Nonlinear Finite Elements for Continua and Structures, 2000, sec. 4.4.
    """

    def __init__(self, forces: ArrayLike, vertices: SetOrIndices | None = None, name: str | None = None):
        present("forces", forces)
        shapes = (3,), ("k", 3), ("steps", "k", 3)
        super().__init__(Input("forces", forces, shapes, "N", plain="external_forces", label="forces"), name=name)
        self.vertices = vertices

    num_numbers = 0  # forces lie in an array of their own

    def links(self, names, own):
        return [PerStep(names["external_forces"], "forces", 3)]

    def force_links(self, names, own, consistent=False):
        """Beside other loads, which add up, by the name `own` forces."""
        return [InTime(names["external_forces"], f"{own} forces", 3, keyed=False)]

    def indices(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices that are acted upon, shape (k,)."""
        if self.vertices is None:
            return np.arange(mesh.num_vertices)
        return mesh.vertex_indices(self.vertices)

    def check(self, mesh) -> None:
        k, shape = len(self.indices(mesh)), self.values["external_forces"].shape
        if len(shape) > 1 and shape[-2] != k:
            raise ValueError(f"ExternalForce: expected forces for {k} vertices, shape (..., {k}, 3), got {shape}")

    def drawn(self, moment):
        vertices, forces = self.indices(moment.mesh), moment.values["external_forces"]
        return [arrows(f"{self.name or 'force'} [N]", moment.mesh, moment.positions, vertices, forces)]

    def settled(self, scene, density, initial_positions, initial_velocities) -> "ExternalForce":
        """With a force for each of the vertices acted upon."""
        k, forces = len(self.indices(scene.mesh)), self.values["external_forces"]
        rows = np.tile(forces, (k, 1)) if forces.ndim == 1 else forces
        return self.with_input("external_forces", value=rows, shapes=((k, 3), ("steps", k, 3)))
