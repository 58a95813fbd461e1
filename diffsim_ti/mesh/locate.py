"""Which tetrahedron a point lies in, and where in it: a sparse map from vertices to points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh.geometry import FACES, nearest_on_triangles
from diffsim_ti.mesh.jacobian import barycentric_in, nearest_on_face, reach
from diffsim_ti.mesh.reference_face import functions
from diffsim_ti.mesh.sets import places_of_triangles
from diffsim_ti.mesh.ten_nodes import FACE_NODES, QUARTERS

TOLERANCE = 1e-9  # how far below zero a barycentric coordinate may fall to round-off


@dataclass(frozen=True)
class LocatedPoints:
    """Points [m] of a mesh, the tetrahedron that each lies in, and the shape functions of its vertices there.

    points (k, 3); tetrahedra (k,); vertices (k, 4 or 10), those of the element; weights (k, 4 or 10), which sum to one: with
    four nodes the barycentric coordinates.
    """

    points: np.ndarray
    tetrahedra: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray
    num_vertices: int

    @cached_property
    def matrix(self):
        """SciPy CSR matrix (k, num_vertices): `matrix @ values` interpolates what vertices have, as the elements do."""
        from scipy.sparse import csr_matrix

        k, width = self.weights.shape
        rows = np.repeat(np.arange(k), width)
        return csr_matrix((self.weights.ravel(), (rows, self.vertices.ravel())), shape=(k, self.num_vertices))


def locate(mesh, points, nearest: bool = False) -> LocatedPoints:
    """See TetrahedralMesh.locate."""
    points = numbers("points [m]", points)
    if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise ValueError(f"points: expected finite numbers of shape (k, 3) [m], got shape {points.shape}")
    tetrahedra, L = _containing(mesh, points)
    outside = np.nonzero(tetrahedra < 0)[0]
    if outside.size:
        places, near, coordinates = _nearest(mesh, points[outside])
        away = np.linalg.norm(places - points[outside], axis=1)
        if not nearest:
            worst = int(away.argmax())
            raise ValueError(
                f"{outside.size} of {len(points)} points lie outside the mesh: point {outside[worst]} at "
                f"({', '.join(f'{x:.6g}' for x in points[outside[worst]])}) by {away[worst]:.3g} m, next to tetrahedron "
                f"{near[worst]}; move them, or take mesh.locate(points, nearest=True).points, the nearest of the body"
            )
        points = points.copy()
        points[outside], tetrahedra[outside], L[outside] = places, near, coordinates
    weights = L if mesh.order == 1 else mesh.reference.functions(L[:, 1:])
    return LocatedPoints(points, tetrahedra, mesh.elements[tetrahedra], weights, mesh.num_vertices)


def _containing(mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tetrahedron that each point lies deepest in, -1 outside, and barycentric coordinates there."""
    from scipy.spatial import cKDTree

    corners = mesh.vertices[mesh.tetrahedra]
    centres = corners.mean(1)
    sizes = np.linalg.norm(corners - centres[:, None], axis=2).max(1)
    bent, gradients = mesh.curved, mesh.shape_gradients
    if bent.any():
        sizes[bent] = reach(mesh.vertices[mesh.elements[bent]], centres[bent])
    found, weights = np.full(len(points), -1), np.zeros((len(points), 4))
    # the trees of tetrahedra of one size each, so that a few large ones do not make all of the small ones candidates
    classes = np.floor(np.log2(sizes / sizes.min())).astype(int)
    deepest = np.full(len(points), -np.inf)
    for size in np.unique(classes):
        members = np.nonzero(classes == size)[0]
        radius = sizes[members].max() * (1 + 1e-9)
        tree = cKDTree(centres[members])
        candidates = [members[np.sort(near).astype(int)] for near in tree.query_ball_point(points, radius)]
        in_curved = _in_curved(mesh, candidates, points) if bent[members].any() else None
        for k, e in enumerate(candidates):
            if len(e):
                N = 0.25 + np.einsum("eai,ei->ea", gradients[e], points[k] - centres[e])
                if in_curved is not None:
                    N[bent[e]] = in_curved[k]
                best = int(N.min(1).argmax())
                if N[best].min() > max(deepest[k], -TOLERANCE):
                    deepest[k], found[k], weights[k] = N[best].min(), e[best], N[best]
    return found, weights


def _in_curved(mesh, candidates: list[np.ndarray], points: np.ndarray) -> list[np.ndarray]:
    """L of each point in the curved elements among its candidates, -infinity in those whose map does not reach it."""
    candidates = [e[mesh.curved[e]] for e in candidates]
    counts = [len(e) for e in candidates]
    flat = np.concatenate(candidates)
    L = barycentric_in(mesh.vertices[mesh.elements[flat]], np.repeat(points, counts, 0))
    return np.split(np.where(np.isnan(L), -np.inf, L), np.cumsum(counts)[:-1])


def _nearest(mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest points of the surface, the tetrahedra behind them, and barycentric coordinates there."""
    faces = mesh.tetrahedra[:, FACES].reshape(-1, 3)
    owner = places_of_triangles(mesh.surface_faces[:, :3], faces)
    if mesh.order == 2:
        return _nearest_on_faces(mesh, points, owner)
    owner = owner // 4
    triangles = mesh.vertices[mesh.surface_triangles]
    places, near = np.empty_like(points), np.empty(len(points), np.int64)
    for k, point in enumerate(points):
        on = nearest_on_triangles(point, triangles)
        best = int(((on - point) ** 2).sum(1).argmin())
        places[k], near[k] = on[best], owner[best]
    X = mesh.vertices[mesh.tetrahedra[near]]
    gradients = mesh.shape_gradients[near]
    return places, near, 0.25 + np.einsum("eai,ei->ea", gradients, places - X.mean(1))


def _nearest_on_faces(mesh, points: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_nearest` on faces of six nodes, of which `owner` says the place 4 e + a: the face opposite corner a of element e.

    Faces are tried that may be nearer than the nearest of the flat triangles, each by the sag of its edges.
    """
    faces, triangles = mesh.vertices[mesh.surface_faces], mesh.vertices[mesh.surface_triangles]
    a, b = faces[:, :3], np.roll(faces[:, :3], -1, 1)
    sag = np.linalg.norm(faces[:, 3:] - (a + b) / 2, axis=2).sum(1)  # how far a face may lie off its triangles
    at = np.array([[0.0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])[QUARTERS]  # (s, t) of their corners
    places, near, L = np.empty_like(points), np.empty(len(points), np.int64), np.zeros((len(points), 4))
    for k, point in enumerate(points):
        on = nearest_on_triangles(point, triangles)
        flat = np.linalg.norm(on - point, axis=1).reshape(-1, 4)
        least = np.inf
        for f in np.nonzero(flat.min(1) - sag <= (flat.min(1) + sag).min())[0]:
            row = 4 * f + int(flat[f].argmin())
            x, st = triangles[row], at[row % 4]
            T = np.stack([x[1] - x[0], x[2] - x[0]], 1)
            s = st[0] + np.linalg.lstsq(T, on[row] - x[0], rcond=None)[0] @ (st[1:] - st[0])
            if sag[f] > 0:
                s = nearest_on_face(point, faces[f], np.clip(s, 0, 1))
            place = functions(s[None])[0] @ faces[f]
            if np.linalg.norm(place - point) < least:
                least, places[k], (near[k], side) = np.linalg.norm(place - point), place, divmod(owner[f], 4)
                L[k] = 0.0
                L[k, FACE_NODES[side, :3]] = 1 - s.sum(), *s
    return places, near, L
