"""A finer triangulation of the surface of ten-node tetrahedra, whose vertices lie on its curved faces."""

import numpy as np

from diffsim_ti.mesh import reference_face
from diffsim_ti.mesh.face_points import bow

BOWED, MOST_CUTS = 0.1, 3


def cuts_of(mesh, width: float, bend: float = 0.0) -> int:
    """How often pairs cut the four triangles of each face in four, until they are within BOWED widths [m] of it as it is at
    rest or bends by `bend` [m]; MOST_CUTS at most. A cut leaves a fourth of the distance."""
    off = max(bow(mesh), bend if mesh.order == 2 else 0.0) / (BOWED * width)
    return int(np.clip(np.ceil(np.log2(max(off, 1.0)) / 2), 0, MOST_CUTS))


class CollisionSurface:
    """What contact reads of a mesh. Vertices of the mesh keep their numbers, and those that are new come after them.

    x = C X are its vertices, C the CSR matrix `matrix`, whose rows hold six shape functions at most and sum up to 1.
    """

    def __init__(self, mesh, cuts: int):
        from scipy.sparse import csr_matrix

        n, parts, faces = mesh.num_vertices, 2 ** (cuts + 1), mesh.surface_faces
        grid = np.array([[i, j] for i in range(parts + 1) for j in range(parts + 1 - i)])
        N = reference_face.functions(grid / parts)  # exact: so that faces agree on their edges bit by bit
        nodes = np.where(N != 0, faces[:, None], -1).reshape(-1, 6)
        order, weights = np.argsort(nodes, 1), np.tile(N, (len(faces), 1))
        rows = np.concatenate([np.take_along_axis(x, order, 1) for x in (nodes, weights)], 1)
        points, place = np.unique(rows, axis=0, return_inverse=True)
        nodes, weights, place = points[:, :6].astype(int), points[:, 6:], place.reshape(len(faces), -1)
        alone = (weights != 0).sum(1) == 1
        new = np.where(alone, nodes[:, 5], n + np.cumsum(~alone) - 1)
        nodes, weights = nodes[~alone], weights[~alone]
        self.num_vertices = n + len(nodes)
        at, some = np.arange(n, self.num_vertices), weights != 0
        rows = np.concatenate([np.arange(n), np.repeat(at, 6)[some.ravel()]])
        columns = np.concatenate([np.arange(n), nodes[some]])
        values = np.concatenate([np.ones(n), weights[some]])
        self.matrix = csr_matrix((values, (rows, columns)), (self.num_vertices, n))
        self.vertices = self.matrix @ mesh.vertices
        self.surface_triangles = new[place][:, _triangles(grid, parts)].reshape(-1, 3)
        self.surface_vertices = np.unique(self.surface_triangles)
        # what belongs together: a new vertex to one of its nodes
        links = np.concatenate([at[:, None], np.tile(nodes[:, 5:], mesh.elements.shape[1] - 1)], 1)
        self.elements = np.concatenate([mesh.elements, links])
        self.tetrahedron_sets, self.vertex_sets = {}, self._sets(mesh)

    def _sets(self, mesh) -> dict[str, np.ndarray]:
        """Vertices of the mesh's sets, of tetrahedra too; a new one is in those that all of its nodes are in."""
        named = {name: mesh.elements[own] for name, own in mesh.tetrahedron_sets.items()} | dict(mesh.vertex_sets)
        apart, out = np.diff(self.matrix.indptr), {}
        for name, members in named.items():
            inside = np.zeros(self.matrix.shape[1])
            inside[members] = 1
            out[name] = np.flatnonzero((self.matrix != 0).astype(float) @ inside == apart)
        return out


def _triangles(grid, parts: int) -> np.ndarray:
    """Rows of the grid that are corners of its triangles, turned as the face is."""
    number = {(int(i), int(j)): k for k, (i, j) in enumerate(grid)}
    up = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in number if i + j < parts]
    down = [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i, j in number if i + j < parts - 1]
    return np.array([[number[corner] for corner in triangle] for triangle in up + down])
