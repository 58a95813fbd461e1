"""What formats of animated surfaces share: places of the body's surface and of the obstacles wait until the run is over."""

from collections.abc import Iterator

import numpy as np

from diffsim_ti.visual.colouring import Colouring, field_named, to_vertices
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers.writer import Writer

BODY, OBSTACLE = (0.33, 0.55, 0.80), (0.68, 0.68, 0.70)
Surface = tuple[str, np.ndarray, list[np.ndarray], list[np.ndarray]]


class SurfacesWriter(Writer):
    """Keeps of each frame its time, the places of surface vertices, and the field that `view.colour` names, where the format
    has colours of vertices."""

    coloured = True

    def open(self, setting: Setting) -> None:
        self.setting, self._times, self._places, self._values, self.count = setting, [], [], [], 0
        self.path.parent.mkdir(parents=True, exist_ok=True)

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
