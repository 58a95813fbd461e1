"""NumPy arrays of a whole run in one .npz."""

import numpy as np

from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers.writer import Writer, register


@register
class ArraysWriter(Writer):
    """Writes the frames' arrays when it is closed; until then they are kept in memory. n frames:

    time [s], shape (n,); positions, displacements [m], velocities [m/s], shape (n, num_vertices, 3); the fields (von_mises,
    energy_density, J ...), shape (n, num_tetrahedra), of ten nodes von_mises (n, num_vertices); rest_positions [m],
    tetrahedra, all vertices of each, fixed.
    Obstacles are left out.
    """

    suffixes = (".npz",)

    def open(self, setting: Setting) -> None:
        super().open(setting)
        self._frames = []

    def write(self, frame: Frame) -> None:
        own = {name: getattr(frame, name) for name in ("time", "positions", "displacements", "velocities")}
        own |= {name: values for name, values in frame.fields.items() if name not in ("displacement", "speed")}
        self._frames.append({name: np.array(value) for name, value in own.items()})
        self.count += 1

    def close(self) -> None:
        if self._frames:
            rows = {name: np.stack([frame[name] for frame in self._frames]) for name in self._frames[0]}
            mesh = self.setting.mesh
            body = dict(rest_positions=mesh.vertices, tetrahedra=mesh.elements, fixed=self.setting.fixed)
            np.savez_compressed(self.path, **rows, **body)
