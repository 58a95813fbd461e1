"""Loads on surfaces and volumes, and supports by component."""

import numpy as np

import diffsim_ti as ds

from .structures import CELL


def load(kind: str, rng, mesh, steps: int, duration: float, mass: float):
    """One of structures.LOADS; together the loads are some times the weight of the body."""
    name, how = kind.split(" ", 1)
    shape = () if name == "Pressure" else (3,)
    area = len(mesh.surface_triangles) * CELL**2 / 2
    size = 30 * mass / (mesh.volumes.sum() if name == "BodyForce" else area)

    def amount(*leading):
        return size * rng.standard_normal((*leading, *shape))

    if how == "constant":
        given = amount()
    elif how == "per step":
        given = amount(steps)
    elif rng.random() < 0.5:
        given = duration * np.array([0.0, rng.uniform(0.2, 0.8), 1.0]), amount(3)
    else:
        a, b = amount(), amount()
        given = lambda t: a + b * np.sin(3 * t / duration)  # noqa: E731
    if name == "BodyForce":
        some = np.sort(rng.permutation(mesh.num_tetrahedra)[: rng.integers(1, mesh.num_tetrahedra + 1)])
        per = "mass" if rng.random() < 0.5 else "volume"
        given = _scaled(given, 1e-3) if per == "mass" else given
        return ds.BodyForce(given, None if rng.random() < 0.3 else some, per)
    some = None if rng.random() < 0.3 else some_faces(rng, mesh)
    return (ds.Traction if name == "Traction" else ds.Pressure)(given, some)


def some_faces(rng, mesh) -> np.ndarray:
    """Rows of `surface_triangles` of whole faces."""
    each = 4 if mesh.order == 2 else 1
    count = len(mesh.surface_triangles) // each
    chosen = np.sort(rng.permutation(count)[: rng.integers(1, count + 1)])
    return (each * chosen[:, None] + np.arange(each)).ravel()


def over_time(rng, steps: int, duration: float, how: str):
    """size -> a positive number about that size, over time as `how` says."""

    def made(size: float):
        if how == "constant":
            return size
        if how == "per step":
            return size * rng.uniform(0.9, 1.1, steps)
        if rng.random() < 0.5:
            return duration * np.array([0.0, rng.uniform(0.2, 0.8), 1.0]), size * rng.uniform(0.9, 1.1, 3)
        return lambda t: size * (1 + 0.1 * np.sin(3 * t / duration))

    return made


def _scaled(given, share: float):
    if callable(given):
        return lambda t: share * given(t)
    return (given[0], share * given[1]) if isinstance(given, tuple) else share * given


def rollers(rng, mesh, fixed) -> tuple:
    """(mesh with a set for each of the vertices, how each is held)."""
    sets = {f"held_{k}": [vertex] for k, vertex in enumerate(fixed)}
    ways = ("x", "yz", "xyz", "askew", "two askew")
    picked = [ways[k] for k in rng.integers(0, len(ways), len(sets))]
    picked[0] = ways[[0, 1, 3, 4][rng.integers(0, 4)]]  # one at least in some directions alone
    directions = {"askew": 1, "two askew": 2}
    held = [rng.standard_normal((directions[way], 3)) if way in directions else way for way in picked]
    for name, own in sets.items():
        mesh = mesh.with_vertex_set(name, own)
    return mesh, dict(zip(sets, held))
