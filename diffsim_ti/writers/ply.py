"""Surfaces in PLY files, for Blender, MeshLab and renderers: one of the end, or a numbered sequence."""

from pathlib import Path

import numpy as np

from diffsim_ti.visual.frame import Frame
from diffsim_ti.writers.surfaces import SurfacesWriter
from diffsim_ti.writers.writer import View, file_of, numbered, register


@register
class PlyWriter(SurfacesWriter):
    """Writes the last frame when it is closed, or, for a name such as "run_%04d.ply", every frame, numbered from 0: the
    surface of the body, then those of the obstacles, with a colour (red, green, blue) for each vertex, in metres, float64.

    Raises ValueError for a name with a % that is no place for a number.
    G. Turk, The PLY polygon file format, 1994.
    """

    suffixes = (".ply",)

    def __init__(self, path: str | Path, view: View | None = None):
        super().__init__(path, view)
        self.numbered = numbered(self.path)

    def write(self, frame: Frame) -> None:
        if not self.numbered:  # only the last one waits
            self.open(self.setting)
        super().write(frame)

    def close(self) -> None:
        import meshio

        surfaces = list(self.surfaces()) if self._places else []
        first = np.cumsum([0, *(len(places[0]) for _, _, places, _ in surfaces)])
        triangles = [own + at for (_, own, _, _), at in zip(surfaces, first)]
        for k in range(self.count)[0 if self.numbered else -1 :]:
            points, colours = [], []
            for _, _, places, own in surfaces:
                points.append(places[min(k, len(places) - 1)])
                colours.append(np.broadcast_to(own[min(k, len(own) - 1)], points[-1].shape))
            shades = np.rint(255 * np.concatenate(colours)).astype(np.uint8)
            data = {name: shades[:, c] for c, name in enumerate(("red", "green", "blue"))}
            mesh = meshio.Mesh(np.concatenate(points), [("triangle", np.concatenate(triangles))], point_data=data)
            mesh.write(file_of(self.path, k) if self.numbered else self.path, binary=True)

    def describe(self) -> str:
        return super().describe() if self.numbered else str(self.path)
