"""Links of loads, growth, chambers and muscles: from numbers over time, areas and volumes to what kernels read.

What is given over time comes as values at the beginning and at the end of each step, shape (2, rows, ...), between which a
load goes linearly. One row serves all steps.
"""

from collections.abc import Sequence

import numpy as np

from diffsim_ti.differentiation.arrays import summed_at
from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.mesh.enclosure import Enclosure
from diffsim_ti.mesh.face_points import face_points


class InTime(Recording, Link):
    """At the beginning and at the end of each step, shape (2, rows, ...), of an array that is the same all the time or, with
    a leading axis of `ndim` in all, given for each step; `keyed`: for each step's ends instead, linear between."""

    def __init__(self, reads: str, writes: str, ndim: int, keyed: bool):
        self.reads, self.writes, self.ndim, self.keyed = (reads,), (writes,), ndim, keyed

    def value(self, x):
        if self.keyed:
            return (np.stack([x[:-1], x[1:]] if len(x) > 1 else [x, x]),)
        rows = x[None] if x.ndim < self.ndim else x
        return (np.stack([rows, rows]),)


class VertexAreas(Recording, Link):
    """Of rest positions the area [m^2] of each of some vertices, the integral of its shape function over the given faces
    around it, which is what a constant traction on these asks for: a third of triangles; of flat faces of six nodes a
    third at mid-edge vertices and nothing at corners."""

    reads = ("rest",)

    def __init__(self, faces: np.ndarray, vertices: np.ndarray, writes: str):
        self.points, self.writes = face_points(faces), (writes,)
        self.nodes, self.count = np.searchsorted(vertices, faces), len(vertices)

    def value(self, X):
        n = self.points.normals(X)
        return (summed_at(self.nodes, self.points.to_nodes(np.sqrt((n * n).sum(1))), self.count),)


class VertexShares(Recording, Link):
    """What each of some vertices has of the volume [m^3] or, with density, of the mass [kg] of the given tetrahedra around
    it: a fourth of each, or the shares of lumped masses of ten nodes; times factors of the vertices where there are some."""

    def __init__(
        self, mesh, chosen: np.ndarray | slice, vertices: np.ndarray, of_mass: bool, writes: str, factors=None
    ):
        volumes = "volumes" if mesh.order == 1 else "element volumes"
        self.reads, self.writes = (volumes, "density") if of_mass else (volumes,), (writes,)
        self.chosen, self.count, self.shares = chosen, len(vertices), mesh.reference.lumped
        self.nodes, self.factors = np.searchsorted(vertices, mesh.elements[chosen]), factors

    def value(self, volumes, *density):
        of_each = (density[0] * volumes if density else volumes)[self.chosen]
        out = summed_at(self.nodes, of_each[:, None] @ self.shares[None], self.count)
        return (out if self.factors is None else self.factors * out,)


class ConsistentShares(Recording, Link):
    """What `VertexShares` says by integrals of the shape functions of ten nodes, of volumes or of masses."""

    def __init__(self, mesh, chosen: np.ndarray, vertices: np.ndarray, of_mass: bool, writes: str):
        self.reads, self.writes = ("element_masses",) if of_mass else ("element_masses", "density"), (writes,)
        self.chosen, self.count, self.nodes = chosen, len(vertices), np.searchsorted(vertices, mesh.elements[chosen])

    def value(self, masses, *density):
        of_each = masses / np.reshape(density[0], (-1, 1, 1)) if density else masses
        return (summed_at(self.nodes, of_each[self.chosen].sum(2), self.count),)


class Spread(Recording, Link):
    """Forces of vertices, weight times vector, from vectors of shape (2, rows, 3) and one weight for each vertex."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    def value(self, vectors, weights):
        return (vectors[:, :, None] * weights[:, None],)


def rows_of(x: Sequence[np.ndarray]) -> int:
    """The steps that loads in time, each of shape (2, rows, ...), are given for; those of one row hold in all steps."""
    return min((part.shape[1] for part in x if part.shape[1] > 1), default=1)


class SumOfForces(Recording, Link):
    """Forces [N] of all dead loads, shape (rows, k, 3) for the k vertices that any of them acts on; with `keyed`, where some
    change within steps, (rows, 2 k, 3): at the beginning of each step in even columns, at its end in odd ones."""

    def __init__(self, reads: Sequence[str], vertices: Sequence[np.ndarray], keyed: bool, writes: str):
        self.reads, self.writes = tuple(reads), (writes,)
        self.vertices = np.unique(np.concatenate(vertices))
        self.columns, self.keyed = [np.searchsorted(self.vertices, own) for own in vertices], keyed

    def value(self, *x):
        rows, k = rows_of(x), len(self.vertices)
        out = np.zeros((k, 2, rows, 3))
        for columns, part in zip(self.columns, x):
            out = out + summed_at(columns, np.moveaxis(part[:, :rows], 2, 0), k)
        return (np.moveaxis(out, 2, 0).reshape(rows, 2 * k, 3) if self.keyed else np.moveaxis(out[:, 0], 1, 0).copy(),)


class PressureRows(Recording, Link):
    """Pressures [Pa] of all loads, then numbers of chambers, shape (rows, k, 3): as each step begins, as it ends, zero."""

    def __init__(self, reads: Sequence[str], writes: str):
        self.reads, self.writes = tuple(reads), (writes,)

    def value(self, *x):
        rows = rows_of(x)
        parts = [np.broadcast_to(part[:, :rows], (2, rows)).T for part in x]
        return (np.stack([np.concatenate([part, np.zeros((rows, 1))], 1) for part in parts], 1),)


class RemoteForces(Recording, Link):
    """f_i = a_i (F / A + omega x r_i),    J omega = M + (p - c) x F,    J = sum a_i (|r_i|^2 - r_i r_i^T),

    shape (2, rows, k, 3), of (F, M) over time, (2, rows, 6), rest positions and areas a_i of k vertices, A = sum a_i, r_i
    from their centre c. p: the point; None: c.
    """

    def __init__(self, load: str, areas: str, vertices: np.ndarray, point: np.ndarray | None, writes: str):
        self.reads, self.writes = (load, "rest", areas), (writes,)
        self.vertices, self.point = vertices, point

    def value(self, load, X, a):
        F, M = load[..., :3], load[..., 3:]
        A, x = a.sum(), X[self.vertices]
        c = a @ x / A
        r, arm = x - c, np.zeros(3) if self.point is None else self.point - c
        J = (a * (r**2).sum(1)).sum() * np.eye(3) - (r.T * a) @ r
        omega = np.linalg.solve(J, (M + np.cross(arm, F))[..., None])[..., 0]
        return (a[:, None] * (F[..., None, :] / A + np.cross(omega[..., None, :], r)),)


class GrowthRows(Recording, Link):
    """Sum of all growths in time, shape (rows, 2, m): as each step begins and ends, of each tetrahedron, or m = 1 where all
    grow alike. Each part has shape (2, rows) or (2, rows, groups); chosen: its tetrahedra, None for all; group: which
    number each of these has."""

    writes = ("growths",)

    def __init__(self, reads: Sequence[str], chosen: Sequence, group: Sequence, num_tetrahedra: int):
        self.reads, self.chosen, self.group = tuple(reads), chosen, group
        self.count = 1 if all(own is None for own in chosen) else num_tetrahedra

    def value(self, *x):
        rows = rows_of(x)
        out = np.zeros((self.count, rows, 2))
        for part, chosen, group in zip(x, self.chosen, self.group):
            chosen = np.arange(self.count) if chosen is None else chosen
            by_time = np.swapaxes(part[:, :rows], 0, 1)
            spread = by_time[None] if part.ndim == 2 else np.moveaxis(by_time[..., group], 2, 0)
            out = out + summed_at(chosen, np.broadcast_to(spread, (len(chosen), *spread.shape[1:])), self.count)
        return (np.moveaxis(out, 0, 2).copy(),)


class RestVolume(Recording, Link):
    """Of rest positions the volume [m^3] of a chamber."""

    reads = ("rest",)

    def __init__(self, enclosure: Enclosure, writes: str):
        self.enclosure, self.writes = enclosure, (writes,)

    def value(self, X):
        return (self.enclosure.recorded(X),)


class MuscleTension(Recording, Link):
    """T = alpha s V / L0 [N] in time, shape (2, rows, points): alpha: activations in time as `InTime` has them, of all
    together or of each group; s: stress [Pa], a number or one for each group; V: volume of each of the points `chosen` among
    those of all tetrahedra; L0: length at rest of the segment there; group: that of each point."""

    def __init__(self, activation: str, stress: str, segments: str, chosen, group, writes: str):
        self.reads, self.writes = (activation, stress, segments, "volumes"), (writes,)
        self.chosen, self.group = chosen, group

    def _spread(self, of_groups):
        """To points, along the last axis."""
        return of_groups[..., self.group] if of_groups.shape[-1] > 1 else of_groups

    def value(self, activation, stress, segments, volumes):
        alpha, D = self._spread(activation.reshape(*activation.shape[:2], -1)), segments[0::2]
        s, V = self._spread(stress.reshape(-1)), volumes.ravel()[self.chosen]
        return (alpha * (s * V / np.sqrt((D * D).sum(1))),)
