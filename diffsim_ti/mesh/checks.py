"""What a tetrahedral mesh must be before anything is computed on it. Every threshold is relative to the tetrahedron.

Each check raises ValueError as rule, value, remedy; `TetrahedralMesh` runs them in the order in which they stand here.
"""

import warnings

import numpy as np

from diffsim_ti.mesh.geometry import FACES, edge_matrices, signed_volumes, squared_edges

# A tetrahedron with det [e1 e2 e3] below this share of its longest edge cubed is flat. The determinant's own rounding
# is about 1e-15 of it, so 1e-12 leaves three digits of volume; the quality is then 1e-8, a usable sliver's above 1e-4.
FLAT = 1e-12
# Subtracting coordinates of size |x| leaves an edge error of eps |x|, hence a determinant error of a few eps |x| L^2.
FLAT_ROUNDING = 8 * np.finfo(np.float64).eps
SLIVER = 0.1  # quality below which a tetrahedron is reported as a sliver


def checked_vertices(vertices) -> np.ndarray:
    """A float64 copy of shape (num_vertices, 3); ValueError for a wrong shape or a NaN or infinite coordinate."""
    vertices = np.array(vertices, np.float64, order="C")
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
    """An int64 copy of shape (num_tetrahedra, 4) whose rows hold four different indices below num_vertices."""
    given = np.asarray(tetrahedra)
    if given.size == 0:
        raise ValueError(f"a mesh needs at least one tetrahedron, got an array of shape {given.shape}")
    if given.dtype.kind not in "iu":
        raise ValueError(f"tetrahedra must be integers, got dtype {given.dtype}; convert with .astype(np.int64)")
    if given.ndim != 2 or given.shape[1] != 4:
        hint = "; these look like 10-node tetrahedra: keep the first 4 columns" if given.shape[-1] == 10 else ""
        raise ValueError(f"tetrahedra must have shape (num_tetrahedra, 4), got {given.shape}{hint}")
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
        raise ValueError(
            f"a tetrahedron needs four different vertices: tetrahedron {bad[0]} is {tetrahedra[bad[0]].tolist()} "
            f"({len(bad)} such tetrahedra); remove them"
        )
    return tetrahedra


def checked_volumes(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Signed volumes V [m^3]; ValueError where 6 |V| <= (1e-12 L + 8 eps max|x|) L^2, L the longest edge, x coordinates."""
    volumes = signed_volumes(edge_matrices(vertices, tetrahedra))
    longest = np.sqrt(squared_edges(vertices, tetrahedra).max(1))
    size = np.abs(vertices).max(1)[tetrahedra].max(1)
    flat = np.nonzero(6 * np.abs(volumes) <= (FLAT * longest + FLAT_ROUNDING * size) * longest**2)[0]
    if len(flat):
        first = flat[0]
        raise ValueError(
            f"tetrahedron {first} is flat: volume {volumes[first]:.3g} m^3, longest edge {longest[first]:.3g} m, "
            f"vertices {tetrahedra[first].tolist()} ({len(flat)} such tetrahedra); remove them or remesh"
        )
    return volumes


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
    tetrahedra[inside_out, 2:] = tetrahedra[inside_out, :1:-1]
    return tetrahedra


def surface_of(tetrahedra: np.ndarray, num_vertices: int) -> np.ndarray:
    """Faces of one tetrahedron only, oriented outwards, shape (k, 3); one sort of all faces.

    ValueError for a repeated tetrahedron, a face of more than two tetrahedra, and two tetrahedra on one side of a face.
    """
    corners = tetrahedra[:, FACES].reshape(-1, 3)
    a, b, c = np.sort(corners, 1).T
    if num_vertices < 2_000_000:  # three indices fit in one 64-bit key
        key = (a * num_vertices + b) * num_vertices + c
        order = np.argsort(key, kind="stable")
        key = key[order]
        same = key[1:] == key[:-1]
    else:
        order = np.lexsort((c, b, a))
        same = (a[order][1:] == a[order][:-1]) & (b[order][1:] == b[order][:-1]) & (c[order][1:] == c[order][:-1])
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
    return corners[np.sort(order[single])]


def warn_of_orphans(orphans: np.ndarray) -> None:
    """One UserWarning if there are vertices that no tetrahedron uses."""
    if len(orphans):
        vertices = "1 vertex" if len(orphans) == 1 else f"{len(orphans)} vertices"
        warnings.warn(
            f"{vertices} in no tetrahedron, first {orphans[0]}: without mass, a simulation holds them in place; remove "
            "them, or load with from_file(..., drop_orphans=True)",
            stacklevel=4,
        )


def warn_of_slivers(mesh) -> None:
    """One UserWarning if there are tetrahedra of a quality below SLIVER."""
    count, worst = int((mesh.quality < SLIVER).sum()), int(np.argmin(mesh.quality))
    if count:
        warnings.warn(
            f"{count} sliver{'' if count == 1 else 's'} (quality below {SLIVER}), worst {mesh.quality[worst]:.3g} in "
            f"tetrahedron {worst} with an altitude of {mesh.altitudes[worst].min():.3g} m: the stable explicit step "
            "falls in proportion to the smallest altitude; remesh, or use an implicit solver",
            stacklevel=4,
        )
