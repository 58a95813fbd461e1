"""Where points of the body are, in space and in a camera's picture, and where its centre of mass is."""

from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.differentiation.arrays import summed_at, value_of
from diffsim_ti.inputs import Derived
from diffsim_ti.mesh.geometry import barycentric_in_plane, inverse_edges
from diffsim_ti.mesh.jacobian import barycentric_in
from diffsim_ti.outputs.deformation import followed
from diffsim_ti.outputs.output import Frames, Output, derived
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

    def value(self, frames: Frames) -> np.ndarray:
        u = frames.displacements[:, self.located.vertices].astype(np.float64)
        return self.points + np.einsum("pa,fpai->fpi", self._shares(frames.inputs["rest_positions"]), u)

    def _shares(self, X: np.ndarray) -> np.ndarray:
        """N at the points in rest positions X, shape (num_points, nodes)."""
        if self.element.order == 2:
            return self.element.functions(followed(X, self.located, self.xi))
        nodes = self.located.vertices
        inner = np.einsum("pij,pj->pi", inverse_edges(X, nodes), self.points - X[nodes[:, 0]])
        return np.concatenate([1 - inner.sum(1, keepdims=True), inner], 1)


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

    unit, _shown = "m", ("of",)

    def __init__(self, of: str | ArrayLike | None = None, name: str = "center_of_mass"):
        self.of, self.name = of, name

    def settled(self, scene: Scene) -> "CenterOfMass":
        out, mesh = copy(self), scene.mesh
        out.scene = scene
        out.vertices = np.arange(mesh.num_vertices) if self.of is None else mesh.vertex_indices(self.of)
        if not out._masses(scene.inputs.derive(scene.inputs.values)).sum() > 0:
            raise ValueError(f"{self!r}: the set has no mass; name one that has vertices of tetrahedra")
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 3

    def _masses(self, of: Derived) -> np.ndarray:
        """m_i [kg]."""
        if of.element_masses is None:
            return of.mass[self.vertices]
        elements = self.scene.mesh.elements
        return summed_at(elements, of.element_masses.sum(2), len(of.rest))[self.vertices]

    def value(self, frames: Frames) -> np.ndarray:
        own = self._masses(derived(self.scene, frames))
        return np.einsum("i,fij->fj", own / own.sum(), frames.positions[:, self.vertices].astype(np.float64))


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

    def value(self, frames: Frames) -> np.ndarray:
        x = self.points.value(frames)
        depth = -(value_of(x) - self.camera.position) @ self.camera.axes[2]
        if not np.all(depth > 0):
            frame, k = np.argwhere(~(depth > 0))[0]
            raise FloatingPointError(
                f"{self!r}: in frame {frame} point {k} is {-depth[frame, k]:.3g} m behind the camera; move it back"
            )
        return self.camera.project(x, self.size)[..., :2]

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
