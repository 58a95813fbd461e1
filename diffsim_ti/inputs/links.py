"""Links of a body, its rest shape, mass and start, and what joins the numbers of terms and the paths of obstacles."""

from collections.abc import Callable

import numpy as np

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh import geometry


class RestShape(Link):
    """Of rest positions X: X itself, rows grad N_1..3 = D^-1 and volumes V = det D / 6, D the edges from corner 0.

    dD^-1 = -D^-1 dD D^-1 and dV = V tr(D^-1 dD). Raises ValueError for a tetrahedron that is turned inside out.
    """

    reads, writes = ("rest_positions",), ("rest", "gradients", "volumes")

    def __init__(self, tetrahedra: np.ndarray):
        self.tetrahedra = tetrahedra
        self._last = None  # X, D^-1, V: derivatives need what the value was made of

    def value(self, X):
        return X, *self._inverse(X)

    def _inverse(self, X):
        """(D^-1, V)"""
        if self._last is not None and self._last[0] is X:
            return self._last[1:]
        D = geometry.edge_matrices(X, self.tetrahedra)
        volumes = np.linalg.det(D) / 6
        if not np.all(volumes > 0):
            worst = int(np.argmin(volumes))
            raise ValueError(
                f"rest_positions turn tetrahedron {worst} inside out (volume {volumes[worst]:.3g} m^3, "
                f"{(~(volumes > 0)).sum()} in all); take a smaller step in the rest shape"
            )
        out = np.linalg.inv(D), volumes
        self._last = None if X.flags.writeable else (X, *out)
        return out

    def jvp(self, x, dx):
        B, V = self._inverse(*x)
        dD = geometry.edge_matrices(dx[0], self.tetrahedra)
        return dx[0], -B @ dD @ B, V * np.einsum("eij,eji->e", B, dD)

    def vjp(self, x, y_adj):
        B, V = self._inverse(*x)
        rest_adj, gradients_adj, volumes_adj = y_adj
        Bt = np.swapaxes(B, 1, 2)
        D_adj = -Bt @ gradients_adj @ Bt + (V * volumes_adj)[:, None, None] * Bt
        by_edge = np.swapaxes(D_adj, 1, 2)  # one row per edge, the derivative by X_a - X_0
        X_adj = np.array(rest_adj)
        np.add.at(X_adj, self.tetrahedra[:, 1:].ravel(), by_edge.reshape(-1, 3))
        np.add.at(X_adj, self.tetrahedra[:, 0], -by_edge.sum(1))
        return (X_adj,)


class Displacement(Link):
    """u = of(x - X), `of` being a symmetric projection onto what the scene can do."""

    reads, writes = ("initial_positions", "rest"), ("displacement",)

    def __init__(self, of: Callable):
        self.of = of

    def value(self, x, X):
        return (self.of(x - X),)

    def jvp(self, x, dx):
        return (self.of(dx[0] - dx[1]),)

    def vjp(self, x, y_adj):
        u_adj = self.of(y_adj[0])
        return u_adj, -u_adj


class FreeVelocity(Link):
    """Velocities without what is held of them: free(v), a projection."""

    reads, writes = ("initial_velocities",), ("velocity",)

    def __init__(self, free: Callable):
        self.free = free

    def value(self, v):
        return (self.free(v),)

    def jvp(self, x, dx):
        return self.value(dx[0])

    def vjp(self, x, y_adj):
        return self.value(y_adj[0])


class LumpedMass(Link):
    """Of each vertex, sum rho V s_a over its elements, with the node's share s_a, 1/4 of four nodes; rho is one number or
    one per tetrahedron; times the vertex's factor where there are some."""

    writes = ("mass",)

    def __init__(self, mesh, factors: np.ndarray | None = None):
        self.factors = factors
        self.elements, self.num_vertices, self.shares = mesh.elements, mesh.num_vertices, mesh.reference.lumped
        self.reads = ("density", "volumes" if mesh.order == 1 else "element volumes")

    def value(self, density, volumes):
        return (self._to_vertices(density * volumes),)

    def jvp(self, x, dx):
        (density, volumes), (d_density, d_volumes) = x, dx
        return (self._to_vertices(d_density * volumes + density * d_volumes),)

    def vjp(self, x, y_adj):
        by_mass = y_adj[0] if self.factors is None else self.factors * y_adj[0]
        (density, volumes), mass_adj = x, (by_mass[self.elements] * self.shares).sum(1)
        by_density = volumes * mass_adj
        return by_density if density.ndim else by_density.sum(), density * mass_adj

    def _to_vertices(self, per_element: np.ndarray) -> np.ndarray:
        mass = np.bincount(self.elements.ravel(), np.outer(per_element, self.shares).ravel(), self.num_vertices)
        return mass if self.factors is None else self.factors * mass


class Same(Link):
    """y = x, an input that kernels read as it is."""

    def __init__(self, reads: str, writes: str):
        self.reads, self.writes = (reads,), (writes,)

    def value(self, x):
        return (x,)

    def jvp(self, x, dx):
        return (np.array(dx[0]),)

    def vjp(self, x, y_adj):
        return y_adj


class PerStep(Link):
    """What holds during each step, as a list: what is given for all steps is a list of one."""

    def __init__(self, reads: str, writes: str, ndim: int):
        self.reads, self.writes, self.ndim = (reads,), (writes,), ndim  # ndim: of the list

    def value(self, x):
        return (x[None] if x.ndim < self.ndim else x,)

    def jvp(self, x, dx):
        return self.value(np.array(dx[0]))

    def vjp(self, x, y_adj):
        return (y_adj[0][0] if x[0].ndim < self.ndim else y_adj[0],)


class NearestPoint(Link):
    """The point of a plane that is nearest to o, of any of its points p and a normal n of any length:

    q = o + s n,    s = n . (p - o) / n . n
    """

    def __init__(self, point: str, normal: str, writes: str, near: np.ndarray):
        self.reads, self.writes, self.near = (point, normal), (writes,), near

    def value(self, p, n):
        return (self.near + n * (n @ (p - self.near)) / (n @ n),)

    def jvp(self, x, dx):
        (p, n), (dp, dn) = x, dx
        s = n @ (p - self.near) / (n @ n)
        return (s * dn + n * (dn @ (p - self.near) + n @ dp - 2 * s * (n @ dn)) / (n @ n),)

    def vjp(self, x, y_adj):
        (p, n), (q_adj,) = x, y_adj
        s, along = n @ (p - self.near) / (n @ n), (q_adj @ n) / (n @ n)
        return along * n, s * q_adj + along * (p - self.near - 2 * s * n)


class Placed(Link):
    """All numbers of some arrays, those of each in its range of one list, zero elsewhere, less those of `shift`."""

    def __init__(self, places: dict[str, slice], writes: str, shift: np.ndarray):
        self.reads, self.places, self.writes, self.shift = tuple(places), tuple(places.values()), (writes,), shift

    def value(self, *x):
        return (self.jvp(x, x)[0] - self.shift,)

    def jvp(self, x, dx):
        out = np.zeros(len(self.shift))
        for place, part in zip(self.places, dx):
            out[place] = part.ravel()
        return (out,)

    def vjp(self, x, y_adj):
        return [y_adj[0][place].reshape(part.shape) for place, part in zip(self.places, x)]
