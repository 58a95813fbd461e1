"""Geometry of linear tetrahedra, vectorised, in float64."""

import math

import numpy as np

from diffsim_ti.common.checked import numbers, shown
from diffsim_ti.differentiation.arrays import cross

# Corner a's opposite face, seen from outside of a tetrahedron of positive volume.
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
SIDES = np.array([[0, 1], [1, 2], [2, 0]])  # of a triangle


def sorted_faces(tetrahedra: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(corners of all faces, shape (k, 3), face 4 e + a opposite corner a of e; an order in which faces of the same corners
    follow each other; which of these has the corners of the next, shape (k - 1,))"""
    corners = tetrahedra[:, FACES].reshape(-1, 3)
    a, b, c = np.sort(corners, 1).T
    if num_vertices < 2_000_000:  # three indices fit in one 64-bit key
        key = (a * num_vertices + b) * num_vertices + c
        order = np.argsort(key, kind="stable")
        key = key[order]
        return corners, order, key[1:] == key[:-1]
    order = np.lexsort((c, b, a))
    a, b, c = a[order], b[order], c[order]
    return corners, order, (a[1:] == a[:-1]) & (b[1:] == b[:-1]) & (c[1:] == c[:-1])


def inner_faces(tetrahedra: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """(pairs of tetrahedra that share a face, shape (k, 2), its corners, shape (k, 3))"""
    corners, order, same = sorted_faces(tetrahedra, num_vertices)
    first, second = order[:-1][same], order[1:][same]
    return np.stack([first // 4, second // 4], 1), corners[first]


def edges_of(corners: np.ndarray, ends: np.ndarray = SIDES) -> tuple[np.ndarray, np.ndarray]:
    """(each edge once, the smaller index first, ascending, shape (k, 2); which of them each row of corners has, shape
    (rows, edges)): of triangles, or of what has edges between the corners `ends`."""
    low, high = np.sort(corners[:, ends].reshape(-1, 2), 1).astype(np.int64).T
    count = high.max(initial=0) + 1
    keys, which = np.unique(low * count + high, return_inverse=True)
    return np.stack(np.divmod(keys, count), 1), which.reshape(-1, len(ends))


def squared_edges(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Squared edge lengths, shape (num_tetrahedra, 6) [m^2], edges in the order of EDGES."""
    out = np.empty((len(tetrahedra), 6))
    for column, (a, b) in enumerate(EDGES):
        d = vertices[tetrahedra[:, a]] - vertices[tetrahedra[:, b]]
        out[:, column] = np.einsum("ij,ij->i", d, d)
    return out


def edge_matrices(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """D = [x1 - x0, x2 - x0, x3 - x0] by columns, shape (num_tetrahedra, 3, 3) [m]."""
    return np.moveaxis(vertices[tetrahedra[:, 1:]] - vertices[tetrahedra[:, :1]], 1, 2)


def inverse_edges(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """D^-1 [1/m]; its rows are grad N_1..3."""
    return np.linalg.inv(edge_matrices(vertices, tetrahedra))


def signed_volumes(D: np.ndarray) -> np.ndarray:
    """V = det D / 6 of each edge matrix [m^3], negative where a tetrahedron is turned inside out."""
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = np.moveaxis(D, 0, 2)
    return (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)) / 6


def shape_gradients(inverse_D: np.ndarray) -> np.ndarray:
    """grad N_a [1/m], shape (num_tetrahedra, 4, 3): rows 1..3 are those of D^-1, row 0 is their negative sum."""
    return np.concatenate([-inverse_D.sum(1, keepdims=True), inverse_D], 1)


def triangle_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normals of triangles, as long as the area [m^2], shape (num_triangles, 3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return cross(b - a, c - a) / 2


def barycentric_in_plane(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Where a point of a plane lies in triangles with these corners, shape (k, 3, 2 or more), whose first two coordinates
    count: weights of the corners, shape (k, 3); of triangles without area they are not finite."""
    (a, b), q = (corners[:, k, :2] - corners[:, 0, :2] for k in (1, 2)), point - corners[:, 0, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        u, v = (q[:, 0] * b[:, 1] - q[:, 1] * b[:, 0]) / area, (a[:, 0] * q[:, 1] - a[:, 1] * q[:, 0]) / area
    return np.stack([1 - u - v, u, v], 1)


def nearest_on_triangles(point: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The point nearest to `point` of each triangle, shape (k, 3): its foot where that lies inside, else on an edge."""
    edges = np.roll(triangles, -1, 1) - triangles  # edge a runs from corner a to the next
    squares = np.maximum(np.einsum("kai,kai->ka", edges, edges), 1e-300)  # of triangles that are points, too
    t = np.einsum("kai,kai->ka", point - triangles, edges) / squares
    on_edges = triangles + np.clip(t, 0, 1)[:, :, None] * edges
    nearest = ((on_edges - point) ** 2).sum(2).argmin(1)
    out = on_edges[np.arange(len(triangles)), nearest]
    normal = np.cross(edges[:, 0], edges[:, 1])
    squares = np.maximum(np.einsum("ki,ki->k", normal, normal), 1e-300)
    height = np.einsum("ki,ki->k", point - triangles[:, 0], normal) / squares
    foot = point - height[:, None] * normal
    inward = np.cross(normal[:, None], edges)
    inside = np.all(np.einsum("kai,kai->ka", foot[:, None] - triangles, inward) >= 0, 1) & normal.any(1)
    out[inside] = foot[inside]
    return out


def rotation_matrix(rotation, angle: float | None) -> np.ndarray:
    """The matrix of a turn about the axis `rotation` by angle [rad], or `rotation` itself; ValueError if it is none.

    R = I + sin(angle) K + (1 - cos(angle)) K^2, K the cross product with the unit axis (Rodrigues).
    """
    R = numbers("rotation", rotation)
    if angle is not None:
        axis = three("axis", rotation)
        if not np.linalg.norm(axis) > 0:
            raise ValueError(f"a rotation needs an axis of positive length, got {shown(rotation)}")
        K = np.cross(np.eye(3), axis / np.linalg.norm(axis))
        R = np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-9) or np.linalg.det(R) < 0:
        raise ValueError(f"a rotation is a matrix (3, 3) with det +1, or an axis and an angle; got {shown(rotation)}")
    return R


def three(name: str, given, one_will_do: bool = False) -> np.ndarray:
    """Three finite numbers, or one for all three where `one_will_do`; otherwise ValueError."""
    values = numbers(name, given)
    if not np.all(np.isfinite(values)) or values.shape != (3,) and not (one_will_do and values.shape == ()):
        raise ValueError(f"{name} must be {'one or ' if one_will_do else ''}three finite numbers, got {shown(given)}")
    return np.broadcast_to(values, (3,))


def curve_order(points: np.ndarray) -> np.ndarray:
    """Indices of points, shape (n, 3), in the order of Morton's curve through their bounding box."""
    lowest, size = points.min(0), float(np.ptp(points, axis=0).max()) or 1.0
    cells = ((points - lowest) * (2**20 / size)).astype(np.int64).clip(0, 2**20 - 1)
    masks = 0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249
    for shift, mask in zip((32, 16, 8, 4, 2), masks):
        cells = (cells | (cells << shift)) & mask
    return np.argsort(cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2), kind="stable")
