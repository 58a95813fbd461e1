"""Tetrahedra of ten nodes as arrays: their faces and their mid-edge vertices."""

import numpy as np

from diffsim_ti.mesh.geometry import FACES, edges_of
from diffsim_ti.mesh.reference_element import MID_EDGES

_MIDDLE = {frozenset(ends): 4 + k for k, ends in enumerate(MID_EDGES.tolist())}


def _row(corners) -> list[int]:
    """Corners, and the middles from each to the next."""
    a, b, c = corners
    return [a, b, c, _MIDDLE[frozenset((a, b))], _MIDDLE[frozenset((b, c))], _MIDDLE[frozenset((c, a))]]


FACE_NODES = np.array([_row(corners) for corners in FACES.tolist()])  # of each face: corners, middles of 01, 12, 20
MIRRORED = np.array([0, 1, 3, 2, 4, 8, 7, 6, 5, 9])  # corners 2 and 3 swapped
QUARTERS = np.array([[0, 3, 5], [1, 4, 3], [2, 5, 4], [3, 4, 5]])  # triangles of a face, turned as it is


def triangles_of(faces: np.ndarray) -> np.ndarray:
    """Triangles of whole faces, shape (4 k, 3): three at the corners, then the one between; of three nodes, as they are."""
    return faces[:, QUARTERS].reshape(-1, 3) if faces.shape[1] == 6 else faces


def middles_of(elements: np.ndarray) -> np.ndarray:
    """Rows (mid-edge vertex, its two ends), one for each edge, shape (k, 3); none with four nodes.

    ValueError where an edge has two mid-edge vertices, a mid-edge vertex two edges, or a corner is one.
    """
    if elements.shape[1] == 4:
        return np.zeros((0, 3), np.int64)
    edges, place = edges_of(elements[:, :4], MID_EDGES)
    place, middles = place.ravel(), elements[:, 4:].ravel()
    _, first = np.unique(place, return_index=True)
    out = middles[first]
    other = np.nonzero(middles != out[place])[0]
    remedy = "order the last six columns by the edges 01, 12, 20, 03, 13, 23 of the corners, and merge equal vertices"
    if len(other):
        k = other[0]
        i, j = edges[place[k]]
        raise ValueError(
            f"an edge has one vertex at its middle: the edge of vertices {i} and {j} has {out[place[k]]} in tetrahedron "
            f"{first[place[k]] // 6} and {middles[k]} in tetrahedron {k // 6}; {remedy}"
        )
    used, count = np.unique(out, return_counts=True)
    if np.any(count > 1):
        twice = used[np.argmax(count)]
        i, j = edges[np.nonzero(out == twice)[0][:2]]
        raise ValueError(
            f"a mid-edge vertex belongs to one edge: vertex {twice} stands on those of vertices {i.tolist()} and "
            f"{j.tolist()}; {remedy}"
        )
    both = np.intersect1d(used, elements[:, :4])
    if len(both):
        raise ValueError(f"a vertex is a corner or stands on an edge: vertex {both[0]} does both; {remedy}")
    return np.concatenate([out[:, None], edges], 1)
