"""What a tetrahedral mesh must be before anything is computed on it. Every threshold is relative to the tetrahedron.

Each check raises ValueError as rule, value, remedy; `TetrahedralMesh` runs them in the order in which they stand here.
"""

import numpy as np

from diffsim_ti.common.checked import numbers
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh import jacobian
from diffsim_ti.mesh.geometry import edge_matrices, signed_volumes, sorted_faces, squared_edges
from diffsim_ti.mesh.reference_element import MID_EDGES
from diffsim_ti.mesh.ten_nodes import FACE_NODES, MIRRORED

# A tetrahedron with det [e1 e2 e3] below this share of its longest edge cubed is flat. The determinant's own rounding
# is about 1e-15 of it, so 1e-12 leaves three digits of volume; the quality is then 1e-8, a usable sliver's above 1e-4.
FLAT = 1e-12
# Subtracting coordinates of size |x| leaves an edge error of eps |x|, hence a determinant error of a few eps |x| L^2.
FLAT_ROUNDING = 8 * np.finfo(np.float64).eps
SLIVER = 0.1  # quality below which a tetrahedron is reported as a sliver


def checked_vertices(vertices) -> np.ndarray:
    """A float64 copy of shape (num_vertices, 3); ValueError for a wrong shape or a NaN or infinite coordinate."""
    vertices = np.ascontiguousarray(numbers("vertices", vertices))
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) == 0:
        raise ValueError(f"vertices must have shape (num_vertices, 3) with at least 4 rows, got {vertices.shape}")
    bad = np.nonzero(~np.isfinite(vertices).all(1))[0]
    if len(bad):
        raise ValueError(
            f"coordinates must be finite: vertex {bad[0]} is at {vertices[bad[0]].tolist()} ({len(bad)} such "
            "vertices); remove or repair them"
        )
    return vertices


def checked_tetrahedra(tetrahedra, num_vertices: int) -> np.ndarray:
    """An int64 copy of shape (num_tetrahedra, 4 or 10) whose rows hold different indices below num_vertices."""
    given = np.asarray(tetrahedra)
    if given.size == 0:
        raise ValueError(f"a mesh needs at least one tetrahedron, got an array of shape {given.shape}")
    if given.dtype.kind not in "iu":
        raise ValueError(f"tetrahedra must be integers, got dtype {given.dtype}; convert with .astype(np.int64)")
    if given.ndim != 2 or given.shape[1] not in (4, 10):
        raise ValueError(
            f"tetrahedra must have shape (num_tetrahedra, 4), or (num_tetrahedra, 10) with mid-edge vertices, got "
            f"{given.shape}; give one row of vertex indices per tetrahedron"
        )
    bad = np.nonzero(((given < 0) | (given >= num_vertices)).any(1))[0]
    if len(bad):
        row = given[bad[0]]
        value = row[(row < 0) | (row >= num_vertices)][0]
        raise ValueError(
            f"vertex indices must lie in 0..{num_vertices - 1}: tetrahedron {bad[0]} has {value} in {row.tolist()} "
            f"({len(bad)} such tetrahedra); indices count from 0"
        )
    tetrahedra = np.array(given, np.int64, order="C")
    ordered = np.sort(tetrahedra, 1)
    bad = np.nonzero((ordered[:, 1:] == ordered[:, :-1]).any(1))[0]
    if len(bad):
        count = {4: "four", 10: "ten"}[given.shape[1]]
        raise ValueError(
            f"a tetrahedron needs {count} different vertices: tetrahedron {bad[0]} is {tetrahedra[bad[0]].tolist()} "
            f"({len(bad)} such tetrahedra); remove them"
        )
    return tetrahedra


def _flat_below(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    longest = np.sqrt(squared_edges(vertices, tetrahedra).max(1))
    size = np.abs(vertices).max(1)[tetrahedra].max(1)
    return (FLAT * longest + FLAT_ROUNDING * size) * longest**2 / 6


def checked_volumes(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Signed volumes V [m^3]; ValueError where 6 |V| <= (1e-12 L + 8 eps max|x|) L^2, L the longest edge, x coordinates."""
    volumes = signed_volumes(edge_matrices(vertices, tetrahedra))
    flat = np.nonzero(np.abs(volumes) <= _flat_below(vertices, tetrahedra))[0]
    if len(flat):
        first = flat[0]
        longest = np.sqrt(squared_edges(vertices, tetrahedra[first : first + 1]).max())
        raise ValueError(
            f"tetrahedron {first} is flat: volume {volumes[first]:.3g} m^3, longest edge {longest:.3g} m, "
            f"vertices {tetrahedra[first].tolist()} ({len(flat)} such tetrahedra); remove them or remesh"
        )
    return volumes


def curved(vertices: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Elements whose mid-edge vertices are not at the middles of straight edges, to round-off; Booleans, shape (m,)."""
    if elements.shape[1] == 4:
        return np.zeros(len(elements), bool)
    ends = vertices[elements[:, MID_EDGES]]
    off = np.linalg.norm(vertices[elements[:, 4:]] - ends.mean(2), axis=2).max(1)
    longest = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2).max(1)
    return off > FLAT * longest + FLAT_ROUNDING * np.abs(vertices).max(1)[elements].max(1)


def checked_curved_volumes(vertices: np.ndarray, elements: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """Those of curved elements too, integrals of J = det dx/dxi; ValueError where J is not positive all over an element.

    J counts as positive above the threshold of `checked_volumes`, by the bounds of `jacobian`.
    """
    some = np.nonzero(curved(vertices, elements))[0]
    if not len(some):
        return volumes
    nodes = vertices[elements[some]]
    least = 6 * _flat_below(vertices, elements[some, :4])
    wrong = jacobian.not_above(nodes, least)
    if len(wrong):
        first = some[wrong[np.argmin(jacobian.lowest(nodes[wrong]) / volumes[some[wrong]])]]
        order = _nearest_edges(vertices[elements[first]])
        columns = np.concatenate([np.arange(4), 4 + order])
        remedy = (
            "straighten or remesh what is bent so far (Gmsh: Mesh.HighOrderOptimize = 2), or take the corners alone, "
            "tetrahedra[:, :4], and call .quadratic()"
        )
        if np.any(order != np.arange(6)) and not len(jacobian.not_above(nodes[:, columns], least)):
            remedy = (
                "these are in another order (VTK's is that of the edges 01, 12, 20, 03, 13, 23; Gmsh swaps the last two): "
                f"take tetrahedra[:, {columns.tolist()}], or pass fix_orientation=True"
            )
        J = jacobian.lowest(vertices[elements[first]][None])[0]
        raise ValueError(
            f"J = det dx/dxi must be positive all over an element: tetrahedron {first} has {J:.3g} m^3, 6 V = "
            f"{6 * volumes[first]:.3g} m^3 by its corners, mid-edge vertices {elements[first, 4:].tolist()} ({len(wrong)} "
            f"such tetrahedra); {remedy}"
        )
    volumes = volumes.copy()
    volumes[some] = jacobian.volumes(nodes)
    return volumes


def middles_in_order(vertices: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Elements with J <= 0 somewhere get their mid-edge vertices in the order of the edges that these are nearest to."""
    some = np.nonzero(curved(vertices, elements))[0]
    if not len(some):
        return elements
    wrong = some[jacobian.not_above(vertices[elements[some]], 6 * _flat_below(vertices, elements[some, :4]))]
    elements = elements.copy()
    for e in wrong:
        elements[e, 4:] = elements[e, 4 + _nearest_edges(vertices[elements[e]])]
    return elements


def _nearest_edges(nodes: np.ndarray) -> np.ndarray:
    """For each edge the mid-edge vertex that is nearest to its middle, such that the sum of squares is least, shape (6,)."""
    from scipy.optimize import linear_sum_assignment

    middles = nodes[MID_EDGES].mean(1)
    return linear_sum_assignment(((middles[:, None] - nodes[None, 4:]) ** 2).sum(2))[1]


def oriented(tetrahedra: np.ndarray, volumes: np.ndarray, fix_orientation: bool) -> np.ndarray:
    """The tetrahedra, all of positive volume: swapped where asked to, otherwise a ValueError with the worst."""
    inside_out = np.nonzero(volumes < 0)[0]
    if len(inside_out) == 0:
        return tetrahedra
    if not fix_orientation:
        worst = int(np.argmin(volumes))
        subject = f"tetrahedron {worst} is inside-out"
        if len(inside_out) > 1:
            subject = f"{len(inside_out)} of {len(volumes)} tetrahedra are inside-out, worst is tetrahedron {worst}"
        raise ValueError(
            f"{subject} (volume {volumes[worst]:.3g} m^3); pass fix_orientation=True or swap two of its vertices"
        )
    tetrahedra = tetrahedra.copy()
    tetrahedra[inside_out] = tetrahedra[inside_out][:, MIRRORED[: tetrahedra.shape[1]]]
    return tetrahedra


def surface_of(elements: np.ndarray, num_vertices: int) -> np.ndarray:
    """Faces of one tetrahedron only, oriented outwards, shape (k, 3), or (k, 6) of ten-node ones; one sort of all faces.

    ValueError for a repeated tetrahedron, a face of more than two tetrahedra, and two tetrahedra on one side of a face.
    """
    tetrahedra = elements[:, :4]
    corners, order, same = sorted_faces(tetrahedra, num_vertices)
    left, right = order[:-1][same], order[1:][same]
    opposite = tetrahedra.ravel()  # face 4 e + a lies opposite corner a of tetrahedron e
    repeated = np.nonzero(opposite[left] == opposite[right])[0]
    if len(repeated):
        e, f = left[repeated[0]] // 4, right[repeated[0]] // 4
        raise ValueError(
            f"tetrahedra must differ: {e} and {f} have the same vertices {sorted(tetrahedra[e].tolist())}; remove one"
        )
    crowded = np.nonzero(same[1:] & same[:-1])[0]
    if len(crowded):
        at = crowded[0]
        raise ValueError(
            f"a face belongs to at most two tetrahedra: {sorted(corners[order[at]].tolist())} belongs to tetrahedra "
            f"{(order[at : at + 3] // 4).tolist()} and maybe more; remove what overlaps"
        )
    # Seen from outside, neighbours list a common face in opposite senses; the same sense means they overlap.
    start = np.argmax(corners[right] == corners[left][:, :1], 1)
    overlapping = np.nonzero(corners[right, (start + 1) % 3] == corners[left, 1])[0]
    if len(overlapping):
        e, f = left[overlapping[0]] // 4, right[overlapping[0]] // 4
        raise ValueError(
            f"neighbours must lie on two sides of their common face: tetrahedra {e} and {f} overlap "
            f"({len(overlapping)} such pairs); the mesh folds over itself there, so remesh"
        )
    single = np.ones(len(order), bool)
    single[1:][same] = single[:-1][same] = False
    places = np.sort(order[single])
    return corners[places] if elements.shape[1] == 4 else elements[places[:, None] // 4, FACE_NODES[places % 4]]


def warn_of_orphans(orphans: np.ndarray) -> None:
    """One UserWarning if there are vertices that no tetrahedron uses."""
    if len(orphans):
        vertices = "1 vertex" if len(orphans) == 1 else f"{len(orphans)} vertices"
        warn(
            f"{vertices} in no tetrahedron, first {orphans[0]}: without mass, a simulation keeps them in place; remove "
            "them, or load with from_file(..., drop_orphans=True)"
        )


def warn_of_slivers(mesh) -> None:
    """One UserWarning if there are tetrahedra of a quality below SLIVER."""
    count, worst = int((mesh.quality < SLIVER).sum()), int(np.argmin(mesh.quality))
    if count:
        warn(
            f"{count} sliver{'' if count == 1 else 's'} (quality below {SLIVER}), worst {mesh.quality[worst]:.3g} in "
            f"tetrahedron {worst} with an altitude of {mesh.altitudes[worst].min():.3g} m: the stable explicit step "
            "falls in proportion to the smallest altitude; remesh, or use an implicit solver"
        )
