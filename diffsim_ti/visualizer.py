"""SimulationVisualizer: a window that shows a moving body, or a picture file where there is no display."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.answers import answered
from diffsim_ti.common.progress import LOG
from diffsim_ti.common.public import Public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Mark
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.backdrop import Backdrop
from diffsim_ti.visual.drawing import Look
from diffsim_ti.visual.viewer import open_window

if TYPE_CHECKING:
    from taichi.ui import Window


@answered
class SimulationVisualizer(metaclass=Public):
    """Shows a mesh whose positions change: `update(positions)` while it runs, `show()` at the end.

    With a display and a Vulkan driver: a Taichi window (the right button turns, Escape closes). Otherwise
    `show()` writes a PNG to `path` and says where, by the logger "diffsim_ti". `has_window` says which. ground, obstacles
    and look are as in `save_picture`; `update(positions, marks)` shows arrows and lines, as `save_picture` takes them.
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        path: str | Path = "output/simulation.png",
        title: str = "diffsim_ti",
        ground: float | None = None,
        obstacles: Sequence[Triangles] = (),
        **look: Unpack[Look],
    ):
        self.mesh, self.path, self.ground, self.look = mesh, Path(path), ground, dict(look, obstacles=obstacles)
        self.positions, self.marks = np.array(mesh.vertices), ()
        self.window = open_window(title, (1024, 768))
        if self.window is not None:
            self._scene = _Scene(self.window, mesh, ground, self.look)

    @property
    def has_window(self) -> bool:
        """Whether a window shows the body; without one, `show` writes a picture."""
        return self.window is not None

    def update(self, positions: ArrayLike, marks: Sequence[Mark] = ()) -> None:
        """Show these positions [m], shape (num_vertices, 3), a NumPy array or what becomes one."""
        positions = np.asarray(positions, np.float64)
        if positions.shape != self.mesh.vertices.shape:
            raise ValueError(f"positions: expected shape {self.mesh.vertices.shape}, got {positions.shape}")
        self.positions, self.marks = positions.copy(), marks
        if self.has_window and self.window.running:
            self._scene.draw(self.positions, marks)

    def show(self) -> None:
        """Keep the window open until it is closed; without one, write the picture and log its path."""
        if not self.has_window:
            from diffsim_ti.picture import save_picture

            save_picture(self.path, self.mesh, self.positions, ground=self.ground, marks=self.marks, **self.look)
            LOG.warning("no display: picture written to %s", self.path)
            return
        while self.window.running:
            self._scene.draw(self.positions, self.marks)


class _Scene:
    """The window's picture, drawn as `Drawing` draws it."""

    def __init__(self, window: "Window", mesh: TetrahedralMesh, ground: float | None, look: dict):
        from diffsim_ti.visual.drawing import Drawing
        from diffsim_ti.visual.painters import Canvas

        self.window, self.size = window, (1024, 768)
        self.drawing = Drawing(mesh, self.size, ground=ground, backend="software", **look)
        self.backdrop, self.canvas = Backdrop((512, 384), ground, self.drawing.box), Canvas(window)
        self._cursor = None

    def draw(self, positions: np.ndarray, marks: Sequence[Mark]) -> None:
        import taichi as ti

        if self.window.is_pressed(ti.ui.ESCAPE):
            self.window.running = False
        cursor = np.array(self.window.get_cursor_pos())
        if self.window.is_pressed(ti.ui.RMB) and self._cursor is not None and np.any(cursor != self._cursor):
            move = cursor - self._cursor
            self.drawing.camera = self.drawing.camera.orbited(-180 * move[0], -120 * move[1])
        self._cursor = cursor
        soup, shapes = self.drawing.soup(positions, drawn=marks)
        self.canvas.draw(soup, self.backdrop.image(self.drawing.camera, shapes), self.size)
        self.window.show()
