"""Arrows, lines, points and cones as lit triangles; how long arrows are; the key that says what they mean, the
legend's words, and the colour bar."""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Arrows, Lines, Mark, Points
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.colouring import Colouring
from diffsim_ti.visual.surface import MARK, Soup, marks, shaded

LENGTH = 0.14  # of the longest arrow, as a share of the body at rest
SIDES = 10  # of what is round
COLOURS = tuple(
    np.array([int(c[k : k + 2], 16) / 255 for k in (0, 2, 4)])
    for c in ("B2182B", "1B7837", "762A83", "01665E", "8C510A", "2D2D2D")
)
INK = "#333333"


def arrow_length(mesh: TetrahedralMesh) -> float:
    """Of the longest arrow of each label [m]."""
    return LENGTH * float(np.ptp(mesh.bounding_box, 0).max())


def longest(drawn: Iterable[Mark], known: Mapping[str, float] | None = None) -> dict[str, float]:
    """{label: size of the largest vector}, of arrows and of what is known of other moments."""
    out = dict(known or {})
    for mark in drawn:
        if isinstance(mark, Arrows):
            sizes = np.linalg.norm(mark.vectors, axis=1)
            out[mark.label] = max(out.get(mark.label, 0.0), float(sizes.max(initial=0.0)))
    return out


def ends(mark: Mark, scale: Mapping[str, float], length: float) -> np.ndarray:
    """Where arrows and lines begin and end [m], shape (k, 2, 3); points are both."""
    if isinstance(mark, Lines):
        return mark.ends
    if isinstance(mark, Points):
        return np.stack([mark.points, mark.points], 1)
    way = mark.vectors * (length / max(scale[mark.label], 1e-300))
    tails = np.where(np.asarray(mark.onto, bool)[:, None], mark.points - way, mark.points)
    return np.stack([tails, tails + way], 1)


def glyphs(
    drawn: Sequence[Mark],
    scale: Mapping[str, float],
    colours: Mapping[str, np.ndarray],
    length: float,
    camera: Camera,
    size: tuple[int, int],
) -> list[Soup]:
    """Triangles of all marks, a little nearer to the eye than they lie, so that what runs along a surface is seen."""
    out, near = [], 0.05 * length
    for mark in drawn:
        colour = colours[mark.label]
        if isinstance(mark, Points):
            out.append(marks(mark.points, camera, size, 0.006 * size[1], near, colour))
            continue
        both = ends(mark, scale, length)
        radius = (0.04 if isinstance(mark, Arrows) else 0.05) * length
        long = np.linalg.norm(both[:, 1] - both[:, 0], axis=1)
        both, long = both[long > 1e-3 * length], long[long > 1e-3 * length]
        if isinstance(mark, Arrows):
            head = np.minimum(0.32 * length, 0.7 * long)
            profile = [(0, 0), (0, radius), (long - head, radius), (long - head, 0.3 * head), (long, 0)]
        else:
            profile = [(0, 0), (0, radius), (long, radius), (long, 0)]
        out.append(turned(both, profile, colour, camera, size, near, isinstance(mark, Arrows) and mark.through))
    return [soup for soup in out if len(soup.corners)]


def cones(points: np.ndarray, axes: np.ndarray, height: float, camera: Camera, size: tuple[int, int]) -> Soup:
    """Cones whose tips touch points [m], shape (k, 3), and that widen along unit vectors: what holds these that way."""
    profile = [(0, 0), (height, 0.45 * height), (height, 0)]
    return turned(np.stack([points, points + height * axes], 1), profile, MARK, camera, size, 0.2 * height)


def turned(both, profile, colour, camera: Camera, size, near: float, through: bool = False) -> Soup:
    """Surfaces of revolution about the lines between two ends, shape (k, 2, 3), by (way along, radius), each per line.
    through: in front of all else."""
    k = len(both)
    if not k:
        return Soup(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    axis = both[:, 1] - both[:, 0]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    side = np.where(np.abs(axis[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(axis, side)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = np.arange(SIDES) * 2 * np.pi / SIDES
    rim = np.cos(angle)[:, None, None] * first + np.sin(angle)[:, None, None] * np.cross(axis, first)  # (SIDES, k, 3)
    along, radius = (np.stack([np.broadcast_to(row[j], k) for row in profile]) for j in (0, 1))  # (rings, k)
    rings = both[:, 0] + along[..., None] * axis + radius[..., None] * rim[:, None]  # (SIDES, rings, k, 3)
    after = np.roll(rings, -1, 0)
    a, b, c, d = rings[:, :-1], after[:, :-1], rings[:, 1:], after[:, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -2), np.stack([b, d, c], -2)]).reshape(-1, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    seen = (sizes > 0) & ((normals * (camera.position - triangles[:, 0])).sum(1) > 0)
    triangles, normals = triangles[seen], normals[seen] / sizes[seen, None]
    corners = camera.project(triangles, size)
    corners[..., 2] = np.maximum((1e-3 if through else 1) * (corners[..., 2] - near), 1e-6)
    lit = np.repeat(shaded(np.broadcast_to(colour, normals.shape), normals)[:, None], 3, 1)
    return Soup(corners, lit, corners[..., 2].mean(1))


def key_lines(
    drawn: Sequence[Mark], scale: Mapping[str, float], colours: Mapping[str, np.ndarray], held: bool, partly_fixed: bool
) -> list[tuple[str, np.ndarray]]:
    """(text, colour) of each line of a picture's key."""
    signs = {Lines: "━", Points: "●"}
    out = {}
    for mark in drawn:
        sign, words = signs.get(type(mark), "→"), mark.label
        if isinstance(mark, Arrows):
            words = f"{words}, longest {scale[mark.label]:.3g}"
        out[mark.label] = f"{sign} {words}", colours[mark.label]
    held_rows = [("● held in all directions", MARK)] * held + [("▲ held along the cone", MARK)] * partly_fixed
    return [*held_rows, *out.values()] if out or partly_fixed else []


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


def with_words(image: np.ndarray, title: str, rows: Sequence[tuple[str, np.ndarray]]) -> np.ndarray:
    """The picture with a title at its upper left, and lines, each in its colour (RGB in [0, 1]), at its lower left."""
    if not (title or rows):
        return image
    from PIL import Image, ImageDraw

    out, (tall, wide) = Image.fromarray(image), image.shape[:2]
    pen, margin, height = ImageDraw.Draw(out), 0.025 * wide, max(10, round(0.024 * tall))
    pen.text((margin, margin), title, INK, _font(max(11, round(0.03 * tall))))
    for k, (text, colour) in enumerate(rows):
        y = tall - margin - 1.35 * height * (len(rows) - k)
        pen.text((margin, y), text, tuple(int(255 * c) for c in 0.85 * colour), _font(height))
    return np.array(out)
