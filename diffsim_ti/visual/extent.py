"""What frames span, so that one camera and one scale of colours serve them all."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Mark
from diffsim_ti.visual.colouring import Colouring, to_vertices
from diffsim_ti.visual.fields import field_named
from diffsim_ti.visual.glyphs import arrow_length, ends, longest


class Extent:
    """The box [m] of a body's surface, and the limits of a field on it, over all frames that were added."""

    def __init__(self, mesh: TetrahedralMesh, colour: str):
        self.mesh, self.field = mesh, field_named(colour)
        self.low, self.high, self.least, self.most = np.full(3, np.inf), np.full(3, -np.inf), np.inf, -np.inf
        self.scale: dict[str, float] = {}  # the largest vector of each label of arrows
        self._marks: list[Mark] = []

    def add(self, positions: np.ndarray, values: np.ndarray, marks: Sequence[Mark] = ()) -> None:
        """positions [m], shape (num_vertices, 3); values per vertex or per tetrahedron, their outermost 0.5 % left out."""
        surface = self.mesh.surface_vertices
        points, shown = positions[surface], to_vertices(self.mesh, values)[surface]
        self.low, self.high = np.minimum(self.low, points.min(0)), np.maximum(self.high, points.max(0))
        self.least = min(self.least, float(np.percentile(shown, 0.5)))
        self.most = max(self.most, float(np.percentile(shown, 99.5)))
        self.scale = longest(marks, self.scale)
        self._marks += marks

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner [m], of marks too, shape (2, 3)."""
        around = [ends(mark, self.scale, arrow_length(self.mesh)).reshape(-1, 3) for mark in self._marks]
        points = np.concatenate([np.stack([self.low, self.high]), *around])
        return np.stack([points.min(0), points.max(0)])

    @property
    def colouring(self) -> Colouring:
        """Colours that suit the field, over its limits."""
        return Colouring(self.field.label, self.field.limits(self.least, self.most), self.field.colours)
