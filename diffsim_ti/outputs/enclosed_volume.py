"""How much a surface of the body encloses."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import wholes
from diffsim_ti.mesh.enclosure import Enclosure, open_edges
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene


class EnclosedVolume(Output):
    """Volume [m^3] within a closed surface of the body, shape (frames,), positive where its normals point outwards.

        V = 1/6 sum over triangles of a . (b x c),        a, b, c the corners, counted from the first vertex

    and with ten-node tetrahedra what curved faces enclose (mesh/enclosure.py).

    triangles: vertex indices, shape (k, 3), or (k, 6) of whole faces with ten-node tetrahedra (`mesh.surface_faces`), of a
        surface that is closed and turned one way, such as that of a cavity, whose normals then point into the body and V is
        negative unless they are turned; None: the body's whole surface, so that V is the volume of the body itself.
    name: how a loss calls it.
    Raises ValueError for a surface with an open edge, or one whose triangles are not turned one way.
    Mirtich 1996, Fast and accurate computation of polyhedral mass properties, doi:10.1080/10867651.1996.10487458.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[ds.EnclosedVolume()]).forward()
    >>> frames["volume"].round(4).tolist()  # before and under its weight
    [1.0, 0.9691]
    """

    def __init__(self, triangles: ArrayLike | None = None, name: str = "volume"):
        self.triangles, self.name = None if triangles is None else wholes("EnclosedVolume: triangles", triangles), name
        if self.triangles is not None and (self.triangles.ndim != 2 or self.triangles.shape[1] not in (3, 6)):
            raise ValueError(f"EnclosedVolume: triangles must have shape (k, 3) or (k, 6), got {self.triangles.shape}")

    def settled(self, scene: Scene) -> "EnclosedVolume":
        out, n = copy(self), scene.mesh.num_vertices
        faces = scene.mesh.surface_faces if self.triangles is None else self.triangles
        if faces.size == 0 or faces.min() < 0 or faces.max() >= n:
            raise ValueError(f"EnclosedVolume: triangles must name vertices 0 .. {n - 1}")
        if faces.shape[1] != scene.mesh.surface_faces.shape[1]:
            raise ValueError(
                f"EnclosedVolume: faces of this mesh have {scene.mesh.surface_faces.shape[1]} vertices, got "
                f"{faces.shape[1]}: take whole faces, as mesh.surface_faces and mesh.faces_of(...) give them; columns "
                "[0, 2, 1, 5, 4, 3] turn one of six round"
            )
        out.enclosure, rim = Enclosure(faces, [], None), open_edges(faces[:, :3], n)
        if len(rim):
            raise ValueError(
                f"EnclosedVolume: the surface is open, or turned two ways, at the edge of vertices {rim[0].min()} and "
                f"{rim[0].max()}: each edge must belong to two triangles, once in each direction"
            )
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,)

    def value(self, frames: Frames) -> np.ndarray:
        return np.array([-self.enclosure.volume(x) for x in frames.positions.astype(np.float64)])

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        if change.positions is None:
            return np.zeros(len(frames.positions))
        by = self.vjp(frames, np.ones(len(frames.positions))).positions
        return (by * change.positions).sum((1, 2))

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        gradients = [-s * self.enclosure.gradient(x) for s, x in zip(seed, frames.positions.astype(np.float64))]
        return Change(positions=np.stack(gradients))  # a closed surface: where it counts from adds nothing
