"""TetGen's .node and .ele files, numbered from 0 or 1, with attributes of regions and markers of vertices.

Si 2015, TetGen manual, "File formats".
"""

from pathlib import Path

import numpy as np

from diffsim_ti.mesh.readers.file_mesh import FileMesh

# TetGen's mid-edge nodes lie on edges 23, 03, 01, 12, 13, 02, seen from its corners
TEN_NODES = [0, 1, 2, 3, 6, 7, 9, 5, 8, 4]


def read(path: Path) -> FileMesh:
    """The mesh of an .ele file and the .node file beside it; region attributes become groups tag_<n>."""
    nodes, first = _table(path.with_suffix(".node"), "points", lambda head: 1 + head[1] + head[2] + head[3])
    cells, _ = _table(path.with_suffix(".ele"), "tetrahedra", lambda head: 1 + head[1] + head[2])
    dim, size = first[1], _header(path.with_suffix(".ele"))[1]
    if dim != 3 or size not in (4, 10):
        raise ValueError(f"points of dimension {dim} and elements of {size} nodes; there may be 3, and 4 or 10")
    number = {int(n): k for k, n in enumerate(nodes[:, 0])}
    if len(number) < len(nodes):
        raise ValueError("two points have the same number")
    rows = cells[:, 1 : 1 + size].astype(np.int64)
    try:
        rows = np.array([[number[n] for n in row] for row in rows.tolist()], np.int64).reshape(len(rows), size)
    except KeyError as error:
        raise ValueError(f"a tetrahedron names point {error}, which the .node file does not list") from error
    out = FileMesh(nodes[:, 1:4], [("tetra", rows) if size == 4 else ("tetra10", rows[:, TEN_NODES])])
    if cells.shape[1] > 1 + size:
        regions = cells[:, 1 + size]
        if np.all(regions == np.round(regions)):
            out.group_by_number([regions.astype(np.int64)], named_zero=True)
        else:
            out.left_out.append("attributes of regions that are no whole numbers")
        if cells.shape[1] > 2 + size:
            out.left_out.append("further attributes of regions")
    return out


def _lines(path: Path) -> list[list[str]]:
    if not path.is_file():
        raise ValueError(
            f"{path.name} is missing: a mesh of TetGen is an .ele file and the .node file of the same name"
        )
    rows = (line.split(b"#")[0].split() for line in path.read_bytes().splitlines())
    return [row for row in rows if row]


def _header(path: Path) -> list[int]:
    head = [int(word) for word in _lines(path)[0]]
    return head + [0] * (4 - len(head))


def _table(path: Path, what: str, width) -> tuple[np.ndarray, list[int]]:
    lines = _lines(path)
    if not lines:
        raise ValueError(f"{path.name} is empty")
    head = _header(path)
    own = lines[1 : 1 + head[0]]
    if len(own) < head[0] or any(len(row) < width(head) for row in own):
        raise ValueError(f"{path.name} says {head[0]} {what} with {width(head)} numbers each, and has fewer")
    return np.array([row[: width(head)] for row in own], float).reshape(head[0], -1), head
