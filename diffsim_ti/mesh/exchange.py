"""What meshes come from and go to: files, surfaces, objects of meshio and PyVista."""

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.common.checked import instance
from diffsim_ti.common.public import public
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.files import KEEPS_SETS, as_meshio, of_meshio, read_mesh, write_mesh
from diffsim_ti.mesh.filling import filled
from diffsim_ti.mesh.readers.file_mesh import FileMesh, parts_of
from diffsim_ti.mesh.readers.vtk_cells import KINDS, LAGRANGE, grid_of_kinds
from diffsim_ti.mesh.sets import without_unused

if TYPE_CHECKING:
    import meshio
    import pyvista
    from typing_extensions import Self


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
    @public
    def from_file(
        cls,
        path: str | PathLike,
        fix_orientation: bool = False,
        drop_orphans: bool = False,
        size: float | None = None,
        cells: int | None = None,
        device: str | None = None,
    ) -> "Self":
        """Load a body: tetrahedra of four or ten nodes from Gmsh .msh (1 to 4.1), Abaqus .inp, MEDIT .mesh, .vtk, .vtu,
        .pvtu, TetGen .ele and whatever else meshio reads, or a surface from .stl, .obj, .ply, .off, .gltf or .glb, which is
        filled (`from_surface`, to which size [m] and cells belong).

        Blocks of tetrahedra are joined. Named groups of tetrahedra become tetrahedron sets; groups of triangles, lines or
        points become the vertex sets of their vertices, and triangles on the surface a surface set too. Whole numbers that
        group cells, of any name (gmsh:physical, MaterialIds, cell_group ...), become "tag_<n>". Parts of a surface file
        keep their names. Ten-node tetrahedra keep their mid-edge vertices, and edges that are curved.
        What a file holds and the mesh does not keep is listed in one UserWarning: cells of other kinds, triangles away from
        the tetrahedra, empty groups, materials and loads of Abaqus.
        drop_orphans: leave out vertices that no tetrahedron uses (Gmsh writes some) and renumber; default: warn. device:
        as for `create_cube`.

        Raises FileNotFoundError, ImportError where meshio needs a further package (h5py for XDMF, CGNS and MED, netCDF4 for
        Exodus), and ValueError for an unreadable file, one without tetrahedra or with both kinds, solid cells of other
        kinds beside tetrahedra, and whatever the constructor refuses.
        """
        instance("from_file", "path", path, str | PathLike, "that of a mesh file")
        runtime.use_device(device)
        try:
            parts, left_out = read_mesh(path, size, cells)
            mesh = cls._of_parts(parts, fix_orientation, drop_orphans)
        except ValueError as error:
            raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
        if left_out:
            warn(f"{path}: left out: {'; '.join(left_out)}")
        return mesh

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
    @public
    def from_surface(
        cls, points: ArrayLike, triangles: ArrayLike, size: float | None = None, cells: int | None = None
    ) -> "Self":
        """The body within a surface, filled by TetGen (`pip install "diffsim-ti[surfaces]"`).

        points [m], shape (n, 3), and triangles, shape (k, 3), of the surface. A closed one keeps all of them (cut into
        parts where size asks for it); points that coincide become one, and closed parts within others bound cavities. One
        that is open or meets itself is filled by fTetWild (`pip install "diffsim-ti[dirty]"`), which moves it by up to a
        thousandth of its size, with a UserWarning that says what is wrong and where.
        size: largest edge of tetrahedra [m], about; or cells: edges along the longest side. Default: as large as the
        quality of tetrahedra allows. `from_file` does this for files of surfaces.

        Raises ValueError for a surface that cannot be filled, and where TetGen or fTetWild is missing.
        Si 2015, TetGen, a Delaunay-Based Quality Tetrahedral Mesh Generator, doi:10.1145/2629697.
        Hu et al. 2020, Fast Tetrahedral Meshing in the Wild, doi:10.1145/3386569.3392385.
        """
        points, triangles = np.asarray(points, np.float64), np.asarray(triangles)
        for name, given, kind in (("points", points, "f"), ("triangles", triangles, "iu")):
            if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in kind:
                numbers = "indices" if name == "triangles" else "numbers"
                raise ValueError(f"{name} must be {numbers} of shape (n, 3), got shape {given.shape} of {given.dtype}")
        if triangles.size and not (0 <= triangles.min() and triangles.max() < len(points)):
            raise ValueError(f"triangles must name points from 0 to {len(points) - 1}, got {triangles.max()}")
        return cls(*filled(points, triangles.astype(np.int64), size=size, cells=cells)[:2])

    @classmethod
    @public
    def from_meshio(cls, mesh: "meshio.Mesh", fix_orientation: bool = False, drop_orphans: bool = False) -> "Self":
        """Of meshio's mesh, with its sets, as `from_file` has it of a file."""
        return cls._from(of_meshio(mesh), fix_orientation, drop_orphans)

    @classmethod
    def _from(cls, mesh: FileMesh, fix_orientation: bool, drop_orphans: bool) -> "Self":
        parts, left_out = parts_of(mesh, again=True)
        if left_out:
            warn(f"left out: {'; '.join(left_out)}")
        return cls._of_parts(parts, fix_orientation, drop_orphans)

    def to_meshio(self) -> "meshio.Mesh":
        """As a mesh of meshio, with the sets as 0/1 arrays, as in .vtu files (`save`); `from_meshio` brings it back."""
        return as_meshio(self)

    @classmethod
    @public
    def from_pyvista(
        cls, grid: "pyvista.UnstructuredGrid", fix_orientation: bool = False, drop_orphans: bool = False
    ) -> "Self":
        """Of a grid of PyVista (or one that only looks like it: `points`, `cells_dict`, `celltypes`, `point_data`,
        `cell_data`), whose 0/1 arrays named as in .vtu files become sets. PyVista need not be there."""
        if other := sorted(set(grid.cells_dict) - set(KINDS) - set(LAGRANGE)):
            raise ValueError(
                f"cells of VTK's types {other} cannot be read; there may be tetrahedra, triangles, lines, vertices"
            )
        types = np.asarray(grid.celltypes)
        parts = [(int(t), np.asarray(own, np.int64), np.nonzero(types == t)[0]) for t, own in grid.cells_dict.items()]
        data = [{name: np.asarray(d[name]) for name in d.keys()} for d in (grid.point_data, grid.cell_data)]
        return cls._from(grid_of_kinds(np.asarray(grid.points), parts, *data), fix_orientation, drop_orphans)

    def to_pyvista(self) -> "pyvista.UnstructuredGrid":
        """As a grid of PyVista, which must be installed, with the sets as 0/1 arrays."""
        try:
            import pyvista
        except ImportError as error:
            raise ImportError("PyVista is missing: pip install pyvista; `to_meshio` needs nothing") from error
        return pyvista.from_meshio(self.to_meshio())
