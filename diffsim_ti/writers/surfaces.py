"""What formats of animated surfaces share: places of the body's surface and of the obstacles wait until the run is
over; and PLY files."""

from collections.abc import Iterator

import numpy as np

from diffsim_ti.visual.colouring import Colouring, field_named, to_vertices
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers.writer import LastOrAll, Writer, register

BODY, OBSTACLE = (0.33, 0.55, 0.80), (0.68, 0.68, 0.70)
Surface = tuple[str, np.ndarray, list[np.ndarray], list[np.ndarray]]


class SurfacesWriter(Writer):
    """Keeps of each frame its time, the places of surface vertices, and the field that `view.colour` names, where the format
    has colours of vertices."""

    coloured = True

    def open(self, setting: Setting) -> None:
        super().open(setting)
        self._times, self._places, self._values = [], [], []

    def write(self, frame: Frame) -> None:
        standing, surface = [points for points, _ in self.setting.obstacles], self.setting.mesh.surface_vertices
        places = [frame.positions[surface], *(frame.obstacles or standing)]
        if self.coloured and self.view.colour is not None:
            values = frame.colour_values(self.view.colour)
            self._values.append(to_vertices(self.setting.mesh, values)[surface])
        self._times.append(frame.time)
        self._places.append([np.asarray(x, np.float64) for x in places])
        self.count += 1

    def surfaces(self) -> Iterator[Surface]:
        """Of the body and each obstacle (name, triangles, places [m] in each frame, or once where nothing moves, colours as
        RGB, one or one for each vertex, in each frame or once)."""
        mesh = self.setting.mesh
        triangles = [np.searchsorted(mesh.surface_vertices, mesh.surface_triangles)]
        triangles += [own for _, own in self.setting.obstacles]
        for k, own in enumerate(triangles):
            places = [frame[k] for frame in self._places]
            moves = any(np.any(x != places[0]) for x in places[1:])
            colours = [np.array([OBSTACLE if k else BODY])]
            if not k and self._values:
                colouring = Colouring.of(np.concatenate(self._values), field=field_named(self.view.colour))
                colours = [colouring(values) for values in self._values]
            yield f"obstacle {k}" if k else "body", own, places if moves else places[:1], colours


@register
class PlyWriter(LastOrAll, SurfacesWriter):
    """Writes the last frame when it is closed, or, for a name such as "run_%04d.ply", every frame, numbered from 0: the
    surface of the body, then those of the obstacles, with a colour (red, green, blue) for each vertex, in metres, float64.

    G. Turk, The PLY polygon file format, 1994.
    """

    suffixes = (".ply",)

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
            mesh.write(self.file_of(k), binary=True)
