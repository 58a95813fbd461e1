"""Which points and edges of obstacles a run has: of an obstacle with many those that are near bodies, so that what a step
costs does not depend on others."""

from itertools import product

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.mechanics.surfaces.obstacle_corners import ObstacleCorners
from diffsim_ti.mesh.sets import pieces


class NearCorners:
    """Those whose boxes, where the obstacle was made, meet boxes around bodies there, which are rounded up to whole cells:
    what there is in a step follows from where it begins, and changes seldom.

    many: obstacles of which it is so; body: a mesh, or its finer surface (mesh/collision_surface.py).
    """

    cell = 0.25  # of the longest side of all bodies
    most_boxes = 8  # one for each body, or where there are more bodies one for all

    def __init__(self, arrays, body):
        self.a, self.all, surface = arrays, ObstacleCorners(arrays), body.surface_vertices
        self.many = [x for x in self.all.parts if x.primitives.many]
        self.matrix = getattr(body, "matrix", None)
        body_of = np.asarray(pieces(body))[surface]
        order = np.argsort(body_of, kind="stable")
        self.surface, self.begins = surface[order], np.flatnonzero(np.diff(body_of[order], prepend=-1))
        if len(self.begins) > self.most_boxes:
            self.begins = self.begins[:1]
        self.size = self.cell * float(np.ptp(body.vertices[surface], axis=0).max())
        self.boxes, self.cells, self.wanted = {}, {}, {}
        self.some = {x.k: (np.arange(1), np.arange(min(len(x.primitives.edges), 1))) for x in self.many}

    @property
    def corners(self) -> ObstacleCorners:
        """Of the points and edges that there are."""
        some = {x.k: x.primitives.of_some(*self.some[x.k]) for x in self.many}
        return ObstacleCorners(self.a, some) if some else self.all

    def load(self) -> None:
        """New values."""
        self.cells, parameters = {}, self.a.values.parameters
        for x in self.many:
            p = x.primitives.at(parameters[x.shape])[0]
            points, ends = p[x.primitives.points], p[x.primitives.edges]
            self.boxes[x.k] = (points, points), (ends.min(1), ends.max(1))

    def has(self, places, poses: list, reach: float, anew: bool) -> bool:
        """Whether all that may be within reach [m] of bodies is there, at and between displacements of nodes, with obstacles
        in poses, (rows, number of the moment); anew: and nothing else."""
        rest = self.a.values.rest - self.a.origin
        x = [rest + u if self.matrix is None else self.matrix @ (rest + u) for u in places]
        x = [y[self.surface] for y in x]
        reach = reach + 1e-5 * max(float(np.abs(y).max()) for y in x)
        low = np.min([np.minimum.reduceat(y, self.begins) for y in x], 0) - reach
        high = np.max([np.maximum.reduceat(y, self.begins) for y in x], 0) + reach
        corners = np.stack([np.where(side, high, low) for side in product((False, True), repeat=3)])
        for part in self.many:
            seen = np.stack([self._made(part, corners, *pose) for pose in poses])
            wide = np.abs(seen - seen[0]).max() if self.all._row(part, 0) is not None else 0.0  # between poses, on arcs
            low, high = (
                np.floor((seen.min((0, 1)) - wide) / self.size),
                np.ceil((seen.max((0, 1)) + wide) / self.size),
            )
            have = self.cells.get(part.k)
            if have is not None and not anew:
                low, high = np.minimum(low, have[0]), np.maximum(high, have[1])
            self.wanted[part.k] = low, high
        return all(np.array_equal(y, self.cells.get(k)) for k, y in self.wanted.items())

    def _made(self, part, x: np.ndarray, rows: np.ndarray, m: int) -> np.ndarray:
        """Places as an obstacle that is in a pose sees them where it was made."""
        x, row = x - rows[3 * part.k + m], self.all._row(part, m)
        if row is None:
            return x
        c = self.all._about(part, self.a.values.parameters)
        return c + rotations.turned(rotations.conjugate(rotations.from_rodrigues(rows[row])), x - c)

    def take(self) -> bool:
        """Have what `has` found missing, and whether that is anything."""
        changed, self.cells = False, dict(self.wanted)
        for part in self.many:
            boxes = np.stack(self.cells[part.k]) * self.size  # shape (2, boxes, 3)
            some = []
            for low, high in self.boxes[part.k]:
                meets = np.zeros(len(low), bool)
                for a, b in zip(*boxes):
                    meets |= ((high >= a) & (low <= b)).all(1)
                some.append(np.flatnonzero(meets))
            if not any(map(len, some)):  # one that is far away stands for all
                some = [np.arange(1), np.arange(min(len(part.primitives.edges), 1))]
            changed = changed or not all(map(np.array_equal, some, self.some[part.k]))
            self.some[part.k] = tuple(some)
        return changed
