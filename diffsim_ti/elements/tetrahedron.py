"""The linear tetrahedron: what each one adds to forces, to their differential and to the adjoint.

H = sum_a (u_a - u_0) (x) grad N_a, a = 1..3, is the displacement gradient; corner forces f_a = -V P grad N_a go to
`corner[4 e + a]`, and vertices gather them, so that there are no atomics and every run gives the same bits.

Functions take one item, a block of eight tetrahedra or a single one (items.py). The last block is filled up with copies of
tetrahedron 0, whose corners no vertex gathers. `scene` is a Bundle of tets, gradients, volumes, coefficients, start,
corner_of.
"""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.elements.items import Block, Single
from diffsim_ti.materials.calculus.tensor import Tensor, inner, sum_of
from diffsim_ti.materials.law import Law
from diffsim_ti.runtime import LANES, let, traced

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class Tetrahedron:
    """Functions of one item for a law; `uniform`: one set of coefficients serves all; `lanes`: items are blocks."""

    law: Law
    uniform: bool
    lanes: bool

    @property
    def fp(self):
        return self.law.fp

    @cached_property
    def items(self):
        """How items are read and written."""
        return (Block if self.lanes else Single)(self.fp)

    @cached_property
    def types(self) -> SimpleNamespace:
        """Types of kernels' arguments."""
        vector = self.items.vector
        return SimpleNamespace(
            fp=self.fp,
            vector=vector,
            blocks=ti.types.ndarray(ti.types.vector(LANES, self.fp), 1),
            scalars=ti.types.ndarray(self.fp, 1),
            scalars2=ti.types.ndarray(self.fp, 2),
            vectors=ti.types.ndarray(vector, 1),
            vectors2=ti.types.ndarray(vector, 2),
            ints=ti.types.ndarray(ti.i32, 1),
        )

    # what kernels that write numbers of their own need of the items
    numbers = property(lambda self: self.items.numbers)
    put = property(lambda self: self.items.put)
    store_corners = property(lambda self: self.items.store)
    broadcast = property(lambda self: self.items.broadcast)

    # ---- what an item has -------------------------------------------------------------------------------------------

    @traced
    def edges(self, item, scene, u, s) -> Tensor:
        """Columns u_a - u_0 of slot s."""
        x = self.items.corners(u, s, scene.tets, item)
        return Tensor(x[a][d] - x[0][d] for d in range(3) for a in (1, 2, 3))

    @traced
    def gradients_of(self, item, array) -> Tensor:
        """Rows grad N_1..3."""
        return Tensor(self.items.numbers(array, 0, 9, 9, item))

    @traced
    def coefficients_of(self, item, array) -> list:
        """The law's coefficients (the first block holds them for all if they are uniform)."""
        K = len(self.law.coefficient_names)
        return self.items.numbers(array, 0, K, K, 0 if self.uniform else item)

    @traced
    def coefficients_at(self, item, scene, u, s) -> list:
        """What the law takes at slot s of the displacement."""
        return self.coefficients_of(item, scene.coefficients)

    @traced
    def volume_of(self, item, array):
        return self.items.numbers(array, 0, 1, 1, item)[0]

    # ---- corners ----------------------------------------------------------------------------------------------------

    @traced
    def store(self, item, corner, Q) -> None:
        """Columns of Q are minus the forces of corners 1..3; corner 0 balances them."""
        minus, zero = ti.cast(-1, self.fp), ti.cast(0, self.fp)
        forces = [[let(minus * Q[d, a]) for d in range(3)] for a in range(3)]
        balance = [let(sum_of(Q[d, a] for a in range(3))) for d in range(3)]
        self.items.store(corner, item, [balance, *forces], zero)

    @ti.func
    def gather(self, i, scene: A, corner: A):
        """Sum of the corners that meet at vertex i, in a fixed order."""
        f = self.types.vector(0)
        for c in range(scene.start[i], scene.start[i + 1]):
            f = f + corner[scene.corner_of[c]]
        return f

    # ---- forces and their derivatives. v: velocities, for laws that read their gradient ------------------------------

    @property
    def reads_rates(self) -> bool:
        return "H_dot" in self.law.reads

    @traced
    def _edges_read(self, item, scene, u, v, s) -> list:
        """Edges of all whose gradients the law reads, at slot s."""
        return [self.edges(item, scene, x, s) for x in ((u, v) if self.reads_rates else (u,))]

    @traced
    def forces(self, item, scene, u, s, corner, v=None) -> None:
        """Corner forces at slot s."""
        B = self.gradients_of(item, scene.gradients)
        x = [D @ B for D in self._edges_read(item, scene, u, v, s)]
        P = self.law.stress_at(x, self.coefficients_of(item, scene.coefficients))
        self.store(item, corner, (P * self.volume_of(item, scene.volumes)) @ B.transpose())

    @traced
    def stiffness(self, item, scene, u, s, w, corner) -> None:
        """Corner products of the derivative of the elastic force with w (negative semi-definite at rest)."""
        B = self.gradients_of(item, scene.gradients)
        H, dH = self.edges(item, scene, u, s) @ B, self.edges(item, scene, w, 0) @ B
        dP = self.law.stress_differential(H, dH, self.coefficients_of(item, scene.coefficients))
        self.store(item, corner, (dP * self.volume_of(item, scene.volumes)) @ B.transpose())

    @traced
    def forces_jvp(self, item, scene, u, s, du, corner, dots, v=None, dv=None) -> None:
        """Change of the corner forces for changes of displacements, velocities, coefficients and rest shape."""
        B, B_dot = self.gradients_of(item, scene.gradients), self.gradients_of(item, dots.gradients)
        volume, p = self.volume_of(item, scene.volumes), self.coefficients_of(item, scene.coefficients)
        D, dD = self._edges_read(item, scene, u, v, s), self._edges_read(item, scene, du, dv, 0)
        x, dx = [d @ B for d in D], [change @ B + d @ B_dot for d, change in zip(D, dD)]
        dP = self.law.stress_jvp_at(x, dx, p, self.coefficients_of(item, dots.coefficients))
        change = B * self.volume_of(item, dots.volumes) + B_dot * volume
        self.store(item, corner, (dP * volume) @ B.transpose() + self.law.stress_at(x, p) @ change.transpose())

    @traced
    def forces_vjp(self, item, scene, u, s, w, corner, adjoint, v=None, rate_corner=None) -> None:
        """Corner products with w of the transposed derivatives of the force, by u to `corner`, by v to `rate_corner`;
        adds the adjoint of the coefficients.

        The work of the forces on w is -V P : W, with W the displacement gradient of w.
        """
        B, volume = self.gradients_of(item, scene.gradients), self.volume_of(item, scene.volumes)
        p = self.coefficients_of(item, scene.coefficients)
        x, W = [D @ B for D in self._edges_read(item, scene, u, v, s)], self.edges(item, scene, w, 0) @ B
        by_x, products = self.law.stress_vjp_at(x, W, p)
        for by, target in zip(by_x, (corner, rate_corner)):
            self.store(item, target, (by * volume) @ B.transpose())
        minus = let(ti.cast(-1, self.fp) * volume)
        self.items.add(adjoint.coefficients, len(p), item, [minus * product for product in products])

    @traced
    def shape_vjp(self, item, scene, u, s, w, adjoint, v=None) -> None:
        """Adds the adjoints of grad N and V: the work is -V P(D B) : (W B)."""
        B, volume = self.gradients_of(item, scene.gradients), self.volume_of(item, scene.volumes)
        p = self.coefficients_of(item, scene.coefficients)
        D, W = self._edges_read(item, scene, u, v, s), self.edges(item, scene, w, 0)
        x, dH = [d @ B for d in D], W @ B
        P, (by_x, _), minus = self.law.stress_at(x, p), self.law.stress_vjp_at(x, dH, p), ti.cast(-1, self.fp)
        by_B = sum_of([*(d.transpose() @ by for d, by in zip(D, by_x)), W.transpose() @ P])
        self.items.add(adjoint.gradients, 9, item, (by_B * let(minus * volume)).numbers)
        self.items.add(adjoint.volumes, 1, item, [minus * inner(P, dH)])
