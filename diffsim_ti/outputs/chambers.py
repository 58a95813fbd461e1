"""The pressure in a chamber, and how much a surface of the body encloses."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import wholes
from diffsim_ti.differentiation.arrays import value_of, with_slopes
from diffsim_ti.mechanics.chambers.pressures import law_of, rows_of
from diffsim_ti.mesh.enclosure import Enclosure, open_edges
from diffsim_ti.outputs.output import Frames, Output, derived
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Chamber


class ChamberPressure(Output):
    """Pressure [Pa] of a chamber on the body, shape (frames,): of a gas p - p_out, of an incompressible fluid the
    multiplier of its volume.

    chamber: its name, or the term as the scene lists it. name: how a loss calls it.

    That of a gas is at the frame's positions, its amount that of the step that ends there. That of a `FilledChamber` is of
    the last substep before the frame, and 0 in the first one.
    The gradient is exact by all inputs.

    Raises ValueError for a chamber that the scene has not.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 8.5.2,
    doi:10.1017/CBO9780511755446.
    """

    reads_chamber_pressures, _shown = True, ("chamber",)

    def __init__(self, chamber: Chamber | str, name: str = "chamber_pressure"):
        self.chamber, self.name = chamber, name

    def settled(self, scene: Scene) -> "ChamberPressure":
        out = copy(self)
        chambers = scene.terms_of(Chamber)
        out.place, out.scene = scene.place_among(chambers, self.chamber, "chamber"), scene
        chamber = chambers[out.place]
        out.law, out.enclosure, (out.rows,) = law_of(chamber), chamber.enclosure, rows_of(scene, [chamber])
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,)

    def value(self, frames: Frames) -> np.ndarray:
        if self.law.holds:
            return frames.chamber_pressures[:, self.place].copy()
        follower, out = derived(self.scene, frames).follower, []
        for step, x in zip(map(int, frames.steps), frames.positions):
            row, end = min(max(step - 1, 0), len(follower) - 1), 1 if step else 0  # of its step, which a frame shows
            numbers, volume = follower[row, self.rows, end], self.enclosure.recorded(x)
            self.law.at(value_of(numbers), 1.0)
            V = value_of(volume)
            slopes = (volume, lambda: self.law.slope(V)), (numbers, lambda: self.law.by_numbers(V))
            out.append(with_slopes(self.law.pressure(V), *slopes))
        return np.stack(out)


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
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
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
        return -np.stack([self.enclosure.recorded(x) for x in frames.positions])
