"""The nodes of a mesh's elements: four, or ten with the mid-edge vertices; and the way from the ones to the others."""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh import checks
from diffsim_ti.mesh.geometry import edge_matrices, edges_of, signed_volumes
from diffsim_ti.mesh.reference_element import MID_EDGES, ReferenceElement, reference_element
from diffsim_ti.mesh.refinement import Refinement, joined_vertex_sets, parts_of_refined
from diffsim_ti.mesh.sets import checked_sets, frozen
from diffsim_ti.mesh.ten_nodes import middles_of, triangles_of

if TYPE_CHECKING:
    from diffsim_ti.mesh.named_sets import SetOrIndices
    from diffsim_ti.mesh.tetrahedral_mesh import TetrahedralMesh


class Elements:
    """A part of TetrahedralMesh: its elements of four or ten nodes."""

    refinement: Refinement | None = None  # of which coarser mesh `refined` made it

    @property
    def elements(self) -> np.ndarray:
        """All vertices of each element, shape (num_tetrahedra, 4) or (num_tetrahedra, 10): corners, then the mid-edge
        vertices of 01, 12, 20, 03, 13, 23 (VTK's order). Of a linear mesh, `tetrahedra` itself."""
        return self._elements

    @property
    def reference(self) -> ReferenceElement:
        """Shape functions and quadrature of the elements."""
        return reference_element(self._elements.shape[1])

    @property
    def order(self) -> int:
        """1: linear tetrahedra, 2: quadratic ones of ten nodes."""
        return self.reference.order

    @property
    def surface_faces(self) -> np.ndarray:
        """Whole faces of the surface: corners, then middles of 01, 12, 20; shape (k, 6), or (k, 3) where order is 1.

        Face f consists of the rows 4 f .. 4 f + 3 of `surface_triangles` (order 1: of row f).
        """
        return self._surface_faces

    @property
    def middles(self) -> np.ndarray:
        """(mid-edge vertex, its two ends) of each edge, shape (k, 3); none where order is 1."""
        return self._middles

    @cached_property
    def curved(self) -> np.ndarray:
        """Whether an element has an edge that is not straight, or its middle off the mid-edge vertex; Booleans, shape
        (num_tetrahedra,)."""
        return frozen(checks.curved(self.vertices, self._elements))

    @cached_property
    def corners(self) -> np.ndarray:
        """Sorted indices of the vertices that are no mid-edge vertices: vertex corners[k] is vertex k of `linear()`."""
        return frozen(np.setdiff1d(np.arange(self.num_vertices), self.middles[:, 0]))

    @cached_property
    def from_corners(self):
        """SciPy CSR matrix P, shape (num_vertices, len(corners)): x = P x_c are the vertices of straight-edged elements with
        corners x_c, and P^T pulls adjoints of all vertices back to the corners, those of a mid-edge vertex half to each end.
        """
        from scipy.sparse import csr_matrix

        n = self.num_vertices
        new = np.zeros(n, np.int64)
        new[self.corners] = np.arange(len(self.corners))
        middle, i, j = self.middles.T
        rows = np.concatenate([self.corners, middle, middle])
        weights = np.repeat([1.0, 0.5], [len(self.corners), 2 * len(middle)])
        return csr_matrix((weights, (rows, new[np.concatenate([self.corners, i, j])])), (n, len(self.corners)))

    def quadratic(self) -> "TetrahedralMesh":
        """Ten-node tetrahedra with straight edges of the same corners; a mesh of order 2 is returned as it is.

        Mid-edge vertices come after the vertices there are, which keep their indices. Tetrahedron sets stay, a triangle of a
        surface set becomes four, and a mid-edge vertex joins the vertex sets that hold all corners of a triangle of the
        surface on which its edge lies, or of a tetrahedron: so sets of sides stay on their sides.
        """
        if self.order == 2:
            return self
        edges, place = edges_of(self.tetrahedra, MID_EDGES)
        vertices = np.concatenate([self.vertices, (self.vertices[edges[:, 0]] + self.vertices[edges[:, 1]]) / 2])
        elements = np.concatenate([self.tetrahedra, self.num_vertices + place], 1)
        tetrahedron, edge = np.divmod(np.unique(place, return_index=True)[1], len(MID_EDGES))
        vertex_sets = joined_vertex_sets(self, tetrahedron, np.eye(4)[MID_EDGES[edge]].mean(1))
        surface_sets = {name: (4 * rows[:, None] + np.arange(4)).ravel() for name, rows in self._surface_sets.items()}
        return self._with_nodes(vertices, elements, self._volumes, vertex_sets, surface_sets)

    def refined(
        self,
        where: "SetOrIndices | None" = None,
        edges: Literal["all", "longest"] = "all",
        onto: Callable[[np.ndarray], ArrayLike] | None = None,
    ) -> "TetrahedralMesh":
        """A mesh in which edges of some tetrahedra, by default of all, are halved, and those of others so that edges fit and
        no element becomes slender: where an edge is halved, the longest of each tetrahedron there is, too.

        where: tetrahedra, as in `tetrahedron_indices`. edges: "all" six of them, which makes eight of a tetrahedron, or the
        "longest" alone, two. Vertices keep their indices, new ones follow; sets stay on their places, and curved ten-node
        elements keep their shape exactly. A new vertex joins a vertex set that has all vertices of a tetrahedron or surface
        face that it lies in; a set along a line it does not join.
        onto: function of the places of new vertices [m], shape (k, 3), that returns where they are to be, such as on a round
        surface that edges are chords of. `refinement` of the mesh says whose parts its tetrahedra are, and has the matrix
        that carries fields: `fine.refinement.from_coarse @ displacements`.
        Rivara 1997, New longest-edge algorithms for the refinement of unstructured meshes,
        doi:10.1002/(SICI)1097-0207(19970930)40:18<3313::AID-NME214>3.0.CO;2-#.

        >>> import diffsim_ti as ds
        >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
        >>> fine = mesh.refined()
        >>> mesh.num_tetrahedra, fine.num_tetrahedra, mesh.refined([0]).num_tetrahedra
        (6, 48, 27)
        """
        parts, refinement, sets = parts_of_refined(self, where, edges, onto)
        out = self._with_nodes(*parts, {})
        tetrahedra, surfaces = sets(out)
        out._tetrahedron_sets = checked_sets(tetrahedra, len(refinement.parents), "tetrahedron")
        out._surface_sets = checked_sets(surfaces, len(out._surface_triangles), "surface")
        out.refinement = refinement
        return out

    def linear(self) -> "TetrahedralMesh":
        """Linear tetrahedra of the same corners; a mesh of order 1 is returned as it is.

        Mid-edge vertices are left out, the others renumbered in their order, as `corners` says. A face stays in a surface
        set where all of its four triangles are in it.
        """
        if self.order == 1:
            return self
        vertices, new = self.vertices[self.corners], np.full(self.num_vertices, -1)
        new[self.corners] = np.arange(len(vertices))
        tetrahedra = new[self.tetrahedra]
        vertex_sets = {name: new[rows][new[rows] >= 0] for name, rows in self._vertex_sets.items()}
        surface_sets = {
            name: np.nonzero(np.bincount(rows // 4, minlength=len(self._surface_faces)) == 4)[0]
            for name, rows in self._surface_sets.items()
        }
        volumes = signed_volumes(edge_matrices(vertices, tetrahedra))
        return self._with_nodes(vertices, tetrahedra, volumes, vertex_sets, surface_sets)

    def _with_nodes(self, vertices, elements, volumes, vertex_sets: dict, surface_sets: dict) -> "TetrahedralMesh":
        """The same tetrahedra with other nodes, which need no check."""
        new = object.__new__(type(self))
        new._put(vertices, elements, volumes)
        new._vertex_sets = checked_sets(vertex_sets, len(vertices), "vertex")
        new._surface_sets = checked_sets(surface_sets, len(new._surface_triangles), "surface")
        new._tetrahedron_sets = self._tetrahedron_sets
        return new

    def _put(self, vertices: np.ndarray, elements: np.ndarray, volumes: np.ndarray) -> None:
        """Take these arrays for good, after a check of what is between elements."""
        self._vertices, self._elements, self._volumes = vertices, elements, volumes
        self._tetrahedra = elements if elements.shape[1] == 4 else elements[:, :4].copy()
        self._surface_faces = checks.surface_of(elements, len(vertices))
        self._surface_triangles = triangles_of(self._surface_faces)
        self._middles = middles_of(elements)
        own = (self._tetrahedra, self._surface_faces, self._surface_triangles, self._middles)
        for array in (vertices, elements, volumes, *own):
            frozen(array)
