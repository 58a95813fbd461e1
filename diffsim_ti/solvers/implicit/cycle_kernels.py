"""Kernels of a V-cycle over matrices of blocks, in float32: a thread for each row of blocks, no sum in an open order."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, A, Kernel, as_kernel, traced
from diffsim_ti.runtime import at as entry


def matrix_arrays(rows: int) -> dict:
    """Of a matrix of blocks with so many rows; entries of row i are start[i] .. start[i + 1] - 1; values: columns."""
    return dict(start="ints", column="ints", values=f"rows{rows}")


def level_arrays(numbers: int, threads: int = 1, coupled: bool = False) -> dict:
    """Of a level with 3 or 6 numbers at a node: its matrix without the diagonal blocks, these, their damped inverses, and
    vectors: right-hand side, approximation, its last change, another one; parts of rows where several threads share one;
    another matrix, of surfaces in contact, that joins that of a `coupled` level."""
    kind, more = f"rows{numbers}", ("part",) if threads > 1 else ()
    contact = {f"contact_{name}": of for name, of in matrix_arrays(numbers).items()} if coupled else {}
    return matrix_arrays(numbers) | contact | dict.fromkeys(("diagonal", "inverse", "b", "x", "d", "y", *more), kind)


def chebyshev(terms: int, share: float) -> tuple[float, list[tuple[float, float]]]:
    """(theta over the largest eigenvalue, factors of (last change, D^-1 (b - A x) / theta) in each change but the first)
    of the polynomial that is least on [share, 1] of the spectrum.
    Saad 2003, Iterative Methods for Sparse Linear Systems, alg. 12.1.
    """
    sigma, rho, factors = (1 + share) / (1 - share), (1 - share) / (1 + share), []
    for _ in range(terms - 1):
        rho, before = 1 / (2 * sigma - rho), rho
        factors.append((rho * before, 2 * rho * sigma))
    return 0.5 * (1 + share), factors


THETA, FACTORS = chebyshev(3, 0.1)  # measured: with one or two terms as fast in statics, a quarter slower in steps


@dataclass(frozen=True)
class CycleKernels:
    """Between a level with `fine` numbers at a node and the next with `coarse` ones. So many threads share a row of the
    level's matrix, and of the one down to the next (`threads_of`). coupled: whether contact of surfaces joins the level."""

    fine: int
    coarse: int
    parallel: bool
    threads: int = 1
    threads_down: int = 1
    coupled: bool = False

    @ti.func
    def zero(self, numbers: A):
        return ti.Vector([0.0] * (4 if numbers == 3 else 8), ti.f32)

    @traced
    def block(self, values, k, x, columns):
        """(block k) x"""
        y = entry(values, columns * k) * entry(x, 0)
        for j in range(1, columns):
            y = y + entry(values, columns * k + j) * entry(x, j)
        return y

    @ti.func
    def share(self, shares, matrix: A, x: A, of: A, numbers: A, columns: A, threads: A):
        """of.part: what each of several threads makes of its share of a row's entries, for `row`; shares: of all rows, a
        number of the launch, for a GPU takes one task more for a bound that is computed."""
        if ti.static(threads > 1):
            ti.loop_config(serialize=not self.parallel)
            for t in range(shares):
                i, y = t // threads, self.zero(numbers)
                k, end = matrix.start[i] + t % threads, matrix.start[i + 1]
                while k < end:
                    other = x[matrix.column[k]]
                    y += self.block(matrix.values, k, other, columns)
                    k += threads
                of.part[t] = y

    @ti.func
    def row(self, i, matrix: A, x: A, of: A, total, columns: A, threads: A):
        """total + (row i of a matrix) x; what several threads share, `share` has left in of.part."""
        y = total
        if ti.static(threads > 1):
            for t in ti.static(range(threads)):
                y += of.part[threads * i + t]
        else:
            for k in range(matrix.start[i], matrix.start[i + 1]):
                other = x[matrix.column[k]]
                y += self.block(matrix.values, k, other, columns)
        return y

    @ti.func
    def share_level(self, level: A, x: A, plan: A):
        self.share(plan.shares, level, x, level, self.fine, self.fine, self.threads)

    @ti.func
    def left(self, i, level: A, x: A):
        """(b - A x) of row i, after `share_level`."""
        own = x[i]
        y = self.row(i, level, x, level, self.block(level.diagonal, i, own, self.fine), self.fine, self.threads)
        if ti.static(self.coupled):
            for k in range(level.contact_start[i], level.contact_start[i + 1]):
                other = x[level.contact_column[k]]
                y += self.block(level.contact_values, k, other, self.fine)
        return level.b[i] + y * ti.cast(-1, ti.f32)

    @ti.func
    def begin(self, i, level: A, b, x, target: A, numbers: A):
        """target = x + D^-1 b / theta, the first change."""
        d = self.block(level.inverse, i, b, numbers)
        level.d[i] = d
        target[i] = x + d

    @ti.func
    def change(self, i, k: A, level: A, x: A, target: A):
        """target = x + change k, which is not the first."""
        left = self.left(i, level, x)
        d = self.block(level.inverse, i, left, self.fine) * ti.cast(FACTORS[k][1], ti.f32)
        d += level.d[i] * ti.cast(FACTORS[k][0], ti.f32)
        level.d[i] = d
        target[i] = x[i] + d

    @ti.func
    def changes(self, level: A, plan: A):
        """The two changes of x that are not the first."""
        self.share_level(level, level.x, plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.change(i, 0, level, level.x, level.y)
        self.share_level(level, level.y, plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.change(i, 1, level, level.y, level.x)

    def _kernel(self, name: str, body, arrays: dict, *numbers: str) -> Kernel:
        arrays = dict(level=level_arrays(self.fine, self.threads, self.coupled)) | arrays
        return Kernel(name, body, "f32", arrays, dict.fromkeys(numbers, "int"))

    @as_kernel(
        "down",
        lambda self: dict(down=matrix_arrays(self.coarse), below=level_arrays(self.coarse, self.threads_down)),
        *("nodes", "below", "shares", "shares_below"),
    )
    def down(self, level: A, down: A, below: A, plan: A):
        """From the first x of a level to b and the first x of the next."""
        self.changes(level, plan)
        self.share_level(level, level.x, plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            level.y[i] = self.left(i, level, level.x)
        self.share(plan.shares_below, down, level.y, below, self.coarse, self.fine, self.threads_down)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.below):
            b = self.row(i, down, level.y, below, self.zero(self.coarse), self.fine, self.threads_down)
            below.b[i] = b
            self.begin(i, below, b, self.zero(self.coarse), below.x, self.coarse)

    @as_kernel("up", lambda self: dict(up=matrix_arrays(self.fine), below=level_arrays(self.coarse)), "nodes", "shares")
    def up(self, level: A, up: A, below: A, plan: A):
        """From the last x of the next level to the last of this."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            level.y[i] = self.row(i, up, below.x, level, level.x[i], self.coarse, 1)
        self.share_level(level, level.y, plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.begin(i, level, self.left(i, level, level.y), level.y[i], level.x, self.fine)
        self.changes(level, plan)


@dataclass(frozen=True)
class LevelKernels:
    """Within a level with so many numbers at a node; precision: of vectors outside the cycle; so many threads share a row of
    its inverse."""

    numbers: int
    precision: str
    parallel: bool
    threads: int = 1

    @cached_property
    def between(self) -> CycleKernels:
        return CycleKernels(self.numbers, self.numbers, self.parallel)

    def _kernel(self, name: str, body, numbers: dict, **arrays) -> Kernel:
        return Kernel(name, body, self.precision, arrays, dict(nodes="int") | numbers)

    @as_kernel(
        "solve",
        dict(shares="int"),
        level=lambda self: level_arrays(self.numbers, self.threads),
        inverse=lambda self: matrix_arrays(self.numbers),
    )
    def solve(self, level: A, inverse: A, plan: A):
        """x = A^-1 b by the inverse, a matrix of blocks."""
        self.between.share(plan.shares, inverse, level.b, level, self.numbers, self.numbers, self.threads)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            zero = self.between.zero(self.numbers)
            level.x[i] = self.between.row(i, inverse, level.b, level, zero, self.numbers, self.threads)

    @as_kernel("enter", dict(scale="float"), at=dict(r="vectors2"), level=level_arrays(3), frames=dict(turned="rows3"))
    def enter(self, at: A, level: A, frames: A, plan: A):
        """b = scale Q^T r, Q: `turned`, and the first x of the finest level."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            r = self.between.zero(3)
            for j in ti.static(range(3)):
                r[j] = ti.cast(at.r[0, i][j] * plan.scale, ti.f32)
            b = self.between.zero(3)
            for j in ti.static(range(3)):
                b[j] = frames.turned[3 * i + j].dot(r)
            level.b[i] = b
            self.between.begin(i, level, b, self.between.zero(3), level.x, 3)

    @as_kernel(
        "leave",
        dict(scale="float"),
        at=dict(z="vectors2"),
        level=level_arrays(3),
        frames=dict(turned="rows3", allowed="rows3"),
    )
    def leave(self, at: A, level: A, frames: A, plan: A):
        """z = scale P Q y, P: what vertices may do."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            own = level.x[i]
            turned = self.between.block(frames.turned, i, own, 3)
            y = self.between.block(frames.allowed, i, turned, 3)
            for j in ti.static(range(3)):
                at.z[0, i][j] = ti.cast(y[j], PRECISIONS[self.precision]) * plan.scale
