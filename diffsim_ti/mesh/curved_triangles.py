"""Triangles of the surface that are parts of curved faces: points on them by the six nodes of the face.

A point of a triangle, whose shares of its corners are s, lies at

    x = sum_a s_a x_a + sum_(a < b) s_a s_b (y - (p + q) / 2)

exactly on the quadratic face; y: the middle, p and q: the ends of the face's edge that is parallel to side ab. Each of the
four triangles of a face has its corners first among six nodes, and the others in an order for which the weights of three of
the triangles are the same functions of s, and the fourth's, the inner one's, others (obstacle_functions.py).
"""

import numpy as np

from diffsim_ti.mesh.face_points import bow

SIX = np.array([[0, 3, 5, 1, 4, 2], [1, 4, 3, 2, 5, 0], [2, 5, 4, 0, 3, 1], [3, 4, 5, 0, 2, 1]])
# (end, middle, end) of the edges that are parallel to their sides, of the three triangles and of the inner one
EDGES = ((0, 1, 3), (0, 2, 5), (3, 4, 5)), ((3, 2, 4), (3, 0, 5), (5, 1, 4))
STRAIGHT = 1e-5  # of its length: what an edge may be off that is straight, in files of single precision too
NOTABLE = (
    0.02  # of a barrier's width: how far curved faces lie from their triangles before contact takes it into account
)


def nodes_of_triangles(mesh) -> np.ndarray:
    """Of each row of `surface_triangles` of ten-node tetrahedra the six nodes of its face, shape (k, 6)."""
    return mesh.surface_faces[:, SIX].reshape(-1, 6)


def arches(mesh) -> np.ndarray:
    """How far points of each triangle lie from the flat one at most [m], at rest."""
    out = np.zeros((len(mesh.surface_faces), 4))
    for k, row in enumerate(SIX):
        x = mesh.vertices[mesh.surface_faces[:, row]]
        for p, y, q in EDGES[k // 3]:
            out[:, k] = np.maximum(out[:, k], np.linalg.norm(x[:, y] - (x[:, p] + x[:, q]) / 2, axis=1))
    return out.ravel() / 3


def curved_faces(mesh) -> np.ndarray:
    """Whether a face of ten-node tetrahedra has an edge that is not straight, Booleans, shape (len(surface_faces),)."""
    x = mesh.vertices[mesh.surface_faces]
    off = np.linalg.norm(x[:, 3:] - (x[:, :3] + np.roll(x[:, :3], -1, 1)) / 2, axis=2).max(1, initial=0)
    longest = np.linalg.norm(x[:, :3] - np.roll(x[:, :3], -1, 1), axis=2).max(1, initial=0)
    return off > STRAIGHT * longest


def are_treated_as_curved(mesh, terms, bend: float = 0.0) -> bool:
    """Whether contact takes into account that faces are curved at rest or bend by `bend` [m]: else it takes the
    triangles, flat as they are."""
    widths = [float(t.values["barrier_width"]) for t in terms if "barrier_width" in t.values]
    return mesh.order == 2 and bool(widths) and max(bow(mesh), bend) > NOTABLE * min(widths)
