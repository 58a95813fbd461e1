"""A PNG of a body in one call; `drawing.Drawing` draws many."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.public import public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Arrows, Lines, Mark, Points, arrows
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.colouring import Colouring, to_vertices
from diffsim_ti.visual.depth_image import DepthImage
from diffsim_ti.visual.drawing import Drawing, Look
from diffsim_ti.visual.frame import marks_of
from diffsim_ti.visual.glyphs import arrow_length, ends, longest

__all__ = ["Arrows", "Camera", "DepthImage", "Lines", "Points", "arrows", "draw", "marks_of", "save_picture"]


@public
def draw(
    mesh: TetrahedralMesh,
    positions: ArrayLike,
    values: ArrayLike | None = None,
    limits: tuple[float, float] | None = None,
    ground: float | None = None,
    box: ArrayLike | None = None,
    size: tuple[int, int] = (1200, 900),
    colours: str | None = None,
    label: str = "",
    title: str = "",
    backend: str = "software",
    marks: Sequence[Mark] = (),
    obstacles: Sequence[Triangles] = (),
    **look: Unpack[Look],
) -> np.ndarray:
    """The picture as RGB in [0, 1], shape (height, width, 3); positions [m] and other arguments as in `save_picture`."""
    colouring = None
    if values is not None:
        values = to_vertices(mesh, values)
        colouring = Colouring.of(values[mesh.surface_vertices], label, limits, colours)
    shown = np.asarray(positions, np.float64)
    if box is None and shown.shape == mesh.vertices.shape and np.all(np.isfinite(shown)):
        shown = shown[mesh.surface_vertices]
        scale, length = longest(marks), arrow_length(mesh)
        shown = np.concatenate([shown, *(ends(mark, scale, length).reshape(-1, 3) for mark in marks)])
        box = np.stack([shown.min(0), shown.max(0)])
    own = dict(colouring=colouring, box=box, backend=backend, obstacles=obstacles)
    with Drawing(mesh, size, ground=ground, **own, **look) as drawing:
        return drawing.image(positions, values, title, drawn=marks) / 255


@public
def save_picture(
    path: str | Path,
    mesh: TetrahedralMesh,
    positions: ArrayLike,
    values: ArrayLike | None = None,
    label: str = "",
    ground: float | None = None,
    title: str = "",
    limits: tuple[float, float] | None = None,
    box: ArrayLike | None = None,
    size: tuple[int, int] = (1200, 900),
    colours: str | None = None,
    backend: str = "software",
    marks: Sequence[Mark] = (),
    obstacles: Sequence[Triangles] = (),
    **look: Unpack[Look],
) -> None:
    """Write a picture of the body's surface at `positions` [m], y upwards, in the format of the suffix (PNG, JPEG ...).

    values: per tetrahedron (averaged to vertices) or per vertex, shown in colour with a bar named `label`; limits: what
    the colours span, default zero (or the smallest value, if negative) to the 99.5th percentile of the surface.
    ground: height of a floor to draw [m]; box, shape (2, 3) [m]: what to fit, default the body; size [pixels]; colours: a
    matplotlib map; backend: by default the one that needs no Vulkan; obstacles: (points, triangles) of each.
    marks: arrows, lines and points, with a key: `marks_of(scene, positions)` are those of a scene's loads,
    `arrows("reaction [N]", mesh, positions, vertices, forces)` those of a result.
    look: what `Drawing` takes besides; `fixed=scene.held` and `held=scene.supports.held` show supports.
    The folder is made if there is none. Raises ValueError for shapes that do not fit.
    """
    from PIL import Image

    own = dict(box=box, size=size, colours=colours, label=label, title=title, backend=backend, marks=marks)
    image = draw(mesh, positions, values, limits, ground, obstacles=obstacles, **own, **look)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * image + 0.5).astype(np.uint8)).save(path)
