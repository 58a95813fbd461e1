"""Conjugate gradients of all scenes of a batch at once: each has its own numbers alpha, beta and end."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.energy.kernels import PotentialKernels
from diffsim_ti.runtime import PRECISIONS, Kernel, Piecewise, kernels_of
from diffsim_ti.solvers.implicit.cg_kernels import ALPHA, BETA, COUNT, LEAST, RZ, SQUARE, STOPPED, CGKernels
from diffsim_ti.solvers.implicit.device_cg import DeviceCG

A = ti.template()
DONE, NEGATIVE = 1, 2  # values of STOPPED
COUNTS = "nodes", "below", "chunks", "num_items", "num_tetrahedra", "num_vertices"  # of all scenes


@dataclass(frozen=True)
class JoinedCGKernels(CGKernels):
    """Row b of `state` is that of scene b; each has as many chunks of `length` vertices."""

    @ti.func
    def is_wanted(self, cg: A, plan: A):
        wanted = False
        for b in range(cg.state.shape[0]):
            if cg.state[b, STOPPED] == 0:
                wanted = True
        return wanted

    @cached_property
    def wanted(self) -> Kernel:
        return Kernel("wanted", self.is_wanted, self.vectors, dict(cg=dict(state="scalars2")), {})

    @ti.func
    def end_of(self, c, chunks, plan: A):
        """(first vertex of a chunk, the one after its last), of scenes with so many chunks."""
        b, nodes = c // chunks, plan.nodes // (plan.chunks // chunks)
        first = b * nodes + (c - b * chunks) * plan.length
        return first, ti.min(first + plan.length, (b + 1) * nodes)

    @ti.func
    def sum_of(self, part: A, k, b, chunks):
        out = ti.cast(0, self.fp)
        for c in range(b * chunks, (b + 1) * chunks):
            out += part[k, c]
        return out

    @ti.func
    def first(self, cg: A, at: A, plan: A):
        scenes = cg.state.shape[0]
        chunks = plan.chunks // scenes
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            rz = ti.cast(0, self.fp)
            begin, end = self.end_of(c, chunks, plan)
            for i in range(begin, end):
                rz += self.dot(cg.r[0, i], cg.z[0, i])
            cg.part[0, c] = rz
        ti.loop_config(serialize=True)
        for b in range(scenes):
            if cg.state[b, STOPPED] == 0:
                rz, old = self.sum_of(cg.part, 0, b, chunks), cg.state[b, RZ]
                cg.state[b, BETA] = ti.cast(0, self.fp)
                cg.state[b, RZ] = rz
                if not rz > 0:
                    cg.state[b, STOPPED] = ti.cast(3, self.fp)
                elif cg.state[b, COUNT] > 0:
                    cg.state[b, BETA] = rz / old
            at.skip[b] = ti.cast(cg.state[b, STOPPED], ti.i32)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            b = i // (plan.nodes // scenes)
            if cg.state[b, STOPPED] == 0:
                p = cg.z[0, i]
                if cg.state[b, BETA] != 0:
                    p += cg.p[0, i] * cg.state[b, BETA]
                cg.p[0, i] = p
                at.w[0, i] = self.to(PRECISIONS[self.scene], p)

    @cached_property
    def turn(self) -> Kernel:
        own = dict(part="scalars2", state="scalars2") | dict.fromkeys(("r", "z", "p"), "vectors2")
        arrays = dict(cg=own, at=dict(w=f"vectors2_{self.scene}", skip="ints"))
        return Kernel("turn", self.first, self.vectors, arrays, dict(chunks="int", length="int", nodes="int"))

    @ti.func
    def advance(self, cg: A, at: A, plan: A):
        scenes = cg.state.shape[0]
        chunks = plan.chunks // scenes
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            if cg.state[c // chunks, STOPPED] == 0:
                begin, end = self.end_of(c, chunks, plan)
                self.multiply(c, begin, end, cg, at)
        ti.loop_config(serialize=True)
        for b in range(scenes):
            if cg.state[b, STOPPED] == 0:
                curvature = self.sum_of(cg.part, 0, b, chunks)
                size = ti.sqrt(self.sum_of(cg.part, 1, b, chunks) * self.sum_of(cg.part, 2, b, chunks))
                cg.state[b, COUNT] = cg.state[b, COUNT] + ti.cast(1, self.fp)
                if curvature > plan.rounding * size:
                    cg.state[b, ALPHA] = cg.state[b, RZ] / curvature
                else:
                    cg.state[b, STOPPED] = ti.cast(NEGATIVE, self.fp)
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            b = c // chunks
            if cg.state[b, STOPPED] == 0:
                square, alpha = ti.cast(0, self.fp), cg.state[b, ALPHA]
                begin, end = self.end_of(c, chunks, plan)
                for i in range(begin, end):
                    x = cg.p[0, i] * alpha
                    if cg.state[b, COUNT] > 1:  # else x is of another solve
                        x += cg.x[0, i]
                    cg.x[0, i] = x
                    cg.r[0, i] = cg.r[0, i] + cg.q[0, i] * -alpha
                    square += self.dot(cg.r[0, i], cg.r[0, i])
                cg.part[0, c] = square
        ti.loop_config(serialize=True)
        for b in range(scenes):
            if cg.state[b, STOPPED] == 0:
                cg.state[b, SQUARE] = self.sum_of(cg.part, 0, b, chunks)
                if cg.state[b, SQUARE] <= cg.state[b, LEAST]:
                    cg.state[b, STOPPED] = ti.cast(DONE, self.fp)

    @cached_property
    def step(self) -> Kernel:
        arrays = super().step.arrays
        arrays = arrays | dict(cg=arrays["cg"] | dict(state="scalars2"))
        numbers = dict(chunks="int", length="int", nodes="int", rounding="float")
        return Kernel("step", self.advance, self.vectors, arrays, numbers)


# what scenes share, or is found by what `start` says, in kernels of one scene
WHOLE = {(m, a) for m in ("level", "down", "up", "inverse") for a in ("column", "values")}
WHOLE |= {("cg", "column"), ("cg", "blocks"), ("cg", "held"), ("scene", "corner_of"), ("at", "rate")}
# which of their numbers are places in which arrays
COUNTING = {("level", "column"): ("level", "x"), ("down", "column"): ("level", "x"), ("up", "column"): ("below", "x")}
COUNTING |= {("inverse", "column"): ("level", "x"), ("cg", "column"): ("cg", "x"), ("scene", "tets"): ("at", "u")}
COUNTING |= {("scene", "corner_of"): ("scene", "corner")}


class JoinedCG(DeviceCG):
    """Solves A x = b of all scenes; a scene that is not `going` keeps x = 0. On the processor a thread takes a scene to its
    end, while its arrays lie in the caches: from 64 scenes of 750 tetrahedra on twice as fast as all scenes in turns."""

    kernels_kind = JoinedCGKernels  # where each loop goes through all scenes

    def __init__(self, potential, cycle, free, parallel: bool):
        super().__init__(potential, cycle, free, parallel)
        scenes = self.scenes = potential.arrays.num_scenes
        n, self.by_scene = self.nodes // scenes, potential.arrays.by_scene
        self.length = max(self.shortest, -(-n // max(self.most_chunks // scenes, 1)))
        self.chunks = scenes * -(-n // self.length)
        fp = PRECISIONS[self.precision]
        self.part = runtime.array(fp, 3, self.chunks)
        self.state = runtime.array(fp, *([scenes * 8] if self.by_scene else [scenes, 8]))
        self._sizes = dict(chunks=self.chunks, length=self.length, nodes=self.nodes)
        self._look = self.many if self.by_scene else 0

    def _iteration(self, more: bool, convex: bool, products: list):
        if not self.by_scene:
            return super()._iteration(more, convex, products)
        a, own, per = self.potential.arrays, dict(cg=self, at=self.potential), self.scenes
        kernels = kernels_of(CGKernels, a.precision, self.precision, False, self.guided, more)
        before = self.cycle.parts(self) if self.cycle else [(kernels.scale, own, dict(nodes=self.nodes))]
        product = kernels_of(PotentialKernels, a.law, a.features().of_state(), False, a.in_lanes).product
        parts = [(kernels.wanted, own, {}), *before, (kernels.turn, own, self._sizes)]
        parts += [(product, products[0][1], self.potential.sizes()), (kernels.step, own, self._sizes)]
        whole = WHOLE | ({("scene", "coefficients")} if a.features().uniform else set())
        run = Piecewise("cg_of_scenes", [x[:2] for x in parts], per, whole, COUNTING, True)
        each = [{n: x // per if n in COUNTS else x for n, x in numbers.items()} for _, _, numbers in parts]
        last = dict(each.pop())
        return lambda times, rounding: run(
            times, *each[:-1], each[-1] | dict(per_gamma=self.potential.per_gamma), last | dict(rounding=rounding)
        )

    def __call__(self, mass, more, b, tolerances, going, max_iterations: int, eps: float):
        """(x, solved, negative, iterations of each scene): b of shape (scenes n, 3); tolerances, going: (scenes,). A scene
        that meets a direction of negative curvature has the x before it or, if it is the first, the preconditioned b."""
        rows = b.reshape(self.scenes, -1)
        size = np.linalg.norm(rows, axis=1)
        wanted = going & (size > 0)
        self.put_system(mass, more)
        run = self.iterations(more is not None, False)
        scaled = rows / np.where(wanted, size, np.inf)[:, None]
        runtime.fill(self.r, scaled.reshape(1, -1, 3))
        state = np.zeros((self.scenes, 8))
        state[:, LEAST], state[:, STOPPED] = tolerances**2, ~wanted
        runtime.fill(self.state, state.reshape(self.state.shape))
        done = 0
        while done < max_iterations and not state[:, STOPPED].all():
            times = min(self._look or max(4, self.last - done), max_iterations - done)
            run(times, 10 * eps)
            done, state = done + times, runtime.fetch(self.state).reshape(state.shape)
        count, ended = state[:, COUNT].astype(int), state[:, STOPPED] == DONE
        self.last = int(count.max(initial=1))
        negative, known = wanted & (state[:, STOPPED] == NEGATIVE), wanted & (count > 0)
        x, first = (runtime.fetch_row(own, 0).reshape(self.scenes, -1) for own in (self.x, self.p))
        x = np.where((negative & (count == 1))[:, None], first, x) * size[:, None]
        return np.where(known[:, None], x, 0.0).reshape(-1, 3), ended | ~wanted, negative, count
