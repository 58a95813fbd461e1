"""The tetrahedron of four or ten nodes: what each one adds to forces, to their differential and to the adjoint.

At each point, H = D B is the displacement gradient, D = du/dxi (nodes.py) and B = dxi/dX, whose rows are grad xi_k; V is
the point's share of the volume. Forces are minus the derivatives of sum V psi(H); that of node a goes to
`corner[nodes e + a]`, and vertices gather them, so that there are no atomics and every run gives the same bits.

Functions take one item, a block of eight tetrahedra or a single one (items.py). The last block is filled up with copies of
tetrahedron 0, whose corners no vertex gathers. `scene` is a Bundle of tets, gradients, volumes, coefficients, start,
corner_of.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.materials.calculus.tensor import Tensor, inner, sum_of
from diffsim_ti.materials.law import Law
from diffsim_ti.mechanics.stress.items import Block, Single
from diffsim_ti.mechanics.stress.nodes import Nodes, nodes_of
from diffsim_ti.runtime import A, Bundle, assign, let, traced, variable
from diffsim_ti.runtime import at as entry
from diffsim_ti.state.pass_table import kicks


@traced
class Onwards(Bundle):
    """How a law's state goes on in a pass: its length h, and `moves`, whether time goes on, None where it always does."""

    def pick(self, moved, held):
        return moved if self.moves is None else let(ti.select(self.moves, moved, held))


@ti.func
def _each_point(job: A, count: ti.template()):
    for q in range(count):
        for k in ti.static(range(count)):
            if q == k:
                _take(job, k)
        _find(job, q)
        for k in ti.static(range(count)):
            if q == k:
                _put(job, k)


@traced
def _take(job, k: int) -> None:
    for now, one in zip(job.now, job.lists):
        for target, number in zip(now, one[k].numbers):
            assign(target, number)


@traced
def _find(job, q) -> None:
    tensors, numbers = job.body(q, *(Tensor(one) for one in job.now))
    job.found = [one.numbers for one in tensors]
    for total, number in zip(job.sums, numbers):
        assign(total, total + number)


@traced
def _put(job, k: int) -> None:
    for points, numbers in zip(job.out, job.found):
        for target, number in zip(points[k], numbers):
            assign(target, number)


@dataclass(frozen=True)
class Tetrahedron:
    """Functions of one item for a law; `uniform`: one set of coefficients serves all; `lanes`: items are blocks; `order`: 1
    or 2, of the functions between nodes."""

    law: Law
    uniform: bool
    lanes: bool
    order: int = 1
    growth: tuple | None = None  # (whether each step, whether all tetrahedra alike) where they grow over time
    by_points: bool = False  # whether each point has coefficients of its own

    @property
    def fp(self):
        return self.law.fp

    @cached_property
    def items(self):
        """How items are read and written."""
        return (Block if self.lanes else Single)(self.fp, self.nodes.count)

    @cached_property
    def nodes(self) -> Nodes:
        """How nodes make gradients."""
        return nodes_of(self.order, self.fp)

    @property
    def points(self) -> range:
        """Where the law is evaluated."""
        return range(self.nodes.points)

    @property
    def is_short(self) -> bool:
        return self.law.short

    # ---- what an item has -------------------------------------------------------------------------------------------

    @traced
    def edges(self, item, scene, x, s) -> list[Tensor]:
        """dx/dxi at each point, of slot s."""
        return self.nodes.edges(self.items.corners(x, s, scene.tets, item))

    @traced
    def each_point(self, lists: list, body, tensors: int = 1, sums: int = 0) -> tuple[list, list]:
        """For each point body(q, *its Tensor of each list), which gives (`tensors` Tensors, `sums` numbers): (a list of
        Tensors at the points for each of these, sums over the points).

        A loop, where points are several and the law is long: code of each point takes four times as much memory, and
        sixteen times as long to compile.
        """
        if self.order == 1 or self.is_short:
            found = [body(q, *(one[q] for one in lists)) for q in self.points]
            return list(zip(*(of for of, _ in found))), [let(sum_of(x)) for x in zip(*(of for _, of in found))]
        lists = [[Tensor(x.numbers) for x in one] for one in lists]  # none that is found in the loop alone
        zero, count = let(0 * lists[0][0][0, 0]), len(self.points)
        job = Bundle(
            lists=lists,
            body=body,
            now=[[variable(x) for x in one[0].numbers] for one in lists],
            out=[[[variable(zero) for _ in range(9)] for _ in range(count)] for _ in range(tensors)],
            sums=[variable(zero) for _ in range(sums)],
        )
        _each_point(job, count)
        return [[Tensor(x) for x in one] for one in job.out], [let(x) for x in job.sums]

    @traced
    def each_seen(self, item, scene, at, s, body) -> None:
        """body(q, H, what the law takes besides) at each point, for kernels that look at a state."""

        def of(q, D):
            body(q, D @ self.gradients_of(item, scene.gradients, q), self.numbers_at(item, scene, at, s, q))
            return (), ()

        self.each_point([self.edges(item, scene, at.u, s)], of, tensors=0)

    @traced
    def gradients_of(self, item, array, q: int = 0) -> Tensor:
        """Rows grad xi_1..3 at point q."""
        return Tensor(self.items.numbers(array, 9 * q, 9, 9 * self.nodes.points, item))

    @traced
    def coefficients_of(self, item, array, q: int = 0) -> list:
        """The law's coefficients at point q (the first block holds them for all if they are uniform)."""
        K = len(self.law.coefficient_names)
        if self.by_points:
            return self.items.numbers(array, K * q, K, K * self.nodes.points, item)
        return self.items.numbers(array, 0, K, K, 0 if self.uniform else item)

    @traced
    def add_coefficients(self, item, adjoint, q, by_p: list) -> None:
        """Add the adjoint of those at point q."""
        K, points = len(by_p), self.nodes.points
        if self.by_points:
            self.items.add(adjoint.coefficients, K * points, item, by_p, K * q)
        else:
            self.items.add(adjoint.coefficients, K, item, by_p)

    @traced
    def state_of(self, item, z, s, q: int = 0) -> list:
        """The law's state at point q in slot s of z; none if it has no state."""
        S = len(self.law.state_names)
        return self.items.row(z, s, S * q, S, S * self.nodes.points, item) if S else []

    @traced
    def put_state(self, item, z, s, numbers, q: int = 0) -> None:
        self.items.put_row(z, s, len(numbers) * q, len(numbers) * self.nodes.points, item, numbers)

    @traced
    def numbers_at(self, item, scene, at, s, q: int = 0) -> list:
        """What the law takes besides tensors at point q and slot s: its coefficients, its state, and what is held in an
        implicit pass."""
        p = self.grown(item, self.coefficients_of(item, scene.coefficients, q), scene)
        p = [*p, *self.state_of(item, at.z, s, q)] if self.has_state else p
        return [*p, *self.frozen_of(item, at.held, q), self.rate_of(at)] if self.holds(at) else p

    def holds(self, at) -> bool:
        """Whether what the law holds in a pass is there."""
        return bool(self.law.frozen_names) and hasattr(at, "held")

    @traced
    def frozen_of(self, item, held, q: int = 0) -> list:
        """What is held in a pass at point q."""
        n = len(self.law.frozen_names)
        return self.items.row(held, 0, n * q, n, n * self.nodes.points, item)

    @traced
    def rate_of(self, at):
        """Changes in a pass times this are rates [1/s]."""
        return self.items.broadcast(let(entry(at.rate, 0)))

    @traced
    def volume_of(self, item, array, q: int = 0):
        """That of point q."""
        return self.items.numbers(array, q, 1, self.nodes.points, item)[0]

    # ---- corners ----------------------------------------------------------------------------------------------------

    @traced
    def store(self, item, corner, pushes, add: bool = False) -> None:
        """Forces of what works on minus dx/dxi, a Tensor for each point. add: to what is there."""
        self.items.store(corner, item, self.nodes.forces(pushes), ti.cast(0, self.fp), add)

    @ti.func
    def gather(self, i, scene: A, corner: A):
        """Sum of the corners that meet at vertex i, in a fixed order."""
        f = self.items.vector(0)
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
        """Edges of all whose gradients the law reads, at slot s: a list for each."""
        return [self.edges(item, scene, x, s) for x in ((at.u, at.v) if self.reads_rates else (at.u,))]

    @traced
    def forces(self, item, scene, at, s, corner) -> None:
        """Corner forces at slot s."""

        def push(q, *D):
            B = self.gradients_of(item, scene.gradients, q)
            P = self.law.stress_at([d @ B for d in D], self.numbers_at(item, scene, at, s, q))
            return [(P * self.volume_of(item, scene.volumes, q)) @ B.transpose()], ()

        self.store(item, corner, self.each_point(self._edges_read(item, scene, at, s), push)[0][0])

    @traced
    def stiffness(self, item, scene, at, s, corner) -> None:
        """Corner products of the derivative of the elastic force with at.w (negative semi-definite at rest), and of a
        viscous one, times a rate."""

        def push(q, D, W):
            B = self.gradients_of(item, scene.gradients, q)
            H, dH, numbers = D @ B, W @ B, self.numbers_at(item, scene, at, s, q)
            dP = self.law.stress_differential(H, dH, numbers)
            if self.law.viscous and not self.holds(at):
                dP = dP + self.law.viscous_differential(H, dH, numbers) * self.rate_of(at)
            return [(dP * self.volume_of(item, scene.volumes, q)) @ B.transpose()], ()

        edges = [self.edges(item, scene, at.u, s), self.edges(item, scene, at.w, 0)]
        self.store(item, corner, self.each_point(edges, push)[0][0])

    @traced
    def forces_jvp(self, item, scene, at, s, change, corner, dots) -> None:
        """Change of the corner forces for a change of what `at` has, in slot 0, and of coefficients and rest shape."""

        def push(q, *edges):
            D, moving = edges[: len(edges) // 2], edges[len(edges) // 2 :]
            B, B_dot = self.gradients_of(item, scene.gradients, q), self.gradients_of(item, dots.gradients, q)
            volume, numbers = self.volume_of(item, scene.volumes, q), self.numbers_at(item, scene, at, s, q)
            x, dx = [d @ B for d in D], [moved @ B + d @ B_dot for d, moved in zip(D, moving)]
            P, dP = self.law.stress_and_jvp_at(x, dx, numbers, self._numbers_jvp(item, change, dots, q))
            turned = B * self.volume_of(item, dots.volumes, q) + B_dot * volume
            return [(dP * volume) @ B.transpose() + P @ turned.transpose()], ()

        edges = [*self._edges_read(item, scene, at, s), *self._edges_read(item, scene, change, 0)]
        self.store(item, corner, self.each_point(edges, push)[0][0])

    @traced
    def _numbers_jvp(self, item, change, dots, q) -> list:
        dp = self.grown(item, self.coefficients_of(item, dots.coefficients, q), dots)
        dp = [*dp, *self.state_of(item, change.z, 0, q)] if self.has_state else dp
        return [*dp, *self.frozen_of(item, change.held, q), let(0 * dp[0])] if self.holds(change) else dp

    @traced
    def forces_vjp(self, item, scene, at, s, w, corner, adjoint, shape: bool, add: bool = False) -> None:
        """Corner products with w of the transposed derivatives of the force by u, to `corner` (add: to what is there), and
        by v, to adjoint.rate_corner; adds the adjoints of coefficients and state and, if `shape`, of B and V.

        The work of the forces on w is -sum V P(D B) : (W B), with D, W the edges of u and w.
        """

        def push(q, *edges):
            *D, W = edges
            B, volume = self.gradients_of(item, scene.gradients, q), self.volume_of(item, scene.volumes, q)
            x, dH, numbers = [d @ B for d in D], W @ B, self.numbers_at(item, scene, at, s, q)
            both = self.law.stress_and_vjp_at if shape else self.law.stress_vjp_at
            *P, by_x, products = both(x, dH, numbers)  # only the rest shape's adjoint reads the stress itself
            pushes = [(by * volume) @ B.transpose() for by in by_x]
            minus = let(ti.cast(-1, self.fp) * volume)
            own, by_z = self._parted([minus * product for product in products])
            if self.holds(at):
                *by_held, _ = by_z[len(self.law.state_names) :]
                by_z = by_z[: len(self.law.state_names)]
                self.items.put_row(adjoint.held, 0, len(by_held) * q, len(by_held) * self.nodes.points, item, by_held)
            if self.has_state:
                known = self.state_of(item, adjoint.z, 0, q)
                self.put_state(item, adjoint.z, 0, [a + b for a, b in zip(known, by_z)], q)
            if shape:
                (P,) = P
                by_B = sum_of([*(d.transpose() @ by for d, by in zip(D, by_x)), W.transpose() @ P])
                self.add_shape(item, adjoint, q, by_B * minus, ti.cast(-1, self.fp) * inner(P, dH))
            if self.by_points:
                self.add_coefficients(item, adjoint, q, own)
            return pushes, own

        edges = [*self._edges_read(item, scene, at, s), self.edges(item, scene, w, 0)]
        count = len(self.law.coefficient_names)
        (pushes, *rates), by_p = self.each_point(edges, push, len(self.law.reads), count)
        self.store(item, corner, pushes, add)
        for rate in rates:
            self.store(item, adjoint.rate_corner, rate)
        if not self.by_points:
            self.add_coefficients(item, adjoint, 0, by_p)
        self.add_growth(item, adjoint, by_p, scene)

    @traced
    def add_shape(self, item, adjoint, q, by_B: Tensor, by_V=None) -> None:
        """Add adjoints of B and V of point q."""
        points = self.nodes.points
        self.items.add(adjoint.gradients, 9 * points, item, by_B.numbers, 9 * q)
        if by_V is not None:
            self.items.add(adjoint.volumes, points, item, [by_V], q)

    @traced
    def _parted(self, numbers: list) -> tuple[list, list]:
        """(those of the coefficients, those of the state)"""
        K = len(self.law.coefficient_names)
        return numbers[:K], numbers[K:]

    # ---- the law's state after a pass --------------------------------------------------------------------------------

    @traced
    def _edges_onwards(self, item, scene, at, s, u_slot) -> list[Tensor]:
        """Edges of the displacement in slot `u_slot` (None: s)."""
        return self.edges(item, scene, at.u, s if u_slot is None else u_slot)

    @traced
    def move_on(self, item, scene, at, s, slot, onwards, u_slot=None) -> None:
        """Put the state after a pass into a slot."""

        def move(q, D):
            H, numbers = D @ self.gradients_of(item, scene.gradients, q), self.numbers_at(item, scene, at, s, q)
            after, held = self.law.next_state_at(H, numbers, onwards.h), self._parted(numbers)[1]
            self.put_state(item, at.z, slot, [onwards.pick(a, b) for a, b in zip(after, held)], q)
            return (), ()

        self.each_point([self._edges_onwards(item, scene, at, s, u_slot)], move, tensors=0)

    @traced
    def move_on_jvp(self, item, scene, at, s, change, dots, onwards, u_slot=None) -> None:
        """Its change, in place of that of the state before."""

        def move(q, D, moved):
            B, numbers = self.gradients_of(item, scene.gradients, q), self.numbers_at(item, scene, at, s, q)
            dH = moved @ B + D @ self.gradients_of(item, dots.gradients, q)
            dq = self._numbers_jvp(item, change, dots, q)
            after, held = self.law.next_state_jvp(D @ B, dH, numbers, dq, onwards.h), self._parted(dq)[1]
            self.put_state(item, change.z, 0, [onwards.pick(a, b) for a, b in zip(after, held)], q)
            return (), ()

        edges = [self._edges_onwards(item, scene, at, s, u_slot), self.edges(item, scene, change.u, 0)]
        self.each_point(edges, move, tensors=0)

    @traced
    def move_on_vjp(self, item, scene, at, s, onwards, corner, adjoint, shape: bool, u_slot=None) -> None:
        """From the adjoint of the state after a pass to that of the state before, in its place, and, in corners, to that of
        the displacement; adds those of coefficients and, if `shape`, of B."""

        def move(q, D):
            B, numbers = self.gradients_of(item, scene.gradients, q), self.numbers_at(item, scene, at, s, q)
            later = self.state_of(item, adjoint.z, 0, q)
            zero = [let(0 * x) for x in later]
            by_H, by_q = self.law.next_state_vjp(
                D @ B, numbers, onwards.h, [onwards.pick(x, o) for x, o in zip(later, zero)]
            )
            by_p, by_z = self._parted(by_q)
            held = [onwards.pick(o, x) for x, o in zip(later, zero)]
            self.put_state(item, adjoint.z, 0, [a + b for a, b in zip(by_z, held)], q)
            self.add_coefficients(item, adjoint, q, by_p)
            self.add_growth(item, adjoint, by_p, scene)
            if shape:
                self.add_shape(item, adjoint, q, D.transpose() @ by_H)
            return [(by_H * ti.cast(-1, self.fp)) @ B.transpose()], ()

        self.store(item, corner, self.each_point([self._edges_onwards(item, scene, at, s, u_slot)], move)[0][0])

    # ---- growth over time: its value at the beginning and at the end of each step, of which a pass takes the mean over its
    # kicks; where no pass is told (`scene.now`), the first row holds, as at the end of its step

    @property
    def growth_at(self) -> int:
        """Place of growth among the law's coefficients."""
        return self.law.coefficient_names.index("growth")

    @traced
    def _growth_weights(self, of) -> list:
        """(row, weight of its beginning, of its end) for each part."""
        one = ti.cast(1, self.fp)
        if not hasattr(of, "now"):
            return [(0, let(one - one), let(one))]
        parts = kicks(of.now, self.growth[0], self.fp)
        return [(row, let(weight * (one - share)), let(weight * share)) for row, share, weight in parts]

    @traced
    def grown(self, item, p: list, of) -> list:
        """Coefficients p with the growths of a Bundle, at its pass; one of scenes in lanes has none."""
        if self.growth is None:
            return p
        total = p[self.growth_at]
        for row, begin, end in self._growth_weights(of):
            first, last = self.items.row(of.growths, row, 0, 2, 2, 0 if self.growth[1] else item)
            total = total + first * begin + last * end
        return [let(total) if k == self.growth_at else x for k, x in enumerate(p)]

    @traced
    def add_growth(self, item, adjoint, by_p: list, of) -> None:
        """Add the adjoint of growth, that of its coefficient."""
        if self.growth is None:
            return
        by = by_p[self.growth_at]
        for row, *weights in self._growth_weights(of):
            known = self.items.row(adjoint.growths, row, 0, 2, 2, item)
            self.items.put_row(adjoint.growths, row, 0, 2, item, [a + by * w for a, w in zip(known, weights)])
