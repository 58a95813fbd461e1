"""Kernels of a V-cycle over matrices of blocks, in float32: a thread for each row of blocks, no sum in an open order."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, Kernel, traced
from diffsim_ti.runtime import at as entry

A = ti.template()


def matrix_arrays(rows: int) -> dict:
    """Of a matrix of blocks with so many rows; entries of row i are start[i] .. start[i + 1] - 1; values: columns."""
    return dict(start="ints", column="ints", values=f"rows{rows}")


def level_arrays(numbers: int) -> dict:
    """Of a level with 3 or 6 numbers at a node: its matrix without the diagonal blocks, these, their damped inverses, and
    vectors: right-hand side, approximation, its last change, another one."""
    kind = f"rows{numbers}"
    return matrix_arrays(numbers) | dict.fromkeys(("diagonal", "inverse", "b", "x", "d", "y"), kind)


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
    """Between a level with `fine` numbers at a node and the next with `coarse` ones."""

    fine: int
    coarse: int
    parallel: bool

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
    def row(self, i, matrix: A, x: A, total, columns: A):
        """total + (row i of a matrix) x"""
        y = total
        for k in range(matrix.start[i], matrix.start[i + 1]):
            other = x[matrix.column[k]]
            y += self.block(matrix.values, k, other, columns)
        return y

    @ti.func
    def left(self, i, level: A, x: A, numbers: A):
        """(b - A x) of row i."""
        own = x[i]
        y = self.row(i, level, x, self.block(level.diagonal, i, own, numbers), numbers)
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
        left = self.left(i, level, x, self.fine)
        d = self.block(level.inverse, i, left, self.fine) * ti.cast(FACTORS[k][1], ti.f32)
        d += level.d[i] * ti.cast(FACTORS[k][0], ti.f32)
        level.d[i] = d
        target[i] = x[i] + d

    @ti.func
    def restrict(self, level: A, down: A, below: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.change(i, 0, level, level.x, level.y)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.change(i, 1, level, level.y, level.x)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            level.y[i] = self.left(i, level, level.x, self.fine)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.below):
            b = self.row(i, down, level.y, self.zero(self.coarse), self.fine)
            below.b[i] = b
            self.begin(i, below, b, self.zero(self.coarse), below.x, self.coarse)

    @cached_property
    def down(self) -> Kernel:
        """From the first x of a level to b and the first x of the next."""
        arrays = dict(level=level_arrays(self.fine), down=matrix_arrays(self.coarse), below=level_arrays(self.coarse))
        return Kernel("down", self.restrict, "f32", arrays, dict(nodes="int", below="int"))

    @ti.func
    def correct(self, level: A, up: A, below: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            level.y[i] = self.row(i, up, below.x, level.x[i], self.coarse)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.begin(i, level, self.left(i, level, level.y, self.fine), level.y[i], level.x, self.fine)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.change(i, 0, level, level.x, level.y)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            self.change(i, 1, level, level.y, level.x)

    @cached_property
    def up(self) -> Kernel:
        """From the last x of the next level to the last of this."""
        arrays = dict(level=level_arrays(self.fine), up=matrix_arrays(self.fine), below=level_arrays(self.coarse))
        return Kernel("up", self.correct, "f32", arrays, dict(nodes="int"))


@dataclass(frozen=True)
class LevelKernels:
    """Within a level with so many numbers at a node; precision: of vectors outside the cycle."""

    numbers: int
    precision: str
    parallel: bool

    @cached_property
    def between(self) -> CycleKernels:
        return CycleKernels(self.numbers, self.numbers, self.parallel)

    @ti.func
    def multiply(self, level: A, inverse: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            level.x[i] = self.between.row(i, inverse, level.b, self.between.zero(self.numbers), self.numbers)

    @cached_property
    def solve(self) -> Kernel:
        """x = A^-1 b by the inverse, a matrix of blocks."""
        arrays = dict(level=level_arrays(self.numbers), inverse=matrix_arrays(self.numbers))
        return Kernel("solve", self.multiply, "f32", arrays, dict(nodes="int"))

    @ti.func
    def turn_back(self, at: A, level: A, frames: A, plan: A):
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

    @cached_property
    def enter(self) -> Kernel:
        """b = scale Q^T r, Q: `turned`, and the first x of the finest level."""
        arrays = dict(at=dict(r="vectors2"), level=level_arrays(3), frames=dict(turned="rows3"))
        return Kernel("enter", self.turn_back, self.precision, arrays, dict(nodes="int", scale="float"))

    @ti.func
    def turn_forth(self, at: A, level: A, frames: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            own = level.x[i]
            turned = self.between.block(frames.turned, i, own, 3)
            y = self.between.block(frames.allowed, i, turned, 3)
            for j in ti.static(range(3)):
                at.z[0, i][j] = ti.cast(y[j], PRECISIONS[self.precision]) * plan.scale

    @cached_property
    def leave(self) -> Kernel:
        """z = scale P Q y, P: what vertices may do."""
        arrays = dict(at=dict(z="vectors2"), level=level_arrays(3), frames=dict(turned="rows3", allowed="rows3"))
        return Kernel("leave", self.turn_forth, self.precision, arrays, dict(nodes="int", scale="float"))
