"""What frames span, so that one camera and one scale of colours serve them all."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Arrows, Mark
from diffsim_ti.visual.colouring import Colouring, field_named, to_vertices
from diffsim_ti.visual.glyphs import arrow_length, ends, longest


class Extent:
    """The box [m] of a body's surface and marks, and the limits of a field, over all frames that were added.

    How long arrows are is not known before the last frame: of those of a label the other end lies at p + q w, q >= 0 the
    same for all. Kept are those that no other leaves behind in a direction for any q, a handful whatever the frames.
    """

    def __init__(self, mesh: TetrahedralMesh, colour: str):
        self.mesh, self.field = mesh, field_named(colour)
        self.low, self.high, self.least, self.most = np.full(3, np.inf), np.full(3, -np.inf), np.inf, -np.inf
        self.scale: dict[str, float] = {}  # the largest vector of each label of arrows
        self._arrows: dict[str, np.ndarray] = {}  # of each label (p, w), shape (k, 6)

    def add(self, positions: np.ndarray, values: np.ndarray, marks: Sequence[Mark] = ()) -> None:
        """positions [m], shape (num_vertices, 3); values per vertex or per tetrahedron, their outermost 0.5 % left out."""
        surface = self.mesh.surface_vertices
        points, shown = positions[surface], to_vertices(self.mesh, values)[surface]
        self.least = min(self.least, float(np.percentile(shown, 0.5)))
        self.most = max(self.most, float(np.percentile(shown, 99.5)))
        self.scale = longest(marks, self.scale)
        known = [mark.points if isinstance(mark, Arrows) else ends(mark, {}, 0.0).reshape(-1, 3) for mark in marks]
        points = np.concatenate([points, *known])
        self.low, self.high = np.minimum(self.low, points.min(0)), np.maximum(self.high, points.max(0))
        for mark in marks:
            if isinstance(mark, Arrows):
                sign = np.where(np.asarray(mark.onto, bool), -1.0, 1.0)[:, None]
                both = np.concatenate([mark.points, sign * mark.vectors], 1)
                earlier = self._arrows.get(mark.label, np.zeros((0, 6)))
                self._arrows[mark.label] = _outermost(np.concatenate([earlier, both]))

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner [m], of marks too, shape (2, 3)."""
        length, others = arrow_length(self.mesh), []
        for label, arrows in self._arrows.items():
            others.append(arrows[:, :3] + length / max(self.scale[label], 1e-300) * arrows[:, 3:])
        points = np.concatenate([np.stack([self.low, self.high]), *others])
        return np.stack([points.min(0), points.max(0)])

    @property
    def colouring(self) -> Colouring:
        """Colours that suit the field, over its limits."""
        return Colouring(self.field.label, self.field.limits(self.least, self.most), self.field.colours)


def _outermost(arrows: np.ndarray) -> np.ndarray:
    """Of rows (p, w) those with the largest or least component of p + q w for some q >= 0."""
    kept = []
    for d in range(3):
        for sign in (1.0, -1.0):
            at, along = sign * arrows[:, d], sign * arrows[:, 3 + d]
            order = np.lexsort((along, at))[::-1]
            before = np.maximum.accumulate(np.concatenate([[-np.inf], along[order]]))[:-1]
            kept.append(_hull(order[along[order] > before], at, along))
    return arrows[np.unique(np.concatenate(kept))]


def _hull(rows: np.ndarray, at: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Of rows whose `at` falls while `along` grows, those of the convex upper chain."""
    chain: list[int] = []
    for r in rows:
        while len(chain) > 1:
            a, b = chain[-2:]
            if (at[b] - at[a]) * (along[r] - along[a]) > (at[r] - at[a]) * (along[b] - along[a]):
                break
            chain.pop()
        chain.append(r)
    return np.array(chain, np.int64)
