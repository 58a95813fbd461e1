"""Forces in float64 on the host: what implicit steps, statics and outputs take of each kind of force.

An `Interaction` (interaction.py) gives its `HostForce` by `host`. Implicit steps, their tangents and adjoints,
preconditioners and outputs loop over these and know none of them by name.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation.arrays import Recorded, forward, reverse
from diffsim_ti.inputs import Derived, DerivedNode
from diffsim_ti.state.schedule import EqualSteps, Schedule


@dataclass(frozen=True)
class Instant:
    """When in a run forces are taken: at a `share` of the step of pass j of a schedule; by default as the run begins.

    load: share of the loads that statics have applied; laid: share of what pass j applies that is there (load_stepping.py).
    origin, gamma: velocities are (u - origin) / gamma; without an origin they are zero.
    """

    schedule: Schedule = EqualSteps(1.0, 1)
    j: int = 0
    share: float = 0.0
    load: float = 1.0
    laid: float = 1.0
    origin: np.ndarray | None = None
    gamma: float = np.inf


class HostForce:
    """Forces of one kind at displacements u [m], with all derivatives; vectors of vertices have the shape (num_vertices, 3).

    A new force writes `forces`, whose derivatives are found by arrays that record (differentiation/arrays.py) unless `jvp`
    and `vjp` stand beside it. It must then read numbers and the rest shape from `values`, which `take` does not convert, and
    velocities by `velocities(u)`. One that has an energy E, so that f = -dE/du, also writes `energies` and, where E is
    stored in the body, `stored`, which balances of energy read. All else has defaults that are right for every force, and
    may be written where it can be had faster or helps linear solvers.

    has_energy: whether it has an energy, which line searches and preconditioners then know. Without one, line searches ask
        for `work`. symmetric: whether df/du is in what may move; else linear systems are solved by GMRES.
    reads_velocities: whether forces depend on velocities.
    """

    has_energy = symmetric = reads_velocities = False

    def restrict(self, free: np.ndarray, rest: np.ndarray) -> None:
        """A run says what vertices may do, projectors of shape (num_vertices, 3, 3), and the rest shape [m]."""

    def take(self, values: Derived, instant: Instant) -> "HostForce":
        """Take the numbers of an instant; all that follows is at these."""
        self.values, self.instant = values, instant
        return self

    def stiffest(self, values: Derived, schedule: Schedule) -> "HostForce":
        """The same with what asks for the shortest explicit steps of all that is in `values`."""
        return self.take(values, Instant(schedule))

    def velocities(self, u: np.ndarray) -> np.ndarray:
        """[m/s]"""
        return np.zeros_like(u) if self.instant.origin is None else (u - self.instant.origin) / self.instant.gamma

    # ---- what a new force writes -------------------------------------------------------------------------------------

    def forces(self, u: np.ndarray) -> np.ndarray:
        """On vertices [N]."""
        raise NotImplementedError

    def energies(self, u: np.ndarray) -> np.ndarray:
        """[J], in as many parts as it likes; of forces that have one."""
        raise NotImplementedError

    # ---- what it may write -------------------------------------------------------------------------------------------

    def recorded(self, u: np.ndarray, numbers: bool, what: str = "forces") -> tuple:
        """(its forces, or another function of displacements; displacements, velocities and, where its numbers are to record,
        what kernels read), all of which record."""
        at, v, own = Recorded(u), Recorded(self.velocities(u)), copy(self)
        of = [DerivedNode(self.values)] if numbers else []
        for values in of:
            own.take(values, self.instant)
        own.velocities = lambda _: v
        return getattr(own, what)(at), at, v, *of

    def jvp(self, u: np.ndarray, du: np.ndarray, dv: np.ndarray | None = None, moved=None, what="forces") -> np.ndarray:
        """Change of the forces, or of another function, for changes of displacements, velocities and, if `moved` tells
        them, of numbers."""
        y, *leaves = self.recorded(u, moved is not None, what)
        return forward(y, zip(leaves, (du, dv, moved)))

    def vjp(self, u: np.ndarray, w: np.ndarray, adj: Derived | None = None, what="forces") -> tuple:
        """Adjoints (of displacements, of velocities) for the adjoint w of the forces; adds those of numbers to `adj`. That
        of velocities is 0 where forces do not read them."""
        y, *leaves = self.recorded(u, adj is not None, what)
        if adj is not None:
            leaves[2].zeros = lambda: adj
        by_u, by_v, *_ = reverse(y, w, leaves)
        return np.zeros(u.shape) if by_u is None else by_u, 0.0 if by_v is None else by_v

    def stored(self, u: np.ndarray) -> dict[str, float]:
        """Energies [J] of the body by name: all that it has, by the name of its class."""
        return {type(self).__name__: float(self.energies(u).sum())} if self.has_energy else {}

    def loads(self, u: np.ndarray) -> np.ndarray:
        """Those of its forces that are loads [N], whose work comes from outside."""
        return np.zeros(u.shape) if self.has_energy else self.forces(u)

    def load_energy(self, u: np.ndarray) -> float:
        """Energy [J] of loads that pull steadily, which may be counted as the body's own."""
        return 0.0

    def sizes(self, u: np.ndarray) -> np.ndarray:
        """Sum of the sizes of the forces that meet at each vertex [N], of which solvers take their tolerance."""
        return np.linalg.norm(self.forces(u), axis=1)

    def product(self, u: np.ndarray, w: np.ndarray, convex: bool = False) -> np.ndarray:
        """-df/du w [N], velocities changing with u; convex: without what has negative curvature."""
        return -self.tangent(u)(w)

    def tangent(self, u: np.ndarray, transposed: bool = False) -> Callable:
        """w -> df/du w, for many w; velocities change with u."""
        gamma = self.instant.gamma
        push, pull = (lambda w: self.jvp(u, w, w / gamma)), lambda w: self.vjp(u, w)
        if type(self).vjp is HostForce.vjp:
            y, *leaves = self.recorded(u, False)
            push = lambda w: forward(y, zip(leaves, (w, w / gamma)))  # noqa: E731
            pull = lambda w: (0.0 if by is None else by for by in reverse(y, w, leaves))  # noqa: E731

        def pulled(w):
            by_u, by_v = pull(w)
            return by_u + by_v / gamma

        return pulled if transposed else push

    def blocks(self, u: np.ndarray) -> np.ndarray:
        """3x3 diagonal blocks of -df/du [N/m], for preconditioners."""
        return np.zeros((len(u), 3, 3))

    def matrix(self, u: np.ndarray):
        """-df/du [N/m] as a SciPy sparse matrix of all unknowns, rows 3 i + d; None where it is not known."""

    def work(self, u: np.ndarray, step: np.ndarray) -> float:
        """Work along a straight step [J]: Simpson's rule."""
        middle = 4 * self.forces(u + 0.5 * step)
        return float(((self.forces(u) + middle + self.forces(u + step)) * step).sum()) / 6

    def row_sums(self, u: np.ndarray) -> np.ndarray:
        """A bound of the sums of |df/du| over the block row of each vertex [N/m]: forces with an energy bound the stable
        step by it."""
        return np.zeros(len(u))

    def resisted(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What it resists at rest, as sums over vertices, (number of each sum, vertex, vector): statics ask whether rigid
        motions are left."""
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))

    def turning(self, u: np.ndarray, w: np.ndarray) -> float:
        """How much w changes what df/du depends on at most, against its size, for differences of it; 0 if it is constant."""
        return float(np.abs(w).max(initial=0.0) / np.ptp(self.values.rest))


class VertexwiseHostForce(HostForce):
    """Of vertices of its own, each by its own displacement; `own_blocks` says -df/du."""

    has_energy = symmetric = True
    vertices: np.ndarray

    def own_blocks(self, u: np.ndarray) -> np.ndarray:
        """-df/du of its vertices [N/m], shape (k, 3, 3)."""
        raise NotImplementedError

    def blocks(self, u):
        out = super().blocks(u)
        out[self.vertices] += self.own_blocks(u)
        return out

    def product(self, u, w, convex=False):
        out = np.zeros_like(w)
        out[self.vertices] += np.einsum("kij,kj->ki", self.own_blocks(u), w[self.vertices])
        return out

    def matrix(self, u):
        from scipy.sparse import bsr_matrix

        n = len(u)
        return bsr_matrix((self.blocks(u), np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n)).tocsr()

    def row_sums(self, u):
        return np.abs(self.blocks(u)).sum(2).max(1)

    def resisted(self):
        values, vectors = np.linalg.eigh(self.own_blocks(np.zeros_like(self.values.rest)))
        held = values > 1e-9 * values.max(initial=0.0)
        which, axis = np.nonzero(held)
        return np.arange(len(which)), self.vertices[which], vectors[which, :, axis]


class HostForces(tuple):
    """Several of them as one."""

    @property
    def with_energy(self) -> "HostForces":
        return HostForces(part for part in self if part.has_energy)

    @property
    def without_energy(self) -> "HostForces":
        return HostForces(part for part in self if not part.has_energy)

    @property
    def symmetric(self) -> bool:
        return all(part.symmetric for part in self)

    def only(self, kind: type):
        """The one of a class, or None."""
        return next((part for part in self if isinstance(part, kind)), None)

    def restrict(self, free: np.ndarray, rest: np.ndarray) -> None:
        for part in self:
            part.restrict(free, rest)

    def take(self, values: Derived, instant: Instant = Instant()) -> "HostForces":
        for part in self:
            part.take(values, instant)
        return self

    def stiffest(self, values: Derived, schedule: Schedule) -> "HostForces":
        for part in self:
            part.stiffest(values, schedule)
        return self

    def forces(self, u: np.ndarray) -> np.ndarray:
        return sum((part.forces(u) for part in self), np.zeros(u.shape))

    def sizes(self, u: np.ndarray) -> np.ndarray:
        return sum((part.sizes(u) for part in self), np.zeros(len(u)))

    def energies(self, u: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros(0), *(part.energies(u) for part in self)])

    def stored(self, u: np.ndarray) -> dict[str, float]:
        return {name: energy for part in self for name, energy in part.stored(u).items()}

    def load_energy(self, u: np.ndarray) -> float:
        return sum(part.load_energy(u) for part in self)

    def product(self, u: np.ndarray, w: np.ndarray, convex: bool = False) -> np.ndarray:
        return sum((part.product(u, w, convex) for part in self), np.zeros(w.shape))

    def tangent(self, u: np.ndarray, transposed: bool = False) -> Callable:
        parts = [part.tangent(u, transposed) for part in self]
        return lambda w: sum((part(w) for part in parts), np.zeros(w.shape))

    def blocks(self, u: np.ndarray) -> np.ndarray:
        return sum((part.blocks(u) for part in self), np.zeros((len(u), 3, 3)))

    def matrices(self, u: np.ndarray) -> list[tuple]:
        """(matrix, its diagonal blocks) of each that knows it."""
        known = ((part, part.matrix(u)) for part in self)
        return [(matrix, part.blocks(u)) for part, matrix in known if matrix is not None]

    def work(self, u: np.ndarray, step: np.ndarray) -> float:
        return sum(part.work(u, step) for part in self)

    def jvp(self, u: np.ndarray, du: np.ndarray, dv: np.ndarray, moved: Derived | None = None) -> np.ndarray:
        return sum((part.jvp(u, du, dv, moved) for part in self), np.zeros(u.shape))

    def vjp(self, u: np.ndarray, w: np.ndarray, adj: Derived | None = None) -> tuple:
        found = [part.vjp(u, w, adj) for part in self]
        return sum((by_u for by_u, _ in found), np.zeros(u.shape)), sum((by_v for _, by_v in found), np.zeros(u.shape))

    def largest_omega2(self, mass: np.ndarray, u: np.ndarray, fixed: np.ndarray) -> float:
        """A bound of the largest eigenvalue of M^-1 K [1/s^2] on the free vertices, by sums of rows."""
        rows = sum((part.row_sums(u) for part in self), np.zeros(len(u)))
        free = np.setdiff1d(np.nonzero(mass > 0)[0], fixed)
        return float((rows[free] / mass[free]).max(initial=0.0))

    def turning(self, u: np.ndarray, w: np.ndarray) -> float:
        return max((part.turning(u, w) for part in self), default=0.0) or 1.0


NONE = HostForces()
