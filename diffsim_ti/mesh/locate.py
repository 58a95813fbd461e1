"""Which tetrahedron a point lies in, and where in it: a sparse map from vertices to points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim_ti.mesh.geometry import FACES

TOLERANCE = 1e-9  # how far below zero a barycentric coordinate may fall to round-off


@dataclass(frozen=True)
class LocatedPoints:
    """Points [m] of a mesh, the tetrahedron that each lies in, and its barycentric coordinates there.

    points (k, 3); tetrahedra (k,); vertices (k, 4), the corners; weights (k, 4), which sum to one.
    """

    points: np.ndarray
    tetrahedra: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray
    num_vertices: int

    @cached_property
    def matrix(self):
        """SciPy CSR matrix (k, num_vertices): `matrix @ values` interpolates what vertices have, linearly."""
        from scipy.sparse import csr_matrix

        k = len(self.points)
        rows = np.repeat(np.arange(k), 4)
        return csr_matrix((self.weights.ravel(), (rows, self.vertices.ravel())), shape=(k, self.num_vertices))


def locate(mesh, points, nearest: bool = False) -> LocatedPoints:
    """See TetrahedralMesh.locate."""
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise ValueError(f"points: expected finite numbers of shape (k, 3) [m], got shape {points.shape}")
    tetrahedra, weights = _containing(mesh, points)
    outside = np.nonzero(tetrahedra < 0)[0]
    if outside.size:
        places, near, coordinates = _nearest(mesh, points[outside])
        away = np.linalg.norm(places - points[outside], axis=1)
        if not nearest:
            worst = int(away.argmax())
            raise ValueError(
                f"{outside.size} of {len(points)} points lie outside the mesh: point {outside[worst]} at "
                f"({', '.join(f'{x:.6g}' for x in points[outside[worst]])}) by {away[worst]:.3g} m, next to tetrahedron "
                f"{near[worst]}; move them, or pass nearest=True for the nearest points of the body"
            )
        points = points.copy()
        points[outside], tetrahedra[outside], weights[outside] = places, near, coordinates
    return LocatedPoints(points, tetrahedra, mesh.tetrahedra[tetrahedra], weights, mesh.num_vertices)


def _containing(mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tetrahedron that each point lies deepest in, -1 outside, and barycentric coordinates there."""
    from scipy.spatial import cKDTree

    corners = mesh.vertices[mesh.tetrahedra]
    centres = corners.mean(1)
    reach = np.linalg.norm(corners - centres[:, None], axis=2).max(1)
    gradients = mesh.shape_gradients
    found, weights = np.full(len(points), -1), np.zeros((len(points), 4))
    # the trees of tetrahedra of one size each, so that a few large ones do not make all of the small ones candidates
    classes = np.floor(np.log2(reach / reach.min())).astype(int)
    deepest = np.full(len(points), -np.inf)
    for size in np.unique(classes):
        members = np.nonzero(classes == size)[0]
        radius = reach[members].max() * (1 + 1e-9)
        for k, near in enumerate(cKDTree(centres[members]).query_ball_point(points, radius)):
            if near:
                e = members[np.sort(near)]
                N = 0.25 + np.einsum("eai,ei->ea", gradients[e], points[k] - centres[e])
                best = int(N.min(1).argmax())
                if N[best].min() > max(deepest[k], -TOLERANCE):
                    deepest[k], found[k], weights[k] = N[best].min(), e[best], N[best]
    return found, weights


def _nearest(mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest points of the surface, the tetrahedra behind them, and barycentric coordinates there."""
    faces = mesh.tetrahedra[:, FACES].reshape(-1, 3)
    keys = {tuple(face): k for k, face in enumerate(np.sort(faces, 1).tolist())}
    owner = np.array([keys[tuple(face)] // 4 for face in np.sort(mesh.surface_triangles, 1).tolist()])
    triangles = mesh.vertices[mesh.surface_triangles]
    places, near = np.empty_like(points), np.empty(len(points), np.int64)
    for k, point in enumerate(points):
        on = nearest_on_triangles(point, triangles)
        best = int(((on - point) ** 2).sum(1).argmin())
        places[k], near[k] = on[best], owner[best]
    X = mesh.vertices[mesh.tetrahedra[near]]
    gradients = mesh.shape_gradients[near]
    return places, near, 0.25 + np.einsum("eai,ei->ea", gradients, places - X.mean(1))


def nearest_on_triangles(point: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The point nearest to `point` of each triangle, shape (k, 3): its foot where that lies inside, else on an edge."""
    edges = np.roll(triangles, -1, 1) - triangles  # edge a runs from corner a to the next
    t = np.einsum("kai,kai->ka", point - triangles, edges) / np.einsum("kai,kai->ka", edges, edges)
    on_edges = triangles + np.clip(t, 0, 1)[:, :, None] * edges
    nearest = ((on_edges - point) ** 2).sum(2).argmin(1)
    out = on_edges[np.arange(len(triangles)), nearest]
    normal = np.cross(edges[:, 0], edges[:, 1])
    height = np.einsum("ki,ki->k", point - triangles[:, 0], normal) / np.einsum("ki,ki->k", normal, normal)
    foot = point - height[:, None] * normal
    inward = np.cross(normal[:, None], edges)
    inside = np.all(np.einsum("kai,kai->ka", foot[:, None] - triangles, inward) >= 0, 1)
    out[inside] = foot[inside]
    return out
