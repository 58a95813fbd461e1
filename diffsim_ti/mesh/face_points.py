"""Integrals over faces of three or of six nodes: points with normals, and what each of the nodes has of a point."""

from functools import lru_cache

import numpy as np

from diffsim_ti.common.rotations import skew
from diffsim_ti.differentiation.arrays import cross
from diffsim_ti.mesh import reference_face
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.mesh.ten_nodes import QUARTERS

STRAIGHT = 1e-5  # of its length: what an edge may be off that is straight, in files of single precision too


class LinearFaces:
    """Triangles: one point each, of which each corner has a third; exact for what is constant on them."""

    points, shares = 1, np.full((1, 3), 1 / 3)  # of the integrals over a face, of each point for each node

    def __init__(self, faces: np.ndarray):
        self.faces = faces

    def normals(self, x: np.ndarray) -> np.ndarray:
        """Normals of the points, as long as their areas [m^2], shape (faces * points, 3)."""
        return triangle_normals(x, self.faces)

    def normals_by_nodes(self, x: np.ndarray) -> np.ndarray:
        """Derivative of each normal by the nodes of its face, shape (faces, points, nodes, 3, 3)."""
        corners = x[self.faces]
        return skew(np.roll(corners, -2, 1) - np.roll(corners, -1, 1))[:, None] / 2

    def to_nodes(self, of_points: np.ndarray) -> np.ndarray:
        """Integrals of the shape functions times what points have (times their areas), shape (faces, nodes, ...)."""
        return np.repeat((of_points / 3)[:, None], 3, 1)


class QuadraticFaces:
    """Faces of six nodes: six points each, exact for pressures that follow, and for tractions where edges are straight."""

    points = len(reference_face.WEIGHTS)

    def __init__(self, faces: np.ndarray):
        self.faces = faces
        self.shares = reference_face.functions(reference_face.POINTS)
        self._by = reference_face.derivatives(reference_face.POINTS)

    def _tangents(self, x):
        """(dx/ds, dx/dt), shape (faces, points, 3)."""
        return np.einsum("qad,fai->dfqi", self._by, x[self.faces], optimize=True)

    def _half(self, products):
        """Weighted with half the points' shares, all points one after the other."""
        return (products * (reference_face.WEIGHTS / 2)[:, None]).reshape(-1, 3)

    def normals(self, x):
        return self._half(cross(*self._tangents(x)))

    def normals_by_nodes(self, x):
        e, f = (skew(t * (reference_face.WEIGHTS / 2)[:, None])[:, :, None] for t in self._tangents(x))
        by_s, by_t = self._by[None, ..., 0, None, None], self._by[None, ..., 1, None, None]
        return e * by_t - f * by_s

    def to_nodes(self, of_points):
        by_face = of_points.reshape(len(self.faces), self.points, *of_points.shape[1:])
        return np.einsum("qa,fq...->fa...", self.shares, by_face, optimize=True)


def face_points(faces: np.ndarray) -> LinearFaces | QuadraticFaces:
    """Of faces of three or six nodes, shape (k, 3) or (k, 6)."""
    return QuadraticFaces(faces) if faces.shape[1] == 6 else LinearFaces(faces)


def curved_faces(mesh) -> np.ndarray:
    """Whether a face of ten-node tetrahedra has an edge that is not straight, Booleans, shape (len(surface_faces),)."""
    x = mesh.vertices[mesh.surface_faces]
    off = np.linalg.norm(x[:, 3:] - (x[:, :3] + np.roll(x[:, :3], -1, 1)) / 2, axis=2).max(1, initial=0)
    longest = np.linalg.norm(x[:, :3] - np.roll(x[:, :3], -1, 1), axis=2).max(1, initial=0)
    return off > STRAIGHT * longest


def bow(mesh) -> float:
    """How far curved faces of a mesh lie from the four triangles that stand for each in contact, at most [m]."""
    return float(bows(mesh.vertices[mesh.surface_faces]).max(initial=0.0)) if mesh.order == 2 else 0.0


def bows(nodes: np.ndarray) -> np.ndarray:
    """The same of each face, from its nodes, shape (k, 6, 3): at the middles of the triangles' sides and at their own."""
    of_curved, flat = _places_of_bow()
    return np.linalg.norm(np.einsum("ka,fai->fki", of_curved - flat, nodes), axis=2).max(1, initial=0.0)


def points_of_bow(nodes: np.ndarray) -> np.ndarray:
    """Where `bows` looks, on the curved faces and on the triangles, shape (2, k, 15, 3)."""
    return np.einsum("ska,fai->sfki", _places_of_bow(), nodes)


@lru_cache(maxsize=None)
def _places_of_bow() -> tuple[np.ndarray, np.ndarray]:
    """Shares of the nodes, of points of the curved face and of the triangles, shape (15, 6)."""
    corners = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])[QUARTERS]
    at = np.concatenate([corners.mean(1), (0.5 * (corners + np.roll(corners, 1, 1))).reshape(-1, 2)])
    flat = np.zeros((4, 3, 6))  # the same places of the triangles: shares of the nodes
    np.put_along_axis(flat, QUARTERS[:, :, None], 1.0, 2)
    flat = np.concatenate([flat.mean(1), (0.5 * (flat + np.roll(flat, 1, 1))).reshape(-1, 6)])
    return reference_face.functions(at), flat
