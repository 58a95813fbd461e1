"""Links of a body, its mass and start, and what joins the numbers of terms and the paths of obstacles."""

from collections.abc import Callable, Sequence

import numpy as np

from diffsim_ti.differentiation.arrays import linear, summed_at
from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.inputs.loads import VertexShares


class FreeVelocity(Recording, Link):
    """Velocities without what is held of them: free(v), a projection."""

    reads, writes = ("initial_velocities",), ("velocity",)

    def __init__(self, free: Callable):
        self.free = free

    def value(self, v):
        return (linear(v, self.free, self.free),)

    def vjp(self, x, y_adj):
        return (self.free(y_adj[0]),)


class LumpedMass(VertexShares):
    """Of each vertex, sum rho V s_a over its elements, with the node's share s_a, 1/4 of four nodes; rho is one number or
    one per tetrahedron; times the vertex's factor where there are some."""

    def __init__(self, mesh, factors: np.ndarray | None = None):
        super().__init__(mesh, slice(None), np.arange(mesh.num_vertices), True, "mass", factors)


class Same(Recording, Link):
    """y = x, an input that kernels read as it is."""

    def __init__(self, reads: str, writes: str):
        self.reads, self.writes = (reads,), (writes,)

    def value(self, x):
        return (x,)


class PerStep(Recording, Link):
    """What holds during each step, as a list: what is given for all steps is a list of one."""

    def __init__(self, reads: str, writes: str, ndim: int):
        self.reads, self.writes, self.ndim = (reads,), (writes,), ndim  # ndim: of the list

    def value(self, x):
        return (x[None] if x.ndim < self.ndim else x,)


class NearestPoint(Recording, Link):
    """The point of a plane that is nearest to o, of any of its points p and a normal n of any length:

    q = o + s n,    s = n . (p - o) / n . n
    """

    def __init__(self, point: str, normal: str, writes: str, near: np.ndarray):
        self.reads, self.writes, self.near = (point, normal), (writes,), near

    def value(self, p, n):
        return (self.near + n * (n @ (p - self.near)) / (n @ n),)


class Joined(Recording, Link):
    """The numbers of several inputs in one row, or, with the `tail` of their shapes, rows of such a shape."""

    def __init__(self, reads: Sequence[str], writes: str, tail: tuple = ()):
        self.reads, self.writes, self.tail = tuple(reads), (writes,), tail

    def value(self, *x):
        return (np.concatenate([part.reshape(-1, *self.tail) for part in x]),)


class Placed(Recording, Link):
    """All numbers of some arrays, those of each in its range of one list, zero elsewhere, less those of `shift`."""

    def __init__(self, places: dict[str, slice], writes: str, shift: np.ndarray):
        self.reads, self.writes, self.shift = tuple(places), (writes,), shift
        ranges = [np.arange(place.start, place.stop) for place in places.values()]
        self.places = np.concatenate([np.zeros(0, int), *ranges])

    def value(self, *x):
        numbers = np.concatenate([np.zeros(0), *(part.ravel() for part in x)])
        return (summed_at(self.places, numbers, len(self.shift)) - self.shift,)
