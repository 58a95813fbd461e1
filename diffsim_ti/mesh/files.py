"""Tetrahedral meshes from and to files, through meshio (imported only here, when called)."""

import contextlib
import io
from pathlib import Path

import numpy as np

from diffsim_ti.mesh import gmsh1
from diffsim_ti.mesh.filling import SURFACES, filled, read_surface

DIMENSION = {"vertex": 0, "line": 1, "line3": 1, "triangle": 2, "triangle6": 2, "tetra": 3, "tetra10": 3}  # in a file
TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "avsucd:material")  # integer cell data that group cells
VERTEX_PREFIX = "vertex_set:"  # 0/1 data arrays in VTU and VTK files
CELL_PREFIXES = {3: "tetrahedron_set:", 2: "surface_set:"}
KEEPS_SETS = (".msh", ".vtu", ".vtk")
KEEPS_TEN_NODES = (*KEEPS_SETS, ".inp", ".xdmf")


def read_mesh(path) -> tuple[np.ndarray, np.ndarray, dict, dict, dict]:
    """Vertices, elements of four or ten nodes, vertex sets, tetrahedron sets and named triangles (by their corners) of a
    file; see `TetrahedralMesh.from_file`."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"mesh file {path} does not exist (looked in {Path.cwd()})")
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a mesh file")
    if path.suffix.lower() in SURFACES:
        try:
            return *filled(*read_surface(path)), {}, {}, {}
        except ValueError as error:
            raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    return parts_of(_read(path), again=path.suffix == ".msh")


def parts_of(mesh, again: bool = False) -> tuple[np.ndarray, np.ndarray, dict, dict, dict]:
    """The same of meshio's mesh; again: it may list a tetrahedron once for each of its groups."""
    _check_cell_types(mesh)
    blocks = [k for k, block in enumerate(mesh.cells) if DIMENSION[block.type] == 3]
    offset = dict(zip(blocks, np.cumsum([0] + [len(mesh.cells[k].data) for k in blocks])))
    vertex_sets, tetrahedron_sets, triangles = {}, {}, {}

    def add(name: str, k: int, rows: np.ndarray) -> None:
        if len(rows) and k in offset:
            tetrahedron_sets.setdefault(name, []).append(rows + offset[k])
        elif len(rows):
            vertex_sets.setdefault(name, []).append(mesh.cells[k].data[rows].ravel())
            if DIMENSION[mesh.cells[k].type] == 2:
                triangles.setdefault(name, []).append(mesh.cells[k].data[rows, :3])

    for name, k, rows in _groups(mesh):
        add(name, k, rows)
    for name, rows in mesh.point_sets.items():
        vertex_sets.setdefault(name, []).append(rows)
    for name, values in mesh.point_data.items():
        if name.startswith(VERTEX_PREFIX):
            vertex_sets.setdefault(name.removeprefix(VERTEX_PREFIX), []).append(np.nonzero(values)[0])
    tetrahedra = np.concatenate([mesh.cells[k].data for k in blocks])
    join = {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in tetrahedron_sets.items()}
    if again:
        tetrahedra, join = _merge_repeated(tetrahedra, join)
    sets = {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in vertex_sets.items()}
    triangles = {name: np.concatenate(parts).astype(np.int64) for name, parts in triangles.items()}
    return mesh.points, tetrahedra, sets, join, triangles


def _read(path: Path):
    """meshio's mesh; its prints and its sys.exit become one ValueError."""
    import meshio

    with open(path, "rb") as file:
        is_gmsh = path.suffix == ".msh" and b"$" in file.read(1)
    if is_gmsh and gmsh1.is_gmsh1(path):
        try:
            return gmsh1.read(path)
        except ValueError as error:
            raise ValueError(f"{path}: {error}; export it again") from error
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path, file_format="gmsh" if is_gmsh else None)
    except ModuleNotFoundError as error:
        raise _lacking(str(path), error) from error
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
    if any(kind.startswith("tetra") for kind in other) or {"tetra", "tetra10"} <= set(found):
        raise ValueError(
            f"a file holds tetrahedra of four nodes, or of ten; cell types found: {listing}; export elements of order 1 or "
            "2 (in Gmsh: Mesh.ElementOrder = 2)"
        )
    if not found.get("tetra", 0) and not found.get("tetra10", 0):
        raise ValueError(
            f"the file holds no tetrahedra; cell types found: {listing}; fill the surface with tetrahedra first, "
            "for example by TetrahedralMesh.from_surface, Gmsh or fTetWild"
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
        for dim, prefix in CELL_PREFIXES.items():
            own = [k for k, block in enumerate(mesh.cells) if DIMENSION[block.type] == dim and key.startswith(prefix)]
            yield from ((key.removeprefix(prefix), k, np.nonzero(blocks[k])[0]) for k in own)
        if key not in TAGS:
            continue
        blocks = [np.asarray(values).astype(np.int64) for values in blocks]
        used = {int(tag) for block, v in zip(mesh.cells, blocks) if DIMENSION[block.type] == 3 for tag in np.unique(v)}
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


def write_mesh(path, mesh) -> list[str]:
    """Write the mesh in the format that the suffix names; returns the names of the sets that the format cannot keep."""
    import meshio

    path = Path(path)
    if mesh.order == 2 and path.suffix not in KEEPS_TEN_NODES:
        raise ValueError(
            f"cannot save {path}: ten-node tetrahedra go into {', '.join(KEEPS_TEN_NODES)}; use one of these, or save "
            "mesh.linear()"
        )
    faces, vertex_sets = named_parts(mesh)
    if path.suffix == ".msh":
        _write_gmsh(path, mesh, vertex_sets, faces)
        return []
    out, lost = as_meshio(mesh, bare=path.suffix not in KEEPS_SETS), []
    if path.suffix == ".inp":
        out.point_sets = mesh.vertex_sets
        out.cell_sets = {name: [rows] for name, rows in mesh.tetrahedron_sets.items()}
        lost = [name for name in faces if name not in mesh.vertex_sets]
    elif path.suffix not in KEEPS_SETS:
        lost = [*vertex_sets, *mesh.tetrahedron_sets, *faces]
    try:
        out.write(path)
    except (meshio.WriteError, meshio.ReadError) as error:
        raise ValueError(f"cannot save {path}: {error}; use one of {', '.join(KEEPS_SETS)}") from error
    except ModuleNotFoundError as error:
        raise _lacking(f"cannot save {path}", error) from error
    return lost


def _lacking(what: str, error: ModuleNotFoundError) -> ImportError:
    """What to say where meshio needs a package for a format (h5py for XDMF, CGNS, MED, H5M, HMF; netCDF4 for Exodus)."""
    return ImportError(
        f"{what}: meshio needs {error.name} for this format: pip install {error.name}, or use one of "
        f"{', '.join(KEEPS_SETS)}, which need no more",
        name=error.name,
    )


def named_parts(mesh) -> tuple[dict, dict]:
    """(cells of surface sets by name, vertex sets that are not those of these cells)"""
    faces = {name: _cells_of(mesh, rows) for name, rows in mesh.surface_sets.items()}
    known = {name: np.unique(np.concatenate([c.ravel() for c in cells.values()])) for name, cells in faces.items()}
    own = {n: rows for n, rows in mesh.vertex_sets.items() if n not in known or not np.array_equal(rows, known[n])}
    return faces, own


def as_meshio(mesh, bare: bool = False):
    """meshio's mesh, with sets as 0/1 arrays; bare: without."""
    import meshio

    cells, point_data, cell_data = [("tetra" if mesh.order == 1 else "tetra10", mesh.elements)], {}, {}
    if not bare:
        faces, vertex_sets = named_parts(mesh)
        members = [(CELL_PREFIXES[3] + name, 0, rows) for name, rows in mesh.tetrahedron_sets.items()]
        for kind in ("triangle", "triangle6"):
            own = {name: cells_of[kind] for name, cells_of in faces.items() if kind in cells_of}
            if own:
                surface, inverse = np.unique(np.concatenate([*own.values()]), axis=0, return_inverse=True)
                parts = np.split(inverse.ravel(), np.cumsum([len(rows) for rows in own.values()])[:-1])
                members += [(CELL_PREFIXES[2] + name, len(cells), rows) for name, rows in zip(own, parts)]
                cells.append((kind, surface))
        for name, block, rows in members:
            masks = cell_data.setdefault(name, [np.zeros(len(data), np.int32) for _, data in cells])
            masks[block][rows] = 1
        for name, rows in vertex_sets.items():
            point_data[VERTEX_PREFIX + name] = np.bincount(rows, minlength=mesh.num_vertices).astype(np.int32)
    return meshio.Mesh(mesh.vertices, cells, point_data=point_data, cell_data=cell_data)


def _cells_of(mesh, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Kind of cell -> vertices, of rows of the surface: whole faces of six nodes as such, triangles as they are."""
    if mesh.order == 1:
        return {"triangle": mesh.surface_triangles[rows]}
    whole = np.bincount(rows // 4, minlength=len(mesh.surface_faces)) == 4
    out = {"triangle6": mesh.surface_faces[whole], "triangle": mesh.surface_triangles[rows[~whole[rows // 4]]]}
    return {kind: cells for kind, cells in out.items() if len(cells) or kind == "triangle6"}


def _write_gmsh(path, mesh, vertex_sets: dict, faces: dict) -> None:
    """Gmsh 2.2, binary: sets as named physical groups of points, surfaces, volumes; a member of several is listed again."""
    import meshio

    kind, tetrahedra = "tetra" if mesh.order == 1 else "tetra10", mesh.elements
    field_data, first, again = {}, np.zeros(len(tetrahedra), np.int64), []
    for tag, (name, rows) in enumerate(mesh.tetrahedron_sets.items(), start=1):
        field_data[name] = np.array([tag, 3])
        free = first[rows] == 0
        first[rows[free]] = tag
        again.append((rows[~free], tag))
    blocks, tags = [(kind, tetrahedra)], [first]
    for rows, tag in again:
        if len(rows):
            blocks.append((kind, tetrahedra[rows]))
            tags.append(np.full(len(rows), tag))
    points = {name: {"vertex": rows[:, None]} for name, rows in vertex_sets.items()}
    for dim, group in ((2, faces), (0, points)):
        for tag, (name, parts) in enumerate(group.items(), start=1):
            if name in field_data:  # meshio knows one dimension per name
                known = {3: "tetrahedron", 2: "surface"}[int(field_data[name][1])]
                which = {0: "vertex", 2: "surface"}[dim]
                raise ValueError(f"cannot save {path}: {name!r} names a {which} set and a {known} set; rename one")
            field_data[name] = np.array([tag, dim])
            for kind, cells in parts.items():
                if len(cells):
                    blocks.append((kind, cells))
                    tags.append(np.full(len(cells), tag))
    cell_data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    out = meshio.Mesh(mesh.vertices, blocks, cell_data=cell_data, field_data=field_data)
    out.write(path, file_format="gmsh22", binary=True)
