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
    nodes, dim = _table(path.with_suffix(".node"), "points", 4)
    cells, size = _table(path.with_suffix(".ele"), "tetrahedra", 3)
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


def _table(path: Path, what: str, columns: int) -> tuple[np.ndarray, int]:
    """(rows of numbers, the second number of the header); so many numbers of the header say how wide rows are."""
    if not path.is_file():
        raise ValueError(
            f"{path.name} is missing: a mesh of TetGen is an .ele file and the .node file of the same name"
        )
    head, *lines = [row for line in path.read_bytes().splitlines() if (row := line.split(b"#")[0].split())] or [[]]
    if not head:
        raise ValueError(f"{path.name} is empty")
    count, *sizes = [int(word) for word in head][:columns]
    width, own = 1 + sum(sizes), lines[:count]
    if len(own) < count or any(len(row) < width for row in own):
        raise ValueError(f"{path.name} says {count} {what} with {width} numbers each, and has fewer")
    return np.array([row[:width] for row in own], float).reshape(count, -1), [*sizes, 0][0]
