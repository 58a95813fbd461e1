"""Traction of obstacles on the surface: contact force per area, vertex by vertex."""

from copy import copy
from typing import Literal

import numpy as np

from diffsim_ti.differentiation.arrays import ratio, summed_at
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.output import Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Term

# what each node of a face takes of its nodes' values, in stages: of three nodes the mean; of six the middles take over what
# corners have, and corners then the mean of the middles beside them
_LINEAR = (np.full((3, 3), 1 / 3),)
_TO_MIDDLES, _TO_CORNERS = np.diag([0.0, 0, 0, 1, 1, 1]), np.diag([0.0, 0, 0, 1, 1, 1])
_TO_MIDDLES[3:, :3] = 1 / 3
_TO_CORNERS[[0, 0, 1, 1, 2, 2], [3, 5, 3, 4, 4, 5]] = 0.5
_QUADRATIC = (_TO_MIDDLES, _TO_CORNERS)
_ASIDE, _FACING = 0.07, 0.25  # cos^2 at which a face begins to count, and counts in full: at 75 and at 60 degrees


class ContactTraction(Output):
    """Force per area [Pa] of an obstacle on each vertex, shape (frames, num_vertices, 3), zero away from the contact:

        r_i = f_i / sum over the faces around of B_f / 3,    t_i = mean over the faces around, by B_f, of r_f

    f_i: what `ContactForce(obstacle, part, per_vertex=True)` gives, so the mean since the frame before. B_f: a face's area
    at rest times cos^2 of the angle between its normal in the frame and the force on its vertices, so that at an edge of the
    body only the side that lies on the obstacle counts (a face at more than 75 degrees does not). r_f: the mean of r_i over
    the face's three vertices. Faces of ten-node elements share an even pressure among the middles of their edges alone:
    there t_i = r_i, with what the corners have handed on to them, and a corner has the mean of the middles beside it.

    So an even pressure comes out even at all vertices, whether the barrier is softer than the body or stiffer, and the
    integral of t over the faces is the force. At the rim of the contact t falls to zero within one face.
    obstacle, part ("total", "normal", "friction"), name: as there. The gradient is exact by all inputs.
    Raises ValueError as `ContactForce` does.
    Wriggers, Computational Contact Mechanics, 2nd ed., 2006, sec. 5, doi:10.1007/978-3-540-32609-0.
    """

    reads_contact_forces, unit = True, "Pa"

    def __init__(
        self,
        obstacle: Term | str,
        part: Literal["total", "normal", "friction"] = "total",
        name: str = "contact_traction",
    ):
        self._given, self.name = ContactForce(obstacle, part, name, per_vertex=True), name

    def __repr__(self) -> str:
        return f"ContactTraction({self._given.obstacle!r}, {self._given.part!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "ContactTraction":
        out, mesh = copy(self), scene.mesh
        out.force = self._given.settled(scene)
        out.push = ContactForce(self._given.obstacle, "normal", per_vertex=True).settled(scene)
        out.faces, out.triangles = mesh.surface_faces, mesh.surface_triangles
        out.stages = _QUADRATIC if mesh.order == 2 else _LINEAR
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return self.force.shape(num_frames)

    def value(self, frames: Frames) -> np.ndarray:
        X, f, push = frames.inputs["rest_positions"], self.force.value(frames), self.push.value(frames)
        x = frames.positions.astype(np.float64)
        return np.stack([self._spread(self._counting(X, *at), f[k]) for k, at in enumerate(zip(x, push))])

    def _counting(self, X: np.ndarray, x: np.ndarray, push: np.ndarray) -> np.ndarray:
        """B of each face."""
        S0, S = (triangle_normals(at, self.triangles).reshape(len(self.faces), -1, 3).sum(1) for at in (X, x))
        q = push[self.faces].sum(1)
        A, size = np.linalg.norm(S0, axis=1)[:, None], [(v**2).sum(1, keepdims=True) for v in (S, q)]
        S, q = (ratio(v, np.sqrt(s)) for v, s in zip((S, q), size))
        c = (S * q).sum(1, keepdims=True)
        w = np.clip((c**2 - _ASIDE) / (_FACING - _ASIDE), 0, 1)
        return (A * (c**2 * w**2 * (3 - 2 * w)))[:, 0]

    def _spread(self, B: np.ndarray, f: np.ndarray) -> np.ndarray:
        """f over the sum of B around each vertex, and what each stage makes of it."""
        D = summed_at(self.faces, np.repeat(B[:, None], self.faces.shape[1], 1), len(f))[:, None] / 3
        out = ratio(f, D)
        for K in self.stages:
            out = ratio(summed_at(self.faces, B[:, None, None] / 3 * (K @ out[self.faces]), len(f)), D)
        return out
