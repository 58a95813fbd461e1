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
        values = frame.colour_values(self.colour)
        self._extent = self._extent or Extent(self.setting.mesh, self.colour)
        marks = [*frame.marks, *results_as_arrows(frame, self.setting.mesh, self.view.arrows)]
        self._extent.add(frame.positions, values, marks)
        points = [x for x, _ in self.setting.obstacles] if frame.obstacles is None else frame.obstacles
        for array in (frame.time, frame.positions, values, *points):
            np.save(self._waiting, array)
        pickle.dump(marks, self._waiting)
        self.count += 1

    def images(self) -> Iterator[np.ndarray]:
        """A picture of each frame that waits, RGB uint8 (height, width, 3)."""
        view, setting, extent = self.view, self.setting, self._extent
        self._waiting.seek(0)
        look = {name: getattr(view, name) for name in ("camera", "wireframe", "azimuth", "elevation", "backend")}
        look |= {name: getattr(setting, name) for name in ("obstacles", "fixed", "held")}
        look |= dict(ground=setting.ground if view.ground is None else view.ground, colouring=extent.colouring)
        with Drawing(setting.mesh, view.size or self.usual_size, box=extent.box, **look) as drawing:
            drawing.scale = extent.scale
            if view.say:
                view.say(drawing.describe())
            for _ in range(self.count):
                time, positions, values, *points = (np.load(self._waiting) for _ in range(3 + len(setting.obstacles)))
                marks = pickle.load(self._waiting)
                title = f"{view.title}, " * bool(view.title) + f"t = {float(time):.3f} s"
                yield drawing.image(positions, values, title, points, marks)
