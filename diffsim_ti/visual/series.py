"""A run written as a series of frames that ParaView opens: one .vtu per frame and a .pvd that lists them with their times.

Part 0 of a moment is the body, part 1 the obstacles; the list's attribute `ground` is the floor's height [m].
"""

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.obstacles import floor_of, obstacle_surfaces


class Series:
    """Writes `folder`/`name`.pvd and `name`_0000.vtu, `name`_0001.vtu, ...; each frame is readable once it is written.

    The .pvd is replaced at one stroke after each frame, so an interrupted run leaves a valid series. Frames that an
    earlier series of that name left in the folder are removed first. With a scene, its floor, obstacles and fixed vertices
    are written too. Raises OSError if the folder cannot be written.
    """

    def __init__(self, folder, mesh: TetrahedralMesh, name: str = "frames", scene=None):
        self.folder, self.mesh, self.name, self.scene = Path(folder), mesh, name, scene
        self.path = self.folder / f"{name}.pvd"
        self.files: list[Path] = []
        self._times: list[float] = []
        self._obstacles: list[Path] = []
        self.folder.mkdir(parents=True, exist_ok=True)
        for _, _, old in _listed(self.path) if self.path.exists() else []:
            if old.parent == self.folder and old.stem.startswith(f"{name}_"):
                old.unlink(missing_ok=True)
        self._write_list()

    def write(self, time: float, positions, displacements, velocities, fields) -> Path:
        """Append a frame at `time` [s].

        positions, displacements [m] and velocities [m/s]: shape (num_vertices, 3). fields: TetrahedronFields, written as
        von_mises [Pa], energy_density [J/m^3] and J [-] per tetrahedron, in the precision of `displacements`.
        """
        import meshio

        displacements = np.asarray(displacements)
        dtype = displacements.dtype if displacements.dtype == np.float32 else np.float64
        path = self.folder / f"{self.name}_{len(self.files):04d}.vtu"
        held = (
            {}
            if self.scene is None
            else {"fixed": np.isin(np.arange(len(displacements)), self.scene.fixed).astype("u1")}
        )
        frame = meshio.Mesh(
            np.asarray(positions, np.float64),
            [("tetra", self.mesh.tetrahedra)],
            point_data={"displacement": displacements.astype(dtype), "velocity": np.asarray(velocities, dtype)} | held,
            cell_data={
                name: [np.asarray(getattr(fields, name), dtype)] for name in ("von_mises", "energy_density", "J")
            },
        )
        frame.write(path, file_format="vtu", binary=True)
        self.files.append(path)
        self._write_obstacles(float(time))
        self._times.append(float(time))
        self._write_list()
        return path

    def _write_obstacles(self, time: float) -> None:
        """The obstacles at a time [s] as triangles, numbered; those that stand still are written once."""
        import meshio

        shapes = [] if self.scene is None else obstacle_surfaces(self.scene, time)
        if shapes and (self.scene.moving or not self._obstacles):
            self._obstacles.append(self.folder / f"{self.name}_obstacles_{len(self._obstacles):04d}.vtu")
            first = np.cumsum([0, *(len(points) for points, _ in shapes)])
            triangles = np.concatenate([cells + at for (_, cells), at in zip(shapes, first)])
            number = np.repeat(np.arange(len(shapes)), [len(cells) for _, cells in shapes])
            surface = meshio.Mesh(
                np.concatenate([points for points, _ in shapes]),
                [("triangle", triangles)],
                cell_data={"obstacle": [number]},
            )
            surface.write(self._obstacles[-1], file_format="vtu", binary=True)

    def _write_list(self) -> None:
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
        ground = None if self.scene is None else floor_of(self.scene)
        listed = ElementTree.SubElement(root, "Collection", {} if ground is None else {"ground": f"{ground:.9g}"})
        for k, (at, path) in enumerate(zip(self._times, self.files)):
            parts = [path, *self._obstacles[min(k, len(self._obstacles) - 1) :][:1]]
            for part, file in enumerate(parts):
                row = dict(timestep=f"{at:.9g}", group="", part=str(part), file=file.name)
                ElementTree.SubElement(listed, "DataSet", row)
        ElementTree.indent(root)
        draft = self.path.with_suffix(f".pvd.{os.getpid()}")
        try:
            ElementTree.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)
            os.replace(draft, self.path)
        finally:
            draft.unlink(missing_ok=True)


def frames_of(path) -> list[tuple[float, Path]]:
    """(time [s], file) of every frame of the body that a .pvd lists. Raises ValueError if it is no such file."""
    return [(time, file) for time, part, file in _listed(path) if part == "0"]


def _listed(path) -> list[tuple[float, str, Path]]:
    """(time [s], part, file) of all that a .pvd lists."""
    path = Path(path)
    try:
        rows = ElementTree.parse(path).getroot().iter("DataSet")
        return [(float(row.attrib["timestep"]), row.get("part", "0"), path.parent / row.attrib["file"]) for row in rows]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path} is not a ParaView series (.pvd): {error}; remove it or choose another folder"
        ) from error


class Surroundings:
    """What stands around the body in a saved series: `ground`, the floor's height [m] or None, and obstacles."""

    def __init__(self, path):
        self._files = [file for _, part, file in _listed(path) if part == "1"]
        ground = next(ElementTree.parse(path).getroot().iter("Collection")).get("ground")
        self.ground, self._last = None if ground is None else float(ground), (None, [])

    def shapes(self, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """(points [m], triangles) of each obstacle in frame k."""
        import meshio

        if not self._files:
            return []
        file = self._files[k]
        if self._last[0] != file:
            surface = meshio.read(file)
            triangles, number = surface.cells_dict["triangle"], surface.cell_data["obstacle"][0]
            out = []
            for obstacle in np.unique(number):
                used, corners = np.unique(triangles[number == obstacle], return_inverse=True)
                out.append((surface.points[used], corners.reshape(-1, 3)))
            self._last = file, out
        return self._last[1]
