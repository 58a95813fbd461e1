"""Given forces on vertices, constant or one set per step."""

import numpy as np

from diffsim_ti.terms.term import Term


class ExternalForce(Term):
    """Forces [N] on vertices: constant, shape (k, 3), or per step (controls), shape (steps, k, 3).

    vertices: which k vertices, as indices or the name of a vertex set; None means all. A single vector of 3 is laid
    on each of them. Per-step forces hold during one step dt; a run longer than the list is an error.
    Input with gradient: "external_forces", of the shape given. One per scene.
    """

    def __init__(self, forces, vertices=None):
        super().__init__(external_forces=forces)
        self.vertices = vertices
        if self.values["external_forces"].ndim not in (1, 2, 3) or self.values["external_forces"].shape[-1] != 3:
            shape = self.values["external_forces"].shape
            raise ValueError(f"ExternalForce: forces must have shape (3,), (k, 3) or (steps, k, 3), got {shape}")

    def indices(self, mesh) -> np.ndarray:
        """Vertices that are acted upon, shape (k,)."""
        if self.vertices is None:
            return np.arange(mesh.num_vertices)
        return mesh.vertex_indices(self.vertices)

    def check(self, mesh) -> None:
        k, forces = len(self.indices(mesh)), self.values["external_forces"]
        if forces.ndim == 1:
            forces = np.tile(forces, (k, 1))
            forces.setflags(write=False)
            self.values["external_forces"] = forces
        if forces.shape[-2] != k:
            raise ValueError(
                f"ExternalForce: expected forces for {k} vertices, shape (..., {k}, 3), got {forces.shape}"
            )
