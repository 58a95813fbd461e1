"""What classes of Taichi functions with a `precision` share: the types of their numbers and vectors, and products."""

import taichi as ti

from diffsim_ti.runtime.start import PRECISIONS

number_type = property(lambda self: PRECISIONS[self.precision], doc="Taichi's type of its numbers.")
vector_type = property(
    lambda self: ti.types.vector(4, PRECISIONS[self.precision]),
    doc="Taichi's type of its vectors: four components, the last zero.",
)


@ti.func
def cross(a, b):
    """a x b of such vectors."""
    return ti.Vector([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0], a[3]])
