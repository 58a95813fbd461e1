"""Gmsh's formats 1, 2.x, 4.0 and 4.1, in text and binary: parametric, partitioned, periodic and incomplete ones too.

Gmsh reference manual, "MSH file format" and its legacy versions. Sections of other names are passed over.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from diffsim_ti.mesh.readers.file_mesh import FileMesh

KINDS = {1: "line", 2: "triangle", 3: "quad", 4: "tetra", 5: "hexahedron", 6: "wedge", 7: "pyramid", 8: "line3"}
KINDS |= {9: "triangle6", 11: "tetra10", 15: "vertex", 16: "quad8", 10: "quad9", 17: "hexahedron20"}
KINDS |= {26: "line4", 27: "line5", 28: "line6", 29: "tetra20", 30: "tetra35", 31: "tetra56"}
NODES = (0, 2, 3, 4, 4, 8, 6, 5, 3, 6, 9, 10, 27, 18, 14, 1, 8, 20, 15, 13, 9, 10, 12, 15, 15, 21, 4, 5, 6, 20, 35, 56)
DIMENSIONS = {15: 0} | dict.fromkeys((1, 8, 26, 27, 28), 1) | dict.fromkeys((2, 3, 9, 10, 16, *range(20, 26)), 2)
TEN_NODES = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]  # Gmsh's edges in VTK's order
REAL = np.dtype("f8")


class Words:
    """What a section holds, taken number by number: from text, or in binary files by the types that the format states."""

    def __init__(self, data: bytes, at: int, end: int, order: str | None):
        """order: "<" or ">" of a binary file, None of text."""
        self.data, self.at, self.end, self.order = data, at, end, order
        self.words = None if order else np.array(data[at:end].split())

    def take(self, kind: str, count: int = 1) -> np.ndarray:
        """The next numbers: kind "i4", "u8" or "f8"."""
        if count < 0:
            raise ValueError(f"a count of {count}")
        dtype = np.dtype(kind)
        if self.words is not None:
            if self.at_word + count > len(self.words):
                raise ValueError("it ends within a section")
            found = self.words[self.at_word : self.at_word + count]
            self.at_word += count
            return found.astype(REAL) if dtype == REAL else found.astype(np.int64)
        size = dtype.itemsize * count
        if self.at + size > self.end:
            raise ValueError("it ends within a section")
        found = np.frombuffer(self.data, dtype.newbyteorder(self.order), count, self.at)
        self.at += size
        return found.astype(REAL if dtype == REAL else np.int64)

    at_word = 0

    def one(self, kind: str) -> int:
        return int(self.take(kind)[0])

    def leading_number(self) -> int:
        """A count, which stands as text before binary data, too."""
        if self.is_text:
            return self.one("i4")
        line = self.data.find(b"\n", self.at)
        count, self.at = int(self.data[self.at : line]), line + 1
        if not 0 <= count <= len(self.data):
            raise ValueError(f"a count of {count}")
        return count

    @property
    def is_text(self) -> bool:
        return self.words is not None


def read(path: Path) -> FileMesh:
    """The mesh of a file. Raises ValueError for what is incomplete or of an unknown version."""
    data = path.read_bytes()
    try:
        return _first(data) if data.startswith(b"$NOD") else _read(data)
    except KeyError as error:
        raise ValueError(f"an element has node {error}, which the file does not list; export it again") from error
    except (ValueError, IndexError, OverflowError, MemoryError, UnicodeDecodeError) as error:
        raise ValueError(f"it is no complete Gmsh file ({error}); export it again") from error


def _sections(data: bytes):
    """(name, first byte behind its line) of every section, in order."""
    at = 0
    while (at := data.find(b"$", at)) >= 0:
        line = data.find(b"\n", at)
        name = data[at + 1 : line if line >= 0 else len(data)].strip()
        begin = line + 1
        if line < 0 or not name.isalnum() or name.startswith(b"End"):
            at += 1
            continue
        end = data.find(b"$End" + name, begin)
        if end < 0:
            raise ValueError(f"$End{name.decode(errors='replace')} is missing")
        yield name.decode(), begin, end
        at = end + 1


def _read(data: bytes) -> FileMesh:
    sections = {}
    for name, begin, end in _sections(data):
        if name in sections and name in ("Nodes", "Elements"):
            raise ValueError(f"${name} stands there twice")
        sections.setdefault(name, (begin, end))
    missing = [name for name in ("MeshFormat", "Elements") if name not in sections]
    if missing or not {"Nodes", "ParametricNodes"} & set(sections):
        raise ValueError(f"${(missing or ['Nodes'])[0]} is missing")
    head = data[slice(*sections["MeshFormat"])]
    version, binary, size = head.split(b"\n")[0].split()[:3]
    version, order = version.decode(), None
    if int(binary):
        if int(size) != 8:
            raise ValueError(f"numbers of {int(size)} bytes")
        mark = head[head.find(b"\n") + 1 :][:4]
        order = "<" if np.frombuffer(mark, "<i4")[0] == 1 else ">"
    names = _names(data[slice(*sections["PhysicalNames"])].decode()) if "PhysicalNames" in sections else {}

    def section(name: str) -> Words | None:
        return Words(data, *sections[name], order) if name in sections else None

    nodes = section("Nodes") or section("ParametricNodes")
    if version.startswith("2"):
        return _second(nodes, section("Elements"), names, "ParametricNodes" in sections and "Nodes" not in sections)
    if version in ("4.0", "4", "4.1"):
        return _fourth(nodes, section, names, version == "4.1")
    raise ValueError(f"version {version}; save it as Gmsh 4.1 (Mesh.MshFileVersion = 4.1)")


def _names(text: str) -> dict[tuple[int, int], str]:
    """(dimension, number) -> name of physical groups."""
    out = {}
    for line in text.splitlines()[1:]:
        if line.strip():
            dim, number, name = line.split(maxsplit=2)
            out[int(dim), int(number)] = name.strip().strip('"')
    return out


class Cells:
    """Elements by their type, with all physical groups of each."""

    def __init__(self):
        self.nodes: dict[int, list] = {}
        self.groups: dict[int, list] = {}  # of blocks of elements: (how many, group numbers)

    def add(self, kind: int, nodes: np.ndarray, groups) -> None:
        """Elements of one type (their node numbers) that share their groups; or one group each, an array."""
        self.nodes.setdefault(kind, []).append(nodes)
        self.groups.setdefault(kind, []).append((len(nodes), groups))

    def mesh(self, numbers: np.ndarray, points: np.ndarray, names: dict) -> FileMesh:
        """With node numbers as indices of points."""
        order = np.argsort(numbers, kind="stable")
        ranked = numbers[order]
        if len(ranked) and np.any(ranked[1:] == ranked[:-1]):
            twice = ranked[1:][ranked[1:] == ranked[:-1]][0]
            raise ValueError(f"node {twice} is listed twice")
        out, used = FileMesh(points), set()
        for block, (kind, parts) in enumerate(self.nodes.items()):
            nodes = np.concatenate(parts)
            at = np.searchsorted(ranked, nodes)
            unknown = (at >= len(ranked)) | (ranked[np.minimum(at, len(ranked) - 1)] != nodes)
            if unknown.any():
                raise KeyError(int(nodes[unknown][0]))
            cells = order[at]
            name = KINDS.get(kind, f"gmsh_{kind}")
            out.blocks.append((name, cells[:, TEN_NODES] if name == "tetra10" else cells))
            first, dim = 0, DIMENSIONS.get(kind, 3)
            for count, groups in self.groups[kind]:
                rows = np.arange(first, first + count)
                together = isinstance(groups, (list, tuple))
                for g in groups if together else np.unique(groups):
                    group = abs(int(g))  # negative: turned the other way
                    if group:
                        used.add((dim, group))
                        own = rows if together else rows[groups == g]
                        out.group(names.get((dim, group)) or f"tag_{group}", block, own)
                first += count
        empty = [name for key, name in names.items() if key not in used]
        if empty:
            out.left_out.append(
                f"groups that the file names and gives no elements: {', '.join(empty)} (Gmsh writes them so in its format "
                "2.2 with Mesh.SaveAll = 1; set it to 0)"
            )
        return _without_a_group_of_all(out)


def _without_a_group_of_all(mesh: FileMesh) -> FileMesh:
    """A nameless group that all tetrahedra share tells nothing apart."""
    total = sum(len(cells) for kind, cells in mesh.blocks if kind.startswith("tetra"))
    for name, parts in list(mesh.groups.items()):
        solid = [(k, rows) for k, rows in parts if mesh.blocks[k][0].startswith("tetra")]
        if name.startswith("tag_") and sum(len(np.unique(rows)) for _, rows in solid) == total:
            mesh.groups[name] = [part for part in parts if not mesh.blocks[part[0]][0].startswith("tetra")]
            if not mesh.groups[name]:
                del mesh.groups[name]
    return mesh


def _size(kind: int) -> int:
    if not 0 < kind < len(NODES):
        raise ValueError(f"elements of type {kind} are not known")
    return NODES[kind]


def _first(data: bytes) -> FileMesh:
    """$NOD: number of nodes; number x y z of each. $ELM: number of elements; number, type, physical group, entity, number
    of nodes, nodes of each."""
    parts = [data.find(mark) for mark in (b"$NOD", b"$ENDNOD", b"$ELM", b"$ENDELM")]
    if parts != sorted(parts) or parts[0] < 0:
        raise ValueError("it needs $NOD, $ENDNOD, $ELM and $ENDELM, in this order")
    count, *lines = data[parts[0] + 4 : parts[1]].split(b"\n")[1:-1]
    nodes = np.array([line.split()[:4] for line in lines], float).reshape(int(count), 4)  # parametric ones have more
    words = np.array(data[parts[2] + 4 : parts[3]].split()).astype(np.int64)
    cells = Cells()
    _rows_of_text(words[1:], int(words[0]), cells, head=5, tags=lambda row: 0)
    return cells.mesh(nodes[:, 0].astype(np.int64), nodes[:, 1:], {})


def _rows_of_text(words: np.ndarray, count: int, cells: Cells, head: int, tags: Callable) -> None:
    """Elements of text, one after the other: `head` numbers, of which the second is the type, as many tags as
    `tags(head)` says, and the nodes. The third number is the group in the first format, the first tag in the second."""
    places: dict[tuple[int, int], list[int]] = {}
    listed, at = words.tolist(), 0
    for _ in range(count):
        kind, extra = listed[at + 1], tags(listed[at : at + head])
        places.setdefault((kind, extra), []).append(at)
        at += head + extra + _size(kind)
    if at != len(listed):
        raise ValueError(f"{len(listed)} numbers of elements, where {count} elements need {at}")
    for (kind, extra), starts in places.items():
        rows = words[np.array(starts)[:, None] + np.arange(head + extra + _size(kind))]
        has_group = head == 5 or extra > 0
        cells.add(kind, rows[:, head + extra :], rows[:, 2 if head == 5 else 3] if has_group else [])


def _second(nodes: Words, elements: Words, names: dict, parametric: bool) -> FileMesh:
    count = nodes.leading_number()
    numbers, points = np.empty(count, np.int64), np.empty((count, 3))
    if nodes.is_text and not parametric:
        table = nodes.take("f8", 4 * count).reshape(count, 4)
        numbers, points = table[:, 0].astype(np.int64), table[:, 1:]
    else:
        for k in range(count):
            numbers[k] = nodes.one("i4")
            points[k] = nodes.take("f8", 3)
            if parametric:
                dim = int(nodes.take("i4", 2)[0])
                nodes.take("f8", {1: 1, 2: 2}.get(dim, 0))
    cells, left = Cells(), elements.leading_number()
    if elements.is_text:
        _rows_of_text(elements.words[1:].astype(np.int64), left, cells, head=3, tags=lambda row: row[2])
        return cells.mesh(numbers, points, names)
    while left > 0:
        kind, count, num_tags = (int(n) for n in elements.take("i4", 3))
        if not 0 < count <= left:
            raise ValueError(f"a block of {count} elements, of {left} that are left")
        rows = elements.take("i4", count * (1 + num_tags + _size(kind))).reshape(count, -1)
        cells.add(kind, rows[:, 1 + num_tags :], rows[:, 1] if num_tags else [])
        left -= count
    return cells.mesh(numbers, points, names)


def _fourth(nodes: Words, section: Callable, names: dict, is_newer: bool) -> FileMesh:
    """Format 4.0 (entities are named before dimensions, nodes one by one) or 4.1 (counts are of 8 bytes throughout)."""
    groups = {}
    for name in ("Entities", "PartitionedEntities"):
        if words := section(name):
            groups |= _entities(words, is_newer, name != "Entities")
    blocks, count = nodes.take("u8", 2)
    if is_newer:
        nodes.take("u8", 2)
    numbers, points = [], []
    for _ in range(int(blocks)):
        dim, parametric = (int(n) for n in nodes.take("i4", 3)[[0 if is_newer else 1, 2]])
        own = nodes.one("u8")
        width = 3 + dim * bool(parametric)
        if is_newer:
            numbers.append(nodes.take("u8", own))
            points.append(nodes.take("f8", own * width).reshape(own, width)[:, :3])
        else:
            for _ in range(own):
                numbers.append(nodes.take("i4"))
                points.append(nodes.take("f8", width)[None, :3])
    numbers, points = (np.concatenate(x) if x else np.zeros((0, 3)) for x in (numbers, points))
    if len(numbers) != count:
        raise ValueError(f"{len(numbers)} nodes, where it says {count}")
    elements, cells, found = section("Elements"), Cells(), 0
    blocks, count = elements.take("u8", 2)
    if is_newer:
        elements.take("u8", 2)
    for _ in range(int(blocks)):
        first, second, kind = (int(n) for n in elements.take("i4", 3))
        dim, tag = (first, second) if is_newer else (second, first)
        own, width = elements.one("u8"), 1 + _size(kind)
        rows = elements.take("u8" if is_newer else "i4", own * width).reshape(own, width)
        cells.add(kind, rows[:, 1:], groups.get((dim, tag), []))
        found += own
    if found != count:
        raise ValueError(f"{found} elements, where it says {count}")
    return cells.mesh(numbers.astype(np.int64), points, names)


def _entities(words: Words, is_newer: bool, partitioned: bool) -> dict[tuple[int, int], list[int]]:
    """(dimension, entity) -> its physical groups; partitioned: of the parts of entities in a partitioned file."""
    out = {}
    if partitioned:
        words.take("u8")
        words.take("i4", 2 * words.one("u8"))
    for dim, count in enumerate(words.take("u8", 4)):
        for _ in range(int(count)):
            tag = words.one("i4")
            if partitioned:
                words.take("i4", 2)
                words.take("i4", words.one("u8"))
            words.take("f8", 3 if is_newer and dim == 0 else 6)
            out[dim, tag] = words.take("i4", words.one("u8")).tolist()
            if dim:
                words.take("i4", words.one("u8"))
    return out
