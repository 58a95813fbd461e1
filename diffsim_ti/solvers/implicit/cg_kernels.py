"""Kernels of conjugate gradients. Sums go over fixed chunks, then over these: the same bits with any number of threads."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, A, Kernel, as_kernel, runs_on_cpu

# places of numbers in `state`; STOPPED: 0 while it goes on, then 1 converged, 2 negative curvature, 3 r . z <= 0
RZ, BETA, ALPHA, SQUARE, STOPPED, COUNT, LEAST, LIMIT = range(8)
NUMBERS, ROOM = 8, 56  # of these; of those behind them, which are Newton's method's (newton_kernels.py), too
SUMS, SIZES = dict(part="scalars2", state="scalars2"), dict.fromkeys(("chunks", "length", "nodes", "systems"), "int")


@dataclass(frozen=True)
class CGKernels:
    """scene: precision of the products; vectors: that of all else; guided: whether vertices are fixed in some directions
    only; more: whether a matrix of blocks joins the potential's Hessian; several: whether there are several systems of equal
    size, one after the other, each with its row of `state` and as many chunks."""

    scene: str
    vectors: str
    parallel: bool
    guided: bool
    more: bool
    several: bool = False

    @property
    def fp(self):
        return PRECISIONS[self.vectors]

    @ti.func
    def dot(self, a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    @ti.func
    def add_up(self, part: A, rows: A, b, plan: A):
        """The first chunk c of system b; part[k, c] = the sum of what its chunks have left in each of so many rows k."""
        count = plan.chunks // plan.systems
        first = b * count
        if ti.static(self.at_once == 1):
            for c in range(first + 1, first + count):
                for k in ti.static(range(rows)):
                    part[k, first] = part[k, first] + part[k, c]
        else:
            whole = first + 1 + (count - 1) // self.at_once * self.at_once
            for k in ti.static(range(rows)):
                total, c = part[k, first], first + 1
                while c < whole:
                    for j in ti.static(range(self.at_once)):
                        total += part[k, c + j]
                    c += self.at_once
                for j in range(whole, first + count):
                    total += part[k, j]
                part[k, first] = total
        return first

    @property
    def at_once(self) -> int:
        """Numbers that a thread asks for before it waits for the first of them."""
        return 1 if runs_on_cpu() else 8

    @property
    def one_by_one(self) -> bool:
        """Whether a thread goes through all systems: where there are several, a card has a thread for each."""
        return not self.several or runs_on_cpu()

    @ti.func
    def system(self, i, count, plan: A):
        """Of which system an entry is, of so many of all."""
        b = 0
        if ti.static(self.several):
            b = i // (count // plan.systems)
        return b

    @ti.func
    def span(self, c, length, count, plan: A):
        """(first entry of a chunk with so many, the one after its last), of so many of all."""
        begin, end = c * length, ti.min((c + 1) * length, count)
        if ti.static(self.several):
            per, own = plan.chunks // plan.systems, count // plan.systems
            b = c // per
            begin = b * own + (c - b * per) * length
            end = ti.min(begin + length, (b + 1) * own)
        return begin, end

    @ti.func
    def to(self, fp: A, v):
        """A vector in another precision, number by number: Taichi has no vector code for this."""
        return ti.Vector([ti.cast(v[0], fp), ti.cast(v[1], fp), ti.cast(v[2], fp), ti.cast(0, fp)])

    def _kernel(self, name: str, body, numbers: dict, /, **arrays) -> Kernel:
        return Kernel(name, body, self.vectors, arrays, numbers)

    @as_kernel("wanted", {}, cg=dict(state="scalars2"))
    def wanted(self, cg: A, plan: A):
        """Whether a solve goes on, for `Repeated`."""
        wanted = cg.state[0, STOPPED] == 0
        if ti.static(self.several):
            for b in range(1, cg.state.shape[0]):
                if cg.state[b, STOPPED] == 0:
                    wanted = True
        return wanted

    @as_kernel("scale", dict(nodes="int"), cg=dict.fromkeys(("r", "z", "inverse"), "vectors2"))
    def scale(self, cg: A, plan: A):
        """z = D^-1 r; inverse: the columns of each block of D^-1."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            cg.z[0, i] = self.block(cg.inverse, i, cg.r[0, i])

    @as_kernel(
        "invert",
        dict(nodes="int"),
        cg=dict(free="scalars", inverse="vectors2"),
        body=dict(hard="ints", mass="scalars", least="scalars"),
        out=lambda self: dict(blocks=f"vectors2_{self.scene}"),
    )
    def invert(self, cg: A, body: A, out: A, plan: A):
        """D^-1 of each block of a stiffness with inertia; hard: whether it is less than `least`."""
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

    @as_kernel(
        "turn",
        SIZES,
        cg=SUMS | dict.fromkeys(("r", "z", "p"), "vectors2"),
        at=lambda self: dict(w=f"vectors2_{self.scene}") | (dict(skip="ints") if self.several else {}),
    )
    def turn(self, cg: A, at: A, plan: A):
        """The next direction p = z + beta p."""
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            rz = ti.cast(0, self.fp)
            begin, end = self.span(c, plan.length, plan.nodes, plan)
            for i in range(begin, end):
                rz += self.dot(cg.r[0, i], cg.z[0, i])
            cg.part[0, c] = rz
        ti.loop_config(serialize=self.one_by_one)
        for b in range(plan.systems):
            if cg.state[b, STOPPED] == 0:
                rz, old = cg.part[0, self.add_up(cg.part, 1, b, plan)], cg.state[b, RZ]
                cg.state[b, RZ] = rz
                cg.state[b, BETA] = ti.cast(0, self.fp)
                if not rz > 0:
                    cg.state[b, STOPPED] = ti.cast(3, self.fp)
                elif cg.state[b, COUNT] > 0:
                    cg.state[b, BETA] = rz / old
            if ti.static(self.several):
                at.skip[b] = ti.cast(cg.state[b, STOPPED], ti.i32)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            b = self.system(i, plan.nodes, plan)
            if cg.state[b, STOPPED] == 0:
                p = cg.z[0, i]
                if cg.state[b, BETA] != 0:  # else p is of another solve
                    p += cg.p[0, i] * cg.state[b, BETA]
                cg.p[0, i] = p
                at.w[0, i] = self.to(PRECISIONS[self.scene], p)

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
    def choose(self, b, cg: A, plan: A):
        """alpha = r . z / p . A p, unless p . A p is not positive."""
        c = self.add_up(cg.part, 3, b, plan)
        cg.state[b, COUNT] = cg.state[b, COUNT] + ti.cast(1, self.fp)
        if cg.part[0, c] > plan.rounding * ti.sqrt(cg.part[1, c] * cg.part[2, c]):
            cg.state[b, ALPHA] = cg.state[b, RZ] / cg.part[0, c]
        else:
            cg.state[b, STOPPED] = ti.cast(2, self.fp)

    @ti.func
    def go(self, c, b, cg: A, plan: A):
        """x and r of a chunk, and r . r."""
        square, alpha, count = ti.cast(0, self.fp), cg.state[b, ALPHA], cg.state[b, COUNT]
        begin, end = self.span(c, plan.length, plan.nodes, plan)
        for i in range(begin, end):
            x = cg.p[0, i] * alpha
            if count > 1:  # else x is of another solve
                x += cg.x[0, i]
            cg.x[0, i] = x
            cg.r[0, i] = cg.r[0, i] + cg.q[0, i] * -alpha
            square += self.dot(cg.r[0, i], cg.r[0, i])
        cg.part[0, c] = square

    def stepped(self) -> dict:
        """What a step reads and changes."""
        own = SUMS | dict(mass="scalars", free="scalars") | dict.fromkeys(("x", "r", "p", "q"), "vectors2")
        own |= dict(guide="ints", held="vectors2") if self.guided else {}
        return own | (dict(start="ints", column="ints", blocks="vectors2") if self.more else {})

    @as_kernel("step", SIZES | dict(rounding="float"), cg=stepped, at=lambda self: dict(y=f"vectors2_{self.scene}"))
    def step(self, cg: A, at: A, plan: A):
        """x and r after a step along p, y being what the potential's product makes of it."""
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            if cg.state[self.system(c, plan.chunks, plan), STOPPED] == 0:
                begin, end = self.span(c, plan.length, plan.nodes, plan)
                self.multiply(c, begin, end, cg, at)
        ti.loop_config(serialize=self.one_by_one)
        for b in range(plan.systems):
            if cg.state[b, STOPPED] == 0:
                self.choose(b, cg, plan)
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            b = self.system(c, plan.chunks, plan)
            if cg.state[b, STOPPED] == 0:
                self.go(c, b, cg, plan)
        ti.loop_config(serialize=self.one_by_one)
        for b in range(plan.systems):
            if cg.state[b, STOPPED] == 0:
                cg.state[b, SQUARE] = cg.part[0, self.add_up(cg.part, 1, b, plan)]
                if cg.state[b, SQUARE] <= cg.state[b, LEAST]:
                    cg.state[b, STOPPED] = ti.cast(1, self.fp)
