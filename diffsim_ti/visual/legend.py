"""Words and the colour bar on a picture."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from diffsim_ti.visual.colouring import Colouring

INK = "#333333"


def legend(colouring: Colouring, size: tuple[int, int]) -> tuple:
    """((rows, columns), premultiplied RGB in 0 .. 255, cover in [0, 1]): the colour bar with label and unit, made once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    width, height = size
    scale = min(width / 1200, height / 900)
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=(0, 0, 0, 0))
    canvas = FigureCanvasAgg(figure)
    colours = ScalarMappable(Normalize(*colouring.limits), colouring.map)
    bar = figure.colorbar(colours, cax=figure.add_axes((0.925, 0.25, 0.02, 0.5)))
    bar.outline.set_visible(False)
    small = max(16 * scale, 7)
    bar.ax.tick_params(labelsize=small, color=INK, labelcolor=INK, length=4 * scale)
    bar.ax.yaxis.set_ticks_position("left")
    bar.ax.yaxis.get_offset_text().set_fontsize(small)
    bar.formatter.set_powerlimits((-3, 4))
    figure.text(0.965, 0.795, colouring.label, ha="right", color=INK, fontsize=max(18 * scale, 8))
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba()).astype(np.float64)
    rows, columns = np.nonzero(rgba[..., 3])
    where = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    cover = rgba[where][..., 3:] / 255
    return where, rgba[where][..., :3] * cover + 0.5, cover


@lru_cache(maxsize=8)
def _font(pixels: int):
    from matplotlib.font_manager import findfont
    from PIL import ImageFont

    return ImageFont.truetype(findfont("DejaVu Sans"), pixels)


def write_key(image: np.ndarray, rows: Sequence[tuple[str, np.ndarray]]) -> np.ndarray:
    """The picture with lines of words, each in its colour (RGB in [0, 1]), at its lower left."""
    from PIL import Image, ImageDraw

    out = Image.fromarray(image)
    height, margin = max(10, round(0.024 * image.shape[0])), 0.025 * image.shape[1]
    pen = ImageDraw.Draw(out)
    for k, (text, colour) in enumerate(rows):
        y = image.shape[0] - margin - 1.35 * height * (len(rows) - k)
        pen.text((margin, y), text, tuple(int(255 * c) for c in 0.85 * colour), _font(height))
    return np.array(out)


def write_text(image: np.ndarray, text: str) -> np.ndarray:
    """The picture with words at its upper left."""
    from PIL import Image, ImageDraw

    out = Image.fromarray(image)
    margin = 0.025 * image.shape[1]
    ImageDraw.Draw(out).text((margin, margin), text, INK, _font(max(11, round(0.03 * image.shape[0]))))
    return np.array(out)
