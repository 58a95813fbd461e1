"""A saved series as a film (MP4, GIF) or its last frame as a picture (PNG), drawn in software: no display, no Vulkan.

Camera and colour limits are the same in all frames. Frames are read, drawn and written one by one, so memory stays flat.
"""

from pathlib import Path

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.picture import draw, to_vertices
from diffsim_ti.series import frames_of
from diffsim_ti.series_fields import Field, field_named, values_of

KINDS = (".mp4", ".gif", ".png")


def render_series(series, output, colour: str = "von_mises", fps: float = 30.0, size=(640, 480),
                  ground: float | None = None, azimuth: float = 32.0, elevation: float = 14.0) -> int:  # fmt: skip
    """Draw every frame of a .pvd series into `output` (.mp4, .gif), or the last one (.png); the number drawn.

    colour: a name in series_fields.FIELDS; fps: frames per second of the film (a GIF keeps time in steps of 10 ms); size:
    pixels, even for .mp4; ground: height of a floor to draw [m]; azimuth, elevation of the eye [degrees].
    Raises ValueError for bad arguments or an empty series, RuntimeError if MP4's encoder is not installed.
    """
    output, field, frames = Path(output), field_named(colour), frames_of(series)
    _check(output, fps, size)
    if not frames:
        raise ValueError(f"{series}: must list at least one frame, lists none; run the simulation first")
    mesh = _mesh(frames[0][1])
    box, limits = _extent(mesh, frames, colour, field)
    legend = legend_image(field, limits, size)
    frames = frames[-1:] if output.suffix == ".png" else frames
    output.parent.mkdir(parents=True, exist_ok=True)
    with _writer(output, fps) as writer:
        for time, path in frames:
            frame = _read(path)
            image = draw(mesh, frame.points, values_of(frame, colour), limits, ground, box, size, azimuth, elevation,
                         field.colours)  # fmt: skip
            writer.append_data(_with_text(image, legend, f"t = {time:.3f} s"))
    return len(frames)


def legend_image(field: Field, limits: tuple[float, float], size: tuple[int, int]) -> np.ndarray:
    """The colour bar with its label and unit, RGBA in [0, 1], shape (height, width, 4), transparent around it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    figure.patch.set_alpha(0.0)
    axes = figure.add_axes((0.925, 0.25, 0.02, 0.5))
    bar = figure.colorbar(ScalarMappable(Normalize(*limits), field.colours), cax=axes)
    bar.outline.set_visible(False)
    bar.ax.yaxis.set_ticks_position("left")
    bar.ax.tick_params(labelsize=9)
    bar.formatter.set_powerlimits((-3, 4))
    figure.text(0.95, 0.81, field.label, ha="right", fontsize=10, color="#333333")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()) / 255.0


def _with_text(image: np.ndarray, legend: np.ndarray, text: str) -> np.ndarray:
    """The picture under its legend and time, bytes of shape (height, width, 3)."""
    from PIL import Image, ImageDraw

    alpha = legend[..., 3:]
    picture = Image.fromarray(np.uint8(255 * (image * (1 - alpha) + legend[..., :3] * alpha) + 0.5))
    ImageDraw.Draw(picture).text((12, 10), text, fill=(51, 51, 51))
    return np.asarray(picture)


def _check(output: Path, fps: float, size) -> None:
    if output.suffix not in KINDS:
        raise ValueError(f"output: must end in {', '.join(KINDS)}, got {output.name!r}; rename it")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: must be finite and > 0, got {fps:g}; 30 is usual")
    if min(size) < 16 or (output.suffix == ".mp4" and (size[0] % 2 or size[1] % 2)):
        raise ValueError(f"size: must be at least 16 pixels a side, and even for .mp4, got {tuple(size)}; try 640 480")


def _writer(output: Path, fps: float):
    import imageio.v2 as imageio

    if output.suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise RuntimeError("MP4 needs imageio-ffmpeg: pip install 'diffsim-ti[film]', or write a .gif") from error
        return imageio.get_writer(output, format="FFMPEG", fps=fps, macro_block_size=2)
    return imageio.get_writer(output, duration=1000 / fps, loop=0) if output.suffix == ".gif" else imageio.get_writer(output)


def _read(path: Path):
    import meshio

    return meshio.read(path)


def _mesh(path: Path) -> TetrahedralMesh:
    """The body at rest, whose volumes weight the colours."""
    frame = _read(path)
    if "displacement" not in frame.point_data:
        raise ValueError(f"{path}: must hold displacements, has {sorted(frame.point_data)}; render a series of diffsim-ti")
    return TetrahedralMesh(frame.points - frame.point_data["displacement"], frame.cells_dict["tetra"])


def _extent(mesh: TetrahedralMesh, frames, colour: str, field: Field) -> tuple[np.ndarray, tuple[float, float]]:
    """The box of all frames, (2, 3) [m], and the limits of the colours over the surfaces of all frames."""
    low, high, least, most = np.full(3, np.inf), np.full(3, -np.inf), np.inf, -np.inf
    for _, path in frames:
        frame = _read(path)
        surface, shown = frame.points[mesh.surface_vertices], to_vertices(mesh, values_of(frame, colour))
        shown = shown[mesh.surface_vertices]
        low, high = np.minimum(low, surface.min(0)), np.maximum(high, surface.max(0))
        least, most = min(least, float(np.percentile(shown, 0.5))), max(most, float(np.percentile(shown, 99.5)))
    return np.stack([low, high]), field.limits(least, most)
