"""What a depth camera measures of a frame: distances, what is seen in each pixel, and points in space."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.public import Public
from diffsim_ti.visual.camera import NEAREST, Camera
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.painters import nearest


@dataclass(eq=False, repr=False)
class DepthImage(metaclass=Public):
    """A picture of distances.

    depth: along the camera's axis [m], shape (height, width), infinite where nothing is seen. segments: which of `names` is
    seen, -1 for none. points: place [m] of what is seen in each pixel that sees something, shape (k, 3), row by row.
    """

    depth: np.ndarray
    segments: np.ndarray
    points: np.ndarray
    names: list[str]

    def __repr__(self) -> str:
        height, width = self.depth.shape
        return f"DepthImage({width} x {height}, {len(self.points)} points of {', '.join(self.names)})"

    @classmethod
    def of(
        cls,
        camera: Camera,
        setting: Setting,
        frame: Frame,
        size: tuple[int, int] = (640, 480),
        bodies: Sequence[str] = (),
    ) -> "DepthImage":
        """What a camera sees of a frame at the centres of its pixels: the body's surface, obstacles, and the floor.

        bodies: vertex sets of the mesh that are told apart, such as "body_0" and "body_1" of a joined mesh; what is in none
        of them is "body". Triangles with a corner behind the camera are not seen.
        Raises ValueError for a set that there is not.
        """
        mesh, names = setting.mesh, [*bodies, "body"]
        of_vertex = np.full(mesh.num_vertices, len(bodies))
        for k in reversed(range(len(bodies))):
            of_vertex[mesh.vertex_indices(bodies[k])] = k
        shapes = [(np.asarray(frame.positions, np.float64), mesh.surface_triangles)]
        obstacles = [points for points, _ in setting.obstacles] if frame.obstacles is None else frame.obstacles
        shapes += [(np.asarray(x, np.float64), own) for x, (_, own) in zip(obstacles, setting.obstacles)]
        labels = [of_vertex[mesh.surface_triangles].min(1)]
        for k, (_, own) in enumerate(setting.obstacles):
            labels.append(np.full(len(own), len(names)))
            names.append(f"obstacle {k + 1}")
        corners = np.concatenate([camera.project(x, size)[own] for x, own in shapes])
        depth, segments = _nearest(corners, np.concatenate(labels), size)
        rows, columns = np.indices(depth.shape)
        rays = camera.rays(columns.ravel() + 0.5, rows.ravel() + 0.5, size).reshape(*depth.shape, 3)
        ahead = -rays @ camera.axes[2]
        if setting.ground is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                floor = (setting.ground - camera.position[1]) / rays[..., 1] * ahead
            nearer = (floor > NEAREST) & (floor < depth)
            depth, segments = np.where(nearer, floor, depth), np.where(nearer, len(names), segments)
            names.append("floor")
        seen = np.isfinite(depth)
        points = camera.position + rays[seen] * (depth[seen] / ahead[seen])[:, None]
        return cls(depth, segments, points, names)


def _nearest(corners: np.ndarray, labels: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(depth, label) of the nearest of triangles with corners (column, row, depth) at each pixel's centre."""
    width, height = size
    ahead = corners[..., 2].min(1) > NEAREST
    corners, labels = corners[ahead], labels[ahead]
    pixel, triangle, nearness = nearest(corners[..., :2], 1 / corners[..., 2:], size)
    depth, found = np.full(width * height, np.inf), np.full(width * height, -1)
    depth[pixel], found[pixel] = 1 / nearness, labels[triangle]
    return depth.reshape(height, width), found.reshape(height, width)
