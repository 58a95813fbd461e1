"""Where points of the body are, in space and in a camera's picture, and where its centre of mass is."""

from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.inputs import Derived
from diffsim_ti.mesh.geometry import barycentric_in_plane, inverse_edges, shape_gradients
from diffsim_ti.mesh.jacobian import barycentric_in
from diffsim_ti.outputs.deformation import followed
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene

if TYPE_CHECKING:
    from diffsim_ti.visual.camera import Camera


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
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> top = ds.MaterialPoints([[0.5, 1.0, 0.5]], name="top")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[top]).forward()
    >>> frames["top"][:, 0, 1].round(4).tolist()
    [1.0, 0.9614]
    """

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
            by_xi = self.element.derivatives(xi := followed(X, self.located, self.xi))
            return by_xi @ np.linalg.inv(np.einsum("pai,pak->pik", X[nodes], by_xi)), self.element.functions(xi)
        B = inverse_edges(X, nodes)
        inner = np.einsum("pij,pj->pi", B, self.points - X[nodes[:, 0]])
        return shape_gradients(B), np.concatenate([1 - inner.sum(1, keepdims=True), inner], 1)

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


class CenterOfMass(Output):
    """Centre of mass [m] in each frame, shape (frames, 3):

        x = sum_i m_i x_i / sum_i m_i

    m_i: the lumped mass of a vertex; of ten-node tetrahedra in implicit steps the sum of its row of the consistent mass, so
    that x is the integral of rho x over the body, divided by that of rho.

    of: whose centre, by a vertex set's name, indices, a mask or a list of names; of a joined mesh a body's name; None: all.
    name: how a loss calls it.
    The gradient is exact by all inputs. Raises ValueError for an unknown set, and for one without mass.
    Goldstein, Poole, Safko, Classical Mechanics, 3rd ed., 2002, sec. 1.2.

    >>> import diffsim_ti as ds
    >>> cube = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> mesh = ds.TetrahedralMesh.joined({"ball": cube, "left": cube.translated((2, 0, 0))})
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3))
    >>> simulator.output(ds.CenterOfMass("left")).round(6).tolist()
    [2.5, 0.5, 0.5]
    """

    unit = "m"

    def __init__(self, of: str | ArrayLike | None = None, name: str = "center_of_mass"):
        self.of, self.name = of, name

    def __repr__(self) -> str:
        return f"CenterOfMass({self.of!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "CenterOfMass":
        out, mesh = copy(self), scene.mesh
        out.scene = scene
        out.vertices = np.arange(mesh.num_vertices) if self.of is None else mesh.vertex_indices(self.of)
        if not out._masses(scene.inputs.derive(scene.inputs.values), out.vertices).sum() > 0:
            raise ValueError(f"{self!r}: the set has no mass; name one that has vertices of tetrahedra")
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 3

    def _masses(self, derived: Derived, vertices: np.ndarray) -> np.ndarray:
        """m_i of some vertices [kg], or their change."""
        mass = derived.mass
        if derived.element_masses is not None:
            mass = np.zeros(len(derived.rest))
            np.add.at(mass, self.scene.mesh.elements, derived.element_masses.sum(2))
        return mass[vertices]

    def _read(self, frames: Frames) -> tuple[Derived, float, np.ndarray, np.ndarray, np.ndarray]:
        """(what kernels read, m [kg], shares m_i / m, positions x_i [m], x)."""
        derived = self.scene.inputs.derive(frames.inputs)
        own, x = self._masses(derived, self.vertices), frames.positions[:, self.vertices].astype(np.float64)
        share = own / own.sum()
        return derived, own.sum(), share, x, np.einsum("i,fij->fj", share, x)

    def value(self, frames: Frames) -> np.ndarray:
        return self._read(frames)[-1]

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        _, mass, share, x, center = self._read(frames)
        dm = self._masses(self.scene.inputs.derive_jvp(frames.inputs, change.inputs), self.vertices)
        out = np.einsum("i,fij->fj", dm / mass, x - center[:, None])
        moved = change.positions
        return out if moved is None else out + np.einsum("i,fij->fj", share, moved[:, self.vertices])

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        derived, mass, share, x, center = self._read(frames)
        positions, adjoint, by_mass = np.zeros(frames.positions.shape), derived.zeros(), np.zeros(len(derived.rest))
        positions[:, self.vertices] = share[:, None] * seed[:, None]
        by_mass[self.vertices] = np.einsum("fj,fij->i", seed, x - center[:, None]) / mass
        if derived.element_masses is None:
            adjoint.mass = by_mass
        else:
            adjoint.element_masses += by_mass[self.scene.mesh.elements][:, :, None]
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(positions=positions, inputs=inputs)


class PixelTracks(Output):
    """(column, row) of points of the body in a camera's picture [pixels], shape (frames, num_points, 2):

        (c_x + f_x a . r / d, c_y - f_y a . u / d),    a = x - position,    d = -a . b

    x: `MaterialPoints(points)`; r, u, b: the camera's axes (right, up, backwards), f and c: its focal lengths and principal
    point. Columns and rows count from the corner of the picture, so that the first pixel's centre is (0.5, 0.5).
    camera: `picture.Camera`, at rest; size: width and height of its picture [pixels]. points, nearest: as of
    `MaterialPoints`. name: how a loss calls them.

    A point has a place in the picture also where something hides it: `visible(frames)` says where not. In `identify` a
    sample that is missing is NaN. The gradient is exact by positions and rest_positions.
    Raises ValueError as `MaterialPoints` does, and FloatingPointError for a point that is not in front of the camera.
    Hartley, Zisserman, Multiple View Geometry, 2nd ed., 2004, sec. 6.1, doi:10.1017/CBO9780511811685.
    """

    unit = "pixels"

    def __init__(
        self,
        camera: "Camera",
        points: ArrayLike,
        size: tuple[int, int] = (640, 480),
        name: str = "pixel_tracks",
        nearest: bool = False,
    ):
        self.camera, self.size, self.name = camera, (int(size[0]), int(size[1])), name
        self._given = MaterialPoints(points, name, nearest)

    def __repr__(self) -> str:
        return f"PixelTracks({len(self._given.points)} points, {self.size}, name={self.name!r})"

    def settled(self, scene: Scene) -> "PixelTracks":
        out = copy(self)
        out.points, out.triangles = self._given.settled(scene), scene.mesh.surface_triangles
        out.length = float(np.ptp(scene.mesh.bounding_box, 0).max())
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, len(self.points.points), 2

    def _jacobian(self, x: np.ndarray) -> np.ndarray:
        """d(column, row) / dx, shape (..., 2, 3)."""
        axes, focal = self.camera.axes, self.camera.focal_lengths(self.size)
        a = (x - self.camera.position) @ axes.T
        depth = -a[..., 2:]
        by_a = np.zeros((*x.shape[:-1], 2, 3))
        by_a[..., 0, 0] = by_a[..., 1, 1] = 1
        by_a[..., 2] = a[..., :2] / depth
        return (np.array([focal[0], -focal[1]])[:, None] * by_a / depth[..., None]) @ axes

    def value(self, frames: Frames) -> np.ndarray:
        x = self.points.value(frames)
        depth = -(x - self.camera.position) @ self.camera.axes[2]
        if not np.all(depth > 0):
            frame, k = np.argwhere(~(depth > 0))[0]
            raise FloatingPointError(
                f"{self!r}: in frame {frame} point {k} is {-depth[frame, k]:.3g} m behind the camera; move it back"
            )
        return self.camera.project(x, self.size)[..., :2]

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        x = self.points.value(frames)
        return np.einsum("fpij,fpj->fpi", self._jacobian(x), self.points.jvp(frames, change))

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        x = self.points.value(frames)
        return self.points.vjp(frames, np.einsum("fpij,fpi->fpj", self._jacobian(x), seed))

    def visible(self, frames: Frames, within: float = 1e-3) -> np.ndarray:
        """Which points lie within the picture and are not hidden by the body, bool (frames, num_points).

        within: how deep under the surface a marker may lie and still be seen, as a share of the body's length.
        """
        if not hasattr(self, "points"):
            raise ValueError(f"{self!r}: it has no scene yet; take frames.computed[{self.name!r}].visible(frames)")
        x, out = self.points.value(frames), np.zeros(self.shape(len(frames.positions))[:2], bool)
        for k in range(len(x)):
            seen = self.camera.project(x[k], self.size)
            inside = np.all((seen[:, :2] >= 0) & (seen[:, :2] <= self.size), 1)
            body = frames.positions[k].astype(np.float64)
            ahead = ((body - self.camera.position) @ self.camera.axes[2] < 0)[self.triangles].all(1)
            triangles = self.camera.project(body, self.size)[self.triangles[ahead]]
            out[k] = inside & (_nearest_depth(triangles, seen[:, :2]) > seen[:, 2] - within * self.length)
        return out


def _nearest_depth(triangles: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Depth [m] of the nearest triangle, of corners (column, row, depth), at each place; infinite for none."""
    out = np.full(len(places), np.inf)
    for k, place in enumerate(places):
        w = barycentric_in_plane(place, triangles)
        hit = np.flatnonzero((w > -1e-9).all(1))
        if len(hit):
            out[k] = (1 / (w[hit] / triangles[hit, :, 2]).sum(1)).min()  # 1 / depth is linear over the picture
    return out
