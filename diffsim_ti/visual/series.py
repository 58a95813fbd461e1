"""A run that was saved as a series: a .pvd that lists .vtu files with their times (writers/paraview.py).

Part 0 of a moment is the body, part 1 the obstacles, part 2 marks (terms/marks.py), which ParaView shows as lines, and as
arrows by its filter Glyph; the list's attribute `ground` is the floor's height [m], `marks` are labels, `units` those of
fields. Part 2 is of lines and of vertices: point data "vector" and "onto" (of arrows; 0 elsewhere), cell data "mark", the
number of the label, and "kind": 0 arrow, 1 line, 2 point.
"""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.marks import Arrows, Lines, Mark, Points
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.colouring import FIELDS
from diffsim_ti.visual.frame import Frame, Setting

REMEDY = "take the .pvd that a run of diffsim-ti wrote"
ARROW, LINE, POINT = range(3)


def text_of(name: str) -> str:
    """A file's name as text that XML can hold: its bytes as UTF-8 whatever the locale, "_" where they are none."""
    text = os.fsencode(name).decode("utf-8", "replace").replace("\ufffd", "_")
    return "".join(c if c.isprintable() else "_" for c in text)


def listed(path: str | Path, remedy: str = REMEDY) -> list[tuple[float, str, Path]]:
    """(time [s], part, file) of all that a .pvd lists. Raises ValueError, which ends in `remedy`, if it is no such file, and
    FileNotFoundError."""
    path = Path(path)
    try:
        root = ElementTree.parse(path).getroot()
        if next(root.iter("Collection"), None) is None:
            raise ValueError(f"its root is <{root.tag}>, and it has no <Collection>")
        rows = [(row.attrib, path.parent / os.fsdecode(row.attrib["file"].encode())) for row in root.iter("DataSet")]
        return [(float(row["timestep"]), row.get("part", "0"), file) for row, file in rows]
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: no such series; {remedy}") from error
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        reason = f"an entry without {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{path} is not a ParaView series (.pvd): {reason}; {remedy}") from error


def frames_of(path: str | Path) -> list[tuple[float, Path]]:
    """(time [s], file) of every frame of the body that a .pvd lists. Raises ValueError if it is no such file."""
    return [(time, file) for time, part, file in listed(path) if part == "0"]


class SavedSeries:
    """The frames of a .pvd, read one by one; `setting`: what they share.

    Raises ValueError for what is no such file, an empty series, or one without displacements.
    """

    def __init__(self, path: str | Path):
        self._frames = frames_of(path)
        self._parts: list[dict[str, Path]] = []  # of each frame
        if not self._frames:
            raise ValueError(f"{path}: must list at least one frame, lists none; run the simulation first")
        for _, part, file in listed(path):
            self._parts += [{}] if part == "0" or not self._parts else []
            self._parts[-1][part] = file
        self._read: tuple[Path | None, list[Triangles]] = (None, [])
        first = self._mesh(0)
        rest = TetrahedralMesh(first.points - first.point_data["displacement"], first.cells[0].data)
        own = next(ElementTree.parse(path).getroot().iter("Collection"))
        try:
            ground = None if own.get("ground") is None else float(own.get("ground"))
            self._labels, self._units = json.loads(own.get("marks", "[]")), json.loads(own.get("units", "{}"))
        except ValueError as error:
            raise ValueError(f"{path} is not a ParaView series (.pvd) of diffsim-ti: {error}; {REMEDY}") from error
        fixed = np.flatnonzero(first.point_data.get("fixed", []))
        self.setting = Setting(rest, ground, fixed, self._shapes(0))
        if "held" in first.point_data:
            self.setting.held = first.point_data["held"][fixed].reshape(-1, 3, 3)

    def __len__(self) -> int:
        return len(self._frames)

    def frame(self, k: int) -> Frame:
        """Frame k, with the fields that it holds."""
        saved = self._mesh(k)
        u, v = (saved.point_data[name] for name in ("displacement", "velocity"))
        fields = dict(displacement=np.linalg.norm(u, axis=1), speed=np.linalg.norm(v, axis=1))
        fields |= {name: np.asarray(saved.cell_data[name][0], np.float64) for name in FIELDS if name in saved.cell_data}
        numbers = {name: y for name, y in saved.point_data.items() if name in FIELDS and np.ndim(y) == 1}
        fields |= {name: np.asarray(y, np.float64) for name, y in numbers.items()}
        vectors = {name: y for name, y in saved.point_data.items() if np.shape(y) == (len(u), 3)}
        fields |= {name: y for name, y in vectors.items() if name not in ("displacement", "velocity")}
        marks = read_marks(self._parts[k]["2"], self._labels) if "2" in self._parts[k] else []
        around = [points for points, _ in self._shapes(k)]
        return Frame(self._frames[k][0], saved.points, u, v, fields, around, marks, self._units)

    def _mesh(self, k: int):
        return read_part(self._frames[k][1], "displacement", "velocity")

    def _shapes(self, k: int) -> list[Triangles]:
        """(points [m], triangles) of each obstacle in frame k."""
        if "1" not in self._parts[k]:
            return []
        file = self._parts[k]["1"]
        if self._read[0] != file:
            surface = read_part(file, "obstacle")
            triangles, number = surface.cells_dict["triangle"], surface.cell_data["obstacle"][0]
            out = []
            for obstacle in np.unique(number):
                used, corners = np.unique(triangles[number == obstacle], return_inverse=True)
                out.append((surface.points[used], corners.reshape(-1, 3)))
            self._read = file, out
        return self._read[1]


def write_marks(path: Path, drawn: Sequence[Mark], labels: list[str]) -> None:
    """Write marks, adding labels that are new to the list."""
    import meshio

    points, vectors, onto, rows, count = [], [], [], {}, 0  # rows: (cells, numbers, kinds) of each form of cells
    for mark in drawn:
        if mark.label not in labels:
            labels.append(mark.label)
        kind = LINE if isinstance(mark, Lines) else ARROW if isinstance(mark, Arrows) else POINT
        x = mark.ends.reshape(-1, 3) if kind == LINE else mark.points
        points.append(x)
        vectors.append(mark.vectors if kind == ARROW else np.zeros_like(x))
        onto.append(mark.onto if kind == ARROW else np.zeros(len(x), bool))
        cells = np.arange(count, count + len(x)).reshape(-1, 2 if kind == LINE else 1)
        own = cells, np.full(len(cells), labels.index(mark.label)), np.full(len(cells), kind)
        rows.setdefault("line" if kind == LINE else "vertex", []).append(own)
        count += len(x)
    joined = [[np.concatenate(part) for part in zip(*of)] for of in rows.values()]
    cells, numbers, kinds = map(list, zip(*joined))
    point_data = dict(vector=np.concatenate(vectors).astype(float), onto=np.concatenate(onto).astype(np.uint8))
    saved = meshio.Mesh(np.concatenate(points), list(zip(rows, cells)), point_data, dict(mark=numbers, kind=kinds))
    saved.write(path, file_format="vtu", binary=True)


def read_part(path: Path, *names: str):
    """The meshio mesh of one file of a series. Raises ValueError, with its name, if it is missing or damaged, or holds no
    data of those names."""
    import meshio

    try:
        saved = meshio.vtu.read(path)  # meshio.read prints and exits
        for name in names:
            if name not in saved.point_data and name not in saved.cell_data:
                raise ValueError(f"must hold {name!r}, has {sorted([*saved.point_data, *saved.cell_data])}")
        return saved
    except Exception as error:  # meshio lets those of its parsers through
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}, a file of the series, cannot be read: {reason}; write the series again") from error


def read_marks(path: Path, labels: Sequence[str]) -> list[Mark]:
    """What `write_marks` wrote; those of one label and kind are one."""
    saved, out = read_part(path, "vector", "mark", "kind"), []
    for block, number, kind in zip(saved.cells, saved.cell_data["mark"], saved.cell_data["kind"]):
        for which, how in np.unique(np.stack([number, kind], 1), axis=0):
            own = block.data[(number == which) & (kind == how)]
            label, x = labels[which], saved.points[own]
            if how == LINE:
                out.append(Lines(label, x))
            elif how == POINT:
                out.append(Points(label, x[:, 0]))
            else:
                own = own[:, 0]
                onto = saved.point_data["onto"][own].astype(bool)
                out.append(Arrows(label, x[:, 0], saved.point_data["vector"][own], onto))
    return out
