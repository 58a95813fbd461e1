"""Pictures, PNG or JPEG: one of the end, or a numbered series."""

from pathlib import Path

from diffsim_ti.visual.frame import Frame
from diffsim_ti.writers.drawn import DrawnWriter
from diffsim_ti.writers.writer import View, file_of, numbered, register


@register
class PictureWriter(DrawnWriter):
    """Draws the last frame when it is closed, or, for a name such as "run_%04d.png", every frame, numbered from 0.

    Raises ValueError for a name with a % that is no place for a number.
    """

    suffixes = (".png", ".jpg", ".jpeg")
    usual_size = (1200, 900)

    def __init__(self, path: str | Path, view: View | None = None):
        super().__init__(path, view)
        self.numbered = numbered(self.path)

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
            Image.fromarray(image).save(file_of(self.path, k) if self.numbered else self.path)
        self._waiting.close()

    def describe(self) -> str:
        return super().describe() if self.numbered else str(self.path)
