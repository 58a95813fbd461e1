"""What is drawn of a term or of a result besides surfaces: arrows, lines and points in space, at one moment of a run.

They say what and where; how large arrows are, their colours and the key are the picture's matter (visual/glyphs.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import Public, public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.geometry import triangle_normals

MOST = 60  # arrows that are drawn of one load, spread evenly


@dataclass(frozen=True, repr=False)
class Moment:
    """What a term is drawn at: positions [m], shape (num_vertices, 3); time [s]; values: {plain name of an input of the
    term: its value now}, of what is given over time the one of that moment, without the axis of time."""

    mesh: TetrahedralMesh
    positions: np.ndarray
    time: float
    values: Mapping[str, np.ndarray]

    __repr__ = brief_fields


@dataclass(frozen=True, repr=False)
class Arrows(metaclass=Public):
    """Arrows at points [m], shape (k, 3), of vectors of a unit, (k, 3). Those of one label have one scale in a picture,
    whose longest is named in its key. onto: which end at their point, as what pushes, (k,) of bool; others begin there.
    through: whether they are seen through bodies, as forces between two must be."""

    label: str
    points: np.ndarray
    vectors: np.ndarray
    onto: np.ndarray
    through: bool = False

    __repr__ = brief_fields


@dataclass(frozen=True, repr=False)
class Lines(metaclass=Public):
    """Straight lines, such as springs: their two ends [m], shape (k, 2, 3)."""

    label: str
    ends: np.ndarray

    __repr__ = brief_fields


@dataclass(frozen=True, repr=False)
class Points(metaclass=Public):
    """Discs at points [m], shape (k, 3)."""

    label: str
    points: np.ndarray

    __repr__ = brief_fields


Mark = Arrows | Lines | Points


@public
def arrows(
    label: str, mesh: TetrahedralMesh, positions: np.ndarray, vertices: ArrayLike, vectors: np.ndarray, most: int = MOST
) -> Arrows:
    """Arrows at vertices of a body, whose positions are in [m], at most so many, outside it: what points into the
    body ends at its vertex.

    vectors: shape (3,), or (k, 3) of each vertex; those below a thousandth of the largest are left out.
    """
    vertices = np.asarray(vertices)
    vectors = np.broadcast_to(vectors, (len(vertices), 3))
    sizes = np.linalg.norm(vectors, axis=1)
    some = np.flatnonzero(sizes > 1e-3 * sizes.max(initial=0.0))
    some = some[spread(mesh.vertices[vertices[some]], most)]
    vertices, vectors = vertices[some], vectors[some]
    into = (vectors * vertex_normals(mesh, positions)[vertices]).sum(1) < 0
    return Arrows(label, positions[vertices], vectors, into)


def pressing(label: str, moment: Moment, triangles: np.ndarray, pressure: float) -> list[Arrows]:
    """Arrows of a pressure [Pa] on triangles, against their normals if it is positive; none where it is zero."""
    if pressure == 0:
        return []
    triangles = triangles[spread(moment.mesh.vertices[triangles].mean(1), MOST)]
    n = triangle_normals(moment.positions, triangles)
    vectors = -pressure * n / np.linalg.norm(n, axis=1, keepdims=True)
    return [Arrows(label, moment.positions[triangles].mean(1), vectors, np.full(len(n), pressure > 0))]


def vertex_normals(mesh: TetrahedralMesh, positions: np.ndarray) -> np.ndarray:
    """Area vectors [m^2] of the surface around each vertex, a third of each triangle's, shape (num_vertices, 3)."""
    out, normals = np.zeros((mesh.num_vertices, 3)), triangle_normals(positions, mesh.surface_triangles)
    for k in range(3):
        np.add.at(out, mesh.surface_triangles[:, k], normals / 3)
    return out


def spread(points: np.ndarray, most: int) -> np.ndarray:
    """Indices of at most so many of the points, far from each other: each next is the one farthest from all before."""
    if len(points) <= most:
        return np.arange(len(points))
    chosen = [int(np.argmin(points.sum(1)))]
    away = np.full(len(points), np.inf)
    while len(chosen) < most:
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(np.argmax(away)))
    return np.sort(chosen)
