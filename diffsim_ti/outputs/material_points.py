"""Positions of points of the body, such as markers that a camera follows."""

from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh.geometry import inverse_edges
from diffsim_ti.outputs.output import Change, Output

if TYPE_CHECKING:
    from diffsim_ti.rollout.frames import Frames
    from diffsim_ti.scene import Scene


class MaterialPoints(Output):
    """Positions [m] of points that are named by where they lie in the rest shape; shape (frames, num_points, 3).

    A point X of the tetrahedron with corners X_a moves as its corners do, with barycentric coordinates N_a(X):

        x = sum_a N_a(X) x_a = X + sum_a N_a(X) u_a,        sum_a N_a(X) X_a = X

    points: X [m], shape (num_points, 3), inside the mesh; nearest: take the body's nearest points to those outside.
    name: how a loss calls them, for several in one rollout.

    The gradient by rest_positions is that of X held where it is in space: dx/dX_a = -N_a F, besides what moves the x_a.
    The tetrahedron stays that of the mesh, also where rest_positions carry its faces past the point.
    Raises ValueError for points outside, naming one and how far out it is, and for shapes that do not fit.
    Zienkiewicz, Taylor, The Finite Element Method, vol. 1, 5th ed., 2000, sec. 8.6, on volume coordinates.
    """

    def __init__(self, points: ArrayLike, name: str = "material_points", nearest: bool = False):
        self.points, self.name, self.nearest = np.array(points, np.float64), name, bool(nearest)

    def __repr__(self) -> str:
        return f"MaterialPoints({len(self.points)} points, name={self.name!r})"

    def settled(self, scene: "Scene") -> "MaterialPoints":
        out = copy(self)
        out.located = scene.mesh.locate(self.points, nearest=self.nearest)
        out.points = out.located.points
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, len(self.points), 3

    def _weights(self, frames) -> tuple[np.ndarray, np.ndarray]:
        """(B, N): edge matrices inverted, shape (num_points, 3, 3), and coordinates, (num_points, 4), at the rest shape."""
        X, corners = frames.inputs["rest_positions"], self.located.vertices
        B = inverse_edges(X, corners)
        inner = np.einsum("pij,pj->pi", B, self.points - X[corners[:, 0]])
        return B, np.concatenate([1 - inner.sum(1, keepdims=True), inner], 1)

    def _deformation(self, frames, B: np.ndarray) -> np.ndarray:
        """F at the points, shape (frames, num_points, 3, 3)."""
        u = frames.displacements[:, self.located.vertices].astype(np.float64)
        return np.eye(3) + np.einsum("fpai,paj->fpij", u[:, :, 1:] - u[:, :, :1], B)

    def value(self, frames: "Frames") -> np.ndarray:
        u = frames.displacements[:, self.located.vertices].astype(np.float64)
        return self.points + np.einsum("pa,fpai->fpi", self._weights(frames)[1], u)

    def jvp(self, frames: "Frames", change: Change) -> np.ndarray:
        B, N = self._weights(frames)
        out = np.zeros(self.shape(len(frames.positions)))
        if change.positions is not None:
            out += np.einsum("pa,fpai->fpi", N, change.positions[:, self.located.vertices])
        if "rest_positions" in change.inputs:
            moved = np.einsum("pa,pai->pi", N, change.inputs["rest_positions"][self.located.vertices])
            out -= np.einsum("fpij,pj->fpi", self._deformation(frames, B), moved)
        return out

    def vjp(self, frames: "Frames", seed: np.ndarray) -> Change:
        B, N = self._weights(frames)
        positions, rest = np.zeros(frames.positions.shape), np.zeros(frames.positions.shape[1:])
        for frame, s in zip(positions, seed):
            np.add.at(frame, self.located.vertices, N[:, :, None] * s[:, None])
        pulled = np.einsum("fpij,fpi->pj", self._deformation(frames, B), seed)
        np.add.at(rest, self.located.vertices, -N[:, :, None] * pulled[:, None])
        return Change(positions=positions, inputs={"rest_positions": rest})
