"""The names by which torch-diffsim's documents ask a mesh."""

import numpy as np

from diffsim_ti.common.answers import answered


@answered
class SeedNames:
    """A part of TetrahedralMesh: other names of what it has, for code that follows those documents."""

    @property
    def num_elements(self) -> int:
        """Another name of num_tetrahedra."""
        return self.num_tetrahedra

    @property
    def rest_volume(self):
        """volumes [m^3] as a torch tensor made on access, to multiply with `DifferentiableMaterial.energy_density(F)`."""
        import torch

        return torch.from_numpy(np.array(self.volumes))

    def compute_deformation_gradient(self, current_vertices):
        """F = sum_a x_a (x) grad N_a [-] of each tetrahedron at positions x [m], shape (num_vertices, 3); shape
        (num_tetrahedra, 3, 3).

        A NumPy array, or a torch tensor, whose graph goes on. Of a run `Strain` and `Stress` say more, also of ten-node
        tetrahedra, which are refused here (ValueError), as are other shapes.
        """
        if self.order > 1:
            raise ValueError(
                "compute_deformation_gradient: F varies within ten-node tetrahedra; take Strain(stretches=True)"
            )
        if tuple(np.shape(current_vertices)) != self.vertices.shape:
            given = tuple(np.shape(current_vertices))
            raise ValueError(f"current_vertices: expected shape {self.vertices.shape}, got {given}")
        x = current_vertices if hasattr(current_vertices, "new_tensor") else np.asarray(current_vertices, np.float64)
        by_X = x.new_tensor(np.array(self.shape_gradients)) if hasattr(x, "new_tensor") else self.shape_gradients
        return x[np.array(self.tetrahedra)].swapaxes(1, 2) @ by_X

    def _compute_rest_state(self) -> None:
        """Does nothing: the rest state is always ready."""
