"""Links of loads, growth, chambers and muscles: from numbers over time, areas and volumes to what kernels read.

What is given over time comes as values at the beginning and at the end of each step, shape (2, rows, ...), between which a
load goes linearly. One row serves all steps.
"""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.inputs.chain import Analytic, Linear, Link, summed_at
from diffsim_ti.mesh.enclosure import Enclosure
from diffsim_ti.mesh.face_points import face_points


class InTime(Linear, Link):
    """At the beginning and at the end of each step, shape (2, rows, ...), of an array that is the same all the time or, with
    a leading axis of `ndim` in all, given for each step; `keyed`: for each step's ends instead, linear between."""

    def __init__(self, reads: str, writes: str, ndim: int, keyed: bool):
        self.reads, self.writes, self.ndim, self.keyed = (reads,), (writes,), ndim, keyed

    def value(self, x):
        if self.keyed:
            return (np.stack([x[:-1], x[1:]] if len(x) > 1 else [x, x]),)
        rows = x[None] if x.ndim < self.ndim else x
        return (np.stack([rows, rows]),)

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


class VertexAreas(Analytic, Link):
    """Of rest positions the area [m^2] of each of some vertices, the integral of its shape function over the given faces
    around it, which is what a constant traction on these asks for: a third of triangles; of flat faces of six nodes a
    third at mid-edge vertices and nothing at corners."""

    reads = ("rest",)

    def __init__(self, faces: np.ndarray, vertices: np.ndarray, writes: str):
        self.points, self.writes = face_points(faces), (writes,)
        self.nodes, self.count = np.searchsorted(vertices, faces), len(vertices)

    def _to_vertices(self, areas):
        return summed_at(self.nodes, self.points.to_nodes(areas), self.count)

    def value(self, X):
        n = self.points.normals(X)
        return (self._to_vertices(np.sqrt((n * n).sum(1))),)

    def vjp(self, x, y_adj):
        n = self.points.normals(x[0])
        unit = n / np.linalg.norm(n, axis=1, keepdims=True)
        return (self.points.normals_vjp(x[0], self.points.from_nodes(y_adj[0][self.nodes])[:, None] * unit),)


class VertexShares(Analytic, Link):
    """What each of some vertices has of the volume [m^3] or, with density, of the mass [kg] of the given tetrahedra around
    it: a fourth of each, or the shares of lumped masses of ten nodes; times factors of the vertices where there are some."""

    def __init__(self, mesh, chosen: np.ndarray, vertices: np.ndarray, of_mass: bool, writes: str, factors=None):
        volumes = "volumes" if mesh.order == 1 else "element volumes"
        self.reads, self.writes = (volumes, "density") if of_mass else (volumes,), (writes,)
        self.chosen, self.count, self.shares = chosen, len(vertices), mesh.reference.lumped
        self.nodes, self.factors = np.searchsorted(vertices, mesh.elements[chosen]), factors

    def _to_vertices(self, of_each):
        out = summed_at(self.nodes, np.outer(of_each[self.chosen], self.shares), self.count)
        return out if self.factors is None else self.factors * out

    def value(self, volumes, *density):
        return (self._to_vertices(density[0] * volumes if density else volumes),)

    def vjp(self, x, y_adj):
        by_vertex = y_adj[0] if self.factors is None else self.factors * y_adj[0]
        by_each = np.zeros_like(x[0])
        by_each[self.chosen] = (by_vertex[self.nodes] * self.shares).sum(1)
        if len(x) == 1:
            return (by_each,)
        volumes, density = x
        by_density = by_each * volumes
        return by_each * density, by_density if density.ndim else by_density.sum()


class ConsistentShares(Analytic, Link):
    """What `VertexShares` says by integrals of the shape functions of ten nodes, of volumes or of masses."""

    def __init__(self, mesh, chosen: np.ndarray, vertices: np.ndarray, of_mass: bool, writes: str):
        self.reads, self.writes = ("element_masses",) if of_mass else ("element_masses", "density"), (writes,)
        self.chosen, self.count, self.nodes = chosen, len(vertices), np.searchsorted(vertices, mesh.elements[chosen])

    def _to_vertices(self, masses):
        return summed_at(self.nodes, masses[self.chosen].sum(2), self.count)

    @staticmethod
    def _by(density):
        return np.reshape(density, (-1, 1, 1))

    def value(self, masses, *density):
        return (self._to_vertices(masses / self._by(density[0]) if density else masses),)

    def vjp(self, x, y_adj):
        masses_adj = np.zeros_like(x[0])
        masses_adj[self.chosen] = y_adj[0][self.nodes][:, :, None]
        if len(x) == 1:
            return (masses_adj,)
        rho = self._by(x[1])
        by_density = -(masses_adj * x[0] / rho**2).sum((1, 2))
        return masses_adj / rho, by_density if x[1].ndim else by_density.sum()


class Spread(Analytic, Link):
    """Forces of vertices, weight times vector, from vectors of shape (2, rows, 3) and one weight for each vertex."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    def value(self, vectors, weights):
        return (vectors[:, :, None] * weights[:, None],)

    def vjp(self, x, y_adj):
        return np.einsum("brki,k->bri", y_adj[0], x[1]), np.einsum("brki,bri->k", y_adj[0], x[0])


class _Together(Linear, Link):
    """Several loads in time, each of shape (2, rows, ...); those of one row hold in all steps."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    @staticmethod
    def rows(x) -> int:
        """The steps that all are given for, 1 if all are constant."""
        return min((part.shape[1] for part in x if part.shape[1] > 1), default=1)

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


class RemoteForces(Analytic, Link):
    """f_i = a_i (F / A + omega x r_i),    J omega = M + (p - c) x F,    J = sum a_i (|r_i|^2 - r_i r_i^T),

    shape (2, rows, k, 3), of (F, M) over time, (2, rows, 6), rest positions and areas a_i of k vertices, A = sum a_i, r_i
    from their centre c. p: the point; None: c. For all of a, r and (F, M) both derivatives.
    """

    def __init__(self, load: str, areas: str, vertices: np.ndarray, point: np.ndarray | None, writes: str):
        self.reads, self.writes = (load, "rest", areas), (writes,)
        self.vertices, self.point = vertices, point

    def _parts(self, load, X, a):
        F, M = load[..., :3], load[..., 3:]
        A = a.sum()
        c = a @ X[self.vertices] / A
        r, arm = X[self.vertices] - c, np.zeros(3) if self.point is None else self.point - c
        J = (a * (r**2).sum(1)).sum() * np.eye(3) - (r.T * a) @ r
        omega = np.linalg.solve(J, (M + np.cross(arm, F))[..., None])[..., 0]
        return F, A, r, arm, J, omega, F[..., None, :] / A + np.cross(omega[..., None, :], r)

    def value(self, load, X, a):
        return (a[:, None] * self._parts(load, X, a)[-1],)

    def vjp(self, x, y_adj):
        load, X, a = x
        F, A, r, arm, J, omega, per_area = self._parts(load, X, a)
        w = y_adj[0]
        aw = a[:, None] * w
        t = np.linalg.solve(J, np.cross(r, aw).sum(-2)[..., None])[..., 0]  # adjoint of J omega
        by_load = np.concatenate([aw.sum(-2) / A + np.cross(t, arm), t], -1)
        by_a = (w * per_area).sum((0, 1, 3)) - (aw * F[..., None, :]).sum() / A**2
        tr, wr, tw = t @ r.T, omega @ r.T, (t * omega).sum(-1)[..., None]
        by_a += (tr * wr - tw * (r**2).sum(1)).sum((0, 1))
        by_r = np.cross(aw, omega[..., None, :]).sum((0, 1)) - 2 * a[:, None] * r * tw.sum()
        by_r += a[:, None] * ((wr[..., None] * t[..., None, :]) + tr[..., None] * omega[..., None, :]).sum((0, 1))
        by_c = -by_r.sum(0) - (0.0 if self.point is None else np.cross(F, t).sum((0, 1)))
        by_X = np.zeros_like(X)
        by_X[self.vertices] = by_r + a[:, None] * by_c / A
        return by_load, by_X, by_a + r @ by_c / A


class GrowthRows(_Together):
    """Sum of all growths in time, shape (rows, 2, m): as each step begins and ends, of each tetrahedron, or m = 1 where all
    grow alike. Each part has shape (2, rows) or (2, rows, groups); chosen: its tetrahedra, None for all; group: which
    number each of these has."""

    def __init__(self, reads: Sequence[str], chosen: Sequence, group: Sequence, num_tetrahedra: int):
        super().__init__(reads, "growths")
        self.chosen, self.group = chosen, group
        self.count = 1 if all(own is None for own in chosen) else num_tetrahedra

    def value(self, *x):
        rows = self.rows(x)
        out = np.zeros((rows, 2, self.count))
        for part, chosen, group in zip(x, self.chosen, self.group):
            by_time = np.moveaxis(part[:, :rows], 0, 1)
            spread = by_time[..., None] if part.ndim == 2 else by_time[..., group]
            out[..., slice(None) if chosen is None else chosen] += spread
        return (out,)

    def vjp(self, x, y_adj):
        out = []
        for part, chosen, group in zip(x, self.chosen, self.group):
            own = np.moveaxis(y_adj[0][..., slice(None) if chosen is None else chosen], 1, 0)
            if part.ndim == 2:
                out.append(self._pulled(part, own.sum(-1)))
                continue
            by_group = np.zeros((part.shape[2], *own.shape[:2]))
            np.add.at(by_group, group, np.moveaxis(own, -1, 0))
            out.append(self._pulled(part, np.moveaxis(by_group, 0, -1)))
        return out


class RestVolume(Link):
    """Of rest positions the volume [m^3] of a chamber."""

    reads = ("rest",)

    def __init__(self, enclosure: Enclosure, writes: str):
        self.enclosure, self.writes = enclosure, (writes,)

    def value(self, X):
        return (self.enclosure.volume(X),)

    def jvp(self, x, dx):
        return ((self.enclosure.gradient(x[0]) * dx[0]).sum(),)

    def vjp(self, x, y_adj):
        return (self.enclosure.gradient(x[0]) * y_adj[0],)


class MuscleTension(Analytic, Link):
    """T = alpha s V / L0 [N] in time, shape (2, rows, points): alpha: activations in time as `InTime` has them, of all
    together or of each group; s: stress [Pa], a number or one for each group; V: volume of each of the points `chosen` among
    those of all tetrahedra; L0: length at rest of the segment there; group: that of each point."""

    def __init__(self, activation: str, stress: str, segments: str, chosen, group, writes: str):
        self.reads, self.writes = (activation, stress, segments, "volumes"), (writes,)
        self.chosen, self.group = chosen, group

    def _spread(self, of_groups):
        """To points, along the last axis."""
        return of_groups[..., self.group] if of_groups.shape[-1] > 1 else of_groups

    def _parts(self, activation, stress, segments, volumes):
        """(alpha, s, V, D, L0)"""
        alpha = self._spread(activation.reshape(*activation.shape[:2], -1))
        D = segments[0::2]
        return alpha, self._spread(stress.reshape(-1)), volumes.ravel()[self.chosen], D, np.sqrt((D * D).sum(1))

    def value(self, *x):
        alpha, s, V, _, length = self._parts(*x)
        return (alpha * (s * V / length),)

    def vjp(self, x, y_adj):
        alpha, s, V, D, length = self._parts(*x)
        by = (y_adj[0] * alpha).sum((0, 1))
        segments, volumes = np.zeros_like(x[2]), np.zeros(x[3].size)
        segments[0::2] = (-by * s * V / length**3)[:, None] * D
        np.add.at(volumes, self.chosen, by * s / length)
        activation = self._gathered(y_adj[0] * (s * V / length), x[0])
        return activation, self._gathered(by * V / length, x[1]), segments, volumes.reshape(x[3].shape)

    def _gathered(self, by_points, given):
        """Adjoint of what was spread, from that of points."""
        lead = by_points.shape[:-1]
        groups = given.size // int(np.prod(lead, dtype=int))
        if groups == 1:
            return by_points.sum(-1).reshape(given.shape)
        out = np.zeros((groups, *lead))
        np.add.at(out, self.group, np.moveaxis(by_points, -1, 0))
        return np.moveaxis(out, 0, -1).reshape(given.shape)
