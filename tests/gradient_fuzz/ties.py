"""Springs, cables and foundations."""

import numpy as np

import diffsim_ti as ds

from .loads import over_time, some_faces
from .structures import CELL


def tie(kind: str, rng, mesh, steps: int, duration: float, mass: np.ndarray, beat: float):
    """One of structures.TIES; what pulls does so with some times the weight of a vertex, what is stiff beats slower than
    `beat` [s]."""
    name, how = kind.split(" ", 1)
    stiff, pull = rng.uniform(0.005, 0.02) * mass.min() / beat**2, 9.81 * mass.mean() * rng.uniform(1, 10)
    if name == "ElasticFoundation":
        some = some_faces(rng, mesh)
        each = stiff / CELL**2 * rng.uniform(0.2, 1.0, (2, len(mesh.faces_of(some))))
        return ds.ElasticFoundation(each[0] if how == "each" else each[0, 0], each[1, 0], some)
    places = [_point(rng, mesh) for _ in range(int(rng.integers(2, 5)))]
    if name == "Spring":
        ends = mesh.vertices.mean(0) + CELL * rng.normal(size=(2, 3))
        others = ds.Anchor(ends) if how == "anchored" else int(rng.integers(0, mesh.num_vertices))
        few = np.stack([_inside(rng, mesh), _inside(rng, mesh)])
        at_rest = np.linalg.norm(few - (ends if how == "anchored" else mesh.vertices[others]), axis=1)
        given = [{}, dict(tension=pull * rng.normal(size=2)), dict(rest_length=at_rest * rng.uniform(0.98, 1.02, 2))]
        return ds.Spring(few, others, stiff * rng.uniform(0.3, 1.0, 2), **given[rng.integers(0, 3)])
    places.insert(1, ds.Anchor(mesh.vertices.mean(0) + 2 * CELL * rng.normal(size=3)))
    what, when = how.split(" ", 1)
    change = over_time(rng, steps, duration, when)
    if what == "tension":
        return ds.Cable(places, tension=change(pull))
    at_rest = [p.position if isinstance(p, ds.Anchor) else mesh.vertices[p] if np.ndim(p) == 0 else p for p in places]
    length = np.linalg.norm(np.diff(at_rest, axis=0), axis=1).sum()
    slack = rng.random() < 0.2
    return ds.Cable(places, length=change((3.0 if slack else 0.6) * length), stiffness=pull / length)


def _inside(rng, mesh) -> np.ndarray:
    corners = mesh.vertices[mesh.tetrahedra[rng.integers(0, mesh.num_tetrahedra)]]
    return rng.dirichlet(np.full(4, 3.0)) @ corners


def _point(rng, mesh):
    return _inside(rng, mesh) if rng.random() < 0.7 else int(rng.integers(0, mesh.num_vertices))
