"""A saved series as a film (MP4, GIF) or its last frame as a picture (PNG), drawn by Vulkan or in software; no display.

Camera and colour limits are the same in all frames. Frames are read, drawn and written one by one, so memory stays flat.
"""

from pathlib import Path

import numpy as np

from diffsim_ti.colouring import Colouring, to_vertices
from diffsim_ti.drawing import Drawing
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.series import frames_of
from diffsim_ti.series_fields import Field, field_named, values_of

KINDS = (".mp4", ".gif", ".png")


def render_series(series, output, colour: str = "von_mises", fps: float = 30.0, size=(640, 480),
                  ground: float | None = None, azimuth: float = 32.0, elevation: float = 14.0, backend: str = "auto",
                  say=None, **look) -> int:  # fmt: skip
    """Draw every frame of a .pvd series into `output` (.mp4, .gif), or the last one (.png); the number drawn.

    colour: a name in series_fields.FIELDS; fps: frames per second of the film (a GIF keeps time in steps of 10 ms); size:
    pixels, even for .mp4; ground: height of a floor to draw [m]; azimuth, elevation of the eye [degrees]; backend:
    "auto", "vulkan" or "software"; say: told once which draws; look: what else `Drawing` takes.
    Raises ValueError for bad arguments or an empty series, RuntimeError if MP4's encoder is not installed.
    """
    output, field, frames = Path(output), field_named(colour), frames_of(series)
    _check(output, fps, size)
    if not frames:
        raise ValueError(f"{series}: must list at least one frame, lists none; run the simulation first")
    mesh = rest_of(frames[0][1])
    box, limits = extent(mesh, frames, colour, field)
    colouring = Colouring(field.label, limits, field.colours)
    frames = frames[-1:] if output.suffix == ".png" else frames
    drawing = Drawing(mesh, size, ground=ground, colouring=colouring, box=box, azimuth=azimuth, elevation=elevation,
                      backend=backend, **look)  # fmt: skip
    output.parent.mkdir(parents=True, exist_ok=True)
    with drawing, film_writer(output, fps) as writer:
        if say:
            say(drawing.describe())
        for time, path in frames:
            frame = read_frame(path)
            writer.append_data(drawing.image(frame.points, values_of(frame, colour), f"t = {time:.3f} s"))
    return len(frames)


def _check(output: Path, fps: float, size) -> None:
    if output.suffix not in KINDS:
        raise ValueError(f"output: must end in {', '.join(KINDS)}, got {output.name!r}; rename it")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: must be finite and > 0, got {fps:g}; 30 is usual")
    if min(size) < 16 or (output.suffix == ".mp4" and (size[0] % 2 or size[1] % 2)):
        raise ValueError(f"size: must be at least 16 pixels a side, and even for .mp4, got {tuple(size)}; try 640 480")


def film_writer(output: Path, fps: float):
    """What takes the frames of a film, or one picture, through `append_data`."""
    import imageio.v2 as imageio

    if output.suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise RuntimeError("MP4 needs imageio-ffmpeg: pip install 'diffsim-ti[film]', or write a .gif") from error
        return imageio.get_writer(output, format="FFMPEG", fps=fps, macro_block_size=2)
    return imageio.get_writer(output, duration=1000 / fps, loop=0) if output.suffix == ".gif" else imageio.get_writer(output)


def read_frame(path: Path):
    """A saved frame, as meshio reads it."""
    import meshio

    return meshio.read(path)


def rest_of(path: Path) -> TetrahedralMesh:
    """The body at rest, whose volumes weight the colours."""
    frame = read_frame(path)
    if "displacement" not in frame.point_data:
        raise ValueError(f"{path}: must hold displacements, has {sorted(frame.point_data)}; render a series of diffsim-ti")
    return TetrahedralMesh(frame.points - frame.point_data["displacement"], frame.cells_dict["tetra"])


def extent(mesh: TetrahedralMesh, frames, colour: str, field: Field) -> tuple[np.ndarray, tuple[float, float]]:
    """The box of all frames, (2, 3) [m], and the limits of the colours over the surfaces of all frames."""
    low, high, least, most = np.full(3, np.inf), np.full(3, -np.inf), np.inf, -np.inf
    for _, path in frames:
        frame = read_frame(path)
        surface, shown = frame.points[mesh.surface_vertices], to_vertices(mesh, values_of(frame, colour))
        shown = shown[mesh.surface_vertices]
        low, high = np.minimum(low, surface.min(0)), np.maximum(high, surface.max(0))
        least, most = min(least, float(np.percentile(shown, 0.5))), max(most, float(np.percentile(shown, 99.5)))
    return np.stack([low, high]), field.limits(least, most)
