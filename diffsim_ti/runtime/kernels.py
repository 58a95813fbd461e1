"""Kernels whose signatures are made from descriptions of their arrays, so that none is typed by hand."""

import linecache
from collections.abc import Callable
from functools import lru_cache
from itertools import count

import taichi as ti

from diffsim_ti.runtime.language import Bundle
from diffsim_ti.runtime.launch import Launch
from diffsim_ti.runtime.quadrants import QUADRANTS
from diffsim_ti.runtime.start import PRECISIONS, runs_on_cpu

if QUADRANTS:  # has a tracer of its own
    kernel = ti.kernel
else:
    from diffsim_ti.runtime.sources import kernel

LANES = 8  # tetrahedra in a block
ROWS = {3: ti.types.vector(4, ti.f32), 6: ti.types.vector(8, ti.f32)}  # three or six numbers of a preconditioner
_serial = count()


def array_types(precision: str) -> dict:
    """Taichi's annotation for each kind of array, and for numbers "int" and "float"."""
    fp = PRECISIONS[precision]
    vector, lanes = ti.types.vector(4, fp), ti.types.vector(LANES, fp)
    ndarray = ti.types.ndarray
    return {
        "ints": ndarray(ti.i32, 1),
        "scalars": ndarray(fp, 1),
        "scalars2": ndarray(fp, 2),
        "vectors": ndarray(vector, 1),
        "vectors2": ndarray(vector, 2),
        "blocks": ndarray(lanes, 1),
        "blocks2": ndarray(lanes, 2),
        "vectors2_f32": ndarray(ti.types.vector(4, ti.f32), 2),
        "vectors2_f64": ndarray(ti.types.vector(4, ti.f64), 2),
        "singles": ndarray(ti.f32, 1),
        "doubles": ndarray(ti.f64, 1),
        "rows3": ndarray(ROWS[3], 1),
        "rows6": ndarray(ROWS[6], 1),
        "int": ti.i32,
        "float": fp,
    }


class Kernel:
    """A Taichi kernel whose code is `body(*bundles, numbers)`; loops of the body are loops of the kernel.

    arrays: {bundle: {array: kind}}, kinds as in `array_types`; each bundle reaches the body as a `Bundle` of its arrays,
    and `numbers`, {name: "int" or "float"}, as one more.
    loops: so many of its first loops are gone through as often as the last number says (repeated_loops.py); 0: once.
    polished: also by Taichi's own passes (Launch).
    """

    def __init__(
        self,
        name: str,
        body: Callable,
        precision: str,
        arrays: dict[str, dict],
        numbers: dict[str, str],
        loops: int = 0,
        polished: bool = False,
    ):
        if "times" in numbers:  # which launches take from the last number, wherever who describes the kernel names it
            numbers = {n: kind for n, kind in numbers.items() if n != "times"} | dict(times=numbers["times"])
        self.arrays, self.numbers, self.options = arrays, tuple(numbers), dict(loops=loops, polished=polished)
        owner = getattr(body, "__self__", None)
        law = getattr(owner, "law", None) or getattr(getattr(owner, "element", None), "law", None)
        self.options["title"] = f"the kernel {name}" + (f" of {law.title}" if hasattr(law, "title") else "")
        types = array_types(precision)
        arguments = [(f"{b}_{a}", types[kind]) for b, own in arrays.items() for a, kind in own.items()]
        arguments += [(n, types[kind]) for n, kind in numbers.items()]
        bundles = [f"Bundle({', '.join(f'{a}={b}_{a}' for a in own)})" for b, own in arrays.items()]
        # a GPU takes one task more, of one thread, for the bounds of each loop, but one for all that are read before them
        first = [] if runs_on_cpu() else [n for n, kind in numbers.items() if kind == "int"]
        bundles.append(f"Bundle({', '.join(f'{n}={n}_' if n in first else f'{n}={n}' for n in numbers)})")
        signature = ", ".join(f"{argument}: types[{k}]" for k, (argument, _) in enumerate(arguments))
        lines = [*(f"{n}_ = {n}" for n in first), f"body({', '.join(bundles)})"]
        source = f"def {name}({signature}):\n" + "".join(f"    {line}\n" for line in lines)
        file = f"<{name} {next(_serial)}>"
        linecache.cache[file] = (len(source), None, source.splitlines(True), file)  # Taichi reads a kernel's source
        scope = dict(body=body, Bundle=Bundle, types=[kind for _, kind in arguments])
        exec(compile(source, file, "exec"), scope)
        self.kernel = kernel(scope[name])

    def bind(self, vectorized: bool = False, **records) -> Callable:
        """The kernel with its arrays bound; call it with the numbers, by name.

        records: for each bundle the object whose attributes its arrays are, or a tuple of objects that share them.
        """
        arrays = [_found(records[bundle], name) for bundle, own in self.arrays.items() for name in own]
        launch, names = Launch(self.kernel, *arrays, vectorized=vectorized, **self.options), self.numbers
        return lambda **numbers: launch(*map(numbers.__getitem__, names))


@lru_cache(maxsize=None)
def kernels_of(kind: type, *fields):
    """The object kind(*fields) that all share, so that its kernels compile once in a process."""
    return kind(*fields)


def _found(record, name: str):
    parts = record if type(record) is tuple else (record,)
    return next(getattr(part, name) for part in parts if hasattr(part, name))
