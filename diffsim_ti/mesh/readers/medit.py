"""MEDIT's text format, versions 1 to 4, with what mmg adds: ridges, required entities, normals, tangents.

Frey 2001, MEDIT: an interactive mesh visualization software, INRIA RT-0253.
"""

from pathlib import Path

import numpy as np

from diffsim_ti.mesh.readers.file_mesh import FileMesh

CELLS = {  # keyword -> kind, number of nodes; each row ends with a reference
    "Vertices": ("point", 3),
    "Edges": ("line", 2),
    "EdgesP2": ("line3", 3),
    "Triangles": ("triangle", 3),
    "TrianglesP2": ("triangle6", 6),
    "Quadrilaterals": ("quad", 4),
    "Tetrahedra": ("tetra", 4),
    "TetrahedraP2": ("tetra10", 10),
    "Hexahedra": ("hexahedron", 8),
    "Hexaedra": ("hexahedron", 8),
    "Prisms": ("wedge", 6),
    "Pyramids": ("pyramid", 5),
}
NAMED = {"Corners": None, "RequiredVertices": None, "Ridges": "line", "RequiredEdges": "line"}
NAMED |= {"RequiredTriangles": "triangle"}
OTHERS = {"Normals": 3, "NormalAtVertices": 2, "Tangents": 3, "TangentAtVertices": 2, "NormalAtTriangleVertices": 3}
OTHERS |= {"TangentAtEdges": 3, "SubDomainFromMesh": 4, "SubDomainFromGeom": 4, "EdgeOnGeometricEdge": 2}
OTHERS |= {"VertexOnGeometricVertex": 2, "ParallelVertices": 1, "ParallelTriangles": 1, "RequiredTetrahedra": 1}
OTHERS |= {"RequiredQuadrilaterals": 1}
SINGLE = {"AngleOfCornerBound": 1, "BoundingBox": 6, "MeshVersionFormatted": 1, "Dimension": 1, "Geometry": 1}


def read(path: Path) -> FileMesh:
    """The mesh of a file; references become groups tag_<n>, required entities and corners sets of their keywords."""
    lines = (line.split(b"#")[0] for line in path.read_bytes().splitlines())
    words, at = [word.decode(errors="replace") for line in lines for word in line.split()], 0
    tables: dict[str, np.ndarray] = {}
    while at < len(words) and words[at] != "End":
        keyword, at = words[at], at + 1
        if keyword in SINGLE:
            if keyword == "Dimension" and words[at : at + 1] != ["3"]:
                raise ValueError(f"its dimension is {words[at : at + 1]}; a body needs three")
            at += SINGLE[keyword]
            continue
        width = CELLS[keyword][1] + 1 if keyword in CELLS else OTHERS.get(keyword, 1 if keyword in NAMED else None)
        if width is None:
            raise ValueError(f"keyword {keyword!r} is not known; export the mesh without it")
        if at >= len(words) or not words[at].isdigit():
            raise ValueError(f"{keyword} is not followed by a number of rows")
        count = int(words[at])
        own = words[at + 1 : at + 1 + count * width]
        if len(own) < count * width:
            raise ValueError(f"it ends within {keyword}, which has {count} rows")
        if keyword in tables:
            raise ValueError(f"{keyword} stands there twice")
        try:
            tables[keyword] = np.array(own, float).reshape(count, width)
        except ValueError as error:
            raise ValueError(f"{keyword}: {error}") from error
        at += 1 + count * width
    if "Vertices" not in tables:
        raise ValueError("Vertices are missing")
    return _mesh(tables)


def _mesh(tables: dict) -> FileMesh:
    out, numbers, place = FileMesh(tables["Vertices"][:, :3]), [], {}
    for keyword, rows in tables.items():
        if keyword in CELLS and keyword != "Vertices":
            kind = CELLS[keyword][0]
            place[kind] = len(out.blocks)
            out.blocks.append((kind, rows[:, :-1].astype(np.int64) - 1))
            numbers.append(rows[:, -1].astype(np.int64))
    out.group_by_number(numbers)
    for keyword, kind in NAMED.items():
        rows = tables.get(keyword, np.zeros((0, 1)))[:, 0].astype(np.int64) - 1
        if not len(rows):
            continue
        if kind is None:
            out.point_sets[keyword] = np.unique(_within(rows, len(out.points), keyword))
        elif kind in place:
            out.group(keyword, place[kind], np.unique(_within(rows, len(out.blocks[place[kind]][1]), keyword)))
    if (refs := np.unique(tables["Vertices"][:, 3])).any() and len(refs) > 1:
        out.left_out.append(f"references of vertices ({len(refs)} numbers)")
    return out


def _within(rows: np.ndarray, count: int, keyword: str) -> np.ndarray:
    if rows.min() < 0 or rows.max() >= count:
        raise ValueError(f"{keyword} names {rows[(rows < 0) | (rows >= count)][0] + 1}, but there are {count}")
    return rows
