"""Films: MP4 and GIF."""

from pathlib import Path
from typing import Any

from diffsim_ti.writers.drawn import DrawnWriter
from diffsim_ti.writers.writer import View, register


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
