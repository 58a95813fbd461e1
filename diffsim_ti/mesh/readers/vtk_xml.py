"""VTK's XML files of unstructured grids, .vtu, and the .pvtu files that name several of them.

VTK file formats, "XML file formats": several pieces; data as text, base64 or raw bytes at the end, compressed or not.
"""

import base64
import lzma
import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.mesh.readers.file_mesh import FileMesh, beside
from diffsim_ti.mesh.readers.vtk_cells import grid

TYPES = {f"{name}{8 * size}": f"{kind}{size}" for name, kind in (("Int", "i"), ("UInt", "u")) for size in (1, 2, 4, 8)}
TYPES |= {"Float32": "f4", "Float64": "f8"}
COMPRESSED = {"vtkZLibDataCompressor": zlib.decompress, "vtkLZMADataCompressor": lzma.decompress}


def read(path: Path) -> FileMesh:
    """The mesh of all pieces of a file; vertices that pieces share stay as often as the file has them, unless they have
    global numbers (GlobalNodeIds)."""
    return _grid_of(_pieces(path))


def _pieces(path: Path) -> list[tuple]:
    """(points, nodes, offsets, types, point arrays, cell arrays) of each piece."""
    file = _File(path)
    kind = file.root.get("type")
    if kind == "PUnstructuredGrid":
        sources = [piece.get("Source", "") for piece in file.root.iter("Piece")]
        near = [beside(path, source, "it names the piece", "put the pieces beside it", ".vtu") for source in sources]
        return [piece for source in near for piece in _pieces(source)]
    if kind != "UnstructuredGrid":
        raise ValueError(f"it holds {kind or 'no grid'}; export an UnstructuredGrid of tetrahedra (.vtu)")
    return [file.piece(piece) for piece in file.root.iter("Piece")]


class _File:
    def __init__(self, path: Path):
        data, self.appended = path.read_bytes(), b""
        found = re.search(rb"<AppendedData[^>]*>", data)
        if found:
            self.is_base64 = b'"base64"' in found.group() or b"'base64'" in found.group()
            begin = data.index(b"_", found.end()) + 1
            end = data.rfind(b"</AppendedData>")
            self.appended = data[begin : end if end >= 0 else len(data)]
            data = data[: found.start()] + b"</VTKFile>"
        try:
            self.root = ElementTree.fromstring(data)
        except ElementTree.ParseError as error:
            raise ValueError(f"its XML is damaged ({error})") from error
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self.header = np.dtype(TYPES[self.root.get("header_type", "UInt32")]).newbyteorder(self.order)
        name = self.root.get("compressor", "")
        if name and name not in COMPRESSED:
            raise ValueError(
                f"its data are compressed by {name}, which is not read; save it with zlib, or uncompressed"
            )
        self.decompress = COMPRESSED.get(name)

    def piece(self, piece) -> tuple:
        """The arrays of a piece."""
        count, num_cells = (int(piece.get(name, "0")) for name in ("NumberOfPoints", "NumberOfCells"))
        places = self._part(piece, "Points")
        if not places:
            raise ValueError("a piece has no Points")
        points = self.array(places[0]).reshape(-1, 3).astype(np.float64)
        cells = {array.get("Name"): self.array(array) for array in self._part(piece, "Cells")}
        if not {"connectivity", "offsets", "types"} <= set(cells):
            raise ValueError("a piece lacks connectivity, offsets or types of its cells")
        offsets = np.concatenate([[0], cells["offsets"].astype(np.int64)])
        if len(points) != count or len(offsets) != num_cells + 1 or len(cells["types"]) != num_cells:
            raise ValueError(
                f"a piece says {count} points and {num_cells} cells, and has {len(points)} and {len(offsets) - 1}"
            )
        data = {}
        for part in ("PointData", "CellData"):
            arrays = [a for a in self._part(piece, part) if a.get("type") in TYPES]
            data[part] = {array.get("Name", ""): self.array(array) for array in arrays}
        nodes = cells["connectivity"].astype(np.int64)
        return points, nodes, offsets, cells["types"].astype(np.int64), data["PointData"], data["CellData"]

    def _part(self, piece, name: str) -> list:
        part = piece.find(name)
        return [] if part is None else [a for a in part if a.tag in ("DataArray", "Array")]

    def array(self, array) -> np.ndarray:
        """The numbers of a DataArray, one row for each of its tuples."""
        kind = TYPES.get(array.get("type", ""))
        if kind is None:
            raise ValueError(f"numbers of type {array.get('type')!r} are not known")
        dtype, form = np.dtype(kind).newbyteorder(self.order), array.get("format", "ascii")
        if form == "ascii":
            values = np.array((array.text or "").split()).astype(kind)
        else:
            if form == "appended":
                data = self.appended[int(array.get("offset", "0")) :]
                raw = self._decoded(data) if self.is_base64 else self._blocks(data, lambda n: (data[:n], n))
            else:
                raw = self._decoded("".join((array.text or "").split()).encode())
            if len(raw) % dtype.itemsize:
                raise ValueError(f"{len(raw)} bytes are no whole {array.get('type')} numbers")
            values = np.frombuffer(raw, dtype).astype(kind)
        width = int(array.get("NumberOfComponents", "1"))
        return values.reshape(-1, width) if width > 1 else values

    def _decoded(self, data: bytes) -> bytes:
        """Base64 data: the header is encoded by itself where data are compressed."""

        def first(count: int) -> tuple[bytes, int]:
            size = 4 * ((count + 2) // 3)
            return base64.b64decode(data[:size])[:count], size

        return self._blocks(data, first, encoded=True)

    def _blocks(self, data: bytes, first, encoded: bool = False) -> bytes:
        """The bytes behind a header; `first(n)`: the first n bytes, and how many characters these take."""
        word = self.header.itemsize
        head, taken = first(word)
        if len(head) < word:
            raise ValueError("it ends within an array")
        count = int(np.frombuffer(head, self.header)[0])
        if self.decompress is None:
            whole = first(word + count)[0] if encoded else data[: word + count]
            if len(whole) < word + count:
                raise ValueError("it ends within an array")
            return whole[word:]
        head, taken = first((3 + count) * word)
        sizes = np.frombuffer(head, self.header)[3:].astype(np.int64)
        body = data[taken:]
        if encoded:
            body = base64.b64decode(body[: 4 * ((int(sizes.sum()) + 2) // 3)])
        if len(body) < sizes.sum() or len(sizes) < count:
            raise ValueError("it ends within an array")
        ends = np.concatenate([[0], np.cumsum(sizes)])
        return b"".join(self.decompress(body[a:b]) for a, b in zip(ends[:-1], ends[1:]))


def _grid_of(pieces: list[tuple]) -> FileMesh:
    """All pieces as one grid; arrays that not all pieces have are left out."""
    pieces = [piece for piece in pieces if len(piece[3])]
    if not pieces:
        raise ValueError("the file holds no cells")
    points, nodes, offsets, types, _, _ = zip(*pieces)
    firsts = np.cumsum([0, *(len(p) for p in points)])
    starts = np.cumsum([0, *(len(n) for n in nodes)])
    both = [set.intersection(*(set(piece[k]) for piece in pieces)) for k in (4, 5)]
    arrays = []
    for k, common in zip((4, 5), both):
        names = [name for name in pieces[0][k] if name in common]
        arrays.append({name: np.concatenate([np.asarray(piece[k][name]) for piece in pieces]) for name in names})
    nodes = np.concatenate([n + first for n, first in zip(nodes, firsts)])
    offsets = np.concatenate([[0], *(o[1:] + start for o, start in zip(offsets, starts))])
    whole = grid(np.concatenate(points), nodes, offsets, np.concatenate(types), *arrays)
    lost = sorted({name for piece in pieces for k in (4, 5) for name in piece[k]} - both[0] - both[1])
    if lost:
        whole.left_out.append(f"arrays that not all pieces have: {', '.join(lost)}")
    if len(pieces) > 1 and "GlobalNodeIds" in arrays[0]:
        return _merged(whole, arrays[0]["GlobalNodeIds"])
    return whole


def _merged(mesh: FileMesh, numbers: np.ndarray) -> FileMesh:
    """With one vertex for all of the same global number."""
    _, first, place = np.unique(numbers, return_index=True, return_inverse=True)
    place = place.ravel()
    mesh.points = mesh.points[first]
    mesh.blocks = [(kind, place[cells]) for kind, cells in mesh.blocks]
    mesh.point_sets = {name: np.unique(place[rows]) for name, rows in mesh.point_sets.items()}
    return mesh
