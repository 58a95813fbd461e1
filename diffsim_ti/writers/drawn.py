"""What pictures and films share: frames wait in a temporary file until the camera and the colours that fit all are known."""

import pickle
import tempfile
from collections.abc import Iterator

import numpy as np

from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.extent import Extent
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.scene_marks import results_as_arrows
from diffsim_ti.writers.writer import Writer


class DrawnWriter(Writer):
    """Collects frames; `images` draws them, at the end, one by one, so memory stays flat."""

    usual_size = (640, 480)

    def open(self, setting: Setting) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.setting, self.colour, self._extent = setting, self.view.colour, None
        self._waiting, self.count = tempfile.TemporaryFile(), 0

    def write(self, frame: Frame) -> None:
        if self.colour is None:
            self.colour = "von_mises" if "von_mises" in frame.colours else "displacement"
        if self.colour not in frame.colours:
            known = ", ".join(frame.colours)
            raise ValueError(f"colour: the frame must hold {self.colour}, it holds {known}; choose one of these")
        self._extent = self._extent or Extent(self.setting.mesh, self.colour)
        values = np.asarray(frame.fields[self.colour])
        marks = [*frame.marks, *results_as_arrows(frame, self.setting.mesh, self.view.arrows)]
        self._extent.add(frame.positions, values, marks)
        for array in (frame.time, frame.positions, values, *self._points(frame)):
            np.save(self._waiting, array)
        pickle.dump(marks, self._waiting)
        self.count += 1

    def _points(self, frame: Frame) -> list[np.ndarray]:
        return [points for points, _ in self.setting.obstacles] if frame.obstacles is None else frame.obstacles

    def images(self) -> Iterator[np.ndarray]:
        """A picture of each frame that waits, RGB uint8 (height, width, 3)."""
        view, setting = self.view, self.setting
        self._waiting.seek(0)
        with Drawing(
            setting.mesh,
            view.size or self.usual_size,
            camera=view.camera,
            ground=setting.ground if view.ground is None else view.ground,
            obstacles=setting.obstacles,
            fixed=setting.fixed,
            wireframe=view.wireframe,
            colouring=self._extent.colouring,
            box=self._extent.box,
            azimuth=view.azimuth,
            elevation=view.elevation,
            backend=view.backend,
            held=setting.held,
        ) as drawing:
            drawing.scale = self._extent.scale
            if view.say:
                view.say(drawing.describe())
            for _ in range(self.count):
                time, positions, values, *points = (np.load(self._waiting) for _ in range(3 + len(setting.obstacles)))
                marks = pickle.load(self._waiting)
                title = f"{view.title}, " * bool(view.title) + f"t = {float(time):.3f} s"
                yield drawing.image(positions, values, title, points, marks)
