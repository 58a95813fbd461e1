"""What meshes come from and go to: files, surfaces, objects of meshio and PyVista."""

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.common.checked import instance
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.files import KEEPS_SETS, as_meshio, parts_of, read_mesh, write_mesh
from diffsim_ti.mesh.filling import filled
from diffsim_ti.mesh.sets import without_unused

if TYPE_CHECKING:
    import meshio
    import pyvista
    from typing_extensions import Self

VTK_CELLS = {1: "vertex", 3: "line", 5: "triangle", 10: "tetra", 21: "line3", 22: "triangle6", 24: "tetra10"}


class Exchange:
    """A part of TetrahedralMesh."""

    @classmethod
    def _of_parts(cls, parts: tuple, fix_orientation: bool, drop_orphans: bool) -> "Self":
        vertices, tetrahedra, vertex_sets, tetrahedron_sets, triangles = parts
        if drop_orphans and tetrahedra.min() >= 0 and tetrahedra.max() < len(vertices):
            vertices, tetrahedra, vertex_sets, triangles = without_unused(vertices, tetrahedra, vertex_sets, triangles)
        sets = dict(vertex_sets=vertex_sets, tetrahedron_sets=tetrahedron_sets, surface_sets=triangles)
        return cls(vertices, tetrahedra, **sets, fix_orientation=fix_orientation)

    @classmethod
    def from_file(
        cls, path: str | PathLike, fix_orientation: bool = False, drop_orphans: bool = False, device: str | None = None
    ) -> "Self":
        """Load tetrahedra from any format that meshio reads: Gmsh .msh (1, 2.2, 4.x), .vtu, .vtk, MEDIT .mesh, .inp ...
        Surfaces, of .stl, .obj, .ply and .off, are filled (`from_surface`).

        Blocks of tetrahedra are joined. Named groups of tetrahedra become tetrahedron sets, groups of triangles, lines
        or points the vertex sets of their vertices, and those triangles that lie on the surface a surface set too; integer
        tags without a name become "tag_<n>", except 0 and a tag that all tetrahedra share. Other triangles, lines and
        points are ignored. Ten-node tetrahedra keep their mid-edge vertices, and edges that are curved.
        drop_orphans: leave out vertices that no tetrahedron uses (Gmsh writes some) and renumber; default: warn. device: as
        for `create_cube`.

        Raises FileNotFoundError, ImportError where meshio needs a further package (h5py for XDMF, CGNS and MED, netCDF4 for
        Exodus), and ValueError for an unreadable file, one without tetrahedra or with both kinds, other cells
        beside tetrahedra (cell types are named), and whatever the constructor refuses.
        """
        instance("from_file", "path", path, str | PathLike, "that of a mesh file")
        runtime.use_device(device)
        try:
            return cls._of_parts(read_mesh(path), fix_orientation, drop_orphans)
        except ValueError as error:
            raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error

    @classmethod
    def load_from_msh(cls, path: str | PathLike, device: str | None = None) -> "Self":
        """`from_file(path)` in the seeds' spelling; device as for `create_cube`."""
        return cls.from_file(path, device=device)

    def save(self, path: str | PathLike) -> None:
        """Write the mesh through meshio, in the format that the suffix names.

        Sets are kept in .msh (Gmsh 2.2 binary, as physical groups of points, surfaces and volumes) and in .vtu and .vtk (as
        0/1 data arrays "vertex_set:<name>", "tetrahedron_set:<name>", "surface_set:<name>", with triangles as cells; .vtk
        turns blanks in names into underscores), all but surface sets in .inp; others lose them with a UserWarning. These
        keep every digit.
        Ten-node tetrahedra go into these three, .inp and .xdmf. ValueError for an unknown suffix, and in .msh for a name of
        two sets (not a surface set and its own vertices). ImportError where meshio needs a further package, h5py for
        .xdmf (`from_file`).
        """
        lost = write_mesh(path, self)
        if lost:
            kept = ", ".join(KEEPS_SETS)
            warn(f"{path} cannot keep the sets {', '.join(lost)}; these formats can: {kept}")

    @classmethod
    def from_surface(cls, points: ArrayLike, triangles: ArrayLike, size: float | None = None) -> "Self":
        """The body within a closed surface, filled by TetGen (`pip install "diffsim-ti[surfaces]"`).

        points [m], shape (n, 3), and triangles, shape (k, 3), of the surface, which all stay; points that coincide become
        one, and closed parts within others bound cavities. size: largest edge of tetrahedra [m], about; default as large as
        their quality allows. `from_file` does this for .stl, .obj, .ply and .off.

        Raises ValueError for a surface that is open or meets itself, and where TetGen is missing.
        Si 2015, TetGen, a Delaunay-Based Quality Tetrahedral Mesh Generator, doi:10.1145/2629697.
        """
        points, triangles = np.asarray(points, np.float64), np.asarray(triangles)
        for name, given, kind in (("points", points, "f"), ("triangles", triangles, "iu")):
            if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in kind:
                numbers = "indices" if name == "triangles" else "numbers"
                raise ValueError(f"{name} must be {numbers} of shape (n, 3), got shape {given.shape} of {given.dtype}")
        if triangles.size and not (0 <= triangles.min() and triangles.max() < len(points)):
            raise ValueError(f"triangles must name points from 0 to {len(points) - 1}, got {triangles.max()}")
        return cls(*filled(points, triangles.astype(np.int64), size))

    @classmethod
    def from_meshio(cls, mesh: "meshio.Mesh", fix_orientation: bool = False, drop_orphans: bool = False) -> "Self":
        """Of meshio's mesh, with its sets, as `from_file` has it of a file."""
        return cls._of_parts(parts_of(mesh, again=True), fix_orientation, drop_orphans)

    def to_meshio(self) -> "meshio.Mesh":
        """As a mesh of meshio, with the sets as 0/1 arrays, as in .vtu files (`save`); `from_meshio` brings it back."""
        return as_meshio(self)

    @classmethod
    def from_pyvista(
        cls, grid: "pyvista.UnstructuredGrid", fix_orientation: bool = False, drop_orphans: bool = False
    ) -> "Self":
        """Of a grid of PyVista (or one that only looks like it: `points`, `cells_dict`, `celltypes`, `point_data`,
        `cell_data`), whose 0/1 arrays named as in .vtu files become sets. PyVista need not be there."""
        import meshio

        kinds = {number: name for number, name in VTK_CELLS.items() if number in grid.cells_dict}
        other = sorted(set(grid.cells_dict) - set(kinds))
        if other:
            known = ", ".join(VTK_CELLS.values())
            raise ValueError(f"cells of VTK's types {other} cannot be read; there may be {known}")
        cells = [(name, np.asarray(grid.cells_dict[number])) for number, name in kinds.items()]
        rows = [np.nonzero(np.asarray(grid.celltypes) == number)[0] for number in kinds]
        cell_data = {name: [np.asarray(grid.cell_data[name])[k] for k in rows] for name in grid.cell_data.keys()}
        point_data = {name: np.asarray(grid.point_data[name]) for name in grid.point_data.keys()}
        mesh = meshio.Mesh(np.asarray(grid.points), cells, point_data=point_data, cell_data=cell_data)
        return cls.from_meshio(mesh, fix_orientation, drop_orphans)

    def to_pyvista(self) -> "pyvista.UnstructuredGrid":
        """As a grid of PyVista, which must be installed, with the sets as 0/1 arrays."""
        try:
            import pyvista
        except ImportError as error:
            raise ImportError("PyVista is missing: pip install pyvista; `to_meshio` needs nothing") from error
        return pyvista.from_meshio(self.to_meshio())
