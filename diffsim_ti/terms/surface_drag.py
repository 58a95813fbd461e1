"""Drag and lift of a fluid on each triangle of the surface."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.rows import indices
from diffsim_ti.inputs import Input, Range
from diffsim_ti.inputs.description import at_least_0
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.term import Term, nonempty

AT_LEAST_0 = Range(">= 0", at_least_0)


class SurfaceDrag(Term):
    """Still water, or a steady stream: on each triangle of area A and normal n, whose corners have the mean velocity v
    against the stream, the force [N], a third of it at each corner,

        f = -rho A |v| (c_n v_n + c_t v_t) / 2,    v_n = (n . v) n,    v_t = v - v_n.

    Against v, at an angle phi to the surface, that is a drag coefficient c_n sin^2(phi) + c_t cos^2(phi); across it a lift
    coefficient (c_n - c_t) sin(phi) cos(phi). In still water f . v <= 0. Both sides of a body count: a plate of area A that
    moves broadside has c_n on its front and on its back.

    density [kg/m^3]: rho. normal, tangential [-]: c_n, c_t. stream [m/s]: velocity of the fluid far away, 3 numbers.
    surface: where it acts: a surface set's name, several, rows of `surface_triangles`; None: all. Of ten-node tetrahedra on
    the four triangles of each face.
    Explicit passes take velocities at their beginning, so that a vertex of mass m needs substeps well below 2 m / (rho c A
    |v|); implicit steps take those of the step, with the exact differential. Weight in water, added mass, and what parts of
    a body do to each other through it are not in it. Static solves refuse it.
    Inputs with gradient: "water_density", "normal_drag", "tangential_drag", "stream", or "<name>.density" ...
    Raises ValueError for other shapes and numbers below zero, and for unknown sets.
    Taylor 1952, Analysis of the swimming of long and narrow animals, doi:10.1098/rspa.1952.0159.
    """

    index = indices(density=1, normal=1, tangential=1, stream=3)  # of its numbers

    def __init__(
        self,
        density: float = 1000.0,
        normal: float = 1.0,
        tangential: float = 0.1,
        stream: ArrayLike = (0.0, 0.0, 0.0),
        surface: SetOrIndices | None = None,
        name: str | None = None,
    ):
        super().__init__(
            Input("density", density, ((),), "kg/m^3", AT_LEAST_0, plain="water_density", label="density"),
            Input("normal", normal, ((),), "-", AT_LEAST_0, plain="normal_drag", label="normal"),
            Input("tangential", tangential, ((),), "-", AT_LEAST_0, plain="tangential_drag", label="tangential"),
            Input("stream", stream, ((3,),), "m/s", plain="stream", label="stream"),
            name=name,
        )
        self.surface = surface

    def check(self, mesh: TetrahedralMesh) -> None:
        nonempty(self, self.triangles(mesh))

    def triangles(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Where it acts, as vertex indices, shape (k, 3)."""
        return mesh.surface_triangles[mesh.surface_indices(self.surface)]
