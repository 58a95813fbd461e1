"""Films (MP4, GIF) of a saved series or of states in memory, drawn by Vulkan or in software, without a display.

Camera and colour limits are the same in all frames. Frames are read, drawn and written one by one, so memory stays flat.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from typing_extensions import Unpack

from diffsim_ti.common.public import public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Mark
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.colouring import Colouring, to_vertices
from diffsim_ti.visual.drawing import Drawing, Look
from diffsim_ti.visual.glyphs import arrow_length, ends, longest
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import View, writer_for
from diffsim_ti.writers.drawn import check_film, encoder

KINDS = (".mp4", ".gif", ".png")


@public
def render_series(
    series: str | Path,
    output: str | Path,
    colour: str = "von_mises",
    fps: float = 30.0,
    size: tuple[int, int] = (640, 480),
    ground: float | None = None,
    azimuth: float = 32.0,
    elevation: float = 14.0,
    backend: str = "auto",
    say: Callable[[str], object] | None = None,
    wireframe: bool = False,
    arrows: Sequence[str] = (),
) -> int:
    """Write every frame of a .pvd series into `output`, in the format of its suffix (writers/); the number written.

    A film (.mp4, .gif) has all frames, a picture (.png) the last one, "name_%04d.png" all, numbered.
    colour: a name in visual/colouring.py; fps: frames per second of the film (a GIF keeps time in steps of 10 ms); size:
    pixels, even for .mp4; ground: height of a floor to draw [m], default the run's own, if it had one; azimuth, elevation
    of the eye [degrees]; backend: "auto", "vulkan" or "software"; say: called once with what draws; wireframe: draw edges.
    arrows: point data of the series that are vectors, such as forces, to draw as arrows.
    Obstacles, supports, loads and other marks are those that the series holds.
    Raises ValueError for bad arguments or an empty series, RuntimeError if MP4's encoder is not installed.
    """
    more = dict(wireframe=wireframe, backend=backend, say=say, arrows=tuple(arrows))
    view = View(colour, fps, size, azimuth=azimuth, elevation=elevation, ground=ground, **more)
    writer, saved = writer_for(output, view), SavedSeries(series)
    writer.open(saved.setting)
    with writer:
        for k in range(len(saved)):
            writer.write(saved.frame(k))
    return writer.count


@public
def save_film(
    path: str | Path,
    mesh: TetrahedralMesh,
    positions: np.ndarray,
    values: Sequence[np.ndarray] | None = None,
    fps: float = 25.0,
    size: tuple[int, int] = (640, 480),
    title: Callable[[int], str] | None = None,
    obstacles: Sequence[Sequence[Triangles]] | None = None,
    label: str = "",
    limits: tuple[float, float] | None = None,
    box: np.ndarray | None = None,
    marks: Sequence[Sequence[Mark]] | None = None,
    colours: str | None = None,
    ground: float | None = None,
    backend: str = "auto",
    **look: Unpack[Look],
) -> int:
    """Draw states of a body into `path` (.mp4, .gif), or the last one (.png); the number drawn.

    positions: shape (n, num_vertices, 3) [m]; values: shape (n, m), per vertex or tetrahedron, coloured as in `save_picture`
    with one scale for all; obstacles: n lists of (points, triangles), which may move but not change; title: k -> text;
    box, shape (2, 3) [m]: what to frame, default all positions;
    marks: n lists, as `save_picture` takes them, as are colours, ground [m] and look; backend: "auto", "vulkan" or
    "software".
    Raises ValueError for bad arguments, RuntimeError if MP4's encoder is not installed.
    """
    path, positions = Path(path), np.asarray(positions, np.float64)
    if path.suffix not in KINDS:
        raise ValueError(f"output: must end in {', '.join(KINDS)}, got {path.name!r}; rename it")
    View(fps=fps, size=tuple(size))  # raises what does not fit
    check_film(path, size)
    for name, rows in (("values", values), ("obstacles", obstacles), ("marks", marks)):
        if rows is not None and len(rows) != len(positions):
            raise ValueError(f"{name}: must be given for each of the {len(positions)} frames, got {len(rows)}")
    colouring = None
    if values is not None:
        values = [to_vertices(mesh, row) for row in values]
        shown = np.stack(values)[:, mesh.surface_vertices]
        colouring = Colouring.of(shown, label, limits, colours)
    drawn = [mark for row in marks or () for mark in row]
    scale, length = longest(drawn), arrow_length(mesh)
    around = [ends(mark, scale, length).reshape(-1, 3) for mark in drawn]
    seen = np.concatenate([positions[:, mesh.surface_vertices].reshape(-1, 3), *around])
    box = np.stack([seen.min(0), seen.max(0)]) if box is None else box
    own = dict(ground=ground, colouring=colouring, box=box, backend=backend)
    drawing = Drawing(mesh, size, obstacles=obstacles[0] if obstacles else (), **own, **look)
    drawing.scale = scale
    frames = range(len(positions))[-1:] if path.suffix == ".png" else range(len(positions))
    path.parent.mkdir(parents=True, exist_ok=True)
    with drawing, encoder(path, fps) as writer:
        for k in frames:
            around = [points for points, _ in obstacles[k]] if obstacles else None
            own = None if values is None else values[k]
            words = title(k) if title else ""
            writer.append_data(drawing.image(positions[k], own, words, around, marks[k] if marks else ()))
    return len(frames)
