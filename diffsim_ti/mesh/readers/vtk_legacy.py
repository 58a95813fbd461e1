"""Legacy files of VTK, versions 1 to 5.1, in text and binary, of unstructured grids.

VTK file formats, "Simple legacy formats". Binary numbers are big-endian.
"""

from pathlib import Path
from urllib.parse import unquote

import numpy as np

from diffsim_ti.mesh.readers.file_mesh import FileMesh
from diffsim_ti.mesh.readers.vtk_cells import grid

TYPES = {"char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4", "unsigned_int": "u4"}
TYPES |= {"long": "i8", "unsigned_long": "u8", "float": "f4", "double": "f8", "vtkidtype": "i4", "vtktypeint64": "i8"}
TYPES |= {"vtktypeint32": "i4", "vtktypeint16": "i2", "vtktypeint8": "i1", "vtktypeuint8": "u1", "vtktypeuint64": "u8"}
TYPES |= {"vtktypefloat64": "f8", "vtktypefloat32": "f4", "vtktypeuint32": "u4", "bit": "u1"}


class _File:
    """Bytes that are read line by line, and numbers in between."""

    def __init__(self, data: bytes):
        self.data, self.at, self.binary = data, 0, False

    def _next(self) -> bytes | None:
        """The next line; None at the end."""
        if self.at >= len(self.data):
            return None
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        line, self.at = self.data[self.at : end], end + 1
        return line

    def line(self) -> str | None:
        """The next line that is not empty; None at the end."""
        while (line := self._next()) is not None:
            if line.strip():
                return line.strip().decode("utf-8", errors="replace")
        return None

    def skip_metadata(self) -> None:
        """Up to the empty line behind it."""
        while (line := self._next()) is not None and line.strip():
            pass

    def numbers(self, kind: str, count: int) -> np.ndarray:
        """The next numbers."""
        kind = kind.lower()
        if kind not in TYPES:
            raise ValueError(f"numbers of type {kind!r} are not known")
        dtype = np.dtype(TYPES[kind])
        if not 0 <= count <= len(self.data) * (8 if kind == "bit" else 1):
            raise ValueError(f"{count} numbers are more than the file can hold")
        if self.binary:
            size = (count + 7) // 8 if kind == "bit" else count * dtype.itemsize
            if self.at + size > len(self.data):
                raise ValueError("it ends within its numbers")
            raw = self.data[self.at : self.at + size]
            self.at += size
            if kind == "bit":
                return np.unpackbits(np.frombuffer(raw, np.uint8))[:count]
            return np.frombuffer(raw, dtype.newbyteorder(">")).astype(dtype)
        found = []
        while len(found) < count:
            if (line := self._next()) is None:
                raise ValueError("it ends within its numbers")
            found += line.split()
        if len(found) > count:
            raise ValueError(f"a line has more numbers than the {count} that are announced")
        return np.array(found).astype("f8" if dtype.kind == "f" else "i8") if count else np.zeros(0, dtype)


def read(path: Path) -> FileMesh:
    """The mesh of a file; whole numbers of cells become groups (vtk_cells.py)."""
    file = _File(path.read_bytes())
    if not (file.line() or "").lower().startswith("# vtk datafile version"):
        raise ValueError("it does not begin with '# vtk DataFile Version'")
    file.line()
    mode, dataset = (file.line() or "").upper(), (file.line() or "").upper().split()
    file.binary = mode == "BINARY"
    if mode not in ("ASCII", "BINARY"):
        raise ValueError(f"its third line must be ASCII or BINARY, got {mode!r}")
    if dataset[:1] != ["DATASET"] or dataset[1:] != ["UNSTRUCTURED_GRID"]:
        raise ValueError(f"it holds {' '.join(dataset[1:]) or 'no dataset'}; export an UNSTRUCTURED_GRID of tetrahedra")
    points = types = None
    cells, arrays, counts, where = (None, None), {"POINT": {}, "CELL": {}}, {"POINT": 0, "CELL": 0}, None
    while line := file.line():
        word, *rest = line.split()
        word = word.upper()
        if word == "POINTS":
            points = file.numbers(rest[1], 3 * int(rest[0])).reshape(-1, 3)
        elif word == "CELLS":
            cells = _cells(file, int(rest[0]), int(rest[1]))
        elif word == "CELL_TYPES":
            types = file.numbers("int", int(rest[0]))
        elif word in ("POINT_DATA", "CELL_DATA"):
            where = word[:-5]
            counts[where] = int(rest[0])
        elif word == "FIELD":
            _field(file, int(rest[1]), arrays[where] if where else {})
        elif word == "METADATA":
            file.skip_metadata()
        elif where:
            _attribute(file, word, rest, counts[where], arrays[where])
        else:
            raise ValueError(f"{word!r} is not known there")
    if points is None or types is None or cells[0] is None:
        raise ValueError("POINTS, CELLS or CELL_TYPES are missing")
    return grid(points.astype(np.float64), *cells, types.astype(np.int64), arrays["POINT"], arrays["CELL"])


def _cells(file: _File, count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """(nodes of all cells, where those of each begin and end)."""
    before = file.at
    line = file.line() or ""
    if line.upper().startswith("OFFSETS"):
        offsets = file.numbers(line.split()[1], count).astype(np.int64)
        line = file.line() or ""
        if not line.upper().startswith("CONNECTIVITY"):
            raise ValueError("CONNECTIVITY does not follow OFFSETS")
        return file.numbers(line.split()[1], size).astype(np.int64), offsets
    file.at = before
    listed = file.numbers("int", size).astype(np.int64)
    offsets, at, nodes = [0], 0, np.ones(size, bool)
    for _ in range(count):
        if at >= size or not 0 <= listed[at] <= size - at - 1:
            raise ValueError(f"CELLS: {size} numbers do not hold {count} cells")
        nodes[at] = False
        offsets.append(offsets[-1] + int(listed[at]))
        at += 1 + int(listed[at])
    if at != size:
        raise ValueError(f"CELLS: {count} cells have {at} numbers, where it says {size}")
    return listed[nodes], np.array(offsets)


def _field(file: _File, count: int, arrays: dict) -> None:
    for _ in range(count):
        line = file.line() or ""
        if line.upper() == "METADATA":
            file.skip_metadata()
            line = file.line() or ""
        name, width, rows, kind = line.split()
        if kind.lower() == "string":
            _skip_strings(file, int(width) * int(rows))
            continue
        arrays[unquote(name)] = _shaped(file.numbers(kind, int(width) * int(rows)), int(width))


def _skip_strings(file: _File, count: int) -> None:
    for _ in range(count):
        if not file.binary:
            file.line()
            continue
        first = file.data[file.at]
        width = {3: 1, 2: 2, 1: 4, 0: 8}[first >> 6]
        size = int.from_bytes(file.data[file.at : file.at + width], "big") & ((1 << (8 * width - 2)) - 1)
        file.at += width + size


def _shaped(values: np.ndarray, width: int) -> np.ndarray:
    return values if width == 1 else values.reshape(-1, width)


def _attribute(file: _File, word: str, rest: list, count: int, arrays: dict) -> None:
    widths = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6}
    if word == "SCALARS":
        width = int(rest[2]) if len(rest) > 2 else 1
        before = file.at
        if not (file.line() or "").upper().startswith("LOOKUP_TABLE"):
            file.at = before
        arrays[unquote(rest[0])] = _shaped(file.numbers(rest[1], width * count), width)
    elif word in ("LOOKUP_TABLE", "COLOR_SCALARS"):
        each = 4 if word == "LOOKUP_TABLE" else count
        file.numbers("unsigned_char" if file.binary else "float", int(rest[1]) * each)
    elif word in ("TEXTURE_COORDINATES", "GLOBAL_IDS", "PEDIGREE_IDS", *widths):
        width = int(rest[1]) if word == "TEXTURE_COORDINATES" else widths.get(word, 1)
        arrays[unquote(rest[0])] = _shaped(file.numbers(rest[-1], width * count), width)
    else:
        raise ValueError(f"{word!r} is not known there")
