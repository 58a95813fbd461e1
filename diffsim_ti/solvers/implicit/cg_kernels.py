"""Kernels of conjugate gradients. Sums go over fixed chunks, then over these: the same bits with any number of threads."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, Kernel

A = ti.template()
# places of numbers in `state`; STOPPED: 0 while it goes on, then 1 converged, 2 negative curvature, 3 r . z <= 0
RZ, BETA, ALPHA, SQUARE, STOPPED, COUNT, LEAST, LIMIT = range(8)
NUMBERS, ROOM = 8, 56  # of these; of those behind them, which are Newton's method's (newton_kernels.py), too


@dataclass(frozen=True)
class CGKernels:
    """scene: precision of the products; vectors: that of all else; guided: whether vertices are fixed in some directions
    only; more: whether a matrix of blocks joins the potential's Hessian."""

    scene: str
    vectors: str
    parallel: bool
    guided: bool
    more: bool

    @property
    def fp(self):
        return PRECISIONS[self.vectors]

    @ti.func
    def dot(self, a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    @ti.func
    def add_up(self, part: A, rows: A, chunks):
        """part[k, 0] = the sum of what chunks have left in each of so many rows k."""
        for c in range(1, chunks):
            for k in ti.static(range(rows)):
                part[k, 0] = part[k, 0] + part[k, c]

    @ti.func
    def to(self, fp: A, v):
        """A vector in another precision, number by number: Taichi has no vector code for this."""
        return ti.Vector([ti.cast(v[0], fp), ti.cast(v[1], fp), ti.cast(v[2], fp), ti.cast(0, fp)])

    @ti.func
    def is_wanted(self, cg: A, plan: A):
        return cg.state[STOPPED] == 0

    @cached_property
    def wanted(self) -> Kernel:
        """Whether the solve goes on, for `Repeated`."""
        return Kernel("wanted", self.is_wanted, self.vectors, dict(cg=dict(state="scalars")), {})

    @ti.func
    def divide(self, cg: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            cg.z[0, i] = self.block(cg.inverse, i, cg.r[0, i])

    @cached_property
    def scale(self) -> Kernel:
        """z = D^-1 r; inverse: the columns of each block of D^-1."""
        arrays = dict(cg=dict.fromkeys(("r", "z", "inverse"), "vectors2"))
        return Kernel("scale", self.divide, self.vectors, arrays, dict(nodes="int"))

    @ti.func
    def inverses(self, cg: A, body: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            if cg.free[i] > 0:
                D = ti.Matrix.zero(self.fp, 3, 3)
                for j, k in ti.static(ti.ndrange(3, 3)):
                    D[j, k] = ti.cast(out.blocks[j, i][k] + out.blocks[k, i][j], self.fp) * ti.cast(0.5, self.fp)
                least = D - ti.Matrix.identity(self.fp, 3) * (body.least[i] - body.mass[i])
                minor = least[0, 0] * least[1, 1] - least[0, 1] * least[1, 0]
                body.hard[i] = 1
                if least[0, 0] > 0 and minor > 0 and least.determinant() > 0:
                    body.hard[i] = 0
                inverse = (D + ti.Matrix.identity(self.fp, 3) * body.mass[i]).inverse()
                for j in ti.static(range(3)):
                    cg.inverse[j, i] = ti.Vector([inverse[0, j], inverse[1, j], inverse[2, j], 0], self.fp)

    @cached_property
    def invert(self) -> Kernel:
        """D^-1 of each block of a stiffness with inertia; hard: whether it is less than `least`."""
        arrays = dict(
            cg=dict(free="scalars", inverse="vectors2"), body=dict(hard="ints", mass="scalars", least="scalars")
        )
        arrays |= dict(out=dict(blocks=f"vectors2_{self.scene}"))
        return Kernel("invert", self.inverses, self.vectors, arrays, dict(nodes="int"))

    @ti.func
    def first(self, cg: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            rz = ti.cast(0, self.fp)
            for i in range(c * plan.length, ti.min((c + 1) * plan.length, plan.nodes)):
                rz += self.dot(cg.r[0, i], cg.z[0, i])
            cg.part[0, c] = rz
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.add_up(cg.part, 1, plan.chunks)
            rz, old = cg.part[0, 0], cg.state[RZ]
            if cg.state[STOPPED] == 0 and not rz > 0:
                cg.state[STOPPED] = ti.cast(3, self.fp)
            cg.state[BETA] = ti.cast(0, self.fp)
            if cg.state[COUNT] > 0 and cg.state[STOPPED] == 0:
                cg.state[BETA] = rz / old
            if cg.state[STOPPED] == 0:
                cg.state[RZ] = rz
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            if cg.state[STOPPED] == 0:
                p = cg.z[0, i]
                if cg.state[BETA] != 0:  # else p is of another solve
                    p += cg.p[0, i] * cg.state[BETA]
                cg.p[0, i] = p
                at.w[0, i] = self.to(PRECISIONS[self.scene], p)

    @cached_property
    def turn(self) -> Kernel:
        """The next direction p = z + beta p."""
        own = dict(part="scalars2", state="scalars") | dict.fromkeys(("r", "z", "p"), "vectors2")
        arrays = dict(cg=own, at=dict(w=f"vectors2_{self.scene}"))
        return Kernel("turn", self.first, self.vectors, arrays, dict(chunks="int", length="int", nodes="int"))

    @ti.func
    def block(self, columns: A, k, v):
        """Block k, whose columns are given, times v."""
        return columns[0, k] * v[0] + columns[1, k] * v[1] + columns[2, k] * v[2]

    @ti.func
    def allowed(self, i, cg: A, q):
        """What vertex i may do of q; where next to nothing is free, once leaves as much rounding of what is held."""
        out = q * cg.free[i]
        if ti.static(self.guided):
            k = cg.guide[i]
            if k >= 0:
                for _ in ti.static(range(2)):
                    out += self.block(cg.held, k, out) * ti.cast(-1, self.fp)
        return out

    @ti.func
    def multiply(self, c, begin, end, cg: A, at: A):
        """A p, and p . A p, p . p, A p . A p of chunk c, which has the vertices from `begin` up to `end`."""
        curvature, pp, qq = ti.cast(0, self.fp), ti.cast(0, self.fp), ti.cast(0, self.fp)
        for i in range(begin, end):
            p = cg.p[0, i]
            q = p * cg.mass[i] + self.to(self.fp, at.y[0, i]) * ti.cast(-1, self.fp)
            if ti.static(self.more):
                for k in range(cg.start[i], cg.start[i + 1]):
                    q += self.block(cg.blocks, k, cg.p[0, cg.column[k]])
            q = self.allowed(i, cg, q)
            cg.q[0, i] = q
            curvature += self.dot(p, q)
            pp += self.dot(p, p)
            qq += self.dot(q, q)
        cg.part[0, c], cg.part[1, c], cg.part[2, c] = curvature, pp, qq

    @ti.func
    def choose(self, cg: A, plan: A):
        """alpha = r . z / p . A p, zero once it has stopped."""
        self.add_up(cg.part, 3, plan.chunks)
        curvature, size = cg.part[0, 0], ti.sqrt(cg.part[1, 0] * cg.part[2, 0])
        cg.state[ALPHA] = ti.cast(0, self.fp)
        if cg.state[STOPPED] == 0:
            cg.state[COUNT] = cg.state[COUNT] + ti.cast(1, self.fp)
            if curvature > plan.rounding * size:
                cg.state[ALPHA] = cg.state[RZ] / curvature
            else:
                cg.state[STOPPED] = ti.cast(2, self.fp)

    @ti.func
    def advance(self, cg: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            self.multiply(c, c * plan.length, ti.min((c + 1) * plan.length, plan.nodes), cg, at)
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.choose(cg, plan)
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            square, alpha = ti.cast(0, self.fp), cg.state[ALPHA]
            for i in range(c * plan.length, ti.min((c + 1) * plan.length, plan.nodes)):
                if alpha != 0:
                    x = cg.p[0, i] * alpha
                    if cg.state[COUNT] > 1:  # else x is of another solve
                        x += cg.x[0, i]
                    cg.x[0, i] = x
                    cg.r[0, i] = cg.r[0, i] + cg.q[0, i] * -alpha
                square += self.dot(cg.r[0, i], cg.r[0, i])
            cg.part[0, c] = square
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.add_up(cg.part, 1, plan.chunks)
            cg.state[SQUARE] = cg.part[0, 0]
            if cg.state[STOPPED] == 0 and cg.state[SQUARE] <= cg.state[LEAST]:
                cg.state[STOPPED] = ti.cast(1, self.fp)

    @cached_property
    def step(self) -> Kernel:
        """x and r after a step along p, y being what the potential's product makes of it."""
        own = dict(part="scalars2", state="scalars", mass="scalars", free="scalars")
        own |= dict.fromkeys(("x", "r", "p", "q"), "vectors2")
        own |= dict(guide="ints", held="vectors2") if self.guided else {}
        own |= dict(start="ints", column="ints", blocks="vectors2") if self.more else {}
        arrays = dict(cg=own, at=dict(y=f"vectors2_{self.scene}"))
        numbers = dict(chunks="int", length="int", nodes="int", rounding="float")
        return Kernel("step", self.advance, self.vectors, arrays, numbers)
