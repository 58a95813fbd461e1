"""A file of every format and variant that the guide's table names, by programs other than this one or after the formats'
descriptions, and what becomes of it."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mesh_files
import numpy as np
import pytest
from mesh_files import BAR, TAGS, P, T

import diffsim_ti as ds

READ, SAID, REFUSED = "read", "read, with a warning", "refused"
OUTCOMES = (READ, SAID, REFUSED)
TEN = BAR.quadratic()


@dataclass(frozen=True)
class Variant:
    """write: (folder) -> path. words: of the warning or the error. volume [m^3], relatively within; num_sets: of tetrahedra,
    at least."""

    format: str
    name: str
    outcome: str
    write: Callable[[Path], Path]
    words: str = ""
    volume: float = BAR.volume
    num_sets: int = 2
    within: float = 1e-6


VARIANTS: list[Variant] = []


def variant(format: str, name: str, outcome: str = READ, words: str = "", **options):
    """Add what a function writes: a path, or the content of a file of the suffix that it is given with."""

    def add(write):
        VARIANTS.append(Variant(format, name, outcome, write, words, **options))
        return write

    return add


def text(suffix: str, make: Callable):
    """(folder) -> path of a file with that content."""

    def write(folder: Path) -> Path:
        path, content = folder / f"file.{suffix}", make()
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


# ---- Gmsh, by itself -----------------------------------------------------------------------------------------------------


def by_gmsh(folder: Path) -> dict[str, Path]:
    """name -> path: two boxes with groups, in every format of Gmsh's and with every option that changes it."""
    gmsh = pytest.importorskip("gmsh", exc_type=(ImportError, OSError))
    gmsh.initialize(interruptible=False)
    out = {}

    def write(name: str, suffix: str = "msh", **options) -> None:
        for option, value in (dict(MshFileVersion=4.1, Binary=0, SaveAll=0, SaveParametric=0) | options).items():
            gmsh.option.setNumber(f"Mesh.{option}", value)
        out[name] = folder / f"{name}.{suffix}"
        gmsh.write(str(out[name]))

    try:
        gmsh.option.setNumber("General.Terminal", 0)
        occ, mesh = gmsh.model.occ, gmsh.model.mesh
        for order in (1, 2):
            gmsh.clear()
            occ.fragment([(3, occ.addBox(0, 0, 0, 1, 1, 1))], [(3, occ.addBox(1, 0, 0, 1, 1, 1))])
            occ.synchronize()
            first, second = (tag for _, tag in gmsh.model.getEntities(3))
            gmsh.model.addPhysicalGroup(3, [first], 1, "soft")
            gmsh.model.addPhysicalGroup(3, [second], 2, "stiff")
            left, right = (
                [t for _, t in gmsh.model.getEntities(2) if abs(occ.getCenterOfMass(2, t)[0] - x) < 1e-6]
                for x in (0, 2)
            )
            gmsh.model.addPhysicalGroup(2, left, 3, "clamp")
            gmsh.option.setNumber("Mesh.MeshSizeMax", 1.0)
            mesh.generate(3)
            mesh.setOrder(order)
            for version in (1.0, 2.2, 4.0, 4.1):
                for binary, everything, parametric in np.ndindex(2, 2, 2):
                    if not (binary and version in (1.0, 4.0)):
                        options = dict(Binary=binary, SaveAll=everything, SaveParametric=parametric)
                        name = f"order{order}_{version}_{binary}{everything}{parametric}"
                        write(name, MshFileVersion=version, **options)
        for suffix in ("inp", "bdf", "mesh", "vtk", "med"):
            write(f"export.{suffix}", suffix)
        mesh.setOrder(3)
        write("order3")
        mesh.clear()
        shift = [1, 0, 0, 2, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        mesh.setPeriodic(2, right, left, shift)
        mesh.generate(3)
        mesh.setOrder(1)
        write("order1_periodic")
        mesh.partition(3)
        for version in (2.2, 4.1):
            write(f"partitioned_{version}", MshFileVersion=version)
        gmsh.clear()
        occ.addBox(0, 0, 0, 1, 1, 1)
        occ.synchronize()
        mesh.setTransfiniteAutomatic()
        mesh.generate(3)
        write("hexahedra", SaveAll=1)
        return out
    finally:
        gmsh.finalize()


KNOWN: dict[str, Path] = {}  # files by Gmsh, written once for all


def of_gmsh(name: str):
    def write(folder: Path) -> Path:
        if not KNOWN:
            KNOWN.update(by_gmsh(folder))
        return KNOWN[name]

    return write


MSH = "Gmsh `.msh`"
for name, file, options in (
    ("1", "order1_1.0_000", {}),
    ("2.2 text", "order1_2.2_000", {}),
    ("2.2 binary", "order1_2.2_100", {}),
    ("4.0 text", "order1_4.0_000", {}),
    ("4.1 text", "order1_4.1_000", {}),
    ("4.1 binary", "order1_4.1_100", {}),
    ("second order", "order2_4.1_100", {}),
    ("parametric", "order2_4.1_001", {}),
    ("SaveAll of 4.1", "order1_4.1_010", {}),
    ("partitioned", "partitioned_4.1", {}),
    ("periodic", "order1_periodic", {}),
    ("SaveAll of 2.2", "order1_2.2_010", dict(outcome=SAID, words="clamp, soft, stiff .*Mesh.SaveAll", num_sets=0)),
    ("third order", "order3", dict(outcome=REFUSED, words="Mesh.ElementOrder = 2")),
    ("hexahedra", "hexahedra", dict(outcome=REFUSED, words="no tetrahedra.*hexahedron")),
):
    variant(MSH, name, **dict(volume=2.0) | options)(of_gmsh(file))


@variant(MSH, "4.0 binary")
def gmsh40_binary(folder: Path) -> Path:
    """After Gmsh's reference manual, "MSH file format version 4.0": unsigned long counts, entities before dimensions."""
    i, n, x = (lambda *a, kind=kind: struct.pack(f"<{len(a)}{kind}", *a) for kind in "iQd")
    entities = n(0, 0, 1, 2) + b"".join(
        i(tag) + x(0, 0, 0, 1, 1, 1) + n(len(groups)) + i(*groups) + n(0)
        for tag, groups in ((1, [3]), (1, [7]), (2, [9]))
    )
    nodes = n(1, len(P)) + i(1, 3, 0) + n(len(P)) + b"".join(i(k) + x(*p) for k, p in enumerate(P, 1))
    first, elements = 1, n(3, len(mesh_files.CLAMP) + len(T))
    for tag, dim, kind, cells in ((1, 2, 2, mesh_files.CLAMP), (1, 3, 4, T[:6]), (2, 3, 4, T[6:])):
        elements += i(tag, dim, kind) + n(len(cells)) + b"".join(i(k, *row) for k, row in enumerate(cells + 1, first))
        first += len(cells)
    names = b'$PhysicalNames\n3\n2 3 "clamp"\n3 7 "soft"\n3 9 "stiff"\n$EndPhysicalNames\n'
    sections = dict(Entities=entities, Nodes=nodes, Elements=elements)
    path = folder / "binary40.msh"
    path.write_bytes(
        b"$MeshFormat\n4 1 8\n" + i(1) + b"\n$EndMeshFormat\n" + names
        + b"".join(f"${name}\n".encode() + data + f"\n$End{name}\n".encode() for name, data in sections.items())
    )  # fmt: skip
    return path


# ---- Abaqus, MEDIT, TetGen, Nastran: after their manuals, by Gmsh and by meshio ------------------------------------------

INP, NODES = "Abaqus, CalculiX `.inp`", "*NODE\n" + mesh_files.numbered(P.tolist(), 1, ", ")
ELEMENTS = mesh_files.numbered((T + 1).tolist(), 1, ", ")
DECK = f"{NODES}*ELEMENT, TYPE=C3D4, ELSET=ALL\n{ELEMENTS}"
SETS = "*ELSET, ELSET=SOFT, GENERATE\n1, 6\n*ELSET, ELSET=STIFF\n7, 8, 9\n*ELSET, ELSET=STIFF\n10, 11, 12\n"
PART = f"*Part, name=Bar\n{NODES}*Element, type=C3D4\n{ELEMENTS}*End Part\n*Assembly, name=A\n"
PLACED = "*Instance, name=One, part=Bar\n*End Instance\n*Instance, name=Two, part=Bar\n1., 0., 0.\n*End Instance\n"
variant(INP, "as Gmsh writes it", volume=2.0)(of_gmsh("export.inp"))
variant(INP, "sets by range, number and name")(text("inp", lambda: DECK + SETS))
variant(INP, "parts and instances", volume=2 * BAR.volume)(text("inp", lambda: PART + PLACED + "*End Assembly\n"))
variant(INP, "C3D10M", num_sets=0)(
    text(
        "inp",
        lambda: "*NODE\n" + mesh_files.numbered(TEN.vertices.tolist(), 1, ", ")
        + "*ELEMENT, TYPE=C3D10M\n" + mesh_files.numbered((TEN.elements + 1).tolist(), 1, ", "),
    )
)  # fmt: skip
variant(INP, "shells, materials", SAID, r"S4R \(1\).*\*MATERIAL, \*ELASTIC", num_sets=0)(
    text("inp", lambda: DECK + "*ELEMENT, TYPE=S4R\n900, 1, 2, 4, 3\n*MATERIAL, NAME=R\n*ELASTIC\n1e5, 0.3\n")
)
variant(INP, "hexahedra", REFUSED, "C3D8 are no tetrahedra")(
    text("inp", lambda: f"{NODES}*ELEMENT, TYPE=C3D8\n1, 1, 2, 3, 4, 5, 6, 7, 8\n")
)
variant(INP, "`*NGEN`", REFUSED, r"\*NGEN makes nodes")(text("inp", lambda: NODES + "*NGEN\n1, 5\n"))


@variant(INP, "`*INCLUDE`", num_sets=0)
def with_include(folder: Path) -> Path:
    (folder / "nodes.inp").write_text(NODES)
    path = folder / "main.inp"
    path.write_text(f"*INCLUDE, INPUT=nodes.inp\n*ELEMENT, TYPE=C3D4\n{ELEMENTS}")
    return path


MESH = "MEDIT `.mesh`"
variant(MESH, "2, required vertices")(text("mesh", mesh_files.medit))
variant(MESH, "as Gmsh writes it", SAID, "references of vertices", volume=2.0)(of_gmsh("export.mesh"))
variant(MESH, "unknown keywords", REFUSED, "Spheres")(
    text("mesh", lambda: mesh_files.medit().replace("RequiredVertices", "Spheres"))
)
variant(MESH, "binary `.meshb`", REFUSED, "meshio cannot read this file")(
    text("meshb", lambda: struct.pack("<2i", 1, 2) + b"\0" * 20)
)

TET = "TetGen `.ele` with `.node`"


def tetgen(first: int):
    def write(folder: Path) -> Path:
        path = folder / f"from{first}.ele"
        path.with_suffix(".node").write_text(f"{len(P)} 3 0 0\n" + mesh_files.numbered(P.tolist(), first))
        regions = [[*t, tag] for t, tag in zip((T + first).tolist(), TAGS.tolist())]
        path.write_text(f"{len(T)} 4 1\n" + mesh_files.numbered(regions, first))
        return path

    return write


@variant(TET, "ten nodes", num_sets=0)
def tetgen_ten(folder: Path) -> Path:
    """As TetGen itself numbers them."""
    made = pytest.importorskip("tetgen").TetGen(P, BAR.surface_triangles.astype(np.int32))
    X, cells = made.tetrahedralize(order=2, nobisect=True)[:2]
    path = folder / "ten.ele"
    path.with_suffix(".node").write_text(f"{len(X)} 3 0 0\n" + mesh_files.numbered(np.asarray(X).tolist(), 0))
    path.write_text(f"{len(cells)} 10 0\n" + mesh_files.numbered(np.asarray(cells).tolist(), 0))
    return path


variant(TET, "numbered from 0, regions")(tetgen(0))
variant(TET, "numbered from 1, regions")(tetgen(1))
variant(TET, "without `.node`", REFUSED, "node")(
    text("ele", lambda: f"{len(T)} 4 0\n" + mesh_files.numbered(T.tolist()))
)


def meshio_mesh(ten: bool = False):
    meshio = pytest.importorskip("meshio")
    if ten:
        return meshio.Mesh(TEN.vertices, [("tetra10", TEN.elements)])
    return meshio.Mesh(P, [("tetra", T)], cell_data={"MaterialIds": [TAGS]})


def by_meshio(suffix: str, ten: bool = False, needs: str | None = None, **options):
    def write(folder: Path) -> Path:
        if needs:
            pytest.importorskip(needs)
        path = folder / f"meshio.{suffix}"
        meshio_mesh(ten).write(path, **options)
        return path

    return write


BDF = "Nastran `.bdf`, `.nas`, `.fem`"
variant(BDF, "case control and bulk data", volume=BAR.volume)(text("bdf", mesh_files.nastran))
variant(BDF, "bulk data alone", volume=2.0)(of_gmsh("export.bdf"))
variant(BDF, "ten nodes", num_sets=0)(by_meshio("bdf", ten=True))
variant("MED `.med`", "families", volume=2.0)(of_gmsh("export.med"))
variant("XDMF `.xdmf`", "HDF5")(by_meshio("xdmf", needs="h5py"))
variant("XDMF `.xdmf`", "XML")(by_meshio("xdmf", data_format="XML"))
variant("XDMF `.xdmf`", "ten nodes", num_sets=0)(by_meshio("xdmf", ten=True, data_format="XML"))
variant("Exodus `.e`", "where `netCDF4` is installed", num_sets=0)(by_meshio("e", needs="netCDF4"))
variant("AVS-UCD `.avs`", "as meshio writes it")(by_meshio("avs"))


@variant("Exodus `.e`", "without the package `netCDF4`", REFUSED, "pip install netCDF4")
def exodus_alone(folder: Path) -> Path:
    try:
        import netCDF4  # noqa: F401
    except ModuleNotFoundError:
        path = folder / "bare.e"
        path.write_bytes(b"CDF\x02" + b"\0" * 40)
        return path
    pytest.skip("netCDF4 is installed")


# ---- VTK, by itself ------------------------------------------------------------------------------------------------------


def vtk_grid(ten: bool = False, ghosts: bool = False):
    """The bar as VTK has it; ghosts: with the last tetrahedron marked as that of another process."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import numpy_to_vtk

    grid, points = vtk.vtkUnstructuredGrid(), vtk.vtkPoints()
    points.SetDataType(vtk.VTK_DOUBLE)
    body = TEN if ten else ds.TetrahedralMesh(P, T)
    for x in body.vertices:
        points.InsertNextPoint(x)
    grid.SetPoints(points)
    for cell in body.elements:
        grid.InsertNextCell(vtk.VTK_LAGRANGE_TETRAHEDRON if ten else vtk.VTK_TETRA, len(cell), cell.tolist())
    tags = numpy_to_vtk(TAGS.astype(np.int64), deep=True, array_type=vtk.VTK_ID_TYPE)
    tags.SetName("MaterialIds")
    grid.GetCellData().AddArray(tags)
    if ghosts:
        marks = numpy_to_vtk((np.arange(len(T)) == 11).astype(np.uint8), deep=True)
        marks.SetName("vtkGhostType")
        grid.GetCellData().AddArray(marks)
    return vtk, grid


def legacy(version: int, binary: bool):
    def write(folder: Path) -> Path:
        vtk, grid = vtk_grid()
        writer = vtk.vtkUnstructuredGridWriter()
        writer.SetFileVersion(version)
        return finish(writer, grid, folder / f"v{version}_{binary}.vtk", binary)

    return write


def finish(writer, grid, path: Path, binary: bool | None = None) -> Path:
    if binary is not None:
        (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.SetFileName(str(path))
    writer.SetInputData(grid)
    assert writer.Write() == 1
    return path


def xml(mode: str = "Appended", compressor: str | None = None, encoded: bool = False, **options):
    def write(folder: Path) -> Path:
        vtk, grid = vtk_grid(**options)
        writer = vtk.vtkXMLUnstructuredGridWriter()
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetEncodeAppendedData(encoded)
        getattr(writer, f"SetCompressorTypeTo{compressor or 'None'}")()
        return finish(writer, grid, folder / f"{mode}{compressor}{encoded}.vtu")

    return write


VTK, VTU = "VTK `.vtk`", "VTK `.vtu`, `.pvtu`"
variant(VTK, "3.0 binary")(text("vtk", mesh_files.vtk_binary))
variant(VTK, "4.2 text")(legacy(42, False))
variant(VTK, "4.2 binary")(legacy(42, True))
variant(VTK, "5.1 text, `vtkIdType`")(legacy(51, False))
variant(VTK, "5.1 binary, `vtkIdType`")(legacy(51, True))


@variant(VTK, "other datasets than UNSTRUCTURED_GRID", REFUSED, "POLYDATA")
def polydata(folder: Path) -> Path:
    vtk = pytest.importorskip("vtk")
    ball = vtk.vtkSphereSource()
    ball.Update()
    return finish(vtk.vtkPolyDataWriter(), ball.GetOutput(), folder / "ball.vtk")


variant(VTU, "text")(xml("Ascii"))
variant(VTU, "base64")(xml("Binary"))
variant(VTU, "appended")(xml("Appended"))
variant(VTU, "appended in base64")(xml("Appended", encoded=True))
variant(VTU, "zlib")(xml("Appended", "ZLib"))
variant(VTU, "LZMA")(xml("Binary", "LZMA"))
variant(VTU, "LZ4", REFUSED, "LZ4")(xml("Appended", "LZ4"))
variant(VTU, "Lagrange cells of order 2")(xml("Appended", "ZLib", ten=True))
variant(VTU, "ghost cells, which are left out", volume=BAR.volume * 11 / 12)(xml("Appended", "ZLib", ghosts=True))


@variant(VTU, "several pieces, `.pvtu`", volume=2 * BAR.volume)
def pieces(folder: Path) -> Path:
    vtk, grid = vtk_grid()
    move = vtk.vtkTransform()
    move.Translate(0.5, 0, 0)
    moved = vtk.vtkTransformFilter()
    moved.SetTransform(move)
    moved.SetInputData(grid)
    moved.Update()
    for k, part in enumerate((grid, moved.GetOutput())):
        finish(vtk.vtkXMLUnstructuredGridWriter(), part, folder / f"piece_{k}.vtu")
    sources = "".join(f'<Piece Source="piece_{k}.vtu"/>' for k in range(2))
    path = folder / "pieces.pvtu"
    path.write_text(f'<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid>{sources}</PUnstructuredGrid></VTKFile>')
    return path


# ---- surfaces, by trimesh and by VTK -------------------------------------------------------------------------------------

SKIN = "surfaces `.stl`, `.obj`, `.ply`, `.off`, `.gltf`, `.glb`"


def by_trimesh(suffix: str, **options):
    def write(folder: Path) -> Path:
        trimesh = pytest.importorskip("trimesh")
        path = folder / f"skin.{suffix}"
        trimesh.Trimesh(P, BAR.surface_triangles, process=False).export(path, **options)
        return path

    return write


for name, file, options in (
    ("STL text", "stl", dict(file_type="stl_ascii")),
    ("STL binary", "stl", {}),
    ("OBJ", "obj", {}),
    ("PLY text", "ply", dict(encoding="ascii")),
    ("PLY binary", "ply", {}),
    ("OFF", "off", {}),
    ("glTF binary", "glb", {}),
):
    variant(SKIN, name, num_sets=0)(by_trimesh(file, **options))
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]  # of a cube
CORNERS = np.array(list(np.ndindex(2, 2, 2)), float)
CUBES = "".join(
    f"g part{k}\n" + mesh_files.rows((CORNERS + [2.0 * k, 0, 0]).tolist(), "v ")
    + mesh_files.rows((np.array(SIDES) + 1 + 8 * k).tolist(), "f ")
    for k in range(2)
)  # fmt: skip
variant(SKIN, "OBJ with groups and polygons", volume=2.0)(text("obj", lambda: CUBES))
FACES = BAR.surface_triangles.tolist()


def off(faces: list) -> str:
    return f"OFF\n{len(P)} {len(faces)} 0\n" + mesh_files.rows(P.tolist()) + mesh_files.rows(faces, "3 ")


variant(
    SKIN,
    "open or through itself, by fTetWild",
    SAID,
    r"not closed: 3 of .* filled by fTetWild, .* the body has 0\.00\d+ m\^3",
    num_sets=0,
    within=0.05,
)(text("off", lambda: off(FACES[1:])))
variant(SKIN, "points without faces", REFUSED, "no triangles")(text("off", lambda: off([])))
variant("other suffixes", "`.step`, `.c3d` ...", REFUSED, "convert it, with Gmsh or ParaView")(
    text("step", lambda: "x")
)


def table() -> dict[str, dict[str, list[str]]]:
    """format -> outcome -> names of variants."""
    out = {}
    for one in VARIANTS:
        out.setdefault(one.format, {outcome: [] for outcome in OUTCOMES})[one.outcome].append(one.name)
    return out


def page() -> str:
    """The guide's table, as `python tests/mesh_variants.py` prints it."""
    lines = [f"| format | {' | '.join(OUTCOMES)} |", "| --- | --- | --- | --- |"]
    lines += [f"| {name} | {' | '.join('; '.join(cells) for cells in row.values())} |" for name, row in table().items()]
    return "\n".join(lines)


if __name__ == "__main__":
    print(page())
