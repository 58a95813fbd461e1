"""Designs: few numbers to rest positions, each with value, tangent and adjoint; smooth gradients, volume, guarded steps."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.special import comb

from diffsim_ti.common.public import Public, public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.geometry import edge_matrices, inverse_edges, shape_gradients, signed_volumes


class Cage(metaclass=Public):
    """Free-form deformation: rest positions X + sum_k B_k(X) d_k by displacements d of a lattice of control points.

    shape: points of the lattice along x, y, z, at least 2 each, over the mesh's bounding box; d has shape (*shape, 3) [m].
    B are products of Bernstein polynomials. For meshes of any order; `vjp` takes gradients by rest_positions.
    Sederberg, Parry 1986, doi:10.1145/15886.15903.

    >>> import diffsim_ti as ds
    >>> import numpy as np
    >>> from diffsim_ti.designs import Cage
    >>> cage = Cage(ds.TetrahedralMesh.create_cube(resolution=2), (2, 2, 2))
    >>> bool(np.allclose(cage.value(np.full((8, 3), 0.25)), cage.mesh.vertices + 0.25))  # all control points alike
    True
    """

    def __init__(self, mesh: TetrahedralMesh, shape: tuple[int, int, int]):
        if len(shape) != 3 or min(shape) < 2:
            raise ValueError(f"Cage: shape is three numbers of points >= 2, got {shape}")
        self.mesh, self.shape = mesh, (*shape, 3)
        low, high = mesh.bounding_box
        at = (mesh.vertices - low) / (high - low)
        rows = [
            comb(n - 1, np.arange(n)) * s[:, None] ** np.arange(n) * (1 - s[:, None]) ** np.arange(n)[::-1]
            for n, s in zip(shape, at.T)
        ]
        self.weights = np.einsum("vi,vj,vk->vijk", *rows).reshape(len(at), -1)

    def value(self, d: ArrayLike) -> np.ndarray:
        """Rest positions [m], (num_vertices, 3)."""
        return self.mesh.vertices + self.jvp(d)

    def jvp(self, change: ArrayLike) -> np.ndarray:
        """Change of the rest positions; the map is affine."""
        return self.weights @ np.asarray(change, np.float64).reshape(-1, 3)

    def vjp(self, positions_adj: ArrayLike) -> np.ndarray:
        """Gradient by d from that by the rest positions."""
        return (self.weights.T @ np.asarray(positions_adj, np.float64)).reshape(self.shape)


def _stiffness(mesh: TetrahedralMesh) -> sparse.csc_matrix:
    """Laplace's matrix of linear tetrahedra, sum V grad N_a . grad N_b [m]."""
    if mesh.order != 1:
        raise ValueError("a harmonic inside needs linear tetrahedra: make the design on mesh.linear(), or take a Cage")
    G = shape_gradients(inverse_edges(mesh.vertices, mesh.tetrahedra))
    blocks = np.einsum("t,tai,tbi->tab", mesh.volumes, G, G)
    rows, columns = np.repeat(mesh.tetrahedra, 4, 1).ravel(), np.tile(mesh.tetrahedra, 4).ravel()
    return sparse.csc_matrix((blocks.ravel(), (rows, columns)), shape=(mesh.num_vertices,) * 2)


class SurfaceDisplacement(metaclass=Public):
    """Displacements d of the surface's vertices, shape (num surface vertices, 3) [m]; inside, div grad u = 0.

    Rest positions are X + u, u = d on `mesh.surface_vertices` and -K_ii^-1 K_is d inside, K by linear tetrahedra.
    Joshi et al. 2007, doi:10.1145/1276377.1276466, on harmonic coordinates.
    """

    def __init__(self, mesh: TetrahedralMesh):
        self.mesh, K = mesh, _stiffness(mesh)
        self.surface = np.asarray(mesh.surface_vertices)
        self.inside = np.setdiff1d(np.arange(mesh.num_vertices), self.surface)
        self.shape = (len(self.surface), 3)
        self._coupling = K[self.inside][:, self.surface]
        self._solve = splu(K[self.inside][:, self.inside].tocsc()).solve if len(self.inside) else None

    def value(self, d: ArrayLike) -> np.ndarray:
        """Rest positions [m], (num_vertices, 3)."""
        return self.mesh.vertices + self.jvp(d)

    def jvp(self, change: ArrayLike) -> np.ndarray:
        """Change of the rest positions; the map is affine."""
        change, out = np.asarray(change, np.float64), np.zeros(self.mesh.vertices.shape)
        out[self.surface] = change
        if self._solve is not None:
            out[self.inside] = -self._solve(self._coupling @ change)
        return out

    def vjp(self, positions_adj: ArrayLike) -> np.ndarray:
        """Gradient by d from that by the rest positions."""
        positions_adj = np.asarray(positions_adj, np.float64)
        out = positions_adj[self.surface].copy()
        if self._solve is not None:
            out -= self._coupling.T @ self._solve(positions_adj[self.inside])
        return out


def smoothed(mesh: TetrahedralMesh, gradient: ArrayLike, length: float) -> np.ndarray:
    """The H1 gradient g of a raw one: (M + length^2 K) g = gradient, with lumped volumes M [m^3] and Laplace's matrix K.

    A step along -g lowers the loss too, and what is finer than `length` [m] does not tangle the mesh.
    Mohammadi, Pironneau, Applied Shape Optimization for Fluids, 2010, ch. 5.
    """
    if not length > 0:
        raise ValueError(f"smoothed: length must be > 0 [m], got {length}")
    K = _stiffness(mesh)
    M = sparse.diags(np.bincount(mesh.tetrahedra.ravel(), np.repeat(mesh.volumes, 4) / 4, mesh.num_vertices))
    return splu((M + length**2 * K).tocsc()).solve(np.asarray(gradient, np.float64))


def rest_volume(mesh: TetrahedralMesh, positions: ArrayLike) -> tuple[float, np.ndarray]:
    """(volume [m^3] of the mesh's linear tetrahedra at these positions [m], its gradient [m^2], (num_vertices, 3))."""
    positions = np.asarray(positions, np.float64)
    V = signed_volumes(edge_matrices(positions, mesh.tetrahedra))
    G = shape_gradients(inverse_edges(positions, mesh.tetrahedra)) * V[:, None, None]
    out = np.zeros(positions.shape)
    np.add.at(out, mesh.tetrahedra, G)
    return float(V.sum()), out


def smallest_ratio(mesh: TetrahedralMesh, positions: ArrayLike) -> float:
    """Smallest J of the map from the mesh to these rest positions [m], by its linear tetrahedra; 1 for the mesh itself."""
    ratios = signed_volumes(edge_matrices(np.asarray(positions, np.float64), mesh.tetrahedra))
    return float((ratios / signed_volumes(edge_matrices(mesh.vertices, mesh.tetrahedra))).min())


@public
def guarded_step(design: Cage | SurfaceDisplacement, d: ArrayLike, step: ArrayLike, least: float = 0.2) -> np.ndarray:
    """The step, halved until the smallest J of the new rest shape is at least `least`.

    Raises ValueError where the shape at d is already below that, or no step of twenty halvings is short enough.
    """
    if smallest_ratio(design.mesh, design.value(d)) < least:
        raise ValueError(f"guarded_step: the smallest J is below {least} before the step; start from another shape")
    step = np.asarray(step, np.float64)
    for _ in range(20):
        if smallest_ratio(design.mesh, design.value(np.asarray(d) + step)) >= least:
            return step
        step = step / 2
    raise ValueError(f"guarded_step: no step keeps the smallest J above {least}; check the direction")


def tangential(step: ArrayLike, gradient: ArrayLike) -> np.ndarray:
    """The step without its part along the gradient of what is held (a volume), to first order."""
    step, gradient = np.asarray(step, np.float64), np.asarray(gradient, np.float64)
    return step - gradient * (np.sum(step * gradient) / np.sum(gradient * gradient))
