"""A run written as a series of frames that ParaView opens: one .vtu per frame and a .pvd that lists them with their times.
"""

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh


class Series:
    """Writes `folder`/`name`.pvd and `name`_0000.vtu, `name`_0001.vtu, ...; each frame is readable once it is written.

    The .pvd is replaced at one stroke after each frame, so an interrupted run leaves a valid series. Frames that an
    earlier series of that name left in the folder are removed first. Raises OSError if the folder cannot be written.
    """

    def __init__(self, folder, mesh: TetrahedralMesh, name: str = "frames"):
        self.folder, self.mesh, self.name = Path(folder), mesh, name
        self.path = self.folder / f"{name}.pvd"
        self.files: list[Path] = []
        self._times: list[float] = []
        self.folder.mkdir(parents=True, exist_ok=True)
        for old in frames_of(self.path) if self.path.exists() else []:
            if old[1].parent == self.folder and old[1].stem.startswith(f"{name}_"):
                old[1].unlink(missing_ok=True)
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
        frame = meshio.Mesh(
            np.asarray(positions, np.float64),
            [("tetra", self.mesh.tetrahedra)],
            point_data={"displacement": displacements.astype(dtype), "velocity": np.asarray(velocities, dtype)},
            cell_data={
                name: [np.asarray(getattr(fields, name), dtype)] for name in ("von_mises", "energy_density", "J")
            },
        )
        frame.write(path, file_format="vtu", binary=True)
        self.files.append(path)
        self._times.append(float(time))
        self._write_list()
        return path

    def _write_list(self) -> None:
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
        listed = ElementTree.SubElement(root, "Collection")
        for at, path in zip(self._times, self.files):
            ElementTree.SubElement(listed, "DataSet", timestep=f"{at:.9g}", group="", part="0", file=path.name)
        ElementTree.indent(root)
        draft = self.path.with_suffix(f".pvd.{os.getpid()}")
        try:
            ElementTree.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)
            os.replace(draft, self.path)
        finally:
            draft.unlink(missing_ok=True)


def frames_of(path) -> list[tuple[float, Path]]:
    """(time [s], file) of every frame that a .pvd lists. Raises ValueError if it is no such file."""
    path = Path(path)
    try:
        rows = ElementTree.parse(path).getroot().iter("DataSet")
        return [(float(row.attrib["timestep"]), path.parent / row.attrib["file"]) for row in rows]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is not a ParaView series (.pvd): {error}; remove it or choose another folder") from error
