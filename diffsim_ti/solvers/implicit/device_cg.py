"""Conjugate gradients on the device: of what crosses to the host, a few numbers every few iterations."""

import math
from collections.abc import Callable

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Mass
from diffsim_ti.mechanics.supports.free import Free, FreeDirections, mask_of
from diffsim_ti.runtime import PRECISIONS, Repeated, arch_name, array_types, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, LIMIT, ROOM, SQUARE, STOPPED, CGKernels


class DeviceCG:
    """Solves A x = b for A = c M + d2E/du2 of a potential as `linear.conjugate_gradients` does. Vectors have float64 where
    the device has it.

    free: what vertices may do (free.py); of sets that move by few numbers it keeps arrays alone, for rounds.py.
    cycle: the preconditioner, z = cycle(r) (cycle.py); None: `put_inverse` sets its blocks, one for each vertex.
    An iteration is one kernel, but on Vulkan, and a launch makes many.
    """

    # how many; whether there may be more than one; whether a thread takes one of them at a time
    systems, several, by_scene = 1, False, False
    many = 50  # iterations in a launch on one thread, which stops by itself
    ahead = 16  # iterations before a card is asked for the residual

    def __init__(self, potential, cycle, free: Free, parallel: bool):
        n = potential.arrays.num_vertices
        self.potential, self.cycle, self.nodes, self.parallel = potential, cycle, n, parallel
        self.precision = "f64" if arch_name() != "vulkan" else "f32"
        self._vector, fp = array_types(self.precision)["vectors"].dtype, PRECISIONS[self.precision]
        # on a card a thread waits for each entry of its chunk in turn, then one for chunks, eight at a time
        on_card = max(8, math.isqrt(n // self.systems) // 6)
        self.length = max(32, -(-n // max(256, self.systems))) if runs_on_cpu() else on_card
        self.chunks = self.systems * -(-n // (self.systems * self.length))
        self.x, self.r, self.z, self.p, self.q = (runtime.array(self._vector, 1, n) for _ in range(5))
        self.part, self.state = runtime.array(fp, 6, self.chunks), runtime.array(fp, self.systems, ROOM)
        self.mass, self.free = runtime.array(fp, n), runtime.array(fp, n)
        runtime.fill(self.free, mask_of(free)[:, 0])
        self.guided = isinstance(free, FreeDirections)
        if self.guided:
            guide = np.full(n, -1)
            guide[free.partly_fixed] = np.arange(len(free.partly_fixed))
            self.guide, self.held = runtime.upload(guide, ti.i32), self._columns(free.sliding_supports)
        if cycle is None:
            self.inverse = runtime.array(self._vector, 3, n)
        self._sizes = dict(chunks=self.chunks, length=self.length, nodes=n, systems=self.systems)
        self.is_one_kernel = self.by_scene or Repeated.is_possible(parallel)
        whole = runs_on_cpu() and not parallel
        # iterations between looks at the state; on a card as many as seem to be left
        self._look = self.many if whole else 1 if runs_on_cpu() else 0
        # (with a matrix, convex) -> iterate(times, rounding), what tells whether arrays are others
        self._iterations, self._served = {}, None
        self._room = -1  # blocks of that matrix
        self._filled: np.ndarray | None = None  # what `mass` holds

    def _columns(self, blocks: np.ndarray, room: int = 0):
        """Blocks, shape (k, 3, 3), by columns on the device, with room for more."""
        out = runtime.array(self._vector, 3, max(len(blocks), room, 1))
        self._fill(out, blocks)
        return out

    def _fill(self, columns, blocks: np.ndarray) -> None:
        padded = np.zeros((3, columns.shape[1], 3))
        padded[:, : len(blocks)] = np.moveaxis(blocks, 2, 0)
        runtime.fill(columns, padded)

    def put_inverse(self, blocks: np.ndarray) -> None:
        """Set the preconditioner's blocks, shape (num_vertices, 3, 3)."""
        self._fill(self.inverse, blocks)

    def _put(self, more) -> None:
        """A matrix of blocks that joins the Hessian."""
        more = more.tobsr((3, 3))
        if len(more.data) > self._room:
            self._room = max(2 * len(more.data), 1)
            self._iterations = {kind: own for kind, own in self._iterations.items() if not kind[0]}
            self.start, self.column = runtime.array(ti.i32, self.nodes + 1), runtime.array(ti.i32, self._room)
            self.blocks = self._columns(more.data, self._room)
        self._fill(self.blocks, more.data)
        runtime.fill(self.start, more.indptr)
        runtime.fill(self.column, np.pad(more.indices, (0, self._room - len(more.indices))))

    def parts(self, more: bool, products: list) -> list:
        """An iteration, as [(kernel, records, numbers)] of `Repeated`; products: those of the potential."""
        potential, own = self.potential, dict(cg=self, at=self.potential)
        how = potential.arrays.precision, self.precision, self.parallel and not self.by_scene, self.guided, more
        kernels = kernels_of(CGKernels, *how, self.several and not self.by_scene)
        before = self.cycle.parts(self) if self.cycle else [(kernels.scale, own, None)]
        before = [(kernels.wanted, own, None), *before, (kernels.turn, own, None)]
        return [*before, *products, (kernels.step, own, None)]

    def serve(self, iterate: Callable) -> None:
        """Let what serves Newton's method, too, make iterations: (times, rounding) -> so many."""
        self._served = iterate

    def _iteration(self, more: bool, convex: bool, products: list):
        """(times, rounding) -> so many iterations."""
        parts, potential, lanes = self.parts(more, products), self.potential, runs_on_cpu()
        if self.is_one_kernel:
            repeated = potential.repeated("cg", [parts], self.parallel)
            return lambda times, rounding: repeated(times, **potential.sizes(), **self._sizes, rounding=rounding)
        launches = [
            (kernel.bind(lanes, **records), numbers or self._sizes)
            for kernel, records, numbers in parts[1 : -1 - len(products)]
        ]
        step = parts[-1][0].bind(lanes, **parts[-1][1])

        def iterate(times: int, rounding: float) -> None:
            for _ in range(times):
                for launch, numbers in launches:
                    launch(**numbers)
                potential.multiply(convex)
                step(**self._sizes, rounding=rounding)

        return iterate

    def put_mass(self, mass: Mass) -> None:
        """c m, shape (num_vertices, 1)."""
        if mass is not self._filled:
            runtime.fill(self.mass, mass[:, 0])
            self._filled = mass

    def iterations(self, more: bool, convex: bool) -> Callable:
        """(times, rounding) -> so many iterations; more: whether a matrix joins the Hessian."""
        if self._served and not (more or convex):
            return self._served
        kept = self._iterations.get((more, convex))
        if kept is None or kept[1] != self.version:
            made = self._iteration(more, convex, self.potential.multiplying(convex))
            kept = self._iterations[more, convex] = made, self.version
        return kept[0]

    @property
    def version(self) -> tuple | None:
        """Of the arrays that grow."""
        pairs = self.potential.pairs
        return pairs and (pairs.version, self.cycle and self.cycle.renewals)

    def iterate(self, state: np.ndarray, left: int, eps: float, more: bool = False, convex: bool = False) -> None:
        """Some of so many iterations that are left; state: rows of the systems that go on."""
        self.iterations(more, convex)(min(self._look or self._left(state), left), 10 * eps)

    def _left(self, state: np.ndarray) -> int:
        """Iterations that are left if the residual, which was 1, goes on to fall as it did; at most `ahead`."""
        count, square, least = (state[:, k] for k in (COUNT, SQUARE, LEAST))
        with np.errstate(divide="ignore", invalid="ignore"):
            left = count * (np.log(least) / np.log(square) - 1)
        return int(np.clip(np.ceil(np.where((count > 0) & (square < 1), left, count).max()), 1, self.ahead))

    def put_system(self, mass: Mass, more) -> None:
        """Bring the mass and the matrix of a system, if it has one, to the device."""
        if more is not None:
            self._put(more)
        self.put_mass(mass)

    def __call__(
        self, mass: Mass, more, convex: bool, b: np.ndarray, tolerance: float, max_iterations: int, eps: float
    ):
        """(x, relative residual, iterations, p or None), as `linear.conjugate_gradients`. A system that meets a direction of
        negative curvature has the x before it or, if it is the first, the preconditioned b.

        mass: c m, shape (num_vertices, 1); more: a SciPy matrix that joins A, or None; convex: of contact between surfaces
        only its convex part.
        """
        self.put_system(mass, more)
        size, state, done = math.sqrt(np.vdot(b, b)), np.zeros((1, ROOM)), 0
        if not size > 0:
            return np.zeros_like(b), 0.0, 0, None
        runtime.fill(self.r, (b / size)[None])
        state[0, LEAST], state[0, LIMIT] = tolerance**2, max_iterations
        runtime.fill(self.state, state)
        while done < max_iterations and state[0, STOPPED] == 0 and math.isfinite(state[0, SQUARE]):
            self.iterate(state, max_iterations - done, eps, more is not None, convex)
            state = runtime.look(self.state)
            done = max(done + 1, int(state[0, COUNT]))
        count, stopped, square = int(state[0, COUNT]), state[0, STOPPED], float(state[0, SQUARE])
        if stopped == 3:  # the preconditioner is not positive definite
            return np.zeros_like(b), np.inf, count, None
        if not math.isfinite(square):
            raise FloatingPointError("the stiffness of this state is not finite")
        p = runtime.fetch_row(self.p, 0) if stopped == 2 else None
        x = p if p is not None and count == 1 else runtime.fetch_row(self.x, 0)
        return size * x if count else np.zeros_like(b), math.sqrt(square), count, p
