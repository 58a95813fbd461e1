"""Meshes whose elements are halved at their edges, where that is asked for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh import checks
from diffsim_ti.mesh.geometry import FACES, edge_matrices, edges_of, signed_volumes
from diffsim_ti.mesh.reference_element import MID_EDGES
from diffsim_ti.mesh.sets import places_of_triangles

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from diffsim_ti.mesh.tetrahedral_mesh import TetrahedralMesh


@dataclass(frozen=True)
class Refinement:
    """How a mesh came from a coarser one, whose vertices are its first.

    parents: the coarse tetrahedron that each lies in; from_coarse: SciPy CSR matrix P, x = P x_c, which interpolates as the
    coarse elements do, shape (num_vertices, num_vertices of the coarse mesh).
    """

    parents: np.ndarray
    from_coarse: "csr_matrix"

    def spread(self, number):
        """A number, or one for each coarse tetrahedron, which those within it have, too; others as they are."""
        each = not isinstance(number, Mapping) and np.ndim(number) and len(number) == self.parents[-1] + 1
        return np.asarray(number)[self.parents] if each else number


def parts_of_refined(mesh: "TetrahedralMesh", where, edges: str, onto: Callable | None) -> tuple:
    """What TetrahedralMesh.refined is made of: (vertices, elements, volumes, vertex sets), its Refinement, and a function of
    the mesh that says its tetrahedron sets and surface sets."""
    if edges not in ("all", "longest"):
        raise ValueError(f'edges to be halved must be "all" of the chosen tetrahedra or their "longest", got {edges!r}')
    n, corners, every = mesh.num_vertices, mesh.tetrahedra, edges == "all"
    chosen = np.arange(len(corners)) if where is None else mesh.tetrahedron_indices(where)
    edges, place = edges_of(corners, MID_EDGES)
    lengths = np.linalg.norm(mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]], axis=1)
    rank = np.empty(len(edges), np.int64)
    rank[np.argsort(np.round(lengths / lengths.max(), 9), kind="stable")] = np.arange(len(edges))
    halved = _closed(place, rank, chosen, every)
    middle = np.full(len(edges), -1)
    if mesh.order == 1:
        middle[halved] = n + np.arange(halved.sum())
    else:
        middle[place] = mesh.elements[:, 4:]
    cut = _Cut(corners, np.where(halved, middle, -1), rank, edges, place)
    elements, new, (element, L) = cut.tetrahedra, *_new_vertices(mesh, cut, edges, middle, halved)
    from scipy.sparse import csr_matrix, eye, vstack

    weights = mesh.reference.functions(L[:, 1:])
    rows = np.repeat(np.arange(len(L)), weights.shape[1])
    below = csr_matrix((weights.ravel(), (rows, mesh.elements[element].ravel())), (len(L), n))
    below.eliminate_zeros()
    P = vstack([eye(n, format="csr"), below], format="csr")
    new_vertices = below @ mesh.vertices
    if onto is not None:
        new_vertices = numbers("what onto returns [m]", onto(new_vertices))
        if new_vertices.shape != (len(L), 3):
            raise ValueError(f"onto: expected places [m] of shape {(len(L), 3)}, got shape {new_vertices.shape}")
    vertices = np.concatenate([mesh.vertices, new_vertices])
    if mesh.order == 2:
        elements = np.concatenate([elements, new], 1)
    vertex_sets = joined_vertex_sets(mesh, element, L)
    if onto is None:
        volumes = signed_volumes(edge_matrices(vertices, elements[:, :4]))
    else:
        vertices = checks.checked_vertices(vertices)
        volumes = checks.checked_volumes(vertices, elements[:, :4])
        checks.oriented(elements, volumes, fix_orientation=False)
    volumes = checks.checked_curved_volumes(vertices, elements, volumes)

    def sets(fine: "TetrahedralMesh") -> tuple[dict, dict]:
        within = {name: np.isin(cut.parents, rows) for name, rows in mesh.tetrahedron_sets.items()}
        return within, _surface_sets(mesh, fine, cut)

    return (vertices, elements, volumes, vertex_sets), Refinement(cut.parents, P), sets


def _closed(place: np.ndarray, rank: np.ndarray, chosen: np.ndarray, every: bool) -> np.ndarray:
    """Which edges are halved: every one of the chosen tetrahedra, or the longest, and that of each that has a halved one."""
    halved = np.zeros(len(rank), bool)
    longest = place[np.arange(len(place)), rank[place].argmax(1)]
    halved[place[chosen] if every else longest[chosen]] = True
    while True:
        more = longest[halved[place].any(1) & ~halved[longest]]
        if not len(more):
            return halved
        halved[more] = True


class _Cut:
    """Tetrahedra bisected at halved edges, the one of the highest rank first: neighbours cut a common face alike.

    tetrahedra: corners, shape (k, 4); L: where they lie in the coarse ones, barycentric, shape (k, 4, 4); parents: these.
    """

    def __init__(self, corners, middle, rank, edges, place):
        big = int(max(corners.max(), middle.max())) + 2
        keys = edges[:, 0] * big + edges[:, 1]  # ascending
        T, L, parents = corners, np.broadcast_to(np.eye(4), (len(corners), 4, 4)), np.arange(len(corners))
        done = []
        while len(T):
            low, high = np.sort(T[:, MID_EDGES], 2).transpose(2, 0, 1)
            wanted = low * big + high
            at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            ranks = np.where((keys[at] == wanted) & (middle[at] >= 0), rank[at], -1)
            local, rows = ranks.argmax(1), np.arange(len(T))
            cut = ranks[rows, local] >= 0
            done.append((T[~cut], L[~cut], parents[~cut]))
            T, L, parents, local, at = T[cut], L[cut], parents[cut], local[cut], at[cut]
            rows = np.arange(len(T))
            between, halves = middle[at[rows, local]], []
            for end in MID_EDGES[local].T:
                t, share = T.copy(), L.copy()
                t[rows, end] = between
                share[rows, end] = L[rows[:, None], MID_EDGES[local]].mean(1)
                halves.append((t, share, parents))
            T, L, parents = (np.concatenate(x) for x in zip(*halves))
        T, L, parents = (np.concatenate(x) for x in zip(*done))
        order = np.argsort(parents, kind="stable")
        self.tetrahedra, self.L, self.parents = T[order], L[order], parents[order]


def _new_vertices(mesh, cut: _Cut, edges, middle, halved) -> tuple:
    """(mid-edge vertices of each fine element, shape (k, 6), of ten nodes; (the coarse element that each vertex which the
    coarse mesh does not have lies in, its barycentric coordinates there))"""
    n = mesh.num_vertices
    if mesh.order == 1:
        flat, first = np.unique(cut.tetrahedra, return_index=True)
        first = first[flat >= n]
        return np.zeros((0, 6), np.int64), (cut.parents[first // 4], cut.L.reshape(-1, 4)[first])
    fine, place = edges_of(cut.tetrahedra, MID_EDGES)
    _, first = np.unique(place.ravel(), return_index=True)
    keys, own = edges[~halved] @ [n, 1], middle[~halved]
    at = np.minimum(np.searchsorted(keys, fine @ [n, 1]), max(len(keys) - 1, 0))
    known = keys[at] == fine @ [n, 1] if len(keys) else np.zeros(len(fine), bool)
    ids = np.empty(len(fine), np.int64)
    ids[known] = own[at[known]]
    ids[~known] = n + np.arange((~known).sum())
    first = first[~known]
    ends = cut.L[(first // 6)[:, None], MID_EDGES[first % 6]]
    return ids[place], (cut.parents[first // 6], ends.mean(1))


def joined_vertex_sets(mesh, element: np.ndarray, L: np.ndarray) -> dict[str, np.ndarray]:
    """The vertex sets with those of new vertices, at L in an element each, that lie within an edge, a face of the surface or
    a tetrahedron of which all vertices are members; edges count of such faces and tetrahedra."""
    n, on = mesh.num_vertices, L > 0
    ids = np.sort(
        np.where(on, mesh.tetrahedra[element], -1), 1
    )  # of the edge, face or tetrahedron that one lies within
    count = on.sum(1)

    def joined(members: np.ndarray) -> np.ndarray:
        inside = np.zeros(n, bool)
        inside[members] = True
        whole = inside[mesh.elements].all(1)
        faces = mesh.surface_faces[inside[mesh.surface_faces].all(1)][:, :3]
        faces = np.concatenate([faces, mesh.tetrahedra[whole][:, FACES].reshape(-1, 3)])
        pairs = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        if mesh.order == 2:  # edges of lines, too: their middles are members
            ends = mesh.tetrahedra[:, MID_EDGES]
            pairs = np.concatenate([pairs, ends[inside[ends].all(2) & inside[mesh.elements[:, 4:]]]])
        pairs = np.sort(pairs, 1)
        out = whole[element]
        out = np.where(count == 2, np.isin(ids[:, -2:] @ [n, 1], pairs @ [n, 1]), out)
        return np.where(count == 3, places_of_triangles(ids[:, -3:], faces) >= 0, out)

    return {name: np.concatenate([rows, n + np.flatnonzero(joined(rows))]) for name, rows in mesh.vertex_sets.items()}


def _surface_sets(mesh, fine, cut: _Cut) -> dict[str, np.ndarray]:
    """Rows of the fine surface that lie in coarse faces of each set."""
    at = places_of_triangles(fine.surface_faces[:, :3], fine.tetrahedra[:, FACES].reshape(-1, 3))
    tetrahedron, opposite = np.divmod(at, 4)
    outside = (cut.L[tetrahedron[:, None], FACES[opposite]] == 0).all(1).argmax(1)
    face = places_of_triangles(
        mesh.tetrahedra[cut.parents[tetrahedron[:, None]], FACES[outside]], mesh.surface_faces[:, :3]
    )
    each = len(mesh.surface_triangles) // len(mesh.surface_faces)
    out = {}
    for name, rows in mesh.surface_sets.items():
        full = np.bincount(rows // each, minlength=len(mesh.surface_faces)) == each
        out[name] = (each * np.flatnonzero(full[face])[:, None] + np.arange(each)).ravel()
    return out
