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
from diffsim_ti.runtime import LANES, Bundle, let, traced

A = ti.template()  # an array or Bundle handed to a Taichi function


@traced
class Onwards(Bundle):
    """How a law's state goes on in a pass: its length h, and `moves`, whether time goes on, None where it always does."""

    def pick(self, moved, held):
        return moved if self.moves is None else let(ti.select(self.moves, moved, held))


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
    def state_of(self, item, z, s) -> list:
        """The law's state in slot s of z; none if it has no state."""
        S = len(self.law.state_names)
        return self.items.row(z, s, S, item) if S else []

    @traced
    def numbers_at(self, item, scene, at, s) -> list:
        """What the law takes besides tensors at slot s: its coefficients and its state."""
        p = self.coefficients_of(item, scene.coefficients)
        return [*p, *self.state_of(item, at.z, s)] if self.has_state else p

    @traced
    def volume_of(self, item, array):
        return self.items.numbers(array, 0, 1, 1, item)[0]

    # ---- corners ----------------------------------------------------------------------------------------------------

    @traced
    def store(self, item, corner, Q, add: bool = False) -> None:
        """Columns of Q are minus the forces of corners 1..3; corner 0 balances them. add: to what is there."""
        minus, zero = ti.cast(-1, self.fp), ti.cast(0, self.fp)
        forces = [[let(minus * Q[d, a]) for d in range(3)] for a in range(3)]
        balance = [let(sum_of(Q[d, a] for a in range(3))) for d in range(3)]
        self.items.store(corner, item, [balance, *forces], zero, add)

    @ti.func
    def gather(self, i, scene: A, corner: A):
        """Sum of the corners that meet at vertex i, in a fixed order."""
        f = self.types.vector(0)
        for c in range(scene.start[i], scene.start[i + 1]):
            f = f + corner[scene.corner_of[c]]
        return f

    # ---- forces and their derivatives --------------------------------------------------------------------------------
    # `at` has arrays of slots: displacements u and what the law reads besides, velocities v, its state z

    @property
    def reads_rates(self) -> bool:
        return "H_dot" in self.law.reads

    @property
    def has_state(self) -> bool:
        return bool(self.law.state_names)

    @traced
    def _edges_read(self, item, scene, at, s) -> list:
        """Edges of all whose gradients the law reads, at slot s."""
        return [self.edges(item, scene, x, s) for x in ((at.u, at.v) if self.reads_rates else (at.u,))]

    @traced
    def forces(self, item, scene, at, s, corner) -> None:
        """Corner forces at slot s."""
        B = self.gradients_of(item, scene.gradients)
        x = [D @ B for D in self._edges_read(item, scene, at, s)]
        P = self.law.stress_at(x, self.numbers_at(item, scene, at, s))
        self.store(item, corner, (P * self.volume_of(item, scene.volumes)) @ B.transpose())

    @traced
    def stiffness(self, item, scene, at, s, corner) -> None:
        """Corner products of the derivative of the elastic force with at.w (negative semi-definite at rest)."""
        B = self.gradients_of(item, scene.gradients)
        H, dH = self.edges(item, scene, at.u, s) @ B, self.edges(item, scene, at.w, 0) @ B
        dP = self.law.stress_differential(H, dH, self.numbers_at(item, scene, at, s))
        self.store(item, corner, (dP * self.volume_of(item, scene.volumes)) @ B.transpose())

    @traced
    def forces_jvp(self, item, scene, at, s, change, corner, dots) -> None:
        """Change of the corner forces for a change of what `at` has, in slot 0, and of coefficients and rest shape."""
        B, B_dot = self.gradients_of(item, scene.gradients), self.gradients_of(item, dots.gradients)
        volume, q = self.volume_of(item, scene.volumes), self.numbers_at(item, scene, at, s)
        D, dD = self._edges_read(item, scene, at, s), self._edges_read(item, scene, change, 0)
        x, dx = [d @ B for d in D], [moved @ B + d @ B_dot for d, moved in zip(D, dD)]
        P, dP = self.law.stress_and_jvp_at(x, dx, q, self._numbers_jvp(item, change, dots))
        turned = B * self.volume_of(item, dots.volumes) + B_dot * volume
        self.store(item, corner, (dP * volume) @ B.transpose() + P @ turned.transpose())

    @traced
    def _numbers_jvp(self, item, change, dots) -> list:
        dp = self.coefficients_of(item, dots.coefficients)
        return [*dp, *self.state_of(item, change.z, 0)] if self.has_state else dp

    @traced
    def forces_vjp(self, item, scene, at, s, w, corner, adjoint, shape: bool, add: bool = False) -> None:
        """Corner products with w of the transposed derivatives of the force by u, to `corner` (add: to what is there), and
        by v, to adjoint.rate_corner; adds the adjoints of coefficients and state and, if `shape`, of grad N and V.

        The work of the forces on w is -V P(D B) : (W B), with D, W the edges of u and w.
        """
        B, volume = self.gradients_of(item, scene.gradients), self.volume_of(item, scene.volumes)
        D, W = self._edges_read(item, scene, at, s), self.edges(item, scene, w, 0)
        x, dH, q = [d @ B for d in D], W @ B, self.numbers_at(item, scene, at, s)
        both = self.law.stress_and_vjp_at if shape else self.law.stress_vjp_at
        *P, by_x, products = both(x, dH, q)  # the stress itself is felt by the rest shape alone
        self.store(item, corner, (by_x[0] * volume) @ B.transpose(), add)
        if self.reads_rates:
            self.store(item, adjoint.rate_corner, (by_x[1] * volume) @ B.transpose())
        minus = let(ti.cast(-1, self.fp) * volume)
        by_p, by_z = self._parted([minus * product for product in products])
        self.items.add(adjoint.coefficients, len(by_p), item, by_p)
        if self.has_state:
            known = self.state_of(item, adjoint.z, 0)
            self.items.put_row(adjoint.z, 0, item, [a + b for a, b in zip(known, by_z)])
        if shape:
            (P,) = P
            by_B = sum_of([*(d.transpose() @ by for d, by in zip(D, by_x)), W.transpose() @ P])
            self.items.add(adjoint.gradients, 9, item, (by_B * minus).numbers)
            self.items.add(adjoint.volumes, 1, item, [ti.cast(-1, self.fp) * inner(P, dH)])

    @traced
    def _parted(self, numbers: list) -> tuple[list, list]:
        """(those of the coefficients, those of the state)"""
        K = len(self.law.coefficient_names)
        return numbers[:K], numbers[K:]

    # ---- the law's state after a pass --------------------------------------------------------------------------------

    @traced
    def _read_onwards(self, item, scene, at, s, u_slot) -> tuple:
        """(B, D, H, numbers of the law) for the state in slot s and the displacement in slot `u_slot`, default s."""
        B, D = self.gradients_of(item, scene.gradients), self.edges(item, scene, at.u, s if u_slot is None else u_slot)
        return B, D, D @ B, self.numbers_at(item, scene, at, s)

    @traced
    def move_on(self, item, scene, at, s, slot, onwards, u_slot=None) -> None:
        """Put the state after a pass into a slot."""
        _, _, H, q = self._read_onwards(item, scene, at, s, u_slot)
        after, held = self.law.next_state_at(H, q, onwards.h), self._parted(q)[1]
        self.items.put_row(at.z, slot, item, [onwards.pick(a, b) for a, b in zip(after, held)])

    @traced
    def move_on_jvp(self, item, scene, at, s, change, dots, onwards, u_slot=None) -> None:
        """Its change, in place of that of the state before."""
        B, D, H, q = self._read_onwards(item, scene, at, s, u_slot)
        dH = self.edges(item, scene, change.u, 0) @ B + D @ self.gradients_of(item, dots.gradients)
        dq = self._numbers_jvp(item, change, dots)
        after, held = self.law.next_state_jvp(H, dH, q, dq, onwards.h), self._parted(dq)[1]
        self.items.put_row(change.z, 0, item, [onwards.pick(a, b) for a, b in zip(after, held)])

    @traced
    def move_on_vjp(self, item, scene, at, s, onwards, corner, adjoint, shape: bool, u_slot=None) -> None:
        """From the adjoint of the state after a pass to that of the state before, in its place, and, in corners, to that of
        the displacement; adds those of coefficients and, if `shape`, of grad N."""
        B, D, H, q = self._read_onwards(item, scene, at, s, u_slot)
        later = self.state_of(item, adjoint.z, 0)
        zero = [let(0 * x) for x in later]
        by_H, by_q = self.law.next_state_vjp(H, q, onwards.h, [onwards.pick(x, o) for x, o in zip(later, zero)])
        by_p, by_z = self._parted(by_q)
        held = [onwards.pick(o, x) for x, o in zip(later, zero)]
        self.items.put_row(adjoint.z, 0, item, [a + b for a, b in zip(by_z, held)])
        self.items.add(adjoint.coefficients, len(by_p), item, by_p)
        self.store(item, corner, (by_H * ti.cast(-1, self.fp)) @ B.transpose())
        if shape:
            self.items.add(adjoint.gradients, 9, item, (D.transpose() @ by_H).numbers)
