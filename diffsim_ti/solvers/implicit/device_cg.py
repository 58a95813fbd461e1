"""Conjugate gradients on the device: of what crosses to the host, a few numbers every few iterations."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.runtime import PRECISIONS, arch_name, array_types, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, SQUARE, STOPPED, CGKernels


class DeviceCG:
    """Solves A x = b for A = c M + d2E/du2 of a potential, with a cycle as preconditioner (cycle.py), as
    `linear.conjugate_gradients` does. Vectors have float64 where the device has it.

    mass: c m; free: 1 where vertices move, else 0; both of shape (num_vertices, 1).
    """

    most_chunks, shortest = 256, 32

    def __init__(self, potential, cycle, parallel: bool):
        a, n = potential.arrays, potential.arrays.num_vertices
        self.potential, self.cycle, self.nodes = potential, cycle, n
        precision = "f64" if arch_name() != "vulkan" else "f32"
        vector, fp = array_types(precision)["vectors"].dtype, PRECISIONS[precision]
        self.length = max(self.shortest, -(-n // self.most_chunks))
        self.chunks = -(-n // self.length)
        self.x, self.r, self.z, self.p, self.q = (runtime.array(vector, 1, n) for _ in range(5))
        self.part, self.state = runtime.array(fp, 3, self.chunks), runtime.array(fp, 8)
        self.mass, self.free = runtime.array(fp, n), runtime.array(fp, n)
        kernels = kernels_of(CGKernels, a.precision, precision, parallel)
        lanes = runs_on_cpu() and a.precision == precision  # Taichi has no vector code for changes of precision
        self._turn = kernels.turn.bind(lanes, cg=self, at=potential)
        self._step = kernels.step.bind(lanes, cg=self, at=potential)
        self._look = 1 if runs_on_cpu() else 10  # iterations between looks at the state
        self._sizes = dict(chunks=self.chunks, length=self.length, nodes=n)

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
        for k in range(1, max_iterations + 1):
            self.cycle(self, 1.0)
            self._turn(**self._sizes)
            self.potential.multiply()
            self._step(**self._sizes, rounding=10 * eps)
            if k % self._look == 0 or k == max_iterations:
                state = runtime.fetch(self.state)
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
