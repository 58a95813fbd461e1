"""A sequence of surfaces in PLY files, for Blender, MeshLab and renderers."""

import numpy as np

from diffsim_ti.writers.surfaces import SurfacesWriter
from diffsim_ti.writers.writer import register


@register
class PlyWriter(SurfacesWriter):
    """Writes `name`_0000.ply, `name`_0001.ply, ... when it is closed: the surface of the body,
    then those of the obstacles, with a colour (red, green, blue) for each vertex, in metres, float64.

    Files that an earlier sequence of that name left in the folder are removed first.
    G. Turk, The PLY polygon file format, 1994.
    """

    suffixes = (".ply",)

    def close(self) -> None:
        import meshio

        for old in self.path.parent.glob(f"{self.path.stem}_[0-9][0-9][0-9][0-9]*.ply"):
            old.unlink()
        surfaces = list(self.surfaces()) if self._places else []
        first = np.cumsum([0, *(len(places[0]) for _, _, places, _ in surfaces)])
        cells = (
            [("triangle", np.concatenate([own + at for (_, own, _, _), at in zip(surfaces, first)]))]
            if surfaces
            else []
        )
        for k in range(self.count):
            points, colours = [], []
            for _, _, places, own in surfaces:
                points.append(places[min(k, len(places) - 1)])
                colours.append(np.broadcast_to(own[min(k, len(own) - 1)], points[-1].shape))
            shades = np.rint(255 * np.concatenate(colours)).astype(np.uint8)
            data = {name: shades[:, c] for c, name in enumerate(("red", "green", "blue"))}
            path = self.path.parent / f"{self.path.stem}_{k:04d}.ply"
            meshio.Mesh(np.concatenate(points), cells, point_data=data).write(path, binary=True)

    def describe(self) -> str:
        return f"{self.count} files {self.path.stem}_0000{self.path.suffix} ..."
