"""Arrays that grow and kernels bound to them, for lists whose length changes from build to build."""

import math
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime import A, Kernel, kernels_of

BLOCK = 256  # numbers that one thread sums
Parts = list[tuple]  # kernels to launch one after the other: (kernel, records, numbers)


def branches(count: int) -> dict[str, int]:
    """How `count` sums come together: `size` of them by each of `number` threads, and those on one.

    On a GPU both are about the root of `count`; a CPU's thread is quicker alone.
    """
    size = max(1, count if runtime.runs_on_cpu() else math.isqrt(count))
    return dict(size=size, number=-(-count // size))


@dataclass(frozen=True)
class Scan:
    """Sums of the numbers before each: up a tree of three levels and down again."""

    parallel: bool

    @ti.func
    def scan(self, of: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for b in range(plan.blocks):
            total = 0
            for k in range(b * BLOCK, ti.min((b + 1) * BLOCK, plan.count)):
                total += of.values[k]
            of.sums[b] = total
        ti.loop_config(serialize=ti.static(runtime.runs_on_cpu()))
        for c in range(plan.number):
            total = 0
            for b in range(c * plan.size, ti.min((c + 1) * plan.size, plan.blocks)):
                total += of.sums[b]
            of.sums[plan.blocks + c] = total
        ti.loop_config(serialize=True)
        for _ in range(1):
            total = 0
            for c in range(plan.blocks, plan.blocks + plan.number):
                part = of.sums[c]
                of.sums[c] = total
                total += part
            of.values[plan.count] = total
        ti.loop_config(serialize=ti.static(runtime.runs_on_cpu()))
        for c in range(plan.number):
            total = of.sums[plan.blocks + c]
            for b in range(c * plan.size, ti.min((c + 1) * plan.size, plan.blocks)):
                part = of.sums[b]
                of.sums[b] = total
                total += part
        ti.loop_config(serialize=not self.parallel)
        for b in range(plan.blocks):
            total = of.sums[b]
            for k in range(b * BLOCK, ti.min((b + 1) * BLOCK, plan.count)):
                part = of.values[k]
                of.values[k] = total
                total += part

    @cached_property
    def kernel(self) -> Kernel:
        """values[k] becomes the sum of those before k; values[count], which must be there, the sum of all."""
        arrays = dict(of=dict(values="ints", sums="ints"))
        numbers = dict.fromkeys(("count", "blocks", "size", "number"), "int")
        return Kernel("scan", self.scan, "f64", arrays, numbers)  # whatever the precision


class Launches:
    """Kernels bound to arrays, each once: `launches(kernel, **records)(**numbers)`; they keep those arrays alive.

    Arrays of a SimpleNamespace may be others in each call; those of other records must stay, or be followed by `clear`.
    """

    def __init__(self):
        self._bound = {}

    def __call__(self, kernel: Kernel, vectorized: bool = False, **records):
        key = [id(kernel)]
        for record in records.values():
            for part in record if type(record) is tuple else (record,):
                key += map(id, vars(part).values()) if type(part) is SimpleNamespace else (id(part),)
        bound = self._bound.get(tuple(key))
        if bound is None:
            bound = self._bound[tuple(key)] = kernel.bind(vectorized, **records)
        return bound

    def run(self, parts) -> None:
        """Launch (kernel, records, numbers), one after the other."""
        for kernel, records, numbers in parts:
            self(kernel, **records)(**numbers)

    def clear(self) -> None:
        """Let go of the arrays."""
        self._bound.clear()


def whole(source) -> np.ndarray:
    """All components of an array, on the CPU without a copy."""
    host = runtime.view(source)
    return source.to_numpy() if host is None else host


def put(array, data: np.ndarray) -> None:
    """Copy numbers, or vectors by rows, to where an array begins."""
    host = runtime.view(array)
    if host is None:
        padded = np.zeros((array.shape[0], *data.shape[1:]), data.dtype)
        padded[: len(data)] = data
        runtime.fill(array, padded)
    elif data.ndim > 1:
        host[: len(data), : data.shape[1]] = data
    else:
        host[: len(data)] = data


class Buffers:
    """Arrays that grow: `take` hands out one of at least the length asked for, by name."""

    def __init__(self, launch: Launches, parallel: bool):
        self._arrays, self._launch, self._scan = {}, launch, kernels_of(Scan, parallel).kernel
        self.renewals = 0  # arrays that were made anew

    def take(self, name: str, dtype, count: int, least: int = 16):
        """The array of that name, made anew, half as long again, if it is too short; then nothing stays bound."""
        have = self._arrays.get(name)
        if have is None or have.shape[0] < count:
            self._arrays[name] = have = runtime.array(
                dtype, max(least, count + count // 2 if have is not None else count)
            )
            self._launch.clear()
            self.renewals += 1
        return have

    def scan(self, values, count: int) -> None:
        """Exclusive sums in place, over count + 1 numbers, the last of them the sum of all."""
        blocks = -(-count // BLOCK)
        upper = branches(blocks)
        of = SimpleNamespace(values=values, sums=self.take(f"sums of {count}", ti.i32, blocks + upper["number"]))
        self._launch(self._scan, of=of)(count=count, blocks=blocks, **upper)
