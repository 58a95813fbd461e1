"""How far a metal has flowed."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.tensors import _Tensors
from diffsim_ti.scene import Scene


class PlasticStrain(_Tensors):
    """Equivalent plastic strain [-], the integral of sqrt(2/3) |D_p| over time, as the law remembers it in each frame:
    after implicit and static steps that of the frame, after explicit ones that of the substep before.

    at: "tetrahedra", (frames, num_tetrahedra), the means over their points; "vertices", (frames, num_vertices); or material
    points X [m], shape (k, 3). of, name: as of `Stress`. In pictures colour="plastic_strain".
    The gradient is exact by all inputs. Raises ValueError for laws without plastic flow.
    Simo, Hughes, Computational Inelasticity, 1998, sec. 2.3.
    """

    reads_law_state = True

    def __init__(
        self, name: str = "plastic_strain", at: str | ArrayLike = "tetrahedra", of: SetOrIndices | None = None
    ):
        super().__init__(name, at, of)

    def settled(self, scene: Scene) -> "PlasticStrain":
        if not scene.law.plastic:
            raise ValueError(f"PlasticStrain: {scene.law.title} has no plastic flow; take J2Plasticity as the material")
        out = super().settled(scene)
        out.place = scene.law.state_names.index("plastic_strain")
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, self.count

    def _tensors(self, deformation, z, derived):
        return z[..., self.place][:, self.read].reshape(len(z), -1)

    def _tensors_jvp(self, deformation, dH, z, dz, derived, change):
        return self._tensors(deformation, dz, derived)

    def _tensors_vjp(self, deformation, z, derived, seed, adjoint):
        z_adj = np.zeros_like(z)
        for into, rows in zip(z_adj, seed.reshape(len(z), len(self.read), -1)):
            np.add.at(into[..., self.place], self.read, rows)
        return np.zeros_like(deformation.H), z_adj
