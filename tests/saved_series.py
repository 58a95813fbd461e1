"""A series written from arrays, for tests of what reads one."""

from pathlib import Path

from diffsim_ti.obstacles import obstacle_surfaces
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.series import frames_of  # noqa: F401
from diffsim_ti.writers import ParaViewWriter


class Series:
    """Writes `folder`/`name`.pvd; with a scene, its floor, obstacles and fixed vertices too."""

    def __init__(self, folder, mesh, name="frames", scene=None):
        self.scene, self.path = scene, Path(folder) / f"{name}.pvd"
        self._writer = ParaViewWriter(self.path)
        self._writer.open(Setting(mesh) if scene is None else Setting.of(scene))

    def write(self, time, positions, displacements, velocities, fields):
        """`fields`: has von_mises, energy_density and J."""
        obstacles = None if self.scene is None else [points for points, _ in obstacle_surfaces(self.scene, time)]
        given = {name: values for name, values in vars(fields).items() if values is not None}
        self._writer.write(Frame(time, positions, displacements, velocities, given, obstacles))
