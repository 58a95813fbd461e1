"""Cells and arrays of VTK's grids, as legacy and XML files hold them."""

import re

import numpy as np

from diffsim_ti.mesh.readers.file_mesh import DIMENSION, FileMesh

KINDS = {1: "vertex", 3: "line", 5: "triangle", 9: "quad", 10: "tetra", 12: "hexahedron", 13: "wedge", 14: "pyramid"}
KINDS |= {21: "line3", 22: "triangle6", 23: "quad8", 24: "tetra10", 25: "hexahedron20", 28: "quad9", 7: "polygon"}
KINDS |= {2: "poly_vertex", 4: "poly_line", 42: "polyhedron", 11: "voxel", 8: "pixel"}
LAGRANGE = {68: {2: "line", 3: "line3"}, 69: {3: "triangle", 6: "triangle6"}, 71: {4: "tetra", 10: "tetra10"}}
LAGRANGE |= {78: LAGRANGE[71], 76: LAGRANGE[69], 75: LAGRANGE[68]}  # Bezier tetrahedra, triangles, curves of order 1
VERTEX_PREFIX = "vertex_set:"  # 0/1 data arrays of our own files
CELL_PREFIXES = {3: "tetrahedron_set:", 2: "surface_set:"}
TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "avsucd:material", "MaterialIds", "CellEntityIds")
TAGS += ("tetgen:ref", "nastran:ref", "name_to_read", "cell_group", "netgen:index", "flac3d:group")
IDS = re.compile(
    r"(?i)(original|global|pedigree|process|local|element|cell|point|node)[ _]?(cell|point)?[ _]?(ids?|number)$"
)
GHOSTS = "vtkGhostType"  # 1: a copy of another piece's cell
MOST = 1000  # different numbers that may name groups


def grid(points, nodes, offsets, types, point_arrays: dict, cell_arrays: dict) -> FileMesh:
    """The mesh of a grid: nodes of cell k are nodes[offsets[k]:offsets[k + 1]], of VTK's type types[k]."""
    if len(offsets) != len(types) + 1 or (len(offsets) and (offsets[-1] > len(nodes) or np.any(np.diff(offsets) < 0))):
        raise ValueError(f"{len(types)} cell types, where {max(len(offsets) - 1, 0)} cells have nodes")
    sizes, parts = np.diff(offsets), []
    for kind, size in sorted({(int(t), int(s)) for t, s in zip(types, sizes)}):
        rows = np.nonzero((types == kind) & (sizes == size))[0]
        parts.append((kind, nodes[offsets[rows][:, None] + np.arange(size)].astype(np.int64), rows))
    return grid_of_kinds(points, parts, point_arrays, cell_arrays)


def grid_of_kinds(points, parts: list, point_arrays: dict, cell_arrays: dict) -> FileMesh:
    """The mesh of a grid whose cells come by kinds: (VTK's type, nodes of the cells, their places among all cells)."""
    out, rows_of, count = FileMesh(points), [], sum(len(rows) for *_, rows in parts)
    arrays = {name: np.asarray(values) for name, values in cell_arrays.items() if len(values) == count}
    for kind, cells, rows in parts:
        if GHOSTS in arrays:
            own = (arrays[GHOSTS][rows].astype(np.int64) & 1) == 0
            cells, rows = cells[own], rows[own]
        if not len(rows):
            continue
        size = cells.shape[1]
        name = KINDS.get(kind, f"vtk_{kind}")
        if kind in LAGRANGE:
            name = LAGRANGE[kind].get(size, f"tetra{size}" if kind in (71, 78) else f"vtk_{kind}_{size}")
        out.blocks.append((name, cells))
        rows_of.append(rows)
    for name, values in point_arrays.items():
        if name.startswith(VERTEX_PREFIX):
            out.point_sets[name.removeprefix(VERTEX_PREFIX)] = np.nonzero(values)[0]
    groups_of_arrays(out, {name: [values[rows] for rows in rows_of] for name, values in arrays.items()})
    return out


def groups_of_arrays(mesh: FileMesh, arrays: dict[str, list], names: dict | None = None) -> None:
    """Groups of cells by their data: 0/1 arrays named as in our own files, and whole numbers that group tetrahedra.

    arrays: name -> one array for each block. Groups are called "tag_<number>", or "<array>_<number>" where several arrays
    group cells. Numbers of the cells themselves, and ghosts, are none.
    """
    grouping = {}
    for name, blocks in arrays.items():
        own = [(dim, prefix) for dim, prefix in CELL_PREFIXES.items() if name.startswith(prefix)]
        for dim, prefix in own:
            for k, (kind, _) in enumerate(mesh.blocks):
                if DIMENSION.get(kind) == dim:
                    mesh.group(name.removeprefix(prefix), k, np.nonzero(blocks[k])[0])
        if not own and (numbers := _numbers(mesh, name, blocks)) is not None:
            grouping[name] = numbers
    known = [name for name in grouping if name in TAGS]
    chosen = known[:1] or list(grouping)[:1]
    for name, numbers in grouping.items():
        base = "tag" if name in chosen else name
        zero = name not in ("gmsh:physical", "medit:ref", "cell_tags", "avsucd:material")
        mesh.group_by_number(numbers, names if base == "tag" else None, base, named_zero=zero)


def _numbers(mesh: FileMesh, name: str, blocks: list) -> list | None:
    """Whole numbers of each block's cells where an array groups them."""
    if name == GHOSTS or IDS.search(name) or name in ("gmsh:geometrical", "gmsh:bounding_entities"):
        return None
    if any(np.ndim(v) != 1 or np.asarray(v).dtype.kind not in "iuf" for v in blocks):
        return None
    values = np.concatenate(blocks) if blocks else np.zeros(0)
    if name not in TAGS:
        solid = [v for v, (kind, _) in zip(blocks, mesh.blocks) if DIMENSION.get(kind) == 3]
        solid = np.concatenate(solid) if solid else np.zeros(0)
        several = len(np.unique(solid))
        if values.dtype.kind == "f" or several < 2 or several > min(MOST, max(2, len(solid) // 2)):
            return None
    if not np.all(np.isfinite(values)) or np.any(values != np.round(values)):
        return None
    return [np.asarray(v).astype(np.int64) for v in blocks]
