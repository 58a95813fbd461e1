"""Ten-node faces that bend in a run, where they are near obstacles or other surfaces.

Contact takes a face for the four triangles of its nodes; pairs take smaller ones where it was curved from the start. That
is right to BOWED widths. Where a face that pairs look at has bent farther, the run that finds it is done again with
triangles as small as the bow asks for; where it is nearer to an obstacle that acts at nodes than these triangles by more
than FAR widths, a warning says so.
"""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.collision_surface import BOWED, cuts_of
from diffsim_ti.mesh.face_points import bow, bows, points_of_bow

FAR = 0.5


class FacesBend(Exception):
    """Faces have bent by `off` [m] near what they touch, farther than a run takes them for; `bend` is what to take."""

    def __init__(self, off: float):
        super().__init__(f"faces of ten-node tetrahedra have bent by {off:.3g} m")
        self.bend = 2 * off


class Bending:
    """Checks the bending of the faces of a run."""

    def __init__(self, workspace):
        self.ws, a = weakref.proxy(workspace), workspace.arrays
        self.faces, known = a.mesh.surface_faces, 2 * max(bow(a.mesh), a.bend)
        at_nodes = [k for k, term in enumerate(a.contacts) if not (term.primitives and term.primitives.whole)]
        self.limits = {k: FAR * float(a.contacts[k].values["barrier_width"]) + 2 * bow(a.mesh) for k in at_nodes}
        self.width, self.of_pairs = a.width_of_pairs, np.inf
        if np.isfinite(self.width):
            self.of_pairs = max(known, BOWED * self.width * 4 ** cuts_of(a.mesh, self.width, a.bend))
        self.limit = min([self.of_pairs, *self.limits.values()])

    @classmethod
    def of(cls, workspace) -> "Bending | None":
        """For a body of ten-node tetrahedra that may touch something."""
        a = workspace.arrays
        return cls(workspace) if a.mesh.order == 2 and (a.contacts or a.self_contact) else None

    def check(self, now: int, u: np.ndarray) -> None:
        """Raise FacesBend if displacements u before pass `now` ask for it, or warn, once."""
        a = self.ws.arrays
        nodes = (a.values.rest + u)[self.faces]
        off = bows(nodes)
        if not off.max(initial=0) > self.limit:  # nor where it is not finite
            return
        if self.ws.pairs and self.ws.pairs.list.count and off.max() > self.of_pairs:
            bend = FacesBend(float(off.max()))
            left = bend.bend / 2 / 4 ** cuts_of(a.mesh, self.width, bend.bend)
            if left > self.width:
                warn(
                    f"{bend} where they touch, and lie up to {left:.3g} m from the triangles of pairs, more than the width "
                    f"{self.width:.3g} m: refine the mesh, or take a width of {left:.3g} m"
                )
            raise bend
        self.ws.place_obstacles(now)
        places = runtime.fetch(a.offsets).astype(np.float64)
        for k, limit in list(self.limits.items()):
            term, row, far = a.contacts[k], a.poses.row_of(k, places), points_of_bow(nodes[off > limit])
            curved, flat = term.gap(far.reshape(-1, 3), row).reshape(far.shape[:-1])
            nearer = (flat - curved).max(1)
            if (nearer > limit)[curved.min(1) < float(term.values["barrier_width"])].any():
                del self.limits[k]
                most = float(nearer.max())
                warn(
                    f"{FacesBend(most)} towards {term!r}, which acts at their nodes alone: refine the mesh there, or take a "
                    f"width of {2.2 * most:.3g} m or more"
                )
