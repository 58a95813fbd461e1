"""Which points and edges of obstacles a run has: of an obstacle with many those that are near bodies, in explicit steps
near where bodies have been, so that what a step costs does not depend on others."""

from functools import reduce
from itertools import product

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.mechanics.surfaces.obstacle_corners import ObstacleCorners
from diffsim_ti.mesh.sets import pieces

CELL = 0.25  # of the longest side of all bodies
MOST_BOXES = 8  # one for each body, or where there are more bodies one for all


class NearCorners:
    """Those whose boxes, where the obstacle was made, meet boxes around bodies there, which are rounded up to whole cells:
    what there is in a step follows from where it begins, and changes seldom.

    many: obstacles of which it is so; body: a mesh, or its finer surface (mesh/collision_surface.py).
    """

    def __init__(self, arrays, body):
        self.a, self.all, surface = arrays, ObstacleCorners(arrays), body.surface_vertices
        self.many = [x for x in self.all.parts if x.primitives.many]
        self.matrix = getattr(body, "matrix", None)
        body_of = np.asarray(pieces(body))[surface]
        order = np.argsort(body_of, kind="stable")
        self.surface, self.begins = surface[order], np.flatnonzero(np.diff(body_of[order], prepend=-1))
        if len(self.begins) > MOST_BOXES:
            self.begins = self.begins[:1]
        self.cell = CELL * float(np.ptp(body.vertices[surface], axis=0).max())
        # of points and of edges lowest and highest places; boxes around bodies, and those that are asked for
        self.primitives, self.boxes, self.wanted = {}, {}, {}
        self.some = {x.k: (np.arange(1), np.arange(min(len(x.primitives.edges), 1))) for x in self.many}

    @property
    def corners(self) -> ObstacleCorners:
        """Of the points and edges that there are."""
        some = {x.k: x.primitives.of_some(*self.some[x.k]) for x in self.many}
        return ObstacleCorners(self.a, some) if some else self.all

    def load(self) -> None:
        """New values."""
        self.boxes, parameters = {}, self.a.values.parameters
        for x in self.many:
            p = x.primitives.at(parameters[x.shape])[0]
            points, ends = p[x.primitives.points], p[x.primitives.edges]
            self.primitives[x.k] = (points, points), (ends.min(1), ends.max(1))

    def has(self, places, poses: list, reach: float, anew: bool) -> bool:
        """Whether all that may be within reach [m] of bodies is there, at and between displacements of nodes, with obstacles
        in poses, (rows, number of the moment); anew: and nothing else. A state that is not finite is looked at elsewhere."""
        rest = self.a.values.rest - self.a.origin
        x = [(rest + u if self.matrix is None else self.matrix @ (rest + u))[self.surface] for u in places]
        low = np.minimum.reduceat(reduce(np.minimum, x), self.begins)
        high = np.maximum.reduceat(reduce(np.maximum, x), self.begins)
        reach = reach + 1e-5 * max(high.max(), -low.min())
        if not np.isfinite(reach):
            return True
        found = True
        for part in self.many:
            a, b = self._made(part, low - reach, high + reach, poses)
            have = self.boxes.get(part.k)
            if anew or have is None or (a < have[0]).any() or (b > have[1]).any():
                a, b = np.floor(a / self.cell) * self.cell, np.ceil(b / self.cell) * self.cell
                if have is not None and not anew:
                    a, b = np.minimum(a, have[0]), np.maximum(b, have[1])
                found = found and have is not None and np.array_equal(a, have[0]) and np.array_equal(b, have[1])
                self.wanted[part.k] = a, b
        return found

    def _made(self, part, low: np.ndarray, high: np.ndarray, poses: list) -> tuple[np.ndarray, np.ndarray]:
        """Boxes that hold boxes as an obstacle that is in poses, or between them, sees them where it was made."""
        shifts = np.array([rows[3 * part.k + m] for rows, m in poses])
        if self.all.row_of(part, 0) is None:
            return low - shifts.max(0), high - shifts.min(0)
        c = self.all.about(part, self.a.values.parameters)
        corners = np.stack([np.stack(x, -1) for x in product(*zip(low.T, high.T))])
        back = [rotations.conjugate(rotations.from_rodrigues(rows[self.all.row_of(part, m)])) for rows, m in poses]
        seen = np.stack([c + rotations.turned(q, corners - t - c) for q, t in zip(back, shifts)])
        wide = np.abs(seen - seen[0]).max()  # between poses, on arcs
        return seen.min((0, 1)) - wide, seen.max((0, 1)) + wide

    def take(self) -> bool:
        """Have what `has` found missing, and whether that is anything."""
        self.boxes, changed = dict(self.wanted), False
        for part in self.many:
            some = []
            for low, high in self.primitives[part.k]:
                meets = np.zeros(len(low), bool)
                for a, b in zip(*self.boxes[part.k]):
                    meets |= ((high >= a) & (low <= b)).all(1)
                some.append(np.flatnonzero(meets))
            if not any(map(len, some)):  # one that is far away stands for all
                some = [np.arange(1), np.arange(min(len(part.primitives.edges), 1))]
            changed = changed or not all(map(np.array_equal, some, self.some[part.k]))
            self.some[part.k] = tuple(some)
        return changed
