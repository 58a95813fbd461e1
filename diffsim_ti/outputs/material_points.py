"""Positions of points of the body, such as markers that a camera follows."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh.geometry import inverse_edges, shape_gradients
from diffsim_ti.mesh.inverse_map import barycentric_in, solved
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene


class MaterialPoints(Output):
    """Positions [m] of points that are named by where they lie in the rest shape; shape (frames, num_points, 3).

    A point X of the tetrahedron with vertices X_a moves as these do, with its shape functions N_a(X), which are barycentric
    coordinates of four nodes:

        x = sum_a N_a(X) x_a = X + sum_a N_a(X) u_a,        sum_a N_a(X) X_a = X

    points: X [m], shape (num_points, 3), inside the mesh; nearest: take the body's nearest points to those outside.
    name: how a loss calls them, for several in one rollout.

    The gradient by rest_positions is that of X held where it is in space: dx/dX_a = -N_a F, besides what moves the x_a.
    The tetrahedron stays that of the mesh, also where rest_positions carry its faces past the point.
    Raises ValueError for points outside, naming one and how far out it is, and for shapes that do not fit.
    Zienkiewicz, Taylor, The Finite Element Method, vol. 1, 5th ed., 2000, sec. 8.6, on volume coordinates.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> top = ds.MaterialPoints([[0.5, 1.0, 0.5]], name="top")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[top]).forward()
    >>> frames["top"][:, 0, 1].round(4).tolist()
    [1.0, 0.9614]
    """

    linear = True

    def __init__(self, points: ArrayLike, name: str = "material_points", nearest: bool = False):
        self.points, self.name, self.nearest = numbers("MaterialPoints: points", points), name, bool(nearest)

    def __repr__(self) -> str:
        return f"MaterialPoints({len(self.points)} points, name={self.name!r})"

    def settled(self, scene: Scene) -> "MaterialPoints":
        out = copy(self)
        out.located = scene.mesh.locate(self.points, nearest=self.nearest)
        out.points, out.element = out.located.points, scene.mesh.reference
        if out.element.order == 2:
            out.xi = barycentric_in(scene.mesh.vertices[out.located.vertices], out.points)[:, 1:]
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, len(self.points), 3

    def _weights(self, frames) -> tuple[np.ndarray, np.ndarray]:
        """(grad N, shape (num_points, nodes, 3), N, shape (num_points, nodes)) at the points, in the rest shape."""
        X, nodes = frames.inputs["rest_positions"], self.located.vertices
        if self.element.order == 2:
            return self._quadratic_weights(X[nodes])
        B = inverse_edges(X, nodes)
        inner = np.einsum("pij,pj->pi", B, self.points - X[nodes[:, 0]])
        return shape_gradients(B), np.concatenate([1 - inner.sum(1, keepdims=True), inner], 1)

    def _quadratic_weights(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the map of ten nodes at X, shape (num_points, 10, 3), reaches the points."""
        xi, found = solved(X, self.points, self.xi)
        if not found.all():
            k = int(np.argmin(found))
            raise ValueError(
                f"MaterialPoints: rest_positions carry tetrahedron {self.located.tetrahedra[k]} so far from point {k} at "
                f"{self.points[k].tolist()} that it cannot be followed; take a smaller step in the rest shape"
            )
        by_xi = self.element.derivatives(xi)
        return by_xi @ np.linalg.inv(np.einsum("pai,pak->pik", X, by_xi)), self.element.functions(xi)

    def _deformation(self, frames, gradients: np.ndarray) -> np.ndarray:
        """F at the points, shape (frames, num_points, 3, 3)."""
        u = frames.displacements[:, self.located.vertices].astype(np.float64)
        return np.eye(3) + np.einsum("fpai,paj->fpij", u, gradients)

    def value(self, frames: Frames) -> np.ndarray:
        u = frames.displacements[:, self.located.vertices].astype(np.float64)
        return self.points + np.einsum("pa,fpai->fpi", self._weights(frames)[1], u)

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        gradients, N = self._weights(frames)
        out = np.zeros(self.shape(len(frames.positions)))
        if change.positions is not None:
            out += np.einsum("pa,fpai->fpi", N, change.positions[:, self.located.vertices])
        if "rest_positions" in change.inputs:
            moved = np.einsum("pa,pai->pi", N, change.inputs["rest_positions"][self.located.vertices])
            out -= np.einsum("fpij,pj->fpi", self._deformation(frames, gradients), moved)
        return out

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        gradients, N = self._weights(frames)
        positions, rest = np.zeros(frames.positions.shape), np.zeros(frames.positions.shape[1:])
        for frame, s in zip(positions, seed):
            np.add.at(frame, self.located.vertices, N[:, :, None] * s[:, None])
        pulled = np.einsum("fpij,fpi->pj", self._deformation(frames, gradients), seed)
        np.add.at(rest, self.located.vertices, -N[:, :, None] * pulled[:, None])
        return Change(positions=positions, inputs={"rest_positions": rest})
