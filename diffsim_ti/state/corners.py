"""Corners: places in one array for what tetrahedra, contacts, springs and loads do at vertices, which these gather."""

import numpy as np
import taichi as ti

from diffsim_ti import runtime


def vertex_corners(elements: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Compressed rows: the corners c = nodes e + a that meet at vertex i are corner_of[start[i] : start[i + 1]]."""
    corner_of = np.argsort(elements.ravel(), kind="stable")
    counts = np.bincount(elements.ravel(), minlength=num_vertices)
    return np.concatenate([[0], np.cumsum(counts)]), corner_of


def with_own_corner(start: np.ndarray, corner_of: np.ndarray, vertices: np.ndarray, first: int) -> tuple:
    """The same rows with one corner more, first + k, at the end of that of vertices[k]."""
    longer = np.insert(corner_of, start[vertices + 1], first + np.arange(len(vertices)))
    return start + np.searchsorted(vertices, np.arange(len(start))), longer


def with_more_corners(start: np.ndarray, corner_of: np.ndarray, vertices: np.ndarray, first: int) -> tuple:
    """The same rows with corners more, first + k, at the end of those of vertices[k], which may repeat."""
    order = np.argsort(vertices, kind="stable")
    longer = np.insert(corner_of, start[vertices[order] + 1], first + order)
    return start + np.searchsorted(vertices[order], np.arange(len(start))), longer


def slots(indices: np.ndarray, num_vertices: int) -> np.ndarray:
    """Place of each vertex in a list of vertices, -1 where it is not listed."""
    out = np.full(num_vertices, -1)
    out[indices] = np.arange(len(indices))
    return out


@runtime.untaped
@runtime.kernel
def _clear_from(corner: ti.types.ndarray(ndim=1), first: ti.i32):
    for c in range(corner.shape[0] - first):  # Vulkan takes no outermost loop from a variable on
        corner[first + c] = 0 * corner[first + c]


def clear_from(corner, first: int) -> None:
    """corner[first:] = 0; on the CPU without the cost of a launch."""
    host = runtime.view(corner)
    if host is None:
        _clear_from(corner, first)
    else:
        host[first:] = 0
