"""Named sets of vertices, of tetrahedra and of surface triangles: their numbers, checked, joined, renumbered."""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.common.checked import shape_of


def frozen(array: np.ndarray) -> np.ndarray:
    """The array itself, read-only from now on."""
    array.flags.writeable = False
    return array


def checked_sets(sets: dict | None, count: int, what: str) -> dict[str, np.ndarray]:
    """name -> sorted read-only indices; ValueError for a name that is no name and for indices that do not fit."""
    out = {}
    for name, rows in (sets or {}).items():
        if not isinstance(name, str) or not name or '"' in name or "\n" in name:
            raise ValueError(f"a {what} set needs a name without quotes and line breaks, got {name!r}")
        out[name] = frozen(indices_of(rows, count, f"{what} set {name!r}"))
    return out


def chosen_indices(chosen, sets: dict, count: int, what: str) -> np.ndarray:
    """Sorted indices from a set's name, several names, indices, or a Boolean mask; ValueError for an unknown name, and for a
    set that is empty."""
    names = [chosen] if isinstance(chosen, str) else chosen
    if isinstance(names, (list, tuple)) and names and all(isinstance(name, str) for name in names):
        for name in names:
            if name not in sets:
                raise ValueError(f"no {what} set is called {name!r}; there are: {', '.join(sets) or 'none'}")
            if not len(sets[name]):
                full = ", ".join(other for other, rows in sets.items() if len(rows)) or "none"
                raise ValueError(
                    f"the {what} set {name!r} is empty, so that nothing would be chosen by it; sets that are not: {full}"
                )
        return np.unique(np.concatenate([sets[name] for name in names]))
    return indices_of(chosen, count, what)


def array_of(what: str, chosen) -> np.ndarray:
    """What indices are given as, as an array; ValueError where it is none."""
    shape_of(what, chosen)
    if getattr(chosen, "requires_grad", False):
        raise ValueError(
            f"{what}: indices must be integers, got a tensor with a graph; give whole numbers, such as [0, 3]"
        )
    return np.asarray(chosen)


def indices_of(chosen, count: int, what: str) -> np.ndarray:
    """Sorted unique int64 indices from indices or a Boolean mask of length count; ValueError if they do not fit."""
    chosen = array_of(what, chosen)
    if chosen.dtype.kind == "b":
        if chosen.shape != (count,):
            raise ValueError(f"{what}: a mask must have shape ({count},), got {chosen.shape}")
        return np.nonzero(chosen)[0]
    if chosen.size == 0:
        return np.zeros(0, np.int64)
    if chosen.dtype.kind not in "iu":
        raise ValueError(
            f"{what}: indices must be integers, got dtype {chosen.dtype}; give whole numbers, such as [0, 3]"
        )
    chosen = np.unique(chosen).astype(np.int64)
    if chosen[0] < 0 or chosen[-1] >= count:
        bad = chosen[0] if chosen[0] < 0 else chosen[-1]
        raise ValueError(f"{what}: indices must lie in 0..{count - 1}, got {bad}; indices count from 0")
    return chosen


def join_sets(parts: list[dict], firsts: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Sets of several bodies as sets of all, and each body's members by its name, those of a set that others have too as
    "<body>_<name>"; those of body k begin at firsts[k]."""
    merged = _merged([{name: rows + first for name, rows in sets.items()} for sets, first in zip(parts, firsts)], names)
    for name in names:
        if name in merged:
            few = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
            raise ValueError(f"joined names the bodies {few}, but a mesh has a set {name!r}: rename it")
    return {name: np.arange(firsts[k], firsts[k + 1]) for k, name in enumerate(names)} | merged


def _merged(parts: list[dict], names: Sequence[str]) -> dict[str, np.ndarray]:
    """The sets of all bodies by name, and of a name that several have also each body's part of it."""
    out = {}
    for name in dict.fromkeys(name for sets in parts for name in sets):
        own = {body: sets[name] for body, sets in zip(names, parts) if name in sets}
        out |= {part_of(name, body): rows for body, rows in own.items()} if len(own) > 1 else {}
        out[name] = np.concatenate([*own.values()])
    return out


def part_of(name: str, body: str) -> str:
    """The name of what one body has of a set whose name several bodies of a joined mesh have."""
    return f"{body}_{name}"


def parts_of_joined(mesh, name: str) -> list[str]:
    """The names of the parts of a vertex set that several bodies had before they were joined; empty for others."""
    sets, bodies = mesh.vertex_sets, mesh.tetrahedron_sets
    parts = [part for body in bodies if body in sets and (part := part_of(name, body)) in sets]
    return parts if name in sets and sum(len(sets[part]) for part in parts) == len(sets[name]) else []


def places_of_triangles(triangles: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The row of `among` that has the same three vertices, -1 where there is none."""
    if not len(triangles) or not len(among):
        return np.full(len(triangles), -1)
    both = np.sort(np.concatenate([among, triangles]), 1)
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    at = first[inverse.ravel()[len(among) :]]
    return np.where(at < len(among), at, -1)


def rows_of(triangles: np.ndarray, surface: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rows of the surface that triangles are, four for one that has the corners of a face of six nodes; which are none)."""
    rows = places_of_triangles(triangles, surface)
    if faces.shape[1] == 3:
        return rows[rows >= 0], rows < 0
    whole = places_of_triangles(triangles, faces[:, :3])
    four = (4 * whole[whole >= 0, None] + np.arange(4)).ravel()
    return np.concatenate([rows[rows >= 0], four]), (rows < 0) & (whole < 0)


def rows_on_surface(sets: dict | None, surface: np.ndarray, faces: np.ndarray) -> dict[str, np.ndarray]:
    """name -> rows of the surface, from triangles as vertex indices; those within the body are left out, and sets that are
    left with none.

    faces: whole faces of the surface; the corners of one of six nodes (with its middles or without) stand for four rows.
    """
    out = {}
    for name, triangles in (sets or {}).items():
        triangles = np.asarray(triangles)
        if triangles.ndim != 2 or triangles.shape[1] not in (3, faces.shape[1]) or triangles.dtype.kind not in "iu":
            raise ValueError(
                f"surface set {name!r}: triangles must be vertex indices of shape (k, 3), got shape {triangles.shape}"
            )
        rows, _ = rows_of(triangles[:, :3], surface, faces)
        if len(rows) or not len(triangles):
            out[name] = rows
    return out


def join(meshes: list, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, dict]:
    """(vertices, elements, sets by arguments of TetrahedralMesh) of several bodies, one after the other."""
    orders = [mesh.order for mesh in meshes]
    if len(set(orders)) > 1:
        k = orders.index(3 - orders[0])
        raise ValueError(
            f"meshes to be joined must be of one order: mesh 0 is of order {orders[0]}, mesh {k} of order {orders[k]}; call "
            ".quadratic() on those of order 1, or .linear() on the others"
        )
    firsts = np.cumsum([0, *(mesh.num_vertices for mesh in meshes)])
    first_tets = np.cumsum([0, *(mesh.num_tetrahedra for mesh in meshes)])
    triangles = [
        {body: mesh.surface_triangles + first}
        | {name: mesh.surface_triangles[rows] + first for name, rows in mesh.surface_sets.items()}
        for body, mesh, first in zip(names, meshes, firsts)
    ]
    sets = dict(
        vertex_sets=join_sets([mesh.vertex_sets for mesh in meshes], firsts, names),
        tetrahedron_sets=join_sets([mesh.tetrahedron_sets for mesh in meshes], first_tets, names),
        surface_sets=_merged(triangles, names),
    )
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return vertices, np.concatenate([mesh.elements + first for mesh, first in zip(meshes, firsts)]), sets


def values_of_sets(name: str, numbers: dict, mesh, shape: tuple = ()) -> np.ndarray:
    """One value per tetrahedron, of `shape`, from {tetrahedron set: value}; "default" serves those in none of the sets.

    Raises ValueError for an unknown set, sets that overlap, and tetrahedra left out.
    """
    value = np.full((mesh.num_tetrahedra, *shape), np.asarray(numbers.get("default", np.nan), np.float64))
    owner = np.zeros(mesh.num_tetrahedra, np.int64)  # 1 + number of the set that a tetrahedron took its value from
    names = [key for key in numbers if key != "default"]
    for rank, key in enumerate(names, 1):
        if key not in mesh.tetrahedron_sets:
            known = ", ".join(map(repr, mesh.tetrahedron_sets)) or "none"
            raise ValueError(f"{name}: the mesh has no tetrahedron set {key!r} (it has: {known})")
        members = np.asarray(mesh.tetrahedron_sets[key])
        if np.any(owner[members]):
            first = int(members[np.argmax(owner[members] > 0)])
            other = names[owner[first] - 1]
            raise ValueError(f"{name}: tetrahedron {first} is in both {other!r} and {key!r}; make the sets disjoint")
        owner[members] = rank
        value[members] = np.asarray(numbers[key], np.float64)
    if "default" not in numbers and not owner.all():
        left_out = np.flatnonzero(owner == 0)
        raise ValueError(
            f"{name}: {left_out.size} tetrahedra are in none of the sets {names} (first: {left_out[0]}); "
            'add a number for "default"'
        )
    return value


def without_unused(vertices: np.ndarray, tetrahedra: np.ndarray, sets: dict, triangles: dict) -> tuple:
    """(vertices, tetrahedra, vertex sets, triangles by name) without vertices that no tetrahedron uses, renumbered."""
    used = np.unique(tetrahedra)
    new = np.full(len(vertices), -1)
    new[used] = np.arange(len(used))
    sets = {name: new[rows][new[rows] >= 0] for name, rows in sets.items()}
    triangles = {name: new[rows][(new[rows] >= 0).all(1)] for name, rows in triangles.items()}
    return vertices[used], new[tetrahedra], sets, triangles


def components(i: np.ndarray, j: np.ndarray, count: int) -> np.ndarray:
    """For each of `count` things the number of the part that it belongs to, where i[k] and j[k] hang together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_matrix((np.ones(len(i), bool), (i, j)), (count, count)), directed=False)[1]


def parts_of_vertices(elements: np.ndarray, num_vertices: int) -> np.ndarray:
    """For each vertex the number of the part that it belongs to; parts share no vertex, and an unused vertex is one."""
    return components(np.repeat(elements[:, 0], elements.shape[1] - 1), elements[:, 1:].ravel(), num_vertices)


def pieces(mesh) -> np.ndarray:
    """`parts_of_vertices` of a mesh."""
    return parts_of_vertices(mesh.elements, mesh.num_vertices)


def sizes(sets: dict) -> str:
    """Names with the number of members."""
    return ", ".join(f"{name} ({len(rows)})" for name, rows in sets.items()) or "none"
