"""Pictures (PNG, JPEG) and films (MP4, GIF): frames wait in a temporary file until the camera and the colours that fit all
are known."""

import pickle
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.extent import Extent
from diffsim_ti.visual.frame import Frame, Setting, results_as_arrows
from diffsim_ti.writers.writer import LastOrAll, View, Writer, register


class DrawnWriter(Writer):
    """Collects frames; `images` draws them, at the end, one by one, so memory stays flat."""

    usual_size = (640, 480)

    def open(self, setting: Setting) -> None:
        super().open(setting)
        self.colour, self._extent, self._waiting = self.view.colour, None, tempfile.TemporaryFile()

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


@register
class PictureWriter(LastOrAll, DrawnWriter):
    """Draws the last frame when it is closed, or, for a name such as "run_%04d.png", every frame, numbered from 0."""

    suffixes = (".png", ".jpg", ".jpeg")
    usual_size = (1200, 900)

    def write(self, frame: Frame) -> None:
        if not self.numbered:  # only the last one waits
            self._waiting.seek(0)
            self._waiting.truncate()
            self.count = 0
            if self.view.fit == "end":
                self._extent = None
        super().write(frame)

    def close(self) -> None:
        from PIL import Image

        for k, image in enumerate(self.images() if self.count else ()):
            Image.fromarray(image).save(self.file_of(k))
        self._waiting.close()


@register
class FilmWriter(DrawnWriter):
    """Draws a film when it is closed; a GIF keeps time in steps of 10 ms.

    Raises ValueError for an odd size of an MP4, RuntimeError if its encoder is not installed.
    """

    suffixes = (".mp4", ".gif")

    def __init__(self, path: str | Path, view: View | None = None):
        super().__init__(path, view)
        check_film(self.path, self.view.size or self.usual_size)

    def close(self) -> None:
        if self.count:
            with encoder(self.path, self.view.fps) as film:
                for image in self.images():
                    film.append_data(image)
        self._waiting.close()


def check_film(path: Path, size: tuple[int, int]) -> None:
    """Raise if a film of that size cannot be written there, before it is drawn."""
    if path.suffix.lower() != ".mp4":
        return
    if size[0] % 2 or size[1] % 2:
        raise ValueError(f"size: must be even for .mp4, got {tuple(size)}; try 640 480")
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise RuntimeError("MP4 needs imageio-ffmpeg: pip install 'diffsim-ti[film]', or write a .gif") from error


def encoder(path: Path, fps: float) -> Any:
    """What takes the pictures of a film, or one picture, through `append_data`."""
    import imageio.v2 as imageio

    suffix = path.suffix.lower()
    if suffix == ".mp4":
        return imageio.get_writer(path, format="FFMPEG", fps=fps, macro_block_size=2)
    return imageio.get_writer(path, duration=1000 / fps, loop=0) if suffix == ".gif" else imageio.get_writer(path)
