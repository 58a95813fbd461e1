"""Conjugate gradients on the device: of what crosses to the host, a few numbers every few iterations."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.runtime import PRECISIONS, Repeated, arch_name, array_types, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, SQUARE, STOPPED, CGKernels


class DeviceCG:
    """Solves A x = b for A = c M + d2E/du2 of a potential as `linear.conjugate_gradients` does. Vectors have float64 where
    the device has it.

    mass: c m; free: 1 where vertices move, else 0; both of shape (num_vertices, 1).
    cycle: the preconditioner, z = cycle(r) (cycle.py); None: `put_inverse` sets its blocks, one for each vertex. An
    iteration is one kernel, unless surfaces meet, and a launch makes many.
    """

    most_chunks, shortest = 256, 32
    many = 50  # iterations in a launch on one thread, which stops by itself

    def __init__(self, potential, cycle, parallel: bool):
        a, n = potential.arrays, potential.arrays.num_vertices
        self.potential, self.cycle, self.nodes = potential, cycle, n
        precision = "f64" if arch_name() != "vulkan" else "f32"
        self._vector, fp = array_types(precision)["vectors"].dtype, PRECISIONS[precision]
        self.length = max(self.shortest, -(-n // self.most_chunks))
        self.chunks = -(-n // self.length)
        self.x, self.r, self.z, self.p, self.q = (runtime.array(self._vector, 1, n) for _ in range(5))
        self.part, self.state = runtime.array(fp, 3, self.chunks), runtime.array(fp, 8)
        self.mass, self.free = runtime.array(fp, n), runtime.array(fp, n)
        kernels = kernels_of(CGKernels, a.precision, precision, parallel)
        self._sizes = dict(chunks=self.chunks, length=self.length, nodes=n)
        self._look = 1 if runs_on_cpu() else 10  # iterations between looks at the state
        lanes, own = runs_on_cpu(), dict(cg=self, at=potential)
        if cycle is None:
            self.inverse = runtime.array(self._vector, 3, n)
            own["blocks"] = self
            self._parts = [(kernels.scale, own, dict(nodes=n))]
        else:
            self._parts = cycle.parts(self)
        self._repeated, turn, step = None, (kernels.turn, own, self._sizes), (kernels.step, own, self._sizes)
        if potential.is_one_kernel:
            self._parts = [(kernels.wanted, own, {}), *self._parts, turn, (*potential.multiplying, None), step]
            self._repeated = Repeated("cg", [part[:2] for part in self._parts], parallel, lanes)
            self._look = self.many if runs_on_cpu() and not parallel else self._look
            return
        self._launches = [(kernel.bind(lanes, **records), sizes) for kernel, records, sizes in [*self._parts, turn]]
        self._step = kernels.step.bind(lanes, **own)

    def put_inverse(self, blocks: np.ndarray) -> None:
        """Set the preconditioner's blocks, shape (num_vertices, 3, 3)."""
        runtime.fill(self.inverse, np.moveaxis(blocks, 2, 0))

    def _iterate(self, times: int, rounding: float) -> None:
        if self._repeated:
            *sizes, last = [self.potential.sizes() if own is None else own for *_, own in self._parts]
            self._repeated(times, *sizes, last | dict(rounding=rounding))
            return
        for _ in range(times):
            for launch, sizes in self._launches:
                launch(**sizes)
            self.potential.multiply()
            self._step(**self._sizes, rounding=rounding)

    def __call__(self, mass, free, b: np.ndarray, tolerance: float, max_iterations: int, eps: float):
        """(x, relative residual, iterations, p or None), as `linear.conjugate_gradients`."""
        size = np.linalg.norm(b)
        if size == 0:
            return np.zeros_like(b), 0.0, 0, None
        runtime.fill(self.mass, mass[:, 0])
        runtime.fill(self.free, free[:, 0])
        runtime.fill(self.r, (b / size)[None])
        runtime.fill(self.x, 0)
        runtime.fill(self.p, 0)
        state = np.zeros(8)
        state[LEAST] = tolerance**2
        runtime.fill(self.state, state)
        done = 0
        while done < max_iterations:
            times = min(self._look, max_iterations - done)
            self._iterate(times, 10 * eps)
            done, state = done + times, runtime.fetch(self.state)
            if state[STOPPED] or not np.isfinite(state[SQUARE]):
                break
        if state[STOPPED] == 3:  # the preconditioner is not positive definite
            return np.zeros_like(b), np.inf, int(state[COUNT]), None
        if not np.isfinite(state[SQUARE]):
            raise FloatingPointError("the stiffness of this state is not finite")
        count, negative = int(state[COUNT]), None
        if state[STOPPED] == 2:
            negative = runtime.fetch_row(self.p, 0)
        x = runtime.fetch_row(self.x, 0) if count > 1 or negative is None else negative
        return x * size, float(np.sqrt(state[SQUARE])), count, negative
