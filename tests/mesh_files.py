"""One bar of two materials with a clamped end as files of every format, written by hand after the formats' descriptions."""

from pathlib import Path

import numpy as np

import diffsim_ti as ds

BAR = ds.TetrahedralMesh.create_box((3, 2, 2), (0.2, 0.1, 0.1))
ORDER = np.argsort(BAR.centroids[:, 0], kind="stable")
P, T = BAR.vertices, BAR.tetrahedra[ORDER]  # six soft tetrahedra, then six stiff ones
TAGS = np.repeat([7, 9], 6)
CLAMP = BAR.surface_triangles[BAR.surface_sets["xmin"]]


def rows(table, first: str = "") -> str:
    """Lines of numbers."""
    return "".join(
        first + " ".join(f"{x:.17g}" if isinstance(x, float) else str(x) for x in row) + "\n" for row in table
    )


def numbered(table, start: int = 1, between: str = " ") -> str:
    return "".join(f"{k}{between}" + between.join(map(str, row)) + "\n" for k, row in enumerate(table, start))


def points() -> list:
    return P.tolist()


def gmsh22() -> str:
    names = '$PhysicalNames\n3\n2 3 "clamp"\n3 7 "soft"\n3 9 "stiff"\n$EndPhysicalNames\n'
    cells = [(2, 3, t) for t in CLAMP.tolist()] + [(4, g, t) for g, t in zip(TAGS.tolist(), T.tolist())]
    listed = [(kind, 2, g, g, *(k + 1 for k in t)) for kind, g, t in cells]
    return (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{names}$Nodes\n{len(P)}\n{numbered(points())}$EndNodes\n$Elements\n"
        f"{len(listed)}\n{numbered(listed)}$EndElements\n"
    )


def gmsh41() -> str:
    names = '$PhysicalNames\n3\n2 3 "clamp"\n3 7 "soft"\n3 9 "stiff"\n$EndPhysicalNames\n'
    entities = "$Entities\n0 0 1 2\n1 0 0 0 0 1 1 1 3 0\n1 0 0 0 1 1 1 1 7 0\n2 1 0 0 2 1 1 1 9 0\n$EndEntities\n"
    tags = "\n".join(map(str, range(1, len(P) + 1)))
    nodes = f"$Nodes\n1 {len(P)} 1 {len(P)}\n3 1 0 {len(P)}\n{tags}\n{rows(points())}$EndNodes\n"
    parts = [(2, 1, 2, CLAMP), (3, 1, 4, T[:6]), (3, 2, 4, T[6:])]
    text, first = "", 1
    for dim, entity, kind, cells in parts:
        text += f"{dim} {entity} {kind} {len(cells)}\n" + numbered((cells + 1).tolist(), first)
        first += len(cells)
    return (
        f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{names}{entities}{nodes}$Elements\n3 {first - 1} 1 {first - 1}\n{text}"
        "$EndElements\n"
    )


def gmsh1() -> str:
    listed = [(4, g, g, 4, *(k + 1 for k in t)) for g, t in zip(TAGS.tolist(), T.tolist())]
    return f"$NOD\n{len(P)}\n{numbered(points())}$ENDNOD\n$ELM\n{len(listed)}\n{numbered(listed)}$ENDELM\n"


def abaqus() -> str:
    blocks = "".join(
        f"*ELEMENT, TYPE=C3D4, ELSET={name}\n" + numbered((T[part] + 1).tolist(), 1 + part.start, ", ")
        for name, part in (("SOFT", slice(0, 6)), ("STIFF", slice(6, 12)))
    )
    return f"*HEADING\na bar\n*NODE\n{numbered(points(), 1, ', ')}{blocks}*NSET, NSET=CLAMP\n1, 2, 3, 4\n"


def medit() -> str:
    return (
        f"MeshVersionFormatted 2\nDimension 3\nVertices\n{len(P)}\n{rows([[*x, 0] for x in points()])}Triangles\n"
        f"{len(CLAMP)}\n{rows([[*t, 3] for t in (CLAMP + 1).tolist()])}Tetrahedra\n{len(T)}\n"
        f"{rows([[*t, g] for t, g in zip((T + 1).tolist(), TAGS.tolist())])}RequiredVertices\n2\n1\n2\nEnd\n"
    )


def tetgen(path: Path) -> str:
    path.with_suffix(".node").write_text(f"{len(P)} 3 0 0\n{numbered(points())}")
    return f"{len(T)} 4 1\n" + numbered([[*t, g] for t, g in zip((T + 1).tolist(), TAGS.tolist())])


def vtk42() -> str:
    cells = rows([[4, *t] for t in T.tolist()])
    tags = f"CELL_DATA {len(T)}\nSCALARS MaterialIds int 1\nLOOKUP_TABLE default\n{rows(TAGS[:, None].tolist())}"
    return (
        f"# vtk DataFile Version 4.2\nbar\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(P)} double\n{rows(points())}"
        f"CELLS {len(T)} {5 * len(T)}\n{cells}CELL_TYPES {len(T)}\n{rows([[10]] * len(T))}{tags}"
    )


def vtk_binary() -> bytes:
    big = [np.asarray(P, ">f8").tobytes(), np.asarray(np.insert(T, 0, 4, 1), ">i4").tobytes()]
    big += [np.full(len(T), 10, ">i4").tobytes(), np.asarray(TAGS, ">i4").tobytes()]
    heads = [
        f"# vtk DataFile Version 3.0\nbar\nBINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(P)} double\n",
        f"\nCELLS {len(T)} {5 * len(T)}\n",
        f"\nCELL_TYPES {len(T)}\n",
        f"\nCELL_DATA {len(T)}\nFIELD FieldData 1\nMaterialIds 1 {len(T)} int\n",
    ]
    return b"".join(head.encode() + data for head, data in zip(heads, big)) + b"\n"


def piece(vertices, tetrahedra, tags) -> str:
    """A <Piece> of a .vtu file, in text."""
    arrays = [("Float64", 3, "", vertices.ravel())]
    cells = [("Int64", "connectivity", tetrahedra.ravel()), ("UInt8", "types", np.full(len(tetrahedra), 10))]
    cells.append(("Int64", "offsets", np.arange(4, 4 * len(tetrahedra) + 1, 4)))

    def array(kind, name, values, width=1):
        text = " ".join(f"{x:.17g}" if kind == "Float64" else str(int(x)) for x in values)
        return (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" format="ascii">{text}</DataArray>\n'
        )

    return (
        f'<Piece NumberOfPoints="{len(vertices)}" NumberOfCells="{len(tetrahedra)}">\n<Points>'
        + array("Float64", "Points", arrays[0][3], 3)
        + "</Points>\n<Cells>"
        + "".join(array(*cell) for cell in cells)
        + "</Cells>\n<CellData>"
        + array("Int32", "MaterialIds", tags)
        + "</CellData>\n</Piece>\n"
    )


def vtu(*pieces: str) -> str:
    pieces = pieces or (piece(P, T, TAGS),)
    return (
        '<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian">\n'
        + "<UnstructuredGrid>\n"
        + "".join(pieces)
        + "</UnstructuredGrid>\n</VTKFile>\n"
    )


def nastran() -> str:
    grid = "".join(f"GRID    {i:<8d}        {x:<8.4f}{y:<8.4f}{z:<8.4f}\n" for i, (x, y, z) in enumerate(P, 1))
    cells = zip(T.tolist(), TAGS.tolist())
    solid = "".join(
        f"CTETRA  {i:<8d}{g:<8d}" + "".join(f"{k + 1:<8d}" for k in t) + "\n" for i, (t, g) in enumerate(cells, 1)
    )
    return f"SOL 101\nCEND\nBEGIN BULK\n{grid}{solid}ENDDATA\n"


def obj() -> str:
    return "o bar\n" + rows(points(), "v ") + rows((BAR.surface_triangles + 1).tolist(), "f ")


def stl() -> str:
    def facet(t):
        corners = "".join("vertex " + " ".join(f"{x:.9g}" for x in P[k]) + "\n" for k in t)
        return f"facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n"

    return "solid bar\n" + "".join(facet(t) for t in BAR.surface_triangles) + "endsolid bar\n"


def off() -> str:
    triangles = BAR.surface_triangles.tolist()
    return f"OFF\n{len(P)} {len(triangles)} 0\n" + rows(points()) + rows(triangles, "3 ")


SOLID = dict(
    gmsh1=("msh", gmsh1),
    gmsh22=("msh", gmsh22),
    gmsh41=("msh", gmsh41),
    abaqus=("inp", abaqus),
    medit=("mesh", medit),
    vtk42=("vtk", vtk42),
    vtk_binary=("vtk", vtk_binary),
    vtu=("vtu", vtu),
    nastran=("bdf", nastran),
)
SURFACES = dict(obj=("obj", obj), stl=("stl", stl), off=("off", off))


def written(folder: Path, surfaces: bool = True) -> dict[str, Path]:
    """name -> path of the bar in every format."""
    folder.mkdir(parents=True, exist_ok=True)
    out = {}
    for name, (suffix, make) in {**SOLID, **(SURFACES if surfaces else {})}.items():
        path, content = folder / f"{name}.{suffix}", make()
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        out[name] = path
    path = folder / "tetgen.ele"
    path.write_text(tetgen(path))
    return out | {"tetgen": path}
