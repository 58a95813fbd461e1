"""Films (MP4, GIF) of a saved series or of states in memory, drawn by Vulkan or in software, without a display.

Camera and colour limits are the same in all frames. Frames are read, drawn and written one by one, so memory stays flat.
"""

from pathlib import Path

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual.colouring import Colouring, to_vertices
from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.fields import Field, field_named, values_of
from diffsim_ti.visual.series import Surroundings, frames_of

KINDS = (".mp4", ".gif", ".png")


def render_series(
    series,
    output,
    colour: str = "von_mises",
    fps: float = 30.0,
    size=(640, 480),
    ground: float | None = None,
    azimuth: float = 32.0,
    elevation: float = 14.0,
    backend: str = "auto",
    say=None,
    **look,
) -> int:
    """Draw every frame of a .pvd series into `output` (.mp4, .gif), or the last one (.png); the number drawn.

    colour: a name in series_fields.FIELDS; fps: frames per second of the film (a GIF keeps time in steps of 10 ms); size:
    pixels, even for .mp4; ground: height of a floor to draw [m], default the run's own, if it had one; azimuth, elevation
    of the eye [degrees]; backend: "auto", "vulkan" or "software"; say: told once which draws; look: what else `Drawing`
    takes. Obstacles and fixed vertices are those that the series holds.
    Raises ValueError for bad arguments or an empty series, RuntimeError if MP4's encoder is not installed.
    """
    output, field, frames = Path(output), field_named(colour), frames_of(series)
    _check(output, fps, size)
    if not frames:
        raise ValueError(f"{series}: must list at least one frame, lists none; run the simulation first")
    mesh = rest_of(frames[0][1])
    box, limits = extent(mesh, frames, colour, field)
    colouring = Colouring(field.label, limits, field.colours)
    around, shown = Surroundings(series), range(len(frames))[-1 if output.suffix == ".png" else 0 :]
    drawing = Drawing(
        mesh,
        size,
        ground=around.ground if ground is None else ground,
        colouring=colouring,
        box=box,
        azimuth=azimuth,
        elevation=elevation,
        backend=backend,
        obstacles=around.shapes(0),
        fixed=fixed_of(read_frame(frames[0][1])),
        **look,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    with drawing, film_writer(output, fps) as writer:
        if say:
            say(drawing.describe())
        for k in shown:
            frame, obstacles = read_frame(frames[k][1]), [points for points, _ in around.shapes(k)]
            writer.append_data(
                drawing.image(frame.points, values_of(frame, colour), f"t = {frames[k][0]:.3f} s", obstacles)
            )
    return len(shown)


def save_film(
    path,
    mesh,
    positions,
    values=None,
    fps: float = 25.0,
    size=(640, 480),
    title=None,
    obstacles=None,
    label: str = "",
    limits=None,
    box=None,
    **look,
) -> int:
    """Draw states of a body into `path` (.mp4, .gif), or the last one (.png); the number drawn.

    positions: shape (n, num_vertices, 3) [m]; values: shape (n, m), per vertex or tetrahedron, coloured as in `save_picture`
    with one scale for all; obstacles: n lists of (points, triangles), which may move but not change; title: k -> text;
    box, shape (2, 3) [m]: what to frame, default all positions; look: what else `Drawing` takes.
    Raises ValueError for bad arguments, RuntimeError if MP4's encoder is not installed.
    """
    path, positions = Path(path), np.asarray(positions, np.float64)
    _check(path, fps, size)
    for name, rows in (("values", values), ("obstacles", obstacles)):
        if rows is not None and len(rows) != len(positions):
            raise ValueError(f"{name}: must be given for each of the {len(positions)} frames, got {len(rows)}")
    if values is not None:
        values = [to_vertices(mesh, row) for row in values]
        shown = np.stack(values)[:, mesh.surface_vertices]
        look["colouring"] = Colouring.of(shown, label, limits, look.pop("colours", None))
    seen = positions[:, mesh.surface_vertices]
    box = np.stack([seen.min((0, 1)), seen.max((0, 1))]) if box is None else box
    drawing = Drawing(mesh, size, obstacles=obstacles[0] if obstacles else (), box=box, **look)
    frames = range(len(positions))[-1:] if path.suffix == ".png" else range(len(positions))
    path.parent.mkdir(parents=True, exist_ok=True)
    with drawing, film_writer(path, fps) as writer:
        for k in frames:
            around = [points for points, _ in obstacles[k]] if obstacles else None
            writer.append_data(
                drawing.image(positions[k], None if values is None else values[k], title(k) if title else "", around)
            )
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
    return (
        imageio.get_writer(output, duration=1000 / fps, loop=0)
        if output.suffix == ".gif"
        else imageio.get_writer(output)
    )


def read_frame(path: Path):
    """A saved frame, as meshio reads it."""
    import meshio

    return meshio.read(path)


def rest_of(path: Path) -> TetrahedralMesh:
    """The body at rest, whose volumes weight the colours."""
    frame = read_frame(path)
    if "displacement" not in frame.point_data:
        raise ValueError(
            f"{path}: must hold displacements, has {sorted(frame.point_data)}; render a series of diffsim-ti"
        )
    return TetrahedralMesh(frame.points - frame.point_data["displacement"], frame.cells_dict["tetra"])


def fixed_of(frame) -> np.ndarray:
    """The vertices that a saved frame says are fixed."""
    return np.flatnonzero(frame.point_data.get("fixed", []))


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
