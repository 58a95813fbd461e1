"""Tetrahedral meshes from and to files: own readers (readers/), meshio for the other formats (imported only when called)."""

import contextlib
import io
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from diffsim_ti.mesh.filling import SURFACES, filled, read_surface
from diffsim_ti.mesh.readers import abaqus, gmsh, medit, tetgen, vtk_legacy, vtk_xml
from diffsim_ti.mesh.readers.file_mesh import FileMesh, parts_of
from diffsim_ti.mesh.readers.vtk_cells import CELL_PREFIXES, VERTEX_PREFIX, groups_of_arrays
from diffsim_ti.mesh.ten_nodes import MIRRORED

KEEPS_SETS = (".msh", ".vtu", ".vtk")
KEEPS_TEN_NODES = (*KEEPS_SETS, ".inp", ".xdmf")
READERS: dict[str, Callable[[Path], FileMesh]] = {".inp": abaqus.read, ".mesh": medit.read, ".vtk": vtk_legacy.read}
READERS |= dict.fromkeys((".ele", ".node"), tetgen.read) | dict.fromkeys((".vtu", ".pvtu"), vtk_xml.read)
NASTRAN = (".bdf", ".nas", ".fem")


def read_mesh(path, size: float | None = None, cells: int | None = None) -> tuple[tuple, list[str]]:
    """((vertices, elements of four or ten nodes, vertex sets, tetrahedron sets, named triangles by their corners), what is
    left out) of a file; see `TetrahedralMesh.from_file`."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"mesh file {path} does not exist (looked in {Path.cwd()})")
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a mesh file")
    if path.suffix.lower() in SURFACES:
        try:
            return filled(*read_surface(path), size=size, cells=cells), []
        except ValueError as error:
            raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    if size is not None or cells is not None:
        raise ValueError(
            f"size and cells say how finely a surface is filled ({', '.join(SURFACES)}), and this file holds tetrahedra; "
            "leave them out, or use mesh.scaled to change the size of the body"
        )
    return parts_of(_read(path), again=path.suffix.lower() == ".msh")


def _read(path: Path) -> FileMesh:
    """The mesh of a file; whatever a reader raises becomes one ValueError."""
    reader, by = READERS.get(path.suffix.lower()), "the reader of its format"
    with open(path, "rb") as file:
        if path.suffix.lower() == ".msh" and (file.read(1) == b"$" or not path.stat().st_size):
            reader = gmsh.read
    said = io.StringIO()
    try:
        if reader:
            return reader(path)
        by = "meshio"
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return of_meshio(_by_meshio(path))
    except ModuleNotFoundError as error:
        raise _lacking(str(path), error) from error
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{said.getvalue()} {error if str(error) != '1' else ''}".split()) or type(error).__name__
        if isinstance(error, (IndexError, KeyError)):
            reason = f"it ends too early, or counts what is not there ({type(error).__name__}: {reason})"
        raise ValueError(
            f"{path}: {by} cannot read this file ({reason}); check that it is complete and that its suffix names its format"
        ) from error


def _by_meshio(path: Path):
    import meshio

    suffix = path.suffix.lower()
    if suffix not in meshio.extension_to_filetypes:
        known = ", ".join(sorted({*READERS, ".msh", *SURFACES, *meshio.extension_to_filetypes}))
        raise ValueError(
            f"nothing reads {suffix or 'files without a suffix'}; convert it, with Gmsh or ParaView say, to {known}"
        )
    text = path.read_bytes() if suffix in NASTRAN else b""
    if not text or b"BEGIN BULK" in text.upper().replace(b"  ", b" "):
        mesh = meshio.read(path)
        return _of_med(mesh) if suffix == ".med" else mesh
    with tempfile.TemporaryDirectory() as folder:  # bulk data alone, as Gmsh writes them
        whole = Path(folder) / f"bulk{path.suffix}"
        whole.write_bytes(b"BEGIN BULK\n" + text)
        return meshio.read(whole)


def _of_med(mesh):
    """With tetrahedra turned as everybody else has them, and the names of families as groups of cells and points."""
    for block in mesh.cells:
        if block.type in ("tetra", "tetra10"):
            block.data = np.asarray(block.data)[:, list(MIRRORED[: block.data.shape[1]])]
    for number, names in getattr(mesh, "cell_tags", {}).items():
        for name in names:
            rows = [np.nonzero(values == number)[0] for values in mesh.cell_data["cell_tags"]]
            known = mesh.cell_sets.get(name, [np.zeros(0, np.int64)] * len(rows))
            mesh.cell_sets[name] = [np.union1d(a, b).astype(np.int64) for a, b in zip(known, rows)]
    for number, names in getattr(mesh, "point_tags", {}).items():
        for name in names:
            rows = np.nonzero(mesh.point_data["point_tags"] == number)[0]
            mesh.point_sets[name] = np.union1d(mesh.point_sets.get(name, []), rows).astype(np.int64)
    mesh.cell_data.pop("cell_tags", None)
    return mesh


def of_meshio(mesh) -> FileMesh:
    """The same of a mesh of meshio's."""
    out = FileMesh(np.asarray(mesh.points, np.float64), [(block.type, np.asarray(block.data)) for block in mesh.cells])
    if out.points.ndim != 2 or out.points.shape[1] != 3:
        raise ValueError(f"its points have shape {out.points.shape}; a body needs three coordinates")
    names = {(int(dim), int(tag)): name for name, (tag, dim) in mesh.field_data.items()}
    for name, members in mesh.cell_sets.items():
        if name != "gmsh:bounding_entities":
            for k, rows in enumerate(members):
                if rows is not None:
                    out.group(name, k, np.asarray(rows, np.int64))
    groups_of_arrays(out, mesh.cell_data, names)
    for name, rows in mesh.point_sets.items():
        out.point_sets[name] = np.unique(rows).astype(np.int64)
    for name, values in mesh.point_data.items():
        if name.startswith(VERTEX_PREFIX):
            out.point_sets[name.removeprefix(VERTEX_PREFIX)] = np.nonzero(values)[0]
    return out


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
