"""Links of loads: from numbers over time, areas and volumes to what kernels read.

What is given over time comes as values at the beginning and at the end of each step, shape (2, rows, ...), between which a
load goes linearly. One row serves all steps.
"""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh.face_points import face_points


class InTime(Link):
    """At the beginning and at the end of each step, shape (2, rows, ...), of an array that is the same all the time or, with
    a leading axis of `ndim` in all, given for each step; `keyed`: for each step's ends instead, linear between."""

    def __init__(self, reads: str, writes: str, ndim: int, keyed: bool):
        self.reads, self.writes, self.ndim, self.keyed = (reads,), (writes,), ndim, keyed

    def value(self, x):
        if self.keyed:
            return (np.stack([x[:-1], x[1:]] if len(x) > 1 else [x, x]),)
        rows = x[None] if x.ndim < self.ndim else x
        return (np.stack([rows, rows]),)

    def jvp(self, x, dx):
        return self.value(dx[0])

    def vjp(self, x, y_adj):
        begin, end = y_adj[0]
        if not self.keyed:
            both = begin + end
            return (both[0] if x[0].ndim < self.ndim else both,)
        if len(x[0]) == 1:
            return (begin + end,)
        out = np.zeros_like(x[0])
        out[:-1] += begin
        out[1:] += end
        return (out,)


class VertexAreas(Link):
    """Of rest positions the area [m^2] of each of some vertices, the integral of its shape function over the given faces
    around it, which is what a constant traction on these asks for: a third of triangles; of flat faces of six nodes a
    third at mid-edge vertices and nothing at corners."""

    reads = ("rest",)

    def __init__(self, faces: np.ndarray, vertices: np.ndarray, writes: str):
        self.points, self.writes = face_points(faces), (writes,)
        self.nodes, self.count = np.searchsorted(vertices, faces), len(vertices)

    def _to_vertices(self, areas):
        return np.bincount(self.nodes.ravel(), self.points.to_nodes(areas).ravel(), self.count)

    def value(self, X):
        return (self._to_vertices(np.linalg.norm(self.points.normals(X), axis=1)),)

    def jvp(self, x, dx):
        n, dn = self.points.normals(x[0]), self.points.normals_jvp(x[0], dx[0])
        return (self._to_vertices((n * dn).sum(1) / np.linalg.norm(n, axis=1)),)

    def vjp(self, x, y_adj):
        n = self.points.normals(x[0])
        unit = n / np.linalg.norm(n, axis=1, keepdims=True)
        return (self.points.normals_vjp(x[0], self.points.from_nodes(y_adj[0][self.nodes])[:, None] * unit),)


class VertexShares(Link):
    """What each of some vertices has of the volume [m^3] or, with density, of the mass [kg] of the given tetrahedra around
    it: a fourth of each, or the shares of lumped masses of ten nodes; times factors of the vertices where there are some."""

    def __init__(self, mesh, chosen: np.ndarray, vertices: np.ndarray, of_mass: bool, writes: str, factors=None):
        volumes = "volumes" if mesh.order == 1 else "element volumes"
        self.reads, self.writes = (volumes, "density") if of_mass else (volumes,), (writes,)
        self.chosen, self.count, self.shares = chosen, len(vertices), mesh.reference.lumped
        self.nodes, self.factors = np.searchsorted(vertices, mesh.elements[chosen]), factors

    def _to_vertices(self, of_each):
        out = np.bincount(self.nodes.ravel(), np.outer(of_each[self.chosen], self.shares).ravel(), self.count)
        return out if self.factors is None else self.factors * out

    def value(self, volumes, *density):
        return (self._to_vertices(density[0] * volumes if density else volumes),)

    def jvp(self, x, dx):
        if len(x) == 1:
            return self.value(dx[0])
        return (self._to_vertices(dx[1] * x[0] + x[1] * dx[0]),)

    def vjp(self, x, y_adj):
        by_vertex = y_adj[0] if self.factors is None else self.factors * y_adj[0]
        by_each = np.zeros_like(x[0])
        by_each[self.chosen] = (by_vertex[self.nodes] * self.shares).sum(1)
        if len(x) == 1:
            return (by_each,)
        volumes, density = x
        by_density = by_each * volumes
        return by_each * density, by_density if density.ndim else by_density.sum()


class ConsistentShares(Link):
    """What `VertexShares` says by integrals of the shape functions of ten nodes, of volumes or of masses."""

    def __init__(self, mesh, chosen: np.ndarray, vertices: np.ndarray, of_mass: bool, writes: str):
        self.reads, self.writes = ("element_masses",) if of_mass else ("element_masses", "density"), (writes,)
        self.chosen, self.count, self.nodes = chosen, len(vertices), np.searchsorted(vertices, mesh.elements[chosen])

    def _to_vertices(self, masses):
        return np.bincount(self.nodes.ravel(), masses[self.chosen].sum(2).ravel(), self.count)

    @staticmethod
    def _by(density):
        return np.reshape(density, (-1, 1, 1))

    def value(self, masses, *density):
        return (self._to_vertices(masses / self._by(density[0]) if density else masses),)

    def jvp(self, x, dx):
        if len(x) == 1:
            return self.value(dx[0])
        rho = self._by(x[1])
        return (self._to_vertices(dx[0] / rho - x[0] / rho**2 * self._by(dx[1])),)

    def vjp(self, x, y_adj):
        masses_adj = np.zeros_like(x[0])
        masses_adj[self.chosen] = y_adj[0][self.nodes][:, :, None]
        if len(x) == 1:
            return (masses_adj,)
        rho = self._by(x[1])
        by_density = -(masses_adj * x[0] / rho**2).sum((1, 2))
        return masses_adj / rho, by_density if x[1].ndim else by_density.sum()


class Spread(Link):
    """Forces of vertices, weight times vector, from vectors of shape (2, rows, 3) and one weight for each vertex."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    def value(self, vectors, weights):
        return (vectors[:, :, None] * weights[:, None],)

    def jvp(self, x, dx):
        return (self.value(dx[0], x[1])[0] + self.value(x[0], dx[1])[0],)

    def vjp(self, x, y_adj):
        return np.einsum("brki,k->bri", y_adj[0], x[1]), np.einsum("brki,bri->k", y_adj[0], x[0])


class _Together(Link):
    """Several loads in time, each of shape (2, rows, ...); those of one row hold in all steps."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    @staticmethod
    def rows(x) -> int:
        """The steps that all are given for, 1 if all are constant."""
        return min((part.shape[1] for part in x if part.shape[1] > 1), default=1)

    def jvp(self, x, dx):
        return self.value(*dx)

    @staticmethod
    def _pulled(part: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
        """The adjoint of one of them, from that of its share in all rows."""
        if part.shape[1] == 1:
            return adjoint.sum(1, keepdims=True)
        out = np.zeros_like(part)
        out[:, : adjoint.shape[1]] = adjoint
        return out


class SumOfForces(_Together):
    """Forces [N] of all dead loads, shape (rows, k, 3) for the k vertices that any of them acts on; with `keyed`, where some
    change within steps, (rows, 2 k, 3): at the beginning of each step in even columns, at its end in odd ones."""

    def __init__(self, reads: Sequence[str], vertices: Sequence[np.ndarray], keyed: bool, writes: str):
        super().__init__(reads, writes)
        self.vertices = np.unique(np.concatenate(vertices))
        self.columns, self.keyed = [np.searchsorted(self.vertices, own) for own in vertices], keyed

    def value(self, *x):
        rows, k = self.rows(x), len(self.vertices)
        out = np.zeros((2, rows, k, 3))
        for columns, part in zip(self.columns, x):
            out[:, :, columns] += part[:, :rows]
        return (np.moveaxis(out, 0, 2).reshape(rows, 2 * k, 3) if self.keyed else out[0],)

    def vjp(self, x, y_adj):
        if self.keyed:
            adjoint = np.stack([y_adj[0][:, 0::2], y_adj[0][:, 1::2]])
        else:
            adjoint = np.stack([y_adj[0], np.zeros_like(y_adj[0])])
        return [self._pulled(part, adjoint[:, :, columns]) for columns, part in zip(self.columns, x)]


class PressureRows(_Together):
    """Pressures [Pa] of all loads, then numbers of chambers, shape (rows, k, 3): as each step begins, as it ends, zero."""

    def value(self, *x):
        rows = self.rows(x)
        out = np.zeros((rows, len(x), 3))
        for k, part in enumerate(x):
            out[:, k, :2] = part[:, :rows].T
        return (out,)

    def vjp(self, x, y_adj):
        return [self._pulled(part, y_adj[0][:, k, :2].T) for k, part in enumerate(x)]
