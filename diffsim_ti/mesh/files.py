"""Tetrahedral meshes from and to files, through meshio (imported only here, when called)."""

import contextlib
import io
from pathlib import Path

import numpy as np

DIMENSION = {"vertex": 0, "line": 1, "triangle": 2, "tetra": 3}  # the cells that a file may hold
TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "avsucd:material")  # integer cell data that group cells
VERTEX_PREFIX = "vertex_set:"  # 0/1 data arrays in VTU and VTK files
CELL_PREFIXES = {"tetra": "tetrahedron_set:", "triangle": "surface_set:"}
KEEPS_SETS = (".msh", ".vtu", ".vtk")


def read_mesh(path) -> tuple[np.ndarray, np.ndarray, dict, dict, dict]:
    """Vertices, tetrahedra, vertex sets, tetrahedron sets and named triangles of a file; see `TetrahedralMesh.from_file`."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"mesh file {path} does not exist (looked in {Path.cwd()})")
    mesh = _read(path)
    _check_cell_types(mesh)
    blocks = [k for k, block in enumerate(mesh.cells) if block.type == "tetra"]
    offset = dict(zip(blocks, np.cumsum([0] + [len(mesh.cells[k].data) for k in blocks])))
    vertex_sets, tetrahedron_sets, triangles = {}, {}, {}

    def add(name: str, k: int, rows: np.ndarray) -> None:
        if len(rows) and k in offset:
            tetrahedron_sets.setdefault(name, []).append(rows + offset[k])
        elif len(rows):
            vertex_sets.setdefault(name, []).append(mesh.cells[k].data[rows].ravel())
            if mesh.cells[k].type == "triangle":
                triangles.setdefault(name, []).append(mesh.cells[k].data[rows])

    for name, k, rows in _groups(mesh):
        add(name, k, rows)
    for name, rows in mesh.point_sets.items():
        vertex_sets.setdefault(name, []).append(rows)
    for name, values in mesh.point_data.items():
        if name.startswith(VERTEX_PREFIX):
            vertex_sets.setdefault(name.removeprefix(VERTEX_PREFIX), []).append(np.nonzero(values)[0])
    tetrahedra = np.concatenate([mesh.cells[k].data for k in blocks])
    join = {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in tetrahedron_sets.items()}
    if path.suffix == ".msh":
        tetrahedra, join = _merge_repeated(tetrahedra, join)
    sets = {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in vertex_sets.items()}
    triangles = {name: np.concatenate(parts).astype(np.int64) for name, parts in triangles.items()}
    return mesh.points, tetrahedra, sets, join, triangles


def _read(path: Path):
    """meshio's mesh; its prints and its sys.exit become one ValueError."""
    import meshio

    with open(path, "rb") as file:
        is_gmsh = path.suffix == ".msh" and b"$" in file.read(1)
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path, file_format="gmsh" if is_gmsh else None)
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{said.getvalue()} {error if str(error) != '1' else ''}".split()) or type(error).__name__
        hint = "check that it is complete and that its suffix names its format"
        if "gmsh:physical" in reason:
            hint = "either give every volume a physical group or none, or save as Gmsh 2.2 (Mesh.MshFileVersion = 2.2)"
        raise ValueError(f"{path}: meshio cannot read this file ({reason}); {hint}") from error


def _check_cell_types(mesh) -> None:
    found = {}
    for block in mesh.cells:
        found[block.type] = found.get(block.type, 0) + len(block.data)
    other = sorted(set(found) - set(DIMENSION))
    listing = ", ".join(f"{kind} ({count})" for kind, count in found.items()) or "none"
    if any(kind.startswith("tetra") for kind in other):
        raise ValueError(
            f"only 4-node tetrahedra can be read; cell types found: {listing}; export linear elements "
            "(in Gmsh: Mesh.ElementOrder = 1)"
        )
    if found.get("tetra", 0) == 0:
        raise ValueError(
            f"the file holds no tetrahedra; cell types found: {listing}; fill the surface with tetrahedra first, "
            "for example with Gmsh, TetGen or fTetWild"
        )
    if other:
        raise ValueError(
            f"tetrahedra beside {', '.join(other)} cells cannot be read, as these would be lost; cell types found: "
            f"{listing}; mesh the body with tetrahedra alone"
        )


def _groups(mesh):
    """(name, block, rows) of every group of cells: named by the file, or tag_<n> for integer tags without a name."""
    names = {(int(dim), int(tag)): name for name, (tag, dim) in mesh.field_data.items()}
    for name, members in mesh.cell_sets.items():
        if name != "gmsh:bounding_entities":
            yield from ((name, k, np.asarray(rows, np.int64)) for k, rows in enumerate(members) if rows is not None)
    for key, blocks in mesh.cell_data.items():
        for kind, prefix in CELL_PREFIXES.items():
            own = [k for k, block in enumerate(mesh.cells) if block.type == kind and key.startswith(prefix)]
            yield from ((key.removeprefix(prefix), k, np.nonzero(blocks[k])[0]) for k in own)
        if key not in TAGS:
            continue
        blocks = [np.asarray(values).astype(np.int64) for values in blocks]
        used = {int(tag) for block, v in zip(mesh.cells, blocks) if block.type == "tetra" for tag in np.unique(v)}
        for k, (block, values) in enumerate(zip(mesh.cells, blocks)):
            dim = DIMENSION[block.type]
            for tag in np.unique(values).tolist():
                name = names.get((dim, tag))
                if name is None and (tag == 0 or (dim == 3 and len(used) == 1)):
                    continue  # no group, or a nameless one that tells nothing apart
                yield name or f"tag_{tag}", k, np.nonzero(values == tag)[0]


def _merge_repeated(tetrahedra: np.ndarray, sets: dict) -> tuple[np.ndarray, dict]:
    """Gmsh 2.2 lists a tetrahedron once per physical group that holds it; keep the first and all its groups."""
    _, first, inverse = np.unique(tetrahedra, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(tetrahedra):
        return tetrahedra, sets
    groups_of = np.zeros(len(tetrahedra), np.int64)
    for rows in sets.values():
        groups_of[rows] += 1
    if np.any(groups_of[np.setdiff1d(np.arange(len(tetrahedra)), first)] == 0):
        return tetrahedra, sets  # true repetitions: the mesh's own check reports them
    keep = np.sort(first)
    new = np.searchsorted(keep, first[inverse.ravel()])
    return tetrahedra[keep], {name: np.unique(new[rows]) for name, rows in sets.items()}


def write_mesh(path, vertices, tetrahedra, vertex_sets: dict, tetrahedron_sets: dict, triangles: dict) -> list[str]:
    """Write the mesh in the format that the suffix names; returns the names of the sets that the format cannot keep.

    triangles: name -> vertex indices of a surface set, shape (k, 3).
    """
    import meshio

    path = Path(path)
    vertex_sets = {n: rows for n, rows in vertex_sets.items() if not _same_vertices(rows, triangles.get(n))}
    if path.suffix == ".msh":
        _write_gmsh(meshio, path, vertices, tetrahedra, vertex_sets, tetrahedron_sets, triangles)
        return []
    cells, point_data, cell_data, lost = [("tetra", tetrahedra)], {}, {}, [*vertex_sets, *tetrahedron_sets, *triangles]
    if path.suffix in KEEPS_SETS:
        m, surface = len(tetrahedra), np.zeros((0, 3), np.int64)
        if triangles:
            surface, inverse = np.unique(np.concatenate([*triangles.values()]), axis=0, return_inverse=True)
            inverse = np.split(inverse.ravel(), np.cumsum([len(rows) for rows in triangles.values()])[:-1])
            cells.append(("triangle", surface))
        sizes = [m, len(surface)][: len(cells)]
        members = {CELL_PREFIXES["tetra"] + name: (0, rows) for name, rows in tetrahedron_sets.items()}
        if triangles:
            members |= {CELL_PREFIXES["triangle"] + name: (1, rows) for name, rows in zip(triangles, inverse)}
        for name, (block, rows) in members.items():
            cell_data[name] = [_mask(rows if k == block else [], size) for k, size in enumerate(sizes)]
        point_data = {VERTEX_PREFIX + name: _mask(rows, len(vertices)) for name, rows in vertex_sets.items()}
        lost = []
    mesh = meshio.Mesh(vertices, cells, point_data=point_data, cell_data=cell_data)
    try:
        mesh.write(path)
    except (meshio.WriteError, meshio.ReadError) as error:
        raise ValueError(f"cannot save {path}: {error}; use one of {', '.join(KEEPS_SETS)}") from error
    return lost


def _same_vertices(rows: np.ndarray, triangles: np.ndarray | None) -> bool:
    """Whether a vertex set is that of its triangles, which say so when they are read again."""
    return triangles is not None and np.array_equal(rows, np.unique(triangles))


def _mask(rows, count: int) -> np.ndarray:
    mask = np.zeros(count, np.int32)
    mask[rows] = 1
    return mask


def _write_gmsh(meshio, path, vertices, tetrahedra, vertex_sets, tetrahedron_sets, triangles) -> None:
    """Gmsh 2.2, binary: sets as named physical groups of points, surfaces, volumes; a member of several is listed again."""
    field_data, first, again = {}, np.zeros(len(tetrahedra), np.int64), []
    for tag, (name, rows) in enumerate(tetrahedron_sets.items(), start=1):
        field_data[name] = np.array([tag, 3])
        free = first[rows] == 0
        first[rows[free]] = tag
        again.append((rows[~free], tag))
    blocks, tags = [("tetra", tetrahedra)], [first]
    for rows, tag in again:
        if len(rows):
            blocks.append(("tetra", tetrahedra[rows]))
            tags.append(np.full(len(rows), tag))
    surfaces = [("triangle", name, cells) for name, cells in triangles.items()]
    points = [("vertex", name, rows[:, None]) for name, rows in vertex_sets.items()]
    for kind, group in (("triangle", surfaces), ("vertex", points)):
        for tag, (_, name, cells) in enumerate(group, start=1):
            if name in field_data:  # meshio knows one dimension per name
                known = {3: "tetrahedron", 2: "surface"}[int(field_data[name][1])]
                which = {"vertex": "vertex", "triangle": "surface"}[kind]
                raise ValueError(f"cannot save {path}: {name!r} names a {which} set and a {known} set; rename one")
            field_data[name] = np.array([tag, DIMENSION[kind]])
            if len(cells):
                blocks.append((kind, cells))
                tags.append(np.full(len(cells), tag))
    cell_data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    mesh = meshio.Mesh(vertices, blocks, cell_data=cell_data, field_data=field_data)
    mesh.write(path, file_format="gmsh22", binary=True)
