"""Reading a run that was saved as a series: a .pvd that lists .vtu files with their times (writers/paraview.py).

Part 0 of a moment is the body, part 1 the obstacles, part 2 marks (series_marks.py); the list's attribute `ground` is the
floor's height [m], `marks` are labels, `units` those of fields.
"""

import json
import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.fields import FIELDS
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.series_marks import read_marks, read_part

REMEDY = "take the .pvd that a run of diffsim-ti wrote"


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
