"""Ten-node faces that bend in a run, where they are near obstacles or other surfaces.

Contact takes a face for the four triangles of its nodes, unless it was curved from the start: that is right to BOWED widths.
Where a face has bent farther, the run that finds it is done again with faces as curved as they are.
"""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.collision_surface import BOWED, cuts_of
from diffsim_ti.mesh.face_points import bow, bows, points_of_bow


class FacesBend(Exception):
    """Faces have bent by `off` [m] near what they touch, farther than a run takes them for; `bend` is what to take."""

    def __init__(self, off: float):
        super().__init__(f"faces of ten-node tetrahedra have bent by {off:.3g} m where they touch")
        self.bend = 2 * off


class Bending:
    """Checks the bending of the faces of a run."""

    def __init__(self, workspace):
        self.ws, a = weakref.proxy(workspace), workspace.arrays
        self.faces, known = a.mesh.surface_faces, 2 * max(bow(a.mesh), a.bend)
        self.limits = [BOWED * float(term.values["barrier_width"]) + known for term in a.contacts]
        self.of_pairs, pair = np.inf, a.self_contact
        if pair:
            cut = BOWED * float(pair.values["self_contact_width"]) * 4 ** cuts_of(a.mesh, pair, a.bend)
            self.of_pairs = max(known, cut)
        self.limit = min([self.of_pairs, *self.limits])

    @classmethod
    def of(cls, workspace) -> "Bending | None":
        """For a body of ten-node tetrahedra that may touch something."""
        a = workspace.arrays
        return cls(workspace) if a.mesh.order == 2 and (a.contacts or a.self_contact) else None

    def check(self, now: int, u: np.ndarray) -> None:
        """Raise FacesBend if displacements u before pass `now` ask for it."""
        a = self.ws.arrays
        nodes = (a.values.rest + u)[self.faces]
        off = bows(nodes)
        if not off.max(initial=0) > self.limit:  # nor where it is not finite
            return
        if self.ws.pairs and self.ws.pairs.list.count and off.max() > self.of_pairs:
            bend, width = FacesBend(float(off.max())), self.ws.pairs.width
            left = bend.bend / 2 / 4 ** cuts_of(a.mesh, a.self_contact, bend.bend)
            if left > width:
                warn(
                    f"{bend}, and lie up to {left:.3g} m from the triangles of SelfContact, more than its width {width:.3g} "
                    f"m: refine the mesh, or take a width of {left:.3g} m"
                )
            raise bend
        self.ws.place_obstacles(now)
        places = runtime.fetch(a.offsets).astype(np.float64)
        for k, (term, limit) in enumerate(zip(a.contacts, self.limits)):
            far = np.flatnonzero(off > limit)
            points = points_of_bow(nodes[far]).reshape(-1, 3)
            gaps = term.gap(points, a.poses.row_of(k, places)).reshape(len(far), -1).min(1)
            near = gaps < float(term.values["barrier_width"])
            if near.any():
                raise FacesBend(float(off[far][near].max()))
