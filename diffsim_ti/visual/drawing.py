"""Drawing: frame after frame of one body, with the same camera, colours, floor, obstacles and legend, by either back end."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.public import Public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Arrows, Mark, vertex_normals
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.backdrop import Backdrop
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.colouring import Colouring, to_vertices
from diffsim_ti.visual.glyphs import COLOURS, arrow_length, cones, glyphs, key_lines, legend, longest, with_words
from diffsim_ti.visual.surface import OBSTACLE, PLAIN, Soup, Surface, marks, with_edges

if TYPE_CHECKING:
    from diffsim_ti.visual.painters import SoftwarePainter, VulkanPainter


BACKENDS = ("auto", "vulkan", "software")


def painter(backend: str, size: tuple[int, int]) -> "SoftwarePainter | VulkanPainter":
    """What paints triangles: "vulkan", "software" (NumPy, needs no driver), or "auto": Vulkan where there is a driver."""
    from diffsim_ti.visual.painters import SoftwarePainter, VulkanPainter, has_vulkan

    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend == "vulkan" and not has_vulkan():
        remedy = "install one (mesa-vulkan-drivers) or use 'software'"
        raise ValueError(f"backend='vulkan': no Vulkan driver was found; {remedy}")
    return SoftwarePainter(size) if backend == "software" or not has_vulkan() else VulkanPainter(size)


def held_along(mesh: TetrahedralMesh, vertices: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, ...] | None:
    """Of vertices and the projectors onto the directions in which each is fixed: (those held in all, one vertex and unit
    vector for each direction in which another is held); the vectors point out of the body. None if all are fixed wholly."""
    rank = np.rint(np.trace(held, axis1=1, axis2=2)).astype(int)
    if len(held) == 0 or rank.min() == 3:
        return None
    values, vectors = np.linalg.eigh(held)
    which, column = np.nonzero((values > 0.5) & (rank < 3)[:, None])
    axes = vectors[which, :, column]
    out = mesh.vertices - mesh.bounding_box.mean(0)  # where the surface says nothing
    normals = vertex_normals(mesh, mesh.vertices)
    for away in (out, normals):
        along = (axes * away[vertices[which]]).sum(1)
        clear = np.abs(along) > 1e-6 * np.abs(away).max()
        axes = np.where((clear & (along < 0))[:, None], -axes, axes)
    return vertices[rank == 3], vertices[which], axes


class Look(TypedDict, total=False):
    """How a body is seen; `Drawing` says what each means and is where it is left out."""

    camera: Camera | None
    azimuth: float
    elevation: float
    fixed: ArrayLike | None
    held: ArrayLike | None
    wireframe: bool


class Drawing(metaclass=Public):
    """Pictures of a body's surface, y upwards.

    mesh: its rest shape tells sharp edges from curved surfaces.
    size: width and height in pixels. camera: default one that frames `box` [m], shape (2, 3) (default: the rest shape),
        from `azimuth` and `elevation` [degrees].
    ground: height of a floor [m], or None. obstacles: (points, triangles) of what stands around, see `obstacle_surfaces`.
    fixed: vertices to mark; held: projectors onto the directions in which each is fixed, shape (len(fixed), 3, 3),
    None: all.
        wireframe: draw the triangles' edges. colouring: how values are coloured.
    backend: "auto", "vulkan" or "software"; `describe()` says which it became.
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        size: tuple[int, int] = (1200, 900),
        camera: Camera | None = None,
        ground: float | None = None,
        obstacles: Sequence[Triangles] = (),
        fixed: ArrayLike | None = None,
        wireframe: bool = False,
        colouring: Colouring | None = None,
        box: ArrayLike | None = None,
        azimuth: float = 32.0,
        elevation: float = 14.0,
        backend: str = "auto",
        held: ArrayLike | None = None,
    ):
        if len(size) != 2 or any(int(n) != n or not 16 <= n <= 8192 for n in size):
            raise ValueError(f"size must be two whole numbers of pixels between 16 and 8192, got {size}")
        self.mesh, self.size, self.wireframe, self.colouring = mesh, tuple(int(n) for n in size), wireframe, colouring
        fit = mesh.vertices if box is None else np.stack(np.meshgrid(*np.array(box, np.float64).T), -1).reshape(-1, 3)
        self.camera = camera or Camera.framing(fit, self.size, azimuth, elevation)
        self.box = np.stack([fit.min(0), fit.max(0)])
        self.fixed = np.zeros(0, np.int64) if fixed is None else mesh.vertex_indices(fixed)
        self._cones = None if held is None else held_along(mesh, self.fixed, np.asarray(held, np.float64))
        self.scale: dict[str, float] = {}  # the largest vector of each label of arrows so far
        self.colours: dict[str, np.ndarray] = {}  # of marks, by label
        self.obstacles, self._around = tuple(obstacles), [Surface(*shape) for shape in obstacles]
        self._surface = Surface(mesh.vertices, mesh.surface_triangles)
        self._backdrop = Backdrop(self.size, ground, self.box)
        self._painter, self._legend, self._asked = painter(backend, self.size), (None, None), backend

    def describe(self) -> str:
        """Which back end draws, in a line."""
        why = " (no Vulkan driver here)" if self._asked == "auto" and self._painter.name == "NumPy" else ""
        return f"drawn by {self._painter.name}{why}, {self.size[0]} x {self.size[1]} pixels"

    def soup(
        self,
        positions: ArrayLike,
        values: ArrayLike | None = None,
        size: tuple[int, int] | None = None,
        obstacles: Sequence[np.ndarray] | None = None,
        drawn: Sequence[Mark] = (),
    ) -> tuple[Soup, list]:
        """The triangles to paint, and (points, triangles) of what throws shadows."""
        points = np.asarray(positions, np.float64)
        if points.shape != (self.mesh.num_vertices, 3) or not np.all(np.isfinite(points)):
            shape = f"({self.mesh.num_vertices}, 3)"
            raise ValueError(f"positions: expected finite numbers of shape {shape}, got shape {points.shape}")
        size, colour = size or self.size, PLAIN
        if values is not None:
            values = to_vertices(self.mesh, values)
            self.colouring = self.colouring or Colouring.of(values[self.mesh.surface_vertices])
            colour = self.colouring(values)
        body = self._surface.lit(points, colour, self.camera, size)
        soups = [with_edges(body, 0.0006 * size[1]) if self.wireframe else body]
        placed = [s.points for s in self._around] if obstacles is None else obstacles
        soups += [s.lit(p, OBSTACLE, self.camera, size) for s, p in zip(self._around, placed)]
        soups += self._supports(points, size)
        if drawn:
            self.scale = longest(drawn, self.scale)
            for mark in drawn:
                self.colours.setdefault(mark.label, COLOURS[len(self.colours) % len(COLOURS)])
            soups += glyphs(drawn, self.scale, self.colours, arrow_length(self.mesh), self.camera, size)
        shapes = [(points, self.mesh.surface_triangles), *((p, s.triangles) for s, p in zip(self._around, placed))]
        return Soup.joined(soups), shapes

    def _supports(self, points: np.ndarray, size: tuple[int, int]) -> list[Soup]:
        wholly, extent, out = self.fixed, float(np.ptp(self.box, 0).max()), []
        if self._cones is not None:
            wholly, vertices, axes = self._cones
            out.append(cones(points[vertices], axes, 0.035 * extent, self.camera, size))
        if len(wholly):
            out.append(marks(points[wholly], self.camera, size, 0.004 * size[1], 0.01 * extent))
        return out

    def key(self, drawn: Sequence[Mark]) -> list[tuple[str, np.ndarray]]:
        """(text, colour) of lines that say what cones, arrows and lines of a picture mean; none where there are none."""
        wholly = self.fixed if self._cones is None else self._cones[0]
        some = [mark for mark in drawn if not isinstance(mark, Arrows) or len(mark.points)]
        return key_lines(some, self.scale, self.colours, len(wholly) > 0, self._cones is not None)

    def backdrop(self, shapes: Sequence[Triangles]) -> np.ndarray:
        """What lies behind, with the shadows of `shapes` from `soup`: RGB in [0, 1], float32 (height, width, 3)."""
        return self._backdrop.image(self.camera, shapes)

    def image(
        self,
        positions: ArrayLike,
        values: ArrayLike | None = None,
        title: str = "",
        obstacles: Sequence[np.ndarray] | None = None,
        drawn: Sequence[Mark] = (),
    ) -> np.ndarray:
        """A picture, RGB uint8 (height, width, 3), of the body at `positions` [m], shape (num_vertices, 3).

        values: one per vertex or per tetrahedron (averaged to vertices), shown in colours with the legend of the
        colouring; without a colouring the first frame's values set it. obstacles: points of each obstacle, if they moved.
        drawn: arrows, lines and points (terms/marks.py), with a key; see `frame.marks_of`.
        Raises ValueError for shapes that do not fit and for numbers that are not finite.
        """
        soup, shapes = self.soup(positions, values, None, obstacles, drawn)
        image = self._painter.paint(soup, self.backdrop(shapes))
        image = np.ascontiguousarray(np.clip(255 * image + 0.5, 0, 255).astype(np.uint8))
        if values is not None:
            self.add_legend(image)
        return with_words(image, title, self.key(drawn))

    def add_legend(self, image: np.ndarray) -> None:
        """Draw the colouring's bar into a picture, uint8 or in [0, 1]; nothing if it has no label."""
        if not self.colouring.label:
            return
        if self._legend[0] != self.colouring:
            self._legend = self.colouring, legend(self.colouring, self.size)
        (rows, columns), colour, cover = self._legend[1]
        full = 1 if image.dtype == np.uint8 else 255
        image[rows, columns] = colour / full + image[rows, columns] * (1 - cover)

    def close(self) -> None:
        """Give back the back end's window."""
        self._painter.close()

    def __enter__(self) -> "Drawing":
        return self

    def __exit__(self, *_) -> None:
        self.close()
