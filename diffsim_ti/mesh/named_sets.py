"""The named sets of a mesh: of vertices, of tetrahedra, and of triangles of the surface."""

from collections.abc import Callable, Iterable
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import shape_of
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.mesh.sets import array_of, checked_sets, chosen_indices, rows_of

if TYPE_CHECKING:
    from diffsim_ti.mesh.tetrahedral_mesh import TetrahedralMesh

# of a mesh: the name of a set, several, indices or a Boolean mask
SetOrIndices = TypeAliasType("SetOrIndices", str | ArrayLike | Iterable[str])


class NamedSets:
    """A part of TetrahedralMesh: which sets it has, and the ways to choose and to name some."""

    @property
    def vertex_sets(self) -> MappingProxyType:
        """Name -> sorted vertex indices."""
        return MappingProxyType(self._vertex_sets)

    @property
    def tetrahedron_sets(self) -> MappingProxyType:
        """Name -> sorted tetrahedron indices."""
        return MappingProxyType(self._tetrahedron_sets)

    @property
    def surface_sets(self) -> MappingProxyType:
        """Name -> sorted indices of rows of `surface_triangles`."""
        return MappingProxyType(self._surface_sets)

    # Choosing

    def vertex_indices(self, chosen: SetOrIndices) -> np.ndarray:
        """Sorted indices from a set's name, several names, indices, or a Boolean mask over the vertices.

        A surface set of a name that no vertex set has stands for its vertices.
        """
        of_surface = {name: np.unique(self.surface_triangles[rows]) for name, rows in self._surface_sets.items()}
        return chosen_indices(chosen, of_surface | self._vertex_sets, self.num_vertices, "vertex")

    def tetrahedron_indices(self, chosen: SetOrIndices) -> np.ndarray:
        """Sorted indices from a set's name, several names, indices, or a Boolean mask over the tetrahedra."""
        return chosen_indices(chosen, self._tetrahedron_sets, self.num_tetrahedra, "tetrahedron")

    def surface_indices(self, chosen: SetOrIndices | None) -> np.ndarray:
        """Sorted indices of rows of `surface_triangles` from a surface set's name, several names, indices, a Boolean mask
        over the rows, or triangles as vertex indices in any order, shape (k, 3); None means the whole surface.

        ValueError for an unknown name, and for a triangle that is not on the surface.
        """
        count = len(self.surface_triangles)
        if chosen is None:
            return np.arange(count)
        if not isinstance(chosen, str) and len(shape_of("surface", chosen)) == 2:
            triangles = array_of("surface", chosen)
            if triangles.shape[1] not in (3, self._surface_faces.shape[1]) or triangles.dtype.kind not in "iu":
                raise ValueError(f"triangles must be vertex indices of shape (k, 3), got shape {triangles.shape}")
            chosen, none = rows_of(triangles[:, :3], self.surface_triangles, self._surface_faces)
            if none.any():
                first = triangles[np.argmax(none)]
                raise ValueError(
                    f"triangle {first.tolist()} is not on the surface ({none.sum()} of {len(none)} are not); "
                    "take rows of surface_triangles"
                )
        return chosen_indices(chosen, self._surface_sets, count, "surface")

    def faces_of(self, chosen: SetOrIndices | None) -> np.ndarray:
        """Whole faces of the surface, as vertex indices, shape (k, 3), or (k, 6) of ten-node tetrahedra; chosen as in
        `surface_indices`, in the order of these.

        ValueError where some of a face's four triangles are chosen and others not: integrals are over whole faces.
        """
        rows = self.surface_indices(chosen)
        if self.order == 1:
            return self.surface_triangles[rows]
        counts = np.bincount(rows // 4, minlength=len(self.surface_faces))
        cut = np.nonzero((counts > 0) & (counts < 4))[0]
        if len(cut):
            raise ValueError(
                f"loads act on whole faces: of face {cut[0]}, rows {4 * cut[0]}..{4 * cut[0] + 3} of surface_triangles, "
                f"{counts[cut[0]]} of 4 triangles are chosen ({len(cut)} such faces); choose faces by surface_where, or all "
                "four rows"
            )
        return self.surface_faces[counts == 4]

    def vertices_where(self, predicate: Callable) -> np.ndarray:
        """Sorted indices of the vertices where a function of all positions is true: `lambda x: x[:, 0] < 0.1`."""
        return self.vertex_indices(_mask(predicate(self.vertices), self.num_vertices))

    def surface_where(self, predicate: Callable) -> np.ndarray:
        """Sorted indices of the surface triangles where a function of all centroids [m] and outward unit normals, both of
        shape (k, 3), is true: `lambda x, n: n[:, 1] > 0.9`.

        With ten nodes these are the places at the middle and the mean normals of whole faces, and all four triangles of a
        face are taken.
        """
        faces, normals = self.surface_faces, triangle_normals(self.vertices, self.surface_triangles)
        corners = self.vertices[faces[:, :3]]
        centroids = corners.mean(1)
        if self.order == 2:
            sag = self.vertices[faces[:, 3:]] - (corners + np.roll(corners, -1, 1)) / 2
            centroids, normals = centroids + 4 / 9 * sag.sum(1), normals.reshape(-1, 4, 3).sum(1)
        unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        chosen = _mask(predicate(centroids, unit), len(faces))
        return self.surface_indices(np.repeat(chosen, len(self.surface_triangles) // len(faces)))

    # Naming

    def with_vertex_set(self, name: str, chosen: SetOrIndices) -> "TetrahedralMesh":
        """A mesh that has this vertex set too (or instead of one of that name); `chosen` as in `vertex_indices`."""
        return self._with_set("vertex", name, self.vertex_indices(chosen), self.num_vertices)

    def with_tetrahedron_set(self, name: str, chosen: SetOrIndices) -> "TetrahedralMesh":
        """A mesh that has this tetrahedron set too (or instead of one of that name)."""
        return self._with_set("tetrahedron", name, self.tetrahedron_indices(chosen), self.num_tetrahedra)

    def with_surface_set(self, name: str, chosen: SetOrIndices | Callable) -> "TetrahedralMesh":
        """A mesh that has this surface set too (or instead of one of that name), for loads and supports to name.

        chosen: as in `surface_indices`, or a predicate as in `surface_where`:

            mesh.with_surface_set("lid", lambda x, n: n[:, 1] > 0.9)
        """
        rows = self.surface_where(chosen) if callable(chosen) else self.surface_indices(chosen)
        return self._with_set("surface", name, rows, len(self.surface_triangles))

    def _with_set(self, what: str, name: str, rows: np.ndarray, count: int) -> "TetrahedralMesh":
        own = f"_{what}_sets"
        return self._changed(**{own: checked_sets({**getattr(self, own), name: rows}, count, what)})


def _mask(values, count: int) -> np.ndarray:
    mask = np.asarray(values)
    if mask.dtype.kind != "b":
        raise ValueError(f"the predicate must return {count} Booleans, got dtype {mask.dtype}")
    return mask
