"""A PNG of a body: a small NumPy rasteriser with smooth shading, a floor and a shadow; matplotlib adds text and colours.

Every pixel first finds the triangle nearest to the eye (a depth buffer), then is shaded once. The picture is drawn larger
than asked for and averaged down, which smooths its edges.
"""

from dataclasses import dataclass

import numpy as np

SUPERSAMPLING = 2
LIGHT = np.array([-0.45, 1.0, 0.55]) / np.linalg.norm([-0.45, 1.0, 0.55])
PLAIN = np.array([0.33, 0.55, 0.80])
SKY, HORIZON, FLOOR, LINE = (np.array(c) for c in ([0.99] * 3, [0.93, 0.945, 0.96], [0.965] * 3, [0.80, 0.82, 0.85]))
FIELD_OF_VIEW = np.radians(28.0)
CENTER = 0.46  # of the width: the body stands left of the colour bar


@dataclass(frozen=True)
class Camera:
    """A pinhole at `eye` [m]; rows of `axes` are right, up and backwards; `focal` and `size` are in pixels."""

    eye: np.ndarray
    axes: np.ndarray
    focal: float
    size: tuple[int, int]

    @classmethod
    def framing(cls, points: np.ndarray, size: tuple[int, int], azimuth: float, elevation: float) -> "Camera":
        """A camera that sees all points, from the angles [degrees] about y (0: from +z, 90: from +x) and above the floor."""
        a, e = np.radians([azimuth, elevation])
        back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        right = np.array([np.cos(a), 0.0, -np.sin(a)])
        axes = np.stack([right, np.cross(back, right), back])
        center = (points.min(0) + points.max(0)) / 2
        x, y, z = axes @ (points - center).T
        half = np.tan(FIELD_OF_VIEW / 2) * np.array([size[0] / size[1] * 0.76, 0.82])
        distance = max(np.max(np.abs(x) / half[0] + z), np.max(np.abs(y) / half[1] + z))
        focal = size[1] / 2 / np.tan(FIELD_OF_VIEW / 2)
        return cls(center + back * max(distance, 1e-12), axes, focal, size)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel column, row and depth [m] of points, shape (n, 3)."""
        x, y, z = self.axes @ (points - self.eye).T
        depth = np.maximum(-z, 1e-12)
        scale = self.focal / depth
        return np.stack([self.size[0] * CENTER + scale * x, self.size[1] / 2 - scale * y, depth], 1)

    def rays(self, pixel: np.ndarray) -> np.ndarray:
        """Unit direction of the ray through each pixel (counted by rows), shape (n, 3)."""
        row, column = np.divmod(pixel, self.size[0])
        x, y = column + 0.5 - self.size[0] * CENTER, self.size[1] / 2 - row - 0.5
        rays = np.stack([x, y, np.full(x.shape, -self.focal)], 1) @ self.axes
        return rays / np.sqrt(np.einsum("pd,pd->p", rays, rays))[:, None]


def covered_pixels(corners: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(triangle, pixel, weights) of every pixel centre inside a triangle; corners (n, 3, 2) in pixels.

    Triangles are taken in groups of similar size, each group on one square stencil of pixels.
    """
    width, height = size
    low = np.floor(np.clip(corners.min(1), 0, [width, height])).astype(np.int64)
    high = np.ceil(np.clip(corners.max(1), 0, [width, height])).astype(np.int64)
    extent = (high - low).max(1)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    usable = ((high - low).min(1) > 0) & (np.abs(area) > 1e-12)
    found = []
    level = np.ceil(np.log2(np.maximum(extent, 1))).astype(int)
    for power in np.unique(level[usable]):
        side = 2**power
        dx, dy = (g.ravel() for g in np.meshgrid(np.arange(side), np.arange(side)))
        members = np.flatnonzero(usable & (level == power))
        for chunk in np.array_split(members, -(-members.size * side * side // 4_000_000)):
            px, py = low[chunk, :1] + dx, low[chunk, 1:] + dy
            x, y = px + 0.5 - corners[chunk, 0, :1], py + 0.5 - corners[chunk, 0, 1:]
            e1, e2, a = edge1[chunk, None], edge2[chunk, None], area[chunk, None]
            b1, b2 = (x * e2[..., 1] - y * e2[..., 0]) / a, (y * e1[..., 0] - x * e1[..., 1]) / a
            inside = (b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (px < width) & (py < height)
            row, column = np.nonzero(inside)
            b1, b2 = b1[inside], b2[inside]
            found.append((chunk[row], py[inside] * width + px[inside], np.stack([1 - b1 - b2, b1, b2], 1)))
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
    return tuple(np.concatenate(parts) for parts in zip(*found))


def nearest_triangles(camera: Camera, points: np.ndarray, triangles: np.ndarray) -> tuple:
    """(pixel, triangle, perspective-correct weights) where the body is seen, one row per pixel."""
    screen = camera.project(points)[triangles]
    triangle, pixel, weights = covered_pixels(screen[..., :2], camera.size)
    weights = weights / screen[triangle, :, 2]
    depth = 1 / weights.sum(1)
    order = np.lexsort((depth, pixel))
    first = order[np.diff(pixel[order], prepend=-1) > 0]
    return pixel[first], triangle[first], weights[first] * depth[first, None]


def vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals of the surface's vertices: those of the triangles around, weighted by area."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    out = np.stack([np.bincount(triangles.ravel(), np.repeat(faces[:, d], 3), len(points)) for d in range(3)], 1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)


def to_vertices(mesh, values) -> np.ndarray:
    """One value per vertex: given so, or per tetrahedron and averaged, weighted by volume."""
    values = np.asarray(values, np.float64)
    if values.shape == (mesh.num_vertices,):
        return values
    if values.shape != (mesh.num_tetrahedra,):
        raise ValueError(
            f"values: expected one per vertex ({mesh.num_vertices}) or per tetrahedron ({mesh.num_tetrahedra}), "
            f"got shape {values.shape}"
        )
    corners, weight = mesh.tetrahedra.ravel(), np.repeat(mesh.volumes, 4)
    total = np.bincount(corners, weight, mesh.num_vertices)
    return np.bincount(corners, weight * np.repeat(values, 4), mesh.num_vertices) / np.where(total > 0, total, 1)


def _shade(colour: np.ndarray, normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Light from above the left shoulder, some from the sky, and a faint gloss."""
    diffuse = np.clip(normal @ LIGHT, 0, 1)[:, None]
    sky = 0.5 + 0.5 * normal[:, 1:2]
    half = LIGHT + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    gloss = np.clip((normal * half).sum(1), 0, 1)[:, None] ** 40
    return np.clip(colour * (0.45 + 0.25 * sky + 0.45 * diffuse) + 0.10 * gloss + 0.03, 0, 1)


def _grid_step(length: float) -> float:
    """A round distance [m] of which some eight make `length`."""
    power = 10.0 ** np.floor(np.log10(length / 8))
    return float(power * min((1, 2, 5, 10), key=lambda k: abs(np.log(k * power * 8 / length))))


def _floor_light(points: np.ndarray, triangles: np.ndarray, height: float, at: np.ndarray) -> np.ndarray:
    """How much light reaches floor points `at` (n, 2): the body's shadow, projected along LIGHT and blurred."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    flat = points[:, [0, 2]] - (points[:, 1:2] - height) * LIGHT[[0, 2]] / LIGHT[1]
    low, high = flat[triangles].min((0, 1)), flat[triangles].max((0, 1))
    margin, cells = 0.12 * (high - low).max(), 512
    scale = cells / ((high - low).max() + 2 * margin)
    pixels = covered_pixels((flat[triangles] - low + margin) * scale, (cells, cells))[1]
    mask = np.zeros(cells * cells)
    mask[pixels] = 1
    soft = gaussian_filter(mask.reshape(cells, cells), 6)
    column, row = ((at - low + margin) * scale).T - 0.5
    return 1 - 0.38 * map_coordinates(soft, [row, column], order=1, cval=0.0)


def _background(camera: Camera, box: np.ndarray, points, triangles, ground: float | None) -> np.ndarray:
    """Colours of what lies behind the body, shape (pixels, 3): a floor with a grid that fades away, and the sky."""
    image = HORIZON + (SKY - HORIZON) * np.repeat(np.linspace(1, 0, camera.size[1]), camera.size[0])[:, None]
    if ground is None:
        return image
    rays = camera.rays(np.arange(len(image)))
    hit = np.flatnonzero(rays[:, 1] * (ground - camera.eye[1]) > 0)
    rays = rays[hit]
    along = (ground - camera.eye[1]) / rays[:, 1]
    at = camera.eye[[0, 2]] + along[:, None] * rays[:, [0, 2]]
    size = np.ptp(box, 0).max()
    step = _grid_step(2.0 * size)
    pixel, slant = along / camera.focal, np.abs(rays[:, 1])  # size of a pixel on the floor [m], and how flat it is seen
    off = np.abs((at / step + 0.5) % 1 - 0.5) * step
    width = np.maximum(0.003 * size, pixel / np.sqrt(slant))
    line = np.clip(1.5 - off.min(1) / width, 0, 1) * np.clip(0.35 * step * slant / pixel, 0, 1)
    colour = FLOOR + (LINE - FLOOR) * line[:, None]
    colour *= _floor_light(points, triangles, ground, at)[:, None]
    fade = np.exp(-((at - box.mean(0)[[0, 2]]) ** 2).sum(1) / (3.0 * size) ** 2)[:, None]
    image[hit] += (colour - image[hit]) * fade
    return image


def draw(mesh, positions, values=None, limits=(0.0, 1.0), ground: float | None = None, box=None, size=(1200, 900),
         azimuth: float = 32.0, elevation: float = 14.0, colours: str = "viridis") -> np.ndarray:  # fmt: skip
    """The picture without text, RGB in [0, 1], shape (height, width, 3); arguments as in `save_picture`."""
    points = np.asarray(positions, np.float64)
    if points.shape != (mesh.num_vertices, 3) or not np.all(np.isfinite(points)):
        raise ValueError(f"positions: expected finite numbers of shape ({mesh.num_vertices}, 3), got shape {points.shape}")
    triangles, fit = mesh.surface_triangles, points[mesh.surface_vertices]
    if box is not None:
        fit = np.stack(np.meshgrid(*np.array(box, np.float64).T), -1).reshape(-1, 3)
    box = np.stack([fit.min(0), fit.max(0)])
    camera = Camera.framing(fit, size, azimuth, elevation)
    image = _background(camera, box, points, triangles, ground).reshape(size[1], size[0], 3)
    image = image.repeat(SUPERSAMPLING, 0).repeat(SUPERSAMPLING, 1).reshape(-1, 3)
    camera = Camera.framing(fit, (size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING), azimuth, elevation)
    pixel, triangle, weights = nearest_triangles(camera, points, triangles)
    corners = triangles[triangle]
    normal = np.einsum("pk,pkd->pd", weights, vertex_normals(points, triangles)[corners])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    colour = np.broadcast_to(PLAIN, (pixel.size, 3))
    if values is not None:
        from matplotlib import colormaps

        value = (weights * to_vertices(mesh, values)[corners]).sum(1)
        share = np.clip((value - limits[0]) / max(limits[1] - limits[0], 1e-300), 0, 1)
        colour = colormaps[colours](share)[:, :3]
    image[pixel] = _shade(colour, normal, -camera.rays(pixel))
    small = image.reshape(size[1], SUPERSAMPLING, size[0], SUPERSAMPLING, 3).mean((1, 3))
    return np.clip(small, 0, 1)


def save_picture(path, mesh, positions, values=None, label: str = "", ground: float | None = None, title: str = "",
                 limits=None, **view) -> None:  # fmt: skip
    """Write a PNG of the body's surface at `positions` [m], y upwards.

    values: per tetrahedron (averaged to vertices) or per vertex, shown in colour with a bar named `label`; limits: what
    the colours span, default zero (or the smallest value, if negative) to the 99.5th percentile of the surface.
    ground: height of a floor to draw [m]. view: box to fit, (2, 3) [m], default the body's; size in pixels; azimuth and
    elevation [degrees] of the eye; colours, a matplotlib colour map. Raises ValueError for shapes that do not fit.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    beyond = "neither"
    if values is not None:
        values = to_vertices(mesh, values)
        shown = values[mesh.surface_vertices]
        limits = limits or (min(0.0, float(shown.min())), float(np.percentile(shown, 99.5)))
        limits = limits if limits[1] > limits[0] else (limits[0], limits[0] + 1.0)
        beyond = "max" if shown.max() > limits[1] * (1 + 1e-6) else "neither"
    image = draw(mesh, positions, values, limits, ground, **view)
    height, width = image.shape[:2]
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(image, interpolation="nearest", aspect="auto")
    axes.axis("off")
    text = dict(color="#333333", fontsize=13)
    if values is not None:
        colours = ScalarMappable(Normalize(*limits), view.get("colours", "viridis"))
        bar = figure.colorbar(colours, cax=figure.add_axes((0.925, 0.25, 0.014, 0.5)), extend=beyond)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=11, color="#333333", labelcolor="#333333")
        bar.ax.yaxis.set_ticks_position("left")
        bar.formatter.set_powerlimits((-3, 4))
        figure.text(0.95, 0.795, label, ha="right", **text)
    if title:
        figure.text(0.025, 0.955, title, va="top", **text)
    figure.savefig(path, dpi=100)
