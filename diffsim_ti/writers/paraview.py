"""A series that ParaView opens: one .vtu per frame, and a .pvd that lists them with their times (visual/series.py reads it).

Part 0 of a moment is the body, part 1 the obstacles, part 2 arrows and lines that show loads and the like
(visual/series.py); the list's attribute `ground` is the floor's height [m], `marks` are the labels of part 2.
"""

import json
import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.visual.colouring import FIELDS
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.series import listed, text_of, write_marks
from diffsim_ti.writers.writer import Writer, register

PER_TETRAHEDRON = ("von_mises", "energy_density", "J")


def _rows(value) -> np.ndarray:
    """Numbers, vectors, or tensors row by row, of each vertex or tetrahedron."""
    value = np.asarray(value)
    return value.reshape(len(value), -1) if value.ndim > 2 else value


@register
class ParaViewWriter(Writer):
    """Writes `name`.pvd and, beside it, `name`_0000.vtu, `name`_0001.vtu, ...

    Each frame can be read once it is written: the .pvd is replaced as a whole after each, so an interrupted run leaves a
    valid series. Frames that an earlier series of that name left in the folder are removed first. Frames hold
    displacement [m], velocity [m/s] and what is fixed per vertex, and von_mises [Pa], energy_density [J/m^3] and J [-] per
    tetrahedron (of ten nodes von_mises per vertex), in the precision of the displacements; besides, what else a frame's
    fields have for every vertex or every tetrahedron, such as forces and stresses (`Frame.of_run`), tensors row by row.
    Ten-node tetrahedra are quadratic cells. Raises OSError if the folder cannot be written.
    """

    suffixes = (".pvd",)

    def open(self, setting: Setting) -> None:
        super().open(setting)
        self.folder, self.name = self.path.parent, os.fsdecode(text_of(self.path.stem).encode())
        self._rows: list[tuple[float, dict[int, Path]]] = []
        self._labels: list[str] = []  # of marks
        self._units: dict[str, str] = {}
        self._around: list[np.ndarray] | None = None  # obstacles as they were last written
        self._obstacles: list[Path] = []
        for _, _, old in listed(self.path, "remove it or choose another folder") if self.path.exists() else []:
            if old.parent == self.folder and old.stem.startswith(f"{self.name}_"):
                old.unlink(missing_ok=True)
        self._write_list()

    def write(self, frame: Frame) -> None:
        import meshio

        dtype = np.float32 if np.asarray(frame.displacements).dtype == np.float32 else np.float64
        path = self.folder / f"{self.name}_{self.count:04d}.vtu"
        held = np.isin(np.arange(len(frame.positions)), self.setting.fixed).astype("u1")
        point_data, cell_data = {"displacement": frame.displacements, "velocity": frame.velocities}, {}
        for name, value in frame.fields.items():
            if name in PER_TETRAHEDRON or name not in FIELDS:
                of_cells = len(value) == self.setting.mesh.num_tetrahedra
                (cell_data if of_cells else point_data)[name] = value
        point_data, cell_data = (
            {text_of(name): _rows(value).astype(dtype) for name, value in data.items()}
            for data in (point_data, cell_data)
        )
        point_data |= {"fixed": held} | self._held(dtype)
        cell_data = {name: [value] for name, value in cell_data.items()}
        cells = [("tetra" if self.setting.mesh.order == 1 else "tetra10", self.setting.mesh.elements)]
        saved = meshio.Mesh(np.asarray(frame.positions, np.float64), cells, point_data, cell_data)
        saved.write(path, file_format="vtu", binary=True)
        self._write_obstacles(frame)
        parts = {0: path} | ({1: self._obstacles[-1]} if self._obstacles else {})
        if frame.marks:
            parts[2] = self.folder / f"{self.name}_marks_{self.count:04d}.vtu"
            write_marks(parts[2], frame.marks, self._labels)
        self._units |= {name: unit for name, unit in frame.units.items() if unit}
        self._rows.append((float(frame.time), parts))
        self._write_list()
        self.count += 1

    def _held(self, dtype) -> dict[str, np.ndarray]:
        """Where some vertices are fixed in some directions only: the projectors onto these, row by row."""
        if self.setting.held is None:
            return {}
        rows = np.zeros((self.setting.mesh.num_vertices, 9), dtype)
        rows[self.setting.fixed] = self.setting.held.reshape(-1, 9)
        return {"held": rows}

    def _write_obstacles(self, frame: Frame) -> None:
        """The obstacles as triangles, numbered, where they are not as they were written last."""
        import meshio

        shapes = self.setting.obstacles
        points = [points for points, _ in shapes] if frame.obstacles is None else frame.obstacles
        if not shapes or (self._around is not None and all(map(np.array_equal, points, self._around))):
            return
        self._obstacles.append(self.folder / f"{self.name}_obstacles_{len(self._obstacles):04d}.vtu")
        self._around = [np.array(p) for p in points]
        first = np.cumsum([0, *map(len, points)])
        triangles = np.concatenate([cells + at for (_, cells), at in zip(shapes, first)])
        number = np.repeat(np.arange(len(shapes)), [len(cells) for _, cells in shapes])
        surface = meshio.Mesh(np.concatenate(points), [("triangle", triangles)], cell_data={"obstacle": [number]})
        surface.write(self._obstacles[-1], file_format="vtu", binary=True)

    def _write_list(self) -> None:
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
        ground = self.setting.ground
        own = {} if ground is None else {"ground": f"{ground:.9g}"}
        own |= {"marks": json.dumps(self._labels)} if self._labels else {}
        own |= {"units": json.dumps(self._units)} if self._units else {}
        rows = ElementTree.SubElement(root, "Collection", own)
        for at, parts in self._rows:
            for part, file in parts.items():
                row = dict(timestep=f"{at:.9g}", group="", part=str(part), file=text_of(file.name))
                ElementTree.SubElement(rows, "DataSet", row)
        ElementTree.indent(root)
        draft = self.path.with_suffix(f".pvd.{os.getpid()}")
        try:
            ElementTree.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)
            os.replace(draft, self.path)
        finally:
            draft.unlink(missing_ok=True)

    def describe(self) -> str:
        return f"{self.path} and {self.count} .vtu frames"
