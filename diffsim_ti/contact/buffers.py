"""Arrays that grow and kernels bound to them, for lists whose length changes from build to build."""

from functools import lru_cache

import taichi as ti

from diffsim_ti import runtime

BLOCK = 256  # numbers that one thread sums


@lru_cache(maxsize=None)
def _scan_kernel(parallel: bool):
    ints = ti.types.ndarray(ti.i32, 1)

    @ti.kernel
    def scan(values: ints, sums: ints, count: ti.i32, blocks: ti.i32):
        """values[k] becomes the sum of those before k; values[count], which must be there, the sum of all."""
        ti.loop_config(serialize=not parallel)
        for b in range(blocks):
            total = 0
            for k in range(b * BLOCK, ti.min((b + 1) * BLOCK, count)):
                total += values[k]
            sums[b] = total
        ti.loop_config(serialize=True)
        for _ in range(1):
            total = 0
            for b in range(blocks):
                part = sums[b]
                sums[b] = total
                total += part
            values[count] = total
        ti.loop_config(serialize=not parallel)
        for b in range(blocks):
            total = sums[b]
            for k in range(b * BLOCK, ti.min((b + 1) * BLOCK, count)):
                part = values[k]
                values[k] = total
                total += part

    return scan


class Launches:
    """Kernels bound to arrays, each once: `launches(kernel, *arrays)(*numbers)`; they keep those arrays alive."""

    def __init__(self):
        self._bound = {}

    def __call__(self, kernel, *arrays, vectorized: bool = False) -> runtime.Launch:
        key = (id(kernel), *map(id, arrays))
        if key not in self._bound:
            self._bound[key] = runtime.Launch(kernel, *arrays, vectorized=vectorized)
        return self._bound[key]

    def clear(self) -> None:
        """Let go of the arrays."""
        self._bound.clear()


class Buffers:
    """Arrays that grow: `take` hands out one of at least the length asked for, by name."""

    def __init__(self, launch: Launches, parallel: bool):
        self._arrays, self._launch, self._kernel = {}, launch, _scan_kernel(parallel)

    def take(self, name: str, dtype, count: int):
        """The array of that name, made anew, half as long again, if it is too short; then nothing stays bound."""
        have = self._arrays.get(name)
        if have is None or have.shape[0] < count:
            self._arrays[name] = have = runtime.array(dtype, max(16, count + count // 2 if have is not None else count))
            self._launch.clear()
        return have

    def scan(self, values, count: int) -> None:
        """Exclusive sums in place, over count + 1 numbers, the last of them the sum of all."""
        blocks = -(-count // BLOCK)
        self._launch(self._kernel, values, self.take(f"sums of {count}", ti.i32, blocks))(count, blocks)
