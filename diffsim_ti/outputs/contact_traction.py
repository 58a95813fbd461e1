"""Traction of obstacles on the surface: contact force per area, vertex by vertex."""

from copy import copy
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.terms import Term

if TYPE_CHECKING:
    from diffsim_ti.rollout.frames import Frames
    from diffsim_ti.scene import Scene


class ContactTraction(Output):
    """Force per area [Pa] of an obstacle on each vertex, t_i = f_i / a_i, shape (frames, num_vertices, 3), zero within.

    f_i: what `ContactForce(obstacle, part, per_vertex=True)` gives, so the mean since the frame before; a_i: the area of the
    surface at rest that the vertex stands for (inputs/surface_areas.py), by which stiffness per area is dealt out too. At an
    edge a_i is what faces one way, so that the sum of a_i t_i is the force, and not an integral of t over all sides.
    obstacle, part ("total", "normal", "friction"), name: as there. The gradient is exact by all inputs.
    Raises ValueError as `ContactForce` does.
    Wriggers, Computational Contact Mechanics, 2nd ed., 2006, sec. 5, doi:10.1007/978-3-540-32609-0.
    """

    reads_contact_forces, unit = True, "Pa"

    def __init__(self, obstacle: Term | str, part: str = "total", name: str = "contact_traction"):
        self._given, self.name = ContactForce(obstacle, part, name, per_vertex=True), name

    def __repr__(self) -> str:
        return f"ContactTraction({self._given.obstacle!r}, {self._given.part!r}, name={self.name!r})"

    def settled(self, scene: "Scene") -> "ContactTraction":
        out = copy(self)
        out.scene, out.force, out.surface = scene, self._given.settled(scene), scene.mesh.surface_vertices
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return self.force.shape(num_frames)

    def _per_area(self, frames, f: np.ndarray) -> np.ndarray:
        out = np.zeros(f.shape)
        out[:, self.surface] = f[:, self.surface] / self._areas(frames).surface[self.surface, None]
        return out

    def _areas(self, frames):
        return self.scene.inputs.derive(frames.inputs)

    def value(self, frames: "Frames") -> np.ndarray:
        return self._per_area(frames, self.force.value(frames))

    def jvp(self, frames: "Frames", change: Change) -> np.ndarray:
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs).surface
        return self._per_area(frames, self.force.jvp(frames, change) - moved[:, None] * self.value(frames))

    def vjp(self, frames: "Frames", seed: np.ndarray) -> Change:
        by_force, adjoint = self._per_area(frames, seed), self._areas(frames).zeros()
        adjoint.surface = -(by_force * self.value(frames)).sum((0, 2))
        out = self.force.vjp(frames, by_force)
        out.add(Change(inputs=self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))))
        return out
